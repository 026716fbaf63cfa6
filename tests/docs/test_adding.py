"""The changes that the developer's page shows, applied to a copy of the package, do what the page says."""

import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from conftest import MINI, ROOT

pytestmark = pytest.mark.slow
PAGE = ROOT / "docs" / "developer" / "adding.md"
CHANGE = re.compile(r"^--- (\S+)\n\+\+\+ (\S+)\n(.*?)(?=^--- |\Z)", re.M | re.S)


def changes(section: str) -> list[tuple[str, str, str]]:
    """Return file, text before (empty for a new file) and text after, of each change of a section."""
    text = next(part for part in PAGE.read_text().split("\n## ") if part.startswith(section + "\n"))
    found = []
    for block in re.findall(r"^```diff\n(.*?)^```$", text, re.M | re.S):
        for before, path, body in CHANGE.findall(block):
            lines = body.splitlines()
            old = "\n".join(line[1:] for line in lines if not line.startswith("+"))
            new = "\n".join(line[1:] for line in lines if not line.startswith("-"))
            found.append((path, "" if before == "/dev/null" else old, new))
    return found


SECTIONS = ("A band", "A stage", "A column", "An export format")


def test_the_counts_of_places_are_those_of_the_changes():
    places = {section: {path for path, _, _ in changes(section)} for section in SECTIONS}
    assert places["A band"] == {"romandask/instruments/roman/bands.py"}
    assert places["A stage"] == {
        "romandask/stages/analysis/counts.py",
        "romandask/stage_graph.py",
        "catalogs/counts.yaml",
    }
    assert len(places["A column"]) == 3
    assert places["An export format"] == {"romandask/export/ecsv.py"}


def test_the_changes_of_the_page_work(tmp_path):
    for folder in ("romandask", "catalogs", "pipelines"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for section in SECTIONS:
        for name, old, new in changes(section):
            path = tmp_path / name
            if not old:
                assert not path.exists(), f"{section}: {name} exists"
                path.write_text(new + "\n")
                continue
            text = path.read_text()
            assert text.count(old) == 1, f"{section}: {name} has not once\n{old}"
            path.write_text(text.replace(old, new))

    def romandask(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "romandask", *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    settings = [one for one in MINI if not one.startswith(("roman.bands", "roman.pointings"))]
    settings += ["roman.bands=[K213]", "roman.pointings.dithers={K213: [2]}"]
    romandask("run", "tiny", "--store", "small", *settings)
    partitions = (tmp_path / "small" / "objects" / "roman" / "catalog").rglob("Npix=*.parquet")
    objects = pd.concat([pd.read_parquet(path) for path in partitions])
    assert objects["axis_ratio"].between(0, 1).all()
    assert (objects["K213_kronFlux"] > 0).any()
    counts = pd.read_parquet(tmp_path / "small" / "counts" / "roman")
    magnitude = 31.4 - 2.5 * np.log10(objects["K213_kronFlux"][objects["K213_kronFlux"] > 0])
    assert counts["objects"].sum() == magnitude.between(16, 30).sum()
    assert "counts/roman" in romandask("status", "small")
    romandask("export", "ecsv", "small", "tables")
    assert (tmp_path / "tables" / "roman.ecsv").stat().st_size > 1000
    assert "roman.ecsv" in (tmp_path / "tables" / "SHA256SUMS").read_text()
