"""Fixtures: the shared real data, a small Roman whose detectors are quick to draw, and one stored tiny survey."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from romandask.instruments.exposure import Exposure, footprint
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.model.settings import CoaddSettings, RenderSettings, TruthSettings
from romandask.model.sky import Region
from romandask.stages.exposures.exposures import exposures
from romandask.stages.pointings import CORNERS
from romandask.stages.truth.catalogs import truth

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real inputs from the field."""
    if not SHARED.is_dir():
        pytest.skip("the shared real inputs (../shared/data) are not beside this checkout")
    return SHARED


def command(*arguments: str, cwd: Path | None = None, timeout: float = 1800) -> subprocess.CompletedProcess:
    """Run the command line as a user would."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONWARNINGS"}
    return subprocess.run(
        [sys.executable, "-m", "romandask", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


MINI = (
    "roman.bands=[H158]",
    "rubin.bands=[i]",
    "roman.pointings.dithers={H158: [2]}",
    "rubin.pointings.visits={i: 8}",
    "coadds.pixels=600",
    "coadds.overlap=60",
    "region.ra=[53.0151, 53.024]",
    "region.dec=[-40.008, -40.0006]",
    "truth.galaxies=150",
    "render.n_waves=3",
    "roman.psf_degree=0",
    "truth.nside=64",
)
"""Overrides that make the tiny pipeline a few seconds long."""
MINI_RUN = ("run", "tiny", "--store", "s", "--workers", "0", "--no-report", *MINI)
"""Command that makes it in one process, without a cluster."""


def once(tmp_path_factory, worker_id: str, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that the first test process to ask for it fills; all processes share it, and only read."""
    folder = tmp_path_factory.getbasetemp()
    folder = (folder if worker_id == "master" else folder.parent) / name
    folder.mkdir(exist_ok=True)
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "done").exists():
            make(folder)
            (folder / "done").write_text("")
    return folder


@pytest.fixture(scope="session")
def tiny_store(tmp_path_factory, worker_id) -> Path:
    """The tiny pipeline, run once by the command line from an empty folder; test processes share it, and only read."""

    def make(folder: Path) -> None:
        done = command("run", "tiny", "--store", "tiny", cwd=folder)
        assert done.returncode == 0, done.stdout + done.stderr

    return once(tmp_path_factory, worker_id, "tiny-survey", make) / "tiny"


@pytest.fixture(scope="session")
def mini_store(tmp_path_factory, worker_id) -> Path:
    """The tiny pipeline with MINI, made once in one process without a cluster, without a report; only to be read."""

    def make(folder: Path) -> None:
        done = command(*MINI_RUN, cwd=folder)
        assert done.returncode == 0, done.stdout + done.stderr

    return once(tmp_path_factory, worker_id, "mini-survey", make) / "s"


LONG = (
    "test_survey.py",
    "test_sca_readout.py",
    "test_run.py",
    "test_object_store.py",
    "test_draw_accuracy.py",
    "test_memory.py",
    "test_code_rules.py",
    "test_main.py",
    "test_verify.py",
    "test_catalogs.py",
    "test_notebooks.py",
    "test_commands.py",
)
"""Files that take long; the longest single tests first."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take long: at the end, one process would run them alone.

    A test of a stored survey is slow: the first makes it.
    """
    for item in items:
        if {"tiny_store", "mini_store"} & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    places = {name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: places.get(item.path.name, len(LONG)))


class SmallSurvey:
    """Three overlapping Roman exposures with detectors of 300 pixels, the truth under them, and tiles."""

    def __init__(self):
        settings = RomanSettings(bands=("H158",))
        self.roman = replace(Roman(settings, n_waves=3), shape=(300, 300))
        base = Exposure(visit=0, detector=7, band="H158", mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=120.0)
        # the detector of interest lies off the boresight: shift the boresights by half a detector
        self.exposures = [replace(base, visit=k, dec=-40.0 + k * 14 / 3600, mjd=61541.0 + k) for k in range(3)]
        corners = np.stack([footprint(self.roman.header(e), self.roman.shape) for e in self.exposures])
        rows = [
            vars(e) | dict(zip(CORNERS, c.ravel(), strict=True)) for e, c in zip(self.exposures, corners, strict=True)
        ]
        self.table = pd.DataFrame(rows)
        ra, dec = corners[..., 0], corners[..., 1]
        self.region = Region(ra.min(), ra.max(), dec.min(), dec.max())
        rubin = Rubin(RubinSettings(bands=("i",)), n_waves=3)
        bandpasses = {"H158": self.roman.bandpass("H158"), "i": rubin.bandpass("i")}
        self.truth = truth(TruthSettings(order=11, margin=5.0, nside=64), Path("."), self.region, bandpasses, 5)
        self.product = exposures(self.table, self.truth, self.roman, RenderSettings(n_waves=3), 5)
        self.settings = CoaddSettings(pixels=260, overlap=30)
        self.tiles = self.settings.grid().covering(self.region)


@pytest.fixture(scope="session")
def small() -> SmallSurvey:
    return SmallSurvey()
