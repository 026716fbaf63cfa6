"""Rubin's generated cadence: nights, filter changes and the visits of a fixed field grid.

The survey is drawn in two steps, neither of which knows the region. First the whole observatory's filter blocks: each
night is cut at its filter changes, and a block has one filter, one rotator angle and one seeing. Then each field draws
its visits from the blocks in which it can be observed. A visit is thus the same whatever part of the sky asks for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.instruments.rubin.bands import BANDS
from romandask.model.seeds import rng
from romandask.model.sky import Region, unit_vectors

LATITUDE, LONGITUDE = -30.2446, -70.7494
"""Cerro Pachon, degrees (LSST Key Numbers)."""
YEARS = 5
NIGHTS = round(YEARS * 365.25)
BLOCK = 0.75 / 24
"""Days between filter changes: about ten a night, as in OpSim's baselines."""
CLEAR = 0.8
"""Share of the nights that are observed: weather and engineering take the others."""
SPACING = 2.8
"""Of the fields, degrees: a cell is four fifths of the field of view, so neighbours overlap."""
AIRMASS = 1.5
"""Limit of a field's blocks; a dithered visit may exceed it slightly."""
LOWEST_TRANSIT = 30.0
"""Fields that never rise higher, degrees, are not visited."""
MOON_DISTANCE = 30.0
"""No visit is closer to the Moon when it is up, degrees (OpSim's baselines)."""
ROTATOR = 80.0
"""Range of the random rotator angle at a filter change, degrees either way (Awan et al. 2016; the limit is 90)."""
SEEING_NIGHT, SEEING_BLOCK = 0.22, 0.18
"""Scatter of ln(seeing) between and within nights: 0.28 in all, the quartiles of PSTN-054's table 3."""
SKY_SCATTER = 0.05
"""mag"""
SUN_V = -26.76
"""AB magnitude of the Sun in V (Willmer 2018)."""
EXTINCTION_V = 0.172
"""mag an airmass, of Krisciunas & Schaefer (1991)."""
MOONLIGHT = (0.0, 0.1, 0.3, 0.8)
"""Values of `moonlight` at which `RubinBand.moonlight_choice` is given."""


@dataclass(frozen=True)
class Blocks:
    """Times between filter changes; arrays of one length."""

    night: np.ndarray
    """Since the start of the survey."""
    start: np.ndarray
    """MJD"""
    band: np.ndarray
    rotator: np.ndarray
    """Rotator angle (OpSim's rotTelPos), degrees."""
    seeing: np.ndarray
    """FWHM at 500 nm and zenith, arcsec."""
    dither: np.ndarray
    """(n, 2) of the night: shifts in right ascension and declination, in cells of the field grid, -1/2 to 1/2."""


def cadence(
    region: Region,
    seed: int,
    bands: Sequence[str],
    start: float,
    means: Mapping[str, int],
    seeing: float,
    area: float,
    radius: float,
) -> pd.DataFrame:
    """Return the visits of five years that may reach a region, by time (columns of Exposure without the detector).

    Parameters
    ----------
    bands : of the visits that are wanted
    start : MJD of the first night
    means : mean visits of a point, by band: of all bands, for they share the nights
    seeing : median FWHM at 500 nm and zenith, arcsec
    area : of the detectors, square degrees
    radius : from the region within which visits may matter, degrees
    """
    blocks = filter_blocks(seed, start, means, seeing)
    ends = [blocks.start, blocks.start + BLOCK]
    moon = [moon_position(mjd) for mjd in ends]
    centre = unit_vectors(*region.centre)
    edge = _edge(region)
    reach = np.arccos(np.clip((edge @ centre).min(), -1, 1)) + np.radians(radius)
    cells = _along_curve(blocks.dither)
    parts = []
    for field in near_fields(region.centre, np.degrees(reach)).itertuples():
        fit = _observable(field, ends, moon)
        for band in bands:
            candidates = np.flatnonzero(fit & (blocks.band == band))
            chosen = _chosen(field, band, candidates, cells, seed, means[band] / area)
            if len(chosen.blocks):
                parts.append(_visits(field, band, blocks, chosen))
    if not parts:
        return pd.DataFrame({name: np.empty(0, kind) for name, kind in _DTYPES.items()})
    visits = pd.concat(parts)
    visits = visits[unit_vectors(visits["ra"], visits["dec"]) @ centre >= np.cos(min(reach, np.pi))]
    return visits.sort_values(["mjd", "visit"], ignore_index=True)


