"""Rubin's generated cadence: nights, filter changes, and the visits of a fixed grid of fields.

The survey is drawn in two steps, neither of which depends on the region. The first step draws the filter blocks of the
whole survey: each night is divided at its filter changes, and a block has one filter, one rotator angle and one seeing.
In the second step, each field draws its visits from the blocks in which it can be observed. A visit is therefore the
same for every region that includes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
import pandas as pd

from romandask.instruments.rubin.bands import BANDS
from romandask.instruments.rubin.site_sky import (
    LATITUDE,
    LONGITUDE,
    altitude,
    moon_position,
    moonlight,
    parallactic_angle,
    sky_brightness,
    sun_position,
)
from romandask.model.seeds import rng
from romandask.model.sky import Region, unit_vectors

YEARS = 5
"""Duration of the survey, years."""
NIGHTS = round(YEARS * 365.25)
"""Duration of the survey, nights."""
BLOCK = 0.75 / 24
"""Time between filter changes, days: about ten changes per night, as in OpSim's baselines."""
CLEAR = 0.8
"""Fraction of the nights on which the survey observes; the others are lost to weather and engineering."""
SPACING = 2.8
"""Spacing of the fields, degrees. A cell of the grid is four fifths of the field of view, so neighbours overlap."""
AIRMASS = 1.5
"""Maximum airmass of a field; that of a dithered visit may be slightly larger."""
LOWEST_TRANSIT = 30.0
"""Altitude of transit below which a field is not visited, degrees."""
MOON_DISTANCE = 30.0
"""Minimum distance of a field from the Moon when the Moon is up, degrees (OpSim's baselines)."""
ROTATOR = 80.0
"""Largest absolute value of the random rotator angle at a filter change, degrees (Awan et al. 2016; the limit of the
telescope is 90)."""
SEEING_NIGHT, SEEING_BLOCK = 0.22, 0.18
"""Scatter of ln(seeing) between nights and within a night; 0.28 in quadrature, from the quartiles of PSTN-054, table 3.
"""
SKY_SCATTER = 0.05
"""Scatter of the sky brightness, mag."""
MOONLIGHT = (0.0, 0.1, 0.3, 0.8)
"""Values of `moonlight` at which `RubinBand.moonlight_choice` is given."""


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """The n times between filter changes, in which the filter, the rotator angle and the seeing are constant."""

    night: np.ndarray
    """Number of the night since the start of the survey, shape (n,)."""
    start: np.ndarray
    """Start of the block, shape (n,), MJD."""
    band: np.ndarray
    """Band, shape (n,)."""
    rotator: np.ndarray
    """Rotator angle (rotTelPos in OpSim), shape (n,), degrees."""
    seeing: np.ndarray
    """FWHM of the atmospheric PSF at 500 nm and zenith, shape (n,), arcsec."""
    dither: np.ndarray
    """Dither of the night, shape (n, 2): shifts in right ascension and declination, in units of a cell of the field
    grid, -1/2 to 1/2."""


class _Field(Protocol):
    """A row of `near_fields`."""

    number: int
    ra: float
    dec: float
    cell: float
    width: float
    height: float


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
    """Generate the visits of five years that may reach a region.

    Parameters
    ----------
    region : Region
        Region to cover.
    seed : int
        Seed of the survey.
    bands : sequence of str
        Bands of the visits to return.
    start : float, MJD
        First night.
    means : dict of str to int
        Mean number of visits of a point in each band; includes bands that are not returned, because all bands share the
        nights.
    seeing : float, arcsec
        Median FWHM of the atmospheric PSF at 500 nm and zenith.
    area : float, square degrees
        Total area of the detectors.
    radius : float, degrees
        Distance from the region up to which visits are returned.

    Returns
    -------
    DataFrame
        One row per visit in order of time, with the fields of `Exposure` except `detector`.
    """
    blocks = filter_blocks(seed, start, means, seeing)
    ends = [blocks.start, blocks.start + BLOCK]
    moon = [moon_position(mjd) for mjd in ends]
    centre = unit_vectors(*region.centre)
    edge = _edge(region)
    reach = np.arccos(np.clip((edge @ centre).min(), -1, 1)) + np.radians(radius)
    curve_positions = _morton_position(blocks.dither)
    parts = []
    for row in near_fields(region.centre, np.degrees(reach)).itertuples():
        # the stubs of pandas do not know the columns of a row
        field = cast(_Field, row)
        observable = _observable(field, ends, moon)
        for band in bands:
            candidates = np.flatnonzero(observable & (blocks.band == band))
            chosen = _choose(field, band, candidates, curve_positions, seed, means[band] / area)
            if len(chosen.blocks):
                parts.append(_visits(field, band, blocks, chosen))
    if not parts:
        return pd.DataFrame({name: np.empty(0, dtype) for name, dtype in _DTYPES.items()})
    visits = pd.concat(parts)
    visits = visits[unit_vectors(visits["ra"], visits["dec"]) @ centre >= np.cos(min(reach, np.pi))]
    return visits.sort_values(["mjd", "visit"], ignore_index=True)


