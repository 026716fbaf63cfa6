"""Roman's plan against the mission's observing sequence, GalSim and astropy; the focal plane against GalSim's WCS."""

from datetime import datetime, timedelta

import galsim
import galsim.roman
import numpy as np
import pandas as pd
import pytest
from astropy.coordinates import SkyCoord, get_sun
from astropy.io import fits
from astropy.time import Time
from astropy.utils import iers
from astropy.wcs import WCS
from coord.util import sun_position_ecliptic

from romandask.export.obseq import write_obseq
from romandask.ingest import obseq
from romandask.instruments.exposure import Exposure, footprint
from romandask.instruments.roman.focal_plane import move, separations
from romandask.instruments.roman.plan import DITHER, LONG_STEP, SHORT_STEP
from romandask.instruments.roman.roman import Roman, RomanPointings, RomanSettings
from romandask.instruments.roman.sun import best_roll, leads
from romandask.kernels.universe.bandpasses import galsim_roman_bandpasses
from romandask.model.errors import UserError
from romandask.model.sky import Region, covering_sums, unit_vectors

ROMAN = Roman(RomanSettings())
BOX = Region(53.0, 53.0 + 1.5 / np.cos(np.radians(40.0)), -40.75, -39.25)
OBSERVING_SEQUENCE = "roman_obseq/Roman_WAS_obseq_11_1_23.fits"
MAS = np.pi / 180 / 3600e3
"""One milliarcsecond, radians."""


def celestial(ra, dec):
    return galsim.CelestialCoord(ra * galsim.degrees, dec * galsim.degrees)


def date(mjd):
    return datetime(1858, 11, 17) + timedelta(days=float(mjd))


def galsim_wcs(ra, dec, pa, mjd):
    return galsim.roman.getWCS(celestial(ra, dec), PA=pa * galsim.degrees, date=date(mjd), PA_is_FPA=True)


def galsim_header(wcs):
    full = galsim.FitsHeader()
    wcs.writeToFitsHeader(full, galsim.BoundsI(1, 4088, 1, 4088))
    # NAXIS = 0 of GalSim's template makes astropy warn
    return {key: full[key] for key in full.keys() if key not in ("SIMPLE", "BITPIX", "NAXIS", "EXTEND")}  # noqa: SIM118


def allowed_date(ra, dec):
    return next(mjd for mjd in range(61541, 61906) if galsim.roman.allowedPos(celestial(ra, dec), date(mjd)))


@pytest.fixture(scope="module")
def box():
    return ROMAN.plan(BOX, 0)


@pytest.fixture(scope="module")
def wide():
    return ROMAN.plan(Region(51.0, 56.0, -42.0, -38.0), 0)


@pytest.mark.parametrize(
    ("ra", "dec", "pa"),
    [(0.01, -40, 200.0), (359.95, 3, 10.0), (53, -40, 188.0), (30, 85, 77.0), (200, -88.5, 300.0), (120, 30, 0.0)],
)
def test_footprints_and_headers_agree_with_galsim(ra, dec, pa):
    mjd = allowed_date(ra, dec)
    wcs = galsim_wcs(ra, dec, pa, mjd)
    found = ROMAN.footprints(pd.DataFrame({"ra": [ra], "dec": [dec], "pa": [pa]}))
    assert found.shape == (1, 18, 4, 2)
    x, y = np.meshgrid(np.linspace(0, 4087, 5), np.linspace(0, 4087, 5))
    for index, sca in enumerate(ROMAN.detectors):
        full = galsim_header(wcs[sca])
        expected = footprint(full, ROMAN.shape)
        gap = unit_vectors(*expected.T) - unit_vectors(*found[0, index].T)
        assert np.linalg.norm(gap, axis=1).max() < 1e-3 * MAS
        exposure = Exposure(visit=0, detector=sca, band="H158", mjd=mjd, exptime=139.8, ra=ra, dec=dec, pa=pa)
        header = ROMAN.header(exposure)
        gap = unit_vectors(*WCS(full).all_pix2world(x, y, 0)) - unit_vectors(*WCS(header).all_pix2world(x, y, 0))
        assert np.linalg.norm(gap, axis=-1).max() < 1e-3 * MAS


def test_footprints_depend_on_the_shape():
    random = np.random.default_rng(1)
    visits = pd.DataFrame({name: random.uniform(-80, 80, 2000) for name in ("ra", "dec", "pa")})
    found = ROMAN.footprints(visits)
    small = Roman(RomanSettings(), shape=(300, 200))
    header = small.header(Exposure(visit=0, detector=5, band="H158", mjd=61541.0, exptime=139.8, **visits.iloc[3]))
    np.testing.assert_allclose(small.footprints(visits)[3, 4], footprint(header, (300, 200)), atol=1e-9)
    assert found.shape == (2000, 18, 4, 2)