_DTYPES = {"visit": np.int64, "band": object} | dict.fromkeys(
    ("mjd", "exptime", "ra", "dec", "pa", "seeing", "airmass", "sky_brightness"), float
)


def filter_blocks(seed: int, start: float, means: Mapping[str, int], seeing: float) -> Blocks:
    """Return the blocks of the survey: they depend on the seed and the settings only."""
    random = rng(seed, "pointings", "rubin", "nights")
    clear = random.random(NIGHTS) < CLEAR
    dither = random.uniform(-0.5, 0.5, (NIGHTS, 2))
    nightly = SEEING_NIGHT * random.standard_normal(NIGHTS)
    count = int(1 / BLOCK)
    # a night begins at noon; filter changes fall at its own phase
    noon = np.floor(start) - LONGITUDE / 360 + 0.5 + np.arange(NIGHTS) - 1
    times = noon[:, None] + (np.arange(count) + random.random((NIGHTS, 1))) * BLOCK
    rotator = random.uniform(-ROTATOR, ROTATOR, times.shape)
    scatter = SEEING_BLOCK * random.standard_normal(times.shape)
    choice = random.random(times.shape)
    sun = np.maximum(altitude(*sun_position(times), times), altitude(*sun_position(times + BLOCK), times + BLOCK))
    light = moonlight(times + BLOCK / 2)
    names = list(means)
    # wanted share of the blocks; a band that may not be used leaves them to the others
    chances = [means[name] * np.interp(light, MOONLIGHT, BANDS[name].moonlight_choice) for name in names]
    weight = np.stack(
        [np.where(sun < BANDS[name].sun_limit, chance, 0) for name, chance in zip(names, chances, strict=True)]
    )
    total = weight.sum(axis=0)
    band = np.array([*names, ""], object)[(np.cumsum(weight, axis=0) <= choice * total).sum(axis=0)]
    used = (total > 0) & clear[:, None] & (times >= start) & (times < start + NIGHTS)
    night = np.broadcast_to(np.arange(NIGHTS)[:, None], times.shape)[used]
    fwhm = seeing * np.exp(nightly[:, None] + scatter)
    return Blocks(night, times[used], band[used], rotator[used], fwhm[used], dither[night])


def near_fields(centre: tuple[float, float], reach: float) -> pd.DataFrame:
    """Return the fields (number, ra, dec, cell, width, height) of the all-sky grid whose dithers may come in reach.

    Rings of equal height, each cut in cells of equal width in right ascension: cells tile the sky exactly, so visits
    that are spread evenly over their own cell cover the sky evenly, whatever the shape of the camera.
    """
    rings = round(180 / SPACING)
    height = 180 / rings
    dec = -90 + (np.arange(rings) + 0.5) * height
    columns = np.maximum(1, np.rint(360 * np.cos(np.radians(dec)) / SPACING)).astype(int)
    ring = np.repeat(np.arange(rings), columns)
    number = np.arange(len(ring))
    width = 360 / columns[ring]
    ra = (number - np.concatenate([[0], np.cumsum(columns)[:-1]])[ring] + 0.5) * width
    edges = np.sin(np.radians(dec[ring][:, None] + [-height / 2, height / 2]))
    cell = width * np.degrees(edges[:, 1] - edges[:, 0])
    fields = pd.DataFrame(
        {"number": number, "ra": ra, "dec": dec[ring], "cell": cell, "width": width, "height": height}
    )
    # a shift in right ascension moves a field most at the side of its cell that faces the equator
    aside = width / 2 * np.cos(np.radians(np.maximum(np.abs(dec[ring]) - height / 2, 0)))
    near = unit_vectors(ra, dec[ring]) @ unit_vectors(*centre)
    return fields[near >= np.cos(np.radians(np.minimum(reach + np.hypot(aside, height / 2), 180)))]


@dataclass(frozen=True)
class _Chosen:
    """Blocks in which a field is visited in a band, and where in them."""

    blocks: np.ndarray
    moment: np.ndarray
    """Share of the block that has passed."""
    sky: np.ndarray
    """Scatter of the sky brightness, mag."""


def _chosen(field, band: str, candidates: np.ndarray, cells: np.ndarray, seed: int, density: float) -> _Chosen:
    """Draw the visits of a field among its candidate blocks.

    Parameters
    ----------
    cells : of all blocks, the place of their dither on a curve that fills the cell of the field grid
    density : visits a square degree
    """
    random = rng(seed, "pointings", "rubin", field.number, band)
    expected = density * field.cell
    count = (int(expected) + (random.random() < expected % 1)) * (len(candidates) > 0)
    # every so-many-th block in the order of their dithers: all are as likely, but the visits of a field cover its
    # surroundings evenly, as a scheduler sees to; twice in a block only where there are fewer blocks than visits
    order = np.lexsort((random.random(len(candidates)), cells[candidates]))
    rank = (random.random() + np.arange(count)) * len(candidates) / max(count, 1)
    blocks = candidates[order[rank.astype(int)]]
    return _Chosen(blocks, random.random(count), SKY_SCATTER * random.standard_normal(count))