_DTYPES: dict[str, type] = {
    "visit": np.int64,
    "band": object,
    **dict.fromkeys(("mjd", "exptime", "ra", "dec", "pa", "seeing", "airmass", "sky_brightness"), float),
}
"""Columns and dtypes of a table of visits."""


def filter_blocks(seed: int, start: float, means: Mapping[str, int], seeing: float) -> Blocks:
    """Draw the filter blocks of the survey.

    Parameters
    ----------
    seed, start, means, seeing
        As in `cadence`.
    """
    random = rng(seed, "pointings", "rubin", "nights")
    clear = random.random(NIGHTS) < CLEAR
    dither = random.uniform(-0.5, 0.5, (NIGHTS, 2))
    night_scatter = SEEING_NIGHT * random.standard_normal(NIGHTS)
    count = int(1 / BLOCK)
    # a night begins at noon; the phase of the filter changes is drawn for each night
    noon = np.floor(start) - LONGITUDE / 360 + 0.5 + np.arange(NIGHTS) - 1
    times = noon[:, None] + (np.arange(count) + random.random((NIGHTS, 1))) * BLOCK
    rotator = random.uniform(-ROTATOR, ROTATOR, times.shape)
    block_scatter = SEEING_BLOCK * random.standard_normal(times.shape)
    choice = random.random(times.shape)
    sun = np.maximum(altitude(*sun_position(times), times), altitude(*sun_position(times + BLOCK), times + BLOCK))
    moon = moonlight(times + BLOCK / 2)
    names = list(means)
    # relative frequencies of the bands; the blocks of a band that cannot be used go to the other bands
    frequencies = [means[name] * np.interp(moon, MOONLIGHT, BANDS[name].moonlight_choice) for name in names]
    weight = np.stack(
        [np.where(sun < BANDS[name].sun_limit, value, 0) for name, value in zip(names, frequencies, strict=True)]
    )
    total = weight.sum(axis=0)
    band = np.array([*names, ""], object)[(np.cumsum(weight, axis=0) <= choice * total).sum(axis=0)]
    used = (total > 0) & clear[:, None] & (times >= start) & (times < start + NIGHTS)
    night = np.broadcast_to(np.arange(NIGHTS)[:, None], times.shape)[used]
    fwhm = seeing * np.exp(night_scatter[:, None] + block_scatter)
    return Blocks(
        night=night,
        start=times[used],
        band=band[used],
        rotator=rotator[used],
        seeing=fwhm[used],
        dither=dither[night],
    )