def test_refused_visits_agree_with_galsim():
    random = np.random.default_rng(2)
    n = 1500
    visits = pd.DataFrame({"ra": random.uniform(0, 360, n), "mjd": random.uniform(60000, 64000, n)})
    visits["dec"] = np.degrees(np.arcsin(random.uniform(-1, 1, n)))
    # 300 visits within an arcsecond of the limits, on both sides
    for k in range(300):
        when = date(visits.loc[k, "mjd"])
        sun = galsim.CelestialCoord.from_ecliptic(sun_position_ecliptic(when), 0 * galsim.degrees, when.year)
        angle = np.radians((54.0, 126.0)[k % 2] + random.uniform(-1, 1) / 3600)
        bearing = random.uniform(0, 2 * np.pi)
        dec = np.arcsin(np.sin(sun.dec) * np.cos(angle) + np.cos(sun.dec) * np.sin(angle) * np.cos(bearing))
        east = np.arctan2(
            np.sin(bearing) * np.sin(angle) * np.cos(sun.dec), np.cos(angle) - np.sin(sun.dec) * np.sin(dec)
        )
        visits.loc[k, ["ra", "dec"]] = np.degrees(sun.ra.rad + east) % 360, np.degrees(dec)
    expected = [not galsim.roman.allowedPos(celestial(v.ra, v.dec), date(v.mjd)) for v in visits.itertuples()]
    assert 0.3 < np.mean(expected[:300]) < 0.7
    np.testing.assert_array_equal(ROMAN.refused(visits), expected)


def test_coverage_counts_each_visit_once_and_excludes_the_gaps():
    footprints = ROMAN.footprints(pd.DataFrame({"ra": [0.0, 0.0], "dec": [-40.0, -40.0], "pa": [30.0, 30.0]}))
    random = np.random.default_rng(3)
    n = 40_000
    ra, dec = random.uniform(-0.8, 0.8, n) % 360, random.uniform(-40.6, -39.4, n)
    counts = covering_sums(footprints.reshape(-1, 4, 2), ra, dec)
    assert set(counts) == {0, 2}
    area = (counts == 2).mean() * 1.6 * 1.2 * np.cos(np.radians(40.0))
    wcs = galsim_wcs(0, -40, 30.0, allowed_date(0, -40))
    pixels = sum(one.pixelArea(galsim.PositionD(2044, 2044)) for one in wcs.values())
    assert area == pytest.approx(pixels * 4088**2 / 3600**2, rel=0.03)
    for k in range(0, n, 200):
        found = galsim.roman.findSCA(wcs, celestial(ra[k], dec[k]))
        assert (found is not None) == (counts[k] == 2)


def test_move_keeps_relative_positions():
    # two orders of the same offsets end at the same position, also near a pole: the great-circle triangle is small
    for dec in (-40.0, 84.0):
        ra, dec_1, pa = move(10.0, dec, 70.0, 0.8, 0.0)
        x, y = separations(ra, dec_1, pa, 10.0, dec)
        assert (x, y) == pytest.approx((-0.8, 0.0), abs=1e-9)
        first = move(*move(10.0, dec, 70.0, 0.8, 0.0), 0.0, 0.4)
        second = move(*move(10.0, dec, 70.0, 0.0, 0.4), 0.8, 0.0)
        assert np.linalg.norm(unit_vectors(*first[:2]) - unit_vectors(*second[:2])) < np.radians(1e-4)
        assert first[2] == pytest.approx(second[2], abs=0.02)


def test_best_roll_follows_the_ecliptic_relation():
    random = np.random.default_rng(4)
    counts = {True: 0, False: 0}
    for _ in range(100):
        ra, dec = random.uniform(0, 360), np.degrees(np.arcsin(random.uniform(-0.99, 0.99)))
        mjd = random.uniform(61000, 63000)
        when = date(mjd)
        lon, lat = celestial(ra, dec).ecliptic(date=when)  # longitude relative to the Sun
        elongation = np.arccos(np.cos(lat) * np.cos(lon))
        if not np.radians(54) < elongation < np.radians(126):
            continue
        leading = lon.wrap().rad < 0
        lean = np.degrees(np.arcsin(np.tan(lat) / np.tan(elongation)))
        pole = galsim.CelestialCoord.from_ecliptic(0 * galsim.degrees, 90 * galsim.degrees, when.year)
        pole = SkyCoord(pole.ra.deg, pole.dec.deg, unit="deg")
        expected = SkyCoord(ra, dec, unit="deg").position_angle(pole).deg + (210 + lean if leading else 30 - lean)
        assert (best_roll(ra, dec, mjd) - expected + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)
        assert leads(ra, dec, mjd) == leading
        counts[leading] += 1
    assert min(counts.values()) > 10