def _along_curve(dither: np.ndarray) -> np.ndarray:
    """Return the place (n,) of dithers (n, 2) on Morton's curve through 16 x 16 squares: near ones are near on it."""
    squares = np.minimum(((dither + 0.5) * 16).astype(int), 15)
    return sum((squares[:, axis] >> bit & 1) << 2 * bit + axis for bit in range(4) for axis in range(2))


def _visits(field, band: str, blocks: Blocks, chosen: _Chosen) -> pd.DataFrame:
    """Return the visits of a field in a band."""
    at = chosen.blocks
    mjd = blocks.start[at] + BLOCK * chosen.moment
    along, up = blocks.dither[at].T
    ra, dec = (field.ra + along * field.width) % 360, field.dec + up * field.height
    return pd.DataFrame(
        {
            "visit": (field.number * 6 + "ugrizy".index(band)) * 10_000 + np.arange(len(at)),
            "band": band,
            "mjd": mjd,
            "exptime": 30.0,
            "ra": ra,
            "dec": dec,
            "pa": (blocks.rotator[at] - parallactic_angle(ra, dec, mjd)) % 360,
            "seeing": blocks.seeing[at],
            "airmass": 1 / np.sin(np.radians(altitude(ra, dec, mjd))),
            "sky_brightness": sky_brightness(band, ra, dec, mjd) + chosen.sky,
        }
    )


def _observable(field, times: list[np.ndarray], moon: list[tuple]) -> np.ndarray:
    """True for blocks, given by start and end, in which a field is high and far from the Moon throughout."""
    transit = 90 - abs(field.dec - LATITUDE)
    # a field that only just rises above the limit, or never does, is observed near its transit
    lowest = min(np.degrees(np.arcsin(1 / AIRMASS)), transit - 5)
    fit = np.full(len(times[0]), transit >= LOWEST_TRANSIT)
    for mjd, (moon_ra, moon_dec) in zip(times, moon, strict=True):
        apart = unit_vectors(moon_ra, moon_dec) @ unit_vectors(field.ra, field.dec)
        close = (apart > np.cos(np.radians(MOON_DISTANCE))) & (altitude(moon_ra, moon_dec, mjd) > 0)
        fit &= (altitude(field.ra, field.dec, mjd) >= lowest) & ~close
    return fit


def _edge(region: Region) -> np.ndarray:
    """Return unit vectors along the edge of a region."""
    along = np.linspace(0, 1, 33)
    ra = region.ra_min + region.width * np.concatenate([along, along, 0 * along, 0 * along + 1])
    height = region.dec_min + (region.dec_max - region.dec_min) * along
    dec = np.concatenate([0 * along + region.dec_min, 0 * along + region.dec_max, height, height])
    return unit_vectors(ra, dec)


def hour_angle(ra, mjd) -> np.ndarray:
    """Return the hour angle, degrees, at Cerro Pachon; mean sidereal time (Meeus 1998, equation 12.4), UT1 = UTC."""
    return (280.46061837 + 360.98564736629 * (np.asarray(mjd) - 51544.5) + LONGITUDE - ra + 180) % 360 - 180


def altitude(ra, dec, mjd) -> np.ndarray:
    """Return the altitude, degrees, at Cerro Pachon, without refraction."""
    hour, dec, latitude = np.radians(hour_angle(ra, mjd)), np.radians(dec), np.radians(LATITUDE)
    return np.degrees(np.arcsin(np.sin(latitude) * np.sin(dec) + np.cos(latitude) * np.cos(dec) * np.cos(hour)))


def parallactic_angle(ra, dec, mjd) -> np.ndarray:
    """Return the position angle of the zenith, degrees east of north."""
    hour, dec, latitude = np.radians(hour_angle(ra, mjd)), np.radians(dec), np.radians(LATITUDE)
    north = np.tan(latitude) * np.cos(dec) - np.sin(dec) * np.cos(hour)
    return np.degrees(np.arctan2(np.sin(hour), north))