def near_fields(centre: tuple[float, float], reach: float) -> pd.DataFrame:
    """Return the fields of the all-sky grid whose dithered positions may be near a position.

    The grid consists of rings of equal height, each divided into cells of equal width in right ascension. The cells
    tile the sky exactly, so visits that are spread evenly over their own cell cover the sky evenly, whatever the shape
    of the camera.

    Parameters
    ----------
    centre : tuple of float, degrees
        Right ascension and declination of the position.
    reach : float, degrees
        Largest distance of a dithered visit from the position.

    Returns
    -------
    DataFrame
        Columns number; ra, dec (centre of the cell, degrees); cell (its area, square degrees); width (in right
        ascension, degrees); height (degrees).
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
    # a shift in right ascension is largest on the side of the cell that faces the equator
    max_shift = width / 2 * np.cos(np.radians(np.maximum(np.abs(dec[ring]) - height / 2, 0)))
    cos_distance = unit_vectors(ra, dec[ring]) @ unit_vectors(*centre)
    return fields[cos_distance >= np.cos(np.radians(np.minimum(reach + np.hypot(max_shift, height / 2), 180)))]


@dataclass(frozen=True)
class _Chosen:
    """The visits of a field in one band."""

    blocks: np.ndarray
    """Index of the block of each visit."""
    moment: np.ndarray
    """Fraction of the block that has passed at the start of the visit."""
    sky: np.ndarray
    """Random deviation of the sky brightness, mag."""


def _choose(
    field: _Field, band: str, candidates: np.ndarray, curve_positions: np.ndarray, seed: int, density: float
) -> _Chosen:
    """Draw the visits of a field in one band.

    Parameters
    ----------
    field : _Field
        The field.
    band : str
        The band.
    candidates : ndarray of int
        Indices of the blocks of the band in which the field can be observed.
    curve_positions : ndarray, shape (blocks,)
        Position of the dither of each block on a curve that fills the cell of the field grid.
    seed : int
        Seed of the survey.
    density : float
        Mean number of visits per square degree.
    """
    random = rng(seed, "pointings", "rubin", field.number, band)
    expected = density * field.cell
    count = (int(expected) + (random.random() < expected % 1)) * (len(candidates) > 0)
    # systematic sampling of the blocks in the order of their dithers: all blocks are equally likely, and the visits
    # cover the cell of the field evenly, as a scheduler would make them; a block is used twice only if there are fewer
    # blocks than visits
    order = np.lexsort((random.random(len(candidates)), curve_positions[candidates]))
    rank = (random.random() + np.arange(count)) * len(candidates) / max(count, 1)
    blocks = candidates[order[rank.astype(int)]]
    return _Chosen(blocks, random.random(count), SKY_SCATTER * random.standard_normal(count))


def _morton_position(dither: np.ndarray) -> np.ndarray:
    """Return the positions (n,) of dithers (n, 2) on the Morton curve through 16 x 16 squares of a cell.

    Dithers that are near on the curve are near on the sky.
    """
    squares = np.minimum(((dither + 0.5) * 16).astype(int), 15)
    position = np.zeros(len(squares), int)
    for bit in range(4):
        for axis in range(2):
            position += (squares[:, axis] >> bit & 1) << 2 * bit + axis
    return position


def _visits(field: _Field, band: str, blocks: Blocks, chosen: _Chosen) -> pd.DataFrame:
    """Return the table of the visits of a field in one band."""
    at = chosen.blocks
    mjd = blocks.start[at] + BLOCK * chosen.moment
    ra_shift, dec_shift = blocks.dither[at].T
    ra, dec = (field.ra + ra_shift * field.width) % 360, field.dec + dec_shift * field.height
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


def _observable(field: _Field, times: list[np.ndarray], moon: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return a mask of the blocks in which a field can be observed: high, and far from the Moon.

    Parameters
    ----------
    field : _Field
        The field.
    times : list of ndarray, shape (blocks,), MJD
        Start and end of the blocks.
    moon : list of (ndarray, ndarray), degrees
        Right ascension and declination of the Moon at these times.
    """
    transit = 90 - abs(field.dec - LATITUDE)
    # a field that transits near the limit or below it is observed within 5 degrees of the altitude of its transit
    lowest = min(np.degrees(np.arcsin(1 / AIRMASS)), transit - 5)
    observable = np.full(len(times[0]), transit >= LOWEST_TRANSIT)
    for mjd, (moon_ra, moon_dec) in zip(times, moon, strict=True):
        cos_distance = unit_vectors(moon_ra, moon_dec) @ unit_vectors(field.ra, field.dec)
        close = (cos_distance > np.cos(np.radians(MOON_DISTANCE))) & (altitude(moon_ra, moon_dec, mjd) > 0)
        observable &= (altitude(field.ra, field.dec, mjd) >= lowest) & ~close
    return observable


def _edge(region: Region) -> np.ndarray:
    """Return unit vectors along the edge of a region."""
    along = np.linspace(0, 1, 33)
    ra = region.ra_min + region.width * np.concatenate([along, along, 0 * along, 0 * along + 1])
    height = region.dec_min + (region.dec_max - region.dec_min) * along
    dec = np.concatenate([0 * along + region.dec_min, 0 * along + region.dec_max, height, height])
    return unit_vectors(ra, dec)