def astropy_sun(visits):
    """Return distances and position angles of the Sun from visits by astropy, degrees."""
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("iers_degraded_accuracy", "ignore"):
        sun = get_sun(Time(visits["mjd"].to_numpy(), format="mjd", scale="tdb"))
        sun = SkyCoord(sun.ra, sun.dec)
    fields = SkyCoord(visits["ra"].to_numpy(), visits["dec"].to_numpy(), unit="deg")
    return fields.separation(sun).deg, fields.position_angle(sun).deg


@pytest.mark.parametrize(
    "region", ["box", "wide", (10.0, 12.0, -2.0, 0.0), (359.0, 1.0, -40.5, -39.5), (90, 99, 62, 64)]
)
def test_visits_keep_the_limits_of_sun_angle_and_roll_and_do_not_overlap(region, request):
    visits = request.getfixturevalue(region) if isinstance(region, str) else ROMAN.plan(Region(*region), 0)
    angle, direction = astropy_sun(visits)
    assert 54 < angle.min()
    assert angle.max() < 126
    roll = (visits["pa"] - direction - 120 + 180) % 360 - 180
    assert np.abs(roll).max() < 15
    assert (np.diff(visits["mjd"]) * 86400 > 169).all(), "visits overlap in time"
    assert (visits["visit"] == np.arange(len(visits))).all()
    assert not ROMAN.refused(visits).any()
    for band, rows in visits.groupby("band"):
        passes = [direction[rows.index[rows["pass_number"] == number]] for number in (0, 1)]
        turn = (np.median(passes[0]) - np.median(passes[1]) + 180) % 360 - 180
        assert np.abs(turn) > 90, f"{band}: both passes are in the same season"


def test_zodiacal_light_and_rotation_differ_between_bands(wide):
    bandpass = galsim_roman_bandpasses()["H158"]
    first = wide[(wide["field"] == 0) & (wide["strip"] == 0) & (wide["dither"] == 0)]
    levels = [
        galsim.roman.getSkyLevel(bandpass, celestial(row.ra, row.dec), date=date(row.mjd)) for row in first.itertuples()
    ]
    mean = pd.Series(levels, index=first["band"]).groupby(level=0).mean()
    assert mean[["Y106", "J129", "H158"]].max() < 0.95 * mean["F184"]
    mean_pa = wide[(wide["pass_number"] == 0) & (wide["sector"] == 0)].groupby("band")["pa"].mean().sort_values()
    assert np.diff(mean_pa).min() > 2
    assert wide["sector"].nunique() > 1


@pytest.mark.parametrize("band", ROMAN.bands)
def test_a_region_is_covered_evenly(box, wide, band):
    random = np.random.default_rng(5)
    n = 5000
    for visits, region in ((box, BOX), (wide, Region(51.0, 56.0, -42.0, -38.0))):
        ra = random.uniform(region.ra_min, region.ra_max, n)
        dec = random.uniform(region.dec_min, region.dec_max, n)
        counts = covering_sums(ROMAN.footprints(visits[visits["band"] == band]).reshape(-1, 4, 2), ra, dec)
        # seven or eight exposures; a position falls on a gap in an eighth of them
        assert 4.8 < counts.mean() < (7.1 if band == "J129" else 6.5)
        assert (counts < 3).mean() < 0.015


@pytest.mark.parametrize("limits", [(10.0, 10.02, 89.9, 89.95), (359.9, 0.1, -0.1, 0.1), (269.5, 270.5, 66.2, 66.5)])
def test_regions_at_a_pole_at_ra_zero_and_at_the_ecliptic_pole_are_covered(limits):
    region = Region(*limits)
    visits = ROMAN.plan(region, 0)
    random = np.random.default_rng(6)
    ra = (region.ra_min + random.uniform(0, region.width, 500)) % 360
    dec = random.uniform(region.dec_min, region.dec_max, 500)
    for band in ROMAN.bands:
        counts = covering_sums(ROMAN.footprints(visits[visits["band"] == band]).reshape(-1, 4, 2), ra, dec)
        assert 4.8 < counts.mean() < 8
        assert (counts < 3).mean() < 0.01


