"""Exposures with the full detector model of the SCAs: persistence, resumed runs and user errors."""

import io
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from astropy.io import fits
from conftest import MINI, command
from PIL import Image

from romandask.instruments.exposure import Exposure
from romandask.instruments.roman.sca_readout import DAY, age, before
from romandask.kernels.detectors.sca import MEMORY
from romandask.kernels.detectors.sca_exposure import (
    COSMIC_RAY_FLAG,
    FLAGS,
    MIN_TRAPPED_CHARGE,
    Trapped,
    afterglow,
    trap,
)
from romandask.kernels.detectors.simple_detector import PERSISTENCE, usable
from romandask.kernels.detectors.synthetic_sca import released_charge
from romandask.model.seeds import rng
from romandask.report import figures
from romandask.storage.manifest import read_record
from romandask.survey import open_survey

pytestmark = pytest.mark.slow

FULL = (
    *(text for text in MINI if not text.startswith("rubin")),
    "rubin=null",
    "roman.detector=sca",
    "roman.cosmic_rays=true",
)


def test_earlier_exposures_are_of_the_same_sca_and_recent():
    random = rng(1, "before")
    start = random.uniform(0, 4000, 60)
    table = pd.DataFrame(
        {
            "mjd": 61541 + start / DAY,
            "exptime": random.choice([139.8, 300.0], 60),
            "detector": random.integers(1, 4, 60),
        }
    )
    for k in range(60):
        expected = []
        for j in range(60):
            gap = (table.mjd[k] - table.mjd[j]) * DAY - table.exptime[j]
            same = table.detector[j] == table.detector[k]
            if same and table.mjd[j] < table.mjd[k] and gap <= MEMORY * table.exptime[k]:
                expected.append(j)
        found = before(table, k).tolist()
        assert sorted(found) == expected
        assert (np.diff(start[found]) > 0).all()
    first = Exposure(visit=1, detector=1, band="H158", mjd=0.0, exptime=140.0, ra=0, dec=0, pa=0)
    assert age(first, replace(first, visit=2, mjd=200 / DAY)) == pytest.approx(200 - 140 + 70)


def test_traps_hold_interpolated_charge_of_bright_pixels_only():
    planes = {
        "PERSIST": np.stack(list(released_charge(lambda name: rng(3, name)))),
        "SATURATE": np.full((4096, 4096), 110_000, np.int32),
    }
    charge = np.zeros((4096, 4096), np.float32)
    # at tabulated levels, between levels and above the full well; on reference pixels; too faint
    charge[100, 200:204], charge[2, 9], charge[4091, 4091] = [1e4, 2e4, 3e4, 4e5], 5e4, 8e4
    charge[300, 300] = 600.0
    found = trap(charge, lambda name, rows: planes[name][..., rows, :])
    pixel = [96 * 4088 + 196 + k for k in range(4)] + [4087 * 4088 + 4087]
    assert found.pixel.tolist() == pixel
    at = planes["PERSIST"][:, 100, 200:204]
    expected = [at[2, 0], (at[2, 1] + at[3, 1]) / 2, at[3, 2]]
    np.testing.assert_allclose(found.charge[:3], expected, rtol=1e-5)
    # clipped at the full well, between 1e5 and 3e5
    np.testing.assert_allclose(found.charge[3], at[4, 3] + 0.05 * (at[5, 3] - at[4, 3]), rtol=1e-5)
    assert (found.charge >= MIN_TRAPPED_CHARGE).all()
    twice = Trapped(np.array([0, 4088], np.int32), np.array([3.0, 5.0], np.float32))
    current = afterglow([(twice, 100.0), (found, 200.0), (twice, 400.0)])
    assert current[0, 0] == pytest.approx(3 / 100 + 3 / 400)
    assert current[1, 0] == pytest.approx(5 / 100 + 5 / 400)
    assert current[96, 196] == pytest.approx(at[2, 0] / 200, rel=1e-5)
    assert afterglow([]) is None