def sun_position(mjd) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension and declination of the Sun, degrees, to 0.01 (Astronomical Almanac, page C5)."""
    days = np.asarray(mjd) - 51544.5
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = 280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)
    return _equatorial(longitude, np.zeros_like(longitude), days)


def moon_position(mjd) -> tuple[np.ndarray, np.ndarray]:
    """Return the Moon's geocentric right ascension and declination, degrees, to 0.3 (Astronomical Almanac, D46)."""
    days = np.asarray(mjd) - 51544.5
    t = days / 36525

    def wave(phase: float, rate: float) -> np.ndarray:
        return np.sin(np.radians(phase + rate * t))

    longitude = 218.32 + 481267.881 * t + 6.29 * wave(135.0, 477198.87) - 1.27 * wave(259.3, -413335.36)
    longitude += 0.66 * wave(235.7, 890534.22) + 0.21 * wave(269.9, 954397.74)
    longitude -= 0.19 * wave(357.5, 35999.05) + 0.11 * wave(186.5, 966404.03)
    latitude = 5.13 * wave(93.3, 483202.02) + 0.28 * wave(228.2, 960400.89)
    latitude -= 0.28 * wave(318.3, 6003.15) + 0.17 * wave(217.6, -407332.21)
    return _equatorial(longitude, latitude, days)


def _equatorial(longitude, latitude, days) -> tuple[np.ndarray, np.ndarray]:
    obliquity = np.radians(23.439 - 4e-7 * days)
    x, y, z = np.moveaxis(unit_vectors(longitude, latitude), -1, 0)
    y, z = np.cos(obliquity) * y - np.sin(obliquity) * z, np.sin(obliquity) * y + np.cos(obliquity) * z
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arcsin(z))


def moon_phase(mjd) -> np.ndarray:
    """Return the phase angle of the Moon, degrees: 0 when full, 180 when new."""
    apart = np.sum(unit_vectors(*moon_position(mjd)) * unit_vectors(*sun_position(mjd)), axis=-1)
    return 180 - np.degrees(np.arccos(np.clip(apart, -1, 1)))


def moonlight(mjd) -> np.ndarray:
    """Return how moonlit the sky is, 0 to 1: the illuminated fraction times the sine of the Moon's altitude."""
    up = np.sin(np.radians(np.maximum(altitude(*moon_position(mjd), mjd), 0)))
    return (1 + np.cos(np.radians(moon_phase(mjd)))) / 2 * up


def sky_brightness(band: str, ra, dec, mjd) -> np.ndarray:
    """Return the sky at positions and times, AB mag / arcsec2: airglow, scattered moonlight and twilight.

    Airglow (`RubinBand.airglow` at zenith) and moonlight follow Krisciunas & Schaefer (1991). Their V is carried to a
    band with the Sun's colour and wavelength^-2, between Rayleigh's and Mie's scattering; twilight is V 22.3 at -15
    degrees, one magnitude a degree (Patat et al. 2006), with the Sun's colour. Both are fitted to visits of an OpSim
    baseline 3.
    """
    zenith = 90 - altitude(ra, dec, mjd)
    path = 1 / np.sqrt(1 - 0.96 * np.sin(np.radians(zenith)) ** 2)
    dark = 10 ** (-0.4 * (BANDS[band].airglow + BANDS[band].extinction * (path - 1))) * path
    colour = BANDS[band].sun - SUN_V
    moon_ra, moon_dec = moon_position(mjd)
    moon_high = altitude(moon_ra, moon_dec, mjd)
    moon_path = 1 / np.sqrt(1 - 0.96 * np.cos(np.radians(np.maximum(moon_high, 0))) ** 2)
    phase = moon_phase(mjd)
    apart = np.degrees(np.arccos(np.sum(unit_vectors(moon_ra, moon_dec) * unit_vectors(ra, dec), axis=-1)))
    scattered = 10**5.36 * (1.06 + np.cos(np.radians(apart)) ** 2) + 10 ** (6.15 - apart / 40)
    scattered *= (BANDS[band].effective_wave / 550) ** -2 * (1 - 10 ** (-0.4 * EXTINCTION_V * path))
    moon = 3.84 + 0.026 * phase + 4e-9 * phase**4 + BANDS[band].extinction * moon_path
    # nanolamberts; 34.08 are V 22.5 mag / arcsec2
    lit = np.where(moon_high > 0, scattered * 10 ** (-0.4 * moon), 0) / 34.08 * 10 ** (-0.4 * (22.5 + colour))
    twilight = 10 ** (-0.4 * (22.3 - (altitude(*sun_position(mjd), mjd) + 15) + colour))
    return -2.5 * np.log10(dark + lit + twilight)
