"""The start of the package and of the command line: what is imported, and where compiled code is kept."""

import ast
import json
import math
import os
import shutil
import subprocess
import sys

import pytest
from conftest import ROOT

import romandask

HEAVY = {
    "astropy",
    "camb",
    "dask",
    "distributed",
    "galsim",
    "glass",
    "h5py",
    "hats",
    "healpy",
    "matplotlib",
    "numba",
    "numpy",
    "pandas",
    "pyarrow",
    "scipy",
    "treecorr",
    "xarray",
    "zarr",
}
"""Libraries that take time to import."""
REPORT = "import atexit, json, sys; atexit.register(lambda: print(json.dumps(sorted(sys.modules)), file=sys.stderr))\n"
KERNEL = """
import json, multiprocessing, tempfile

def cache_of_a_kernel():
    import numba
    from romandask.kernels.universe.dust import exp_minus
    return [exp_minus(0.5), numba.config.CACHE_DIR, sum(exp_minus.stats.cache_hits.values())]

if __name__ == "__main__":
    first = cache_of_a_kernel()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        print(json.dumps([first, pool.apply(cache_of_a_kernel)]))
"""
COMMAND = "import sys; sys.argv = {}; from romandask.cli.main import main; main()"


def imported(code: str, **environment: str) -> tuple[set[str], str]:
    """Return the modules that a program imports, and its output."""
    done = subprocess.run(
        [sys.executable, "-c", REPORT + code],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return set(json.loads(done.stderr.splitlines()[-1])), done.stdout


def test_the_import_of_the_package_imports_no_library():
    modules, _ = imported("import romandask")
    assert HEAVY & modules == set()
    assert {"typer", "rich", "yaml"}.isdisjoint(modules)
    assert {name for name in modules if name.startswith("romandask")} == {"romandask"}


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--help"], "Make and read a joint synthetic sky survey"),
        (["--version"], romandask.__version__),
        (["run", "--help"], "--retry-failed"),
        (["export", "--help"], "Write the area on the sky of exposures and tiles"),
    ],
)
def test_help_and_version_import_no_library(words, text):
    modules, output = imported(COMMAND.format(["romandask", *words]), COLUMNS="200")
    assert text in output
    assert HEAVY & modules == set()


@pytest.mark.parametrize(
    ("words", "completed"), [("re", ["report", "reference"]), ("export ps", ["psf"]), ("run --dry", ["--dry-run"])]
)
def test_the_completion_of_a_shell_imports_no_library(words, completed):
    count = str(len(words.split()))
    modules, output = imported(
        COMMAND.format(["romandask"]),
        _ROMANDASK_COMPLETE="complete_bash",
        COMP_WORDS=f"romandask {words}",
        COMP_CWORD=count,
    )
    assert output.split() == completed
    assert HEAVY & modules == set()


def test_public_names_are_there_for_users_and_for_type_checkers():
    assert set(romandask.__all__) <= set(dir(romandask))
    for name in romandask.__all__:
        assert getattr(romandask, name) is not None
    (block,) = (
        node
        for node in ast.parse((ROOT / "romandask" / "__init__.py").read_text()).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    typed = {alias.asname or alias.name: node.module for node in block.body for alias in node.names}
    assert typed == romandask._MODULES
    assert sorted(typed) == sorted(romandask.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        romandask.nothing  # noqa: B018


@pytest.fixture(scope="module")
def unwritable(tmp_path_factory):
    """A copy of the package that takes no compiled code: files are where its cache folders would be, even for root."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(ROOT / "romandask", folder / "romandask", ignore=shutil.ignore_patterns("__pycache__"))
    for path in [folder / "romandask", *(folder / "romandask").rglob("*")]:
        if path.is_dir():
            (path / "__pycache__").write_text("")
    (folder / "kernel.py").write_text(KERNEL)
    return folder


def run_kernel(site, **environment: str):
    """Return value, cache folder and number of loads from the cache, in a process and in one that it starts."""
    clean = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    done = subprocess.run(
        [sys.executable, str(site / "kernel.py")],
        # the home is below a file, where no folder can be made
        env=clean | {"PYTHONPATH": str(site), "HOME": str(site / "kernel.py" / "home")} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
def test_compiled_code_is_kept_in_the_first_place_that_can_be_written(unwritable, tmp_path):
    cache, temporary = tmp_path / "cache", tmp_path / "tmp"
    temporary.mkdir()
    places = {
        cache / "romandask" / "numba": {"XDG_CACHE_HOME": str(cache), "TMPDIR": str(temporary)},
        temporary / f"romandask-{os.getuid()}" / "numba": {"TMPDIR": str(temporary)},
    }
    for place, environment in places.items():
        own, other = run_kernel(unwritable, **environment)
        assert own == [pytest.approx(math.exp(-0.5), rel=1e-6), str(place), 0]
        # the process that it starts loads what it has compiled
        assert other == [own[0], str(place), 1]
        assert [*place.rglob("dust.exp_minus*.nbc")]
    assert temporary.joinpath(f"romandask-{os.getuid()}").stat().st_mode & 0o777 == 0o700


@pytest.mark.slow
def test_kernels_work_where_nothing_can_be_written(unwritable, tmp_path):
    """A folder of the temporary folder that others may write is not used, because what is cached is executed."""
    (tmp_path / f"romandask-{os.getuid()}").mkdir()
    (tmp_path / f"romandask-{os.getuid()}").chmod(0o777)
    own, other = run_kernel(unwritable, TMPDIR=str(tmp_path))
    assert own == other == [pytest.approx(math.exp(-0.5), rel=1e-6), "", 0]
    assert not [*tmp_path.rglob("*.nbc")]