@pytest.fixture(scope="module")
def full_store(tmp_path_factory):
    """Store of a small survey with the full detector model."""
    folder = tmp_path_factory.mktemp("full")
    done = command("run", "tiny", *FULL, "--store", "full", cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "full"


@pytest.fixture(scope="module")
def later(full_store):
    """The survey, the row of an exposure with persistence, and the row of the earlier exposure that causes it."""
    survey = open_survey(full_store)
    table = survey.pointings("roman")
    (row,) = [k for k in range(len(table)) if len(before(table, k))]
    return survey, row, int(before(table, row)[0])


def test_exposures_have_raw_data_and_calibrated_images(later):
    survey, row, _ = later
    data = survey.exposures("roman")
    assert data["raw"].attrs["units"] == "DN"
    assert data["image"].attrs["units"] == "electron"
    assert dict(zip(data["dq"].attrs["flag_meanings"].split(), data["dq"].attrs["flag_masks"], strict=True)) == {
        "saturated": 1,
        "no_data": 2,
        **FLAGS,
    }
    exposure = data.isel(exposure=row).load()
    good = exposure["dq"].values == 0
    sky = np.median(exposure["image"].values[good])
    pulls = ((exposure["image"] - exposure["truth"] - sky) / np.sqrt(exposure["variance"])).values[good]
    assert pulls.std() == pytest.approx(1, abs=0.03)
    raw = exposure["raw"].values
    assert raw.dtype == np.uint16
    assert 6000 < np.median(raw) < 7500
    assert (exposure["dq"].values & COSMIC_RAY_FLAG > 0).mean() == pytest.approx(1.4e-3, rel=0.3)
    # flagged pixels do not enter coadds, but most of the tile is covered
    coadd = survey.coadds("roman").isel(tile=0, band=0).load()
    assert (coadd["weight"] > 0).mean() > 0.9


def test_persistence_equals_the_charge_left_by_the_earlier_exposure(later):
    survey, row, earlier = later
    product = survey.output("exposures/roman")
    renderer = product.renderer
    left = renderer.left_by(earlier)
    # the stored table equals the recomputed one
    pd.testing.assert_frame_equal(left, replace(renderer, store=None).left_by(earlier))
    view = renderer.view(row)
    without = renderer.readout(view, [])
    stored = product.load(row)
    earlier_exposure = replace(view.exposure, mjd=survey.pointings("roman")["mjd"].iat[earlier])
    expected = left["charge"].to_numpy() / age(earlier_exposure, view.exposure) * view.exposure.exptime
    change = (stored["image"] - without["image"]).ravel()
    strong = left["charge"].to_numpy() > 0.5
    unflagged = usable(stored["dq"].ravel()[left["pixel"]])
    chosen = left["pixel"].to_numpy()[strong & unflagged]
    scatter = np.sqrt(expected[strong & unflagged].sum() * 8) / len(chosen)
    assert change[chosen].mean() == pytest.approx(expected[strong & unflagged].mean(), abs=4 * scatter)
    flagged = np.flatnonzero(stored["dq"].ravel() & PERSISTENCE)
    np.testing.assert_array_equal(flagged, np.sort(left["pixel"].to_numpy()[expected > 1]))


def test_images_of_each_effect(later):
    survey, row, _ = later
    found = survey.output("exposures/roman").effects(row)
    assert list(found) == [
        "quantum efficiency",
        "count-rate nonlinearity",
        "brighter-fatter",
        "persistence",
        "dark current",
        "saturation",
        "classical nonlinearity",
        "interpixel capacitance",
        "bad pixels",
        "read noise",
        "cosmic rays",
    ]
    # data numbers of 1.6 electrons: differences are quantised, and their sums are accurate to some hundred electrons
    assert found["read noise"].std() == pytest.approx(8.5 * np.sqrt(1 + 0.1**2), rel=0.15)
    assert found["dark current"].mean() > 0.015 * 139.8 * 0.8
    assert abs(found["brighter-fatter"].sum()) < 300
    assert found["interpixel capacitance"].min() < -50
    assert abs(found["interpixel capacitance"].sum()) < 300
    assert found["persistence"].min() >= -2
    assert found["persistence"].sum() > 0
    assert found["cosmic rays"].sum() > 500
    assert found["classical nonlinearity"].sum() < 0
    assert found["count-rate nonlinearity"].mean() < 0
    assert Image.open(io.BytesIO(figures.effects(found))).size[0] > 1000


def test_a_resumed_run_makes_identical_output_and_only_missing_units(full_store, later):
    survey, row, _ = later
    names = survey.output("exposures/roman").names
    stage, store = "exposures/roman", survey.store
    first = read_record(store, stage, names[row])
    times = {name: store.record(stage, name).stat().st_mtime_ns for name in names}
    store.record(stage, names[row]).unlink()
    done = command("run", "tiny", *FULL, "--store", "full", cwd=full_store.parent)
    assert done.returncode == 0, done.stdout + done.stderr
    assert read_record(store, stage, names[row]).output == first.output
    again = {name: store.record(stage, name).stat().st_mtime_ns for name in names}
    assert [name for name in names if again[name] != times[name]] == [names[row]]


def test_wrong_calibrations_are_reported_before_the_run_starts(tmp_path):
    def error_of(*overrides):
        done = command("run", "tiny", *MINI, *overrides, "--store", "none", cwd=tmp_path)
        assert done.returncode == 2, done.stdout + done.stderr
        assert "Traceback" not in done.stderr + done.stdout
        assert not (tmp_path / "none").exists()
        return " ".join((done.stderr + done.stdout).split())

    assert "need detector: sca" in error_of("roman.cosmic_rays=true")
    assert "leave it out" in error_of("roman.detector=sca", "roman.charge_diffusion=0.3")
    full = ("roman.detector=sca", "roman.calibration=calib")
    assert "is no folder" in error_of(*full)
    (tmp_path / "calib").mkdir()
    text = error_of(*full)
    assert "sca01.fits" in text
    assert "romandask calibration make" in text
    for name in ("sca01.fits", "sca10.fits"):
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.zeros((3, 3)), name="GAIN")]).writeto(
            tmp_path / "calib" / name
        )
    assert "sca01.fits: extensions SOURCES" in error_of(*full)
