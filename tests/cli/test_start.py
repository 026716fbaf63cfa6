"""The start of the package and of the command line: what is imported, and where compiled code is kept."""

import ast
import json
import os
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