def sequence(visits: pd.DataFrame) -> dict[str, float]:
    """Return medians of dithers and steps along the focal plane's axes, degrees, and of times, s, of a sequence."""
    first, second = visits.iloc[:-1], visits.iloc[1:]
    x, y = separations(*(first[name].to_numpy() for name in ("ra", "dec", "pa")), second["ra"], second["dec"])
    waits = np.diff(visits["mjd"]) * 86400
    same = (first["band"].to_numpy() == second["band"].to_numpy()) & (waits < 400)
    dither = same & (np.hypot(x, y) < 0.1)
    fields = visits.iloc[np.append(0, np.flatnonzero(~dither) + 1)]
    start, end = fields.iloc[:-1], fields.iloc[1:]
    step_x, step_y = separations(*(start[name].to_numpy() for name in ("ra", "dec", "pa")), end["ra"], end["dec"])
    near = np.isin(end.index, np.flatnonzero(same) + 1)
    short = near & (np.abs(step_x) < 0.05) & (np.abs(np.abs(step_y) - 0.4) < 0.08)
    long = near & (np.abs(np.abs(step_x) - 0.8) < 0.2)
    field_wait = waits[~dither]
    return {
        "dither x": np.median(x[dither]),
        "dither y": np.median(y[dither]),
        "dither spread": np.std(x[dither]),
        "dither wait": np.median(waits[dither]),
        "short y": np.median(np.abs(step_y[short])),
        "short x": np.median(np.abs(step_x[short])),
        "short wait": np.median(field_wait[short]),
        "long x": np.median(np.abs(step_x[long])),
        "long wait": np.median(field_wait[long]),
        "share of short": short.sum() / (short.sum() + long.sum()),
    }


def test_steps_and_times_agree_with_the_missions_sequence(shared, wide):
    mission = sequence(obseq.read(shared / OBSERVING_SEQUENCE))
    ours = sequence(wide)
    assert mission["dither x"] == pytest.approx(DITHER[0], abs=2e-4)
    assert mission["short y"] == pytest.approx(SHORT_STEP, abs=0.003)
    assert mission["long x"] == pytest.approx(LONG_STEP, abs=0.003)
    tolerance = {"dither wait": 0.5, "short wait": 6, "long wait": 10, "share of short": 0.15, "dither spread": 1e-4}
    for name, value in mission.items():
        limit = tolerance.get(name, 2e-4 if name.startswith("dither") else 0.003)
        assert ours[name] == pytest.approx(value, abs=limit), name


def test_a_written_plan_has_the_format_of_the_missions_file(shared, tmp_path):
    visits = ROMAN.plan(Region(53.0151, 53.0484, -40.0133, -40.0006), 0)
    path = tmp_path / "plan.fits"
    write_obseq(path, visits)
    assert [found.name for found in tmp_path.iterdir()] == ["plan.fits"]
    columns = ["visit", "band", "mjd", "exptime", "ra", "dec", "pa", "seeing", "airmass", "sky_brightness"]
    pd.testing.assert_frame_equal(obseq.read(path), visits[columns])
    with fits.open(path) as written, fits.open(shared / OBSERVING_SEQUENCE) as mission:
        assert written[1].data.dtype == mission[1].data.dtype
        assert written[1].columns.names == mission[1].columns.names
        assert len(written) == len(mission)
    with pytest.raises(UserError, match="column 'visit'"):
        write_obseq(path, visits.iloc[1:])


def test_galsim_accepts_every_visit_of_a_written_plan(tmp_path):
    path = tmp_path / "plan.fits"
    write_obseq(path, ROMAN.plan(Region(53.0151, 53.0484, -40.0133, -40.0006), 0))
    with fits.open(path) as hdus:
        table = hdus[1].data
        for i in range(len(table)):
            when = Time(table["date"][i], format="mjd").datetime
            target = celestial(table["ra"][i], table["dec"][i])
            pa = table["pa"][i] * galsim.degrees
            assert galsim.roman.getWCS(target, PA=pa, date=when, SCAs=7, PA_is_FPA=True)
            assert table["filter"][i] in galsim_roman_bandpasses()
            assert table["exptime"][i] == 139.8


def test_a_small_region_has_only_the_fields_that_reach_it():
    visits = ROMAN.plan(Region(53.0151, 53.0484, -40.0133, -40.0006), 0)
    assert len(visits) < 6 * 29
    counts = covering_sums(
        ROMAN.footprints(visits).reshape(-1, 4, 2), np.linspace(53.02, 53.04, 9), np.linspace(-40.01, -40.001, 9)
    )
    assert (counts >= 14).all()
    pd.testing.assert_frame_equal(visits, ROMAN.plan(Region(53.0151, 53.0484, -40.0133, -40.0006), 99))


def test_plan_follows_the_settings_dithers_and_start():
    settings = RomanSettings(bands=("H158",), pointings=RomanPointings(start=62000.0, dithers={"H158": (0, 2)}))
    visits = Roman(settings).plan(Region(10.0, 10.1, -30.0, -29.9), 0)
    assert set(visits["dither"]) == {0, 1}
    assert set(visits["pass_number"]) == {1}
    assert visits["mjd"].between(62000, 62366).all()
    with pytest.raises(ValueError, match="no exposures for H158"):
        RomanSettings(bands=("H158",), pointings=RomanPointings(dithers={"H158": (0, 0)}))
