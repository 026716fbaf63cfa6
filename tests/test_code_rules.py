"""The code's own rules: linter, types, layers, and prose that names real things."""

import ast
import graphlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from conftest import ROOT

from romandask.report.reference import reference

PACKAGE = ROOT / "romandask"
ROOMS = (
    "cli",
    "report",
    "export",
    "run",
    "survey",
    "survey_repr",
    "survey_graph",
    "stage_graph",
    "stages",
    "pipeline",
    "ingest",
    "instruments",
    "engine",
    "products",
    "storage",
    "kernels",
    "model",
)
"""Folders and modules of the package, from the top: a module imports only from rooms below its own, or from its own."""
KERNELS = ("measurement", "coadding", "rendering", "detectors", "universe")
"""The same inside `kernels`."""


def imports_of(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("romandask"):
            found += [f"{node.module}.{name.name}" for name in node.names if name.name != "__version__"]
        elif isinstance(node, ast.Import):
            found += [name.name for name in node.names if name.name.startswith("romandask")]
    return found


def modules() -> list[Path]:
    return [path for path in sorted(PACKAGE.rglob("*.py")) if path.parent != PACKAGE or not path.name.startswith("__")]


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    own = path.relative_to(PACKAGE).with_suffix("").parts
    for module in imports_of(path):
        other = module.split(".")[1:]
        assert other[0] == own[0] or ROOMS.index(other[0]) > ROOMS.index(own[0]), f"{path} imports {module}"
        if own[0] == other[0] == "kernels" and own[1] != other[1]:
            assert KERNELS.index(other[1]) > KERNELS.index(own[1]), f"{path} imports {module}"


def test_no_modules_import_each_other():
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in modules()}

    def module_of(name: str) -> str | None:
        return name if name in names else name.rpartition(".")[0] if name.rpartition(".")[0] in names else None

    graph = {name: {module_of(found) for found in imports_of(path)} - {None} for name, path in names.items()}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the modules


@pytest.mark.parametrize(
    ("room", "forbidden"),
    [
        ("engine", r"romandask\.(survey|stages|stage_graph|pipeline|run)\b"),
        ("stages", r"romandask\.instruments\.(roman|rubin)\b"),
        ("kernels", r"(dask|distributed|zarr|xarray|pyarrow)\b"),
        ("model", r"(dask|distributed|zarr|xarray|pyarrow)\b"),
    ],
)
def test_a_room_does_not_import(room, forbidden):
    for path in (PACKAGE / room).rglob("*.py"):
        found = re.findall(rf"^\s*(?:import|from) {forbidden}.*$", path.read_text(), re.M)
        assert not found, (path, found)


def test_kernels_that_make_images_round_alike_wherever_their_arrays_lie():
    """With fastmath the plain and the vectorised form of a loop differ, and addresses choose between them."""
    for path in (PACKAGE / "kernels").rglob("*.py"):
        assert "fastmath=True" not in path.read_text(), path


def test_nothing_that_a_user_writes_can_become_code():
    for path in modules():
        found = re.findall(
            r"pickle|\beval\(|\bexec\(|unsafe_load|shell=True|yaml\.(?:full_)?load\((?!text, _Loader\))",
            path.read_text(),
        )
        assert not found, (path, found)


@pytest.mark.slow
def test_linear_algebra_has_one_thread_wherever_the_package_is():
    """Its sums are rounded otherwise with more, and so are pixels: not by an environment that is set too late alone."""
    code = (
        "import romandask, threadpoolctl, json; romandask.Survey; import scipy.linalg, numpy\n"
        "print(json.dumps(threadpoolctl.threadpool_info()))"
    )
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    pools = [pool for pool in json.loads(done.stdout) if pool["user_api"] == "blas"]
    assert pools
    assert {pool["num_threads"] for pool in pools} == {1}


def test_one_module_alone_imports_distributed():
    users = [
        path.name
        for path in PACKAGE.rglob("*.py")
        if re.search(r"^\s*(import|from) distributed", path.read_text(), re.M)
    ]
    assert users == ["clients.py"]


def test_modules_read_alone():
    for path in PACKAGE.rglob("*.py"):
        assert len(path.read_text().splitlines()) <= 440, path
        assert ast.get_docstring(ast.parse(path.read_text())), path


def test_ruff_finds_nothing():
    done = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "."], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_the_formatter_changes_nothing():
    done = subprocess.run(
        [sys.executable, "-m", "ruff", "format", "--check", "."], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_types_hold():
    command = [sys.executable, "-m", "mypy"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_reference_of_products_is_what_the_code_makes():
    """romandask reference > catalogs/REFERENCE.md writes it anew."""
    assert (ROOT / "catalogs" / "REFERENCE.md").read_text() == reference()


def test_ci_runs_the_test_command_of_the_readme():
    blocks = re.findall(r"```bash\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    run, test = (block.strip().splitlines()[0] for block in blocks[:2])
    assert "romandask run pipelines/tiny.yaml --store runs/tiny" in run
    assert test in (ROOT / ".ci" / "run").read_text()


def test_every_catalog_column_is_described():
    for path in (ROOT / "catalogs").glob("*.yaml"):
        content = yaml.safe_load(path.read_text())
        assert {"description", "key", "partitioning", "columns"} <= set(content), path
        for column in content["columns"]:
            assert {"name", "dtype", "unit", "ucd", "description"} <= set(column), (path, column)
