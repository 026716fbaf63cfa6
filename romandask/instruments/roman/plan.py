"""Visits of Roman's Reference High-Latitude Imaging Survey (Troxel et al. 2023, section 3), for any region.

The plan has four nested loops:

1. small diagonal dithers over the gaps between SCAs;
2. steps along the short axis of the focal plane, which make a strip;
3. strips side by side along the long axis, which make a pass;
4. two passes, one with the Sun east of the field (leading) and one with the Sun west of it (trailing), between which
   the focal plane rotates by about 180 degrees.

The footprint is divided into sectors, and each band and pass of a sector is observed without interruption. Steps and
times are those of the mission's observing sequence of November 2023. Nothing is random.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta

import galsim
import galsim.roman
import numpy as np
import pandas as pd

from romandask.instruments.roman.bands import BANDS
from romandask.instruments.roman.focal_plane import SCAS, corners, move, separations
from romandask.instruments.roman.sun import FURTHEST, LARGEST_ROLL, NEAREST, best_roll, leads, roll_offset, sun_angle
from romandask.kernels.universe.bandpasses import galsim_roman_bandpasses
from romandask.model.errors import UserError
from romandask.model.sky import Region, touching_pairs, unit_vectors

SHAPE = (galsim.roman.n_pix, galsim.roman.n_pix)
"""Rows and columns of the active area of an SCA."""
EXPTIME = 139.8
"""Exposure time, seconds."""
LONG_STEP, SHORT_STEP = 0.80, 0.403
"""Steps between fields along the x and y axes of the focal plane, degrees."""
DITHER = (0.01624, 0.02740)
"""Diagonal dither over the gaps between SCAs, along the x and y axes of the focal plane, degrees."""
SLEWS = (0.0, 0.0319, 0.327, 0.347, 0.456, 0.490, 0.774, 0.935, 1.017, 1.257, 1.55, 2.44, 3.30, 8.06)
"""Lengths of slews, degrees, at which CADENCE is given."""
CADENCE = (169.7, 169.7, 198.6, 200.3, 206.8, 208.2, 221.9, 228.2, 230.1, 239.0, 248.2, 300.0, 334.3, 413.2)
"""Time from the start of an exposure to the start of the next one after a slew, seconds.

Medians of the mission's observing sequence; the first value is assumed.
"""
SECTOR = 3.0
"""Largest side of a sector, degrees."""
OVERLAP = 0.05
"""Distance outside a sector up to which fields are centred on a side that borders on another sector, degrees."""
OUTER_REACH = 1.0
"""The same on a side that borders on no other sector, degrees."""
MARGIN = 0.14
"""Margin around the region that is also covered, degrees, because coadd tiles extend beyond the region."""
ANGLE_MARGIN = 0.1
"""Distance kept from the limits of the Sun angle and of the roll when dates are chosen, degrees."""
PAUSE = 600.0
"""Time between the last exposure of a sector and the first exposure of another one, seconds."""


@dataclass(frozen=True)
class Sector:
    """A part of the footprint that is observed without interruption."""

    number: int
    """Number of the sector."""
    box: Region
    """Region to cover."""
    centres: Region
    """Region in which fields of the sector may be centred; fields outside it belong to other sectors."""
    patches: np.ndarray
    """Polygons that make up the box, shape (n, 4, 2), degrees."""


def reference_plan(
    region: Region, bands: tuple[str, ...], dithers: Mapping[str, tuple[int, ...]], start: float
) -> pd.DataFrame:
    """Return the visits that cover a region, in order of time; visits do not overlap in time.

    Parameters
    ----------
    region : Region
        Region to cover.
    bands : tuple of str
        Names of the bands.
    dithers : dict of str to tuple of int
        Number of exposures of every field in each pass, by band.
    start : float, MJD
        First day on which the telescope is available.

    Returns
    -------
    DataFrame
        Columns band, mjd, exptime (seconds), ra, dec, pa (of the centre of the focal plane, degrees), visit,
        pass_number, sector, strip (within the sector), field (within the strip), dither.

    Raises
    ------
    UserError
        If a sector cannot be observed on any free date within four years.
    """
    sectors = sectors_of(region)
    busy: list[tuple[float, float]] = []
    blocks = []
    for pass_number in range(max(len(dithers[band]) for band in bands)):
        # bands that need dates of low zodiacal light are planned first
        for band in sorted(bands, key=lambda name: not BANDS[name].low_zodiacal):
            count = dithers[band][pass_number] if pass_number < len(dithers[band]) else 0
            for sector in sectors if count else ():
                block = _observe(sector, band, pass_number, count, start, busy)
                busy.append((block["mjd"].min(), block["mjd"].max() + PAUSE / 86400))
                busy.sort()
                blocks.append(block)
    visits = pd.concat(blocks).sort_values("mjd", ignore_index=True)
    return visits.assign(visit=np.arange(len(visits)))


def sectors_of(region: Region) -> list[Sector]:
    """Return the sectors, of at most 3 x 3 degrees, into which a region and its margin are divided."""
    whole = _grown(region, MARGIN, MARGIN)
    rows = int(np.ceil((whole.dec_max - whole.dec_min) / SECTOR))
    decs = np.linspace(whole.dec_min, whole.dec_max, rows + 1)
    sectors: list[Sector] = []
    for low, high in zip(decs[:-1], decs[1:], strict=True):
        width = whole.width * np.cos(np.radians(min(abs(low), abs(high)) if low * high > 0 else 0.0))
        polar = max(-low, high) + OUTER_REACH >= 90
        columns = 1 if polar and whole.width == 360 else int(np.ceil(width / SECTOR))
        ras = whole.ra_min + np.linspace(0, whole.width, columns + 1)
        for left, right in zip(ras[:-1], ras[1:], strict=True):
            box = Region(left % 360, right % 360, low, high)
            # no other sector has the fields outside the region, so every field that reaches the region is included
            reach = [OUTER_REACH if edge else OVERLAP for edge in (left == ras[0], right == ras[-1])]
            if columns == 1 or whole.width == 360:
                reach = [OUTER_REACH if columns == 1 else OVERLAP] * 2
            bottom = low - (OUTER_REACH if low == decs[0] else OVERLAP)
            top = high + (OUTER_REACH if high == decs[-1] else OVERLAP)
            centres = _grown(Region(left % 360, right % 360, bottom, top), reach[0], 0.0, reach[1])
            if polar and columns == 1:
                centres = Region(0.0, 360.0, centres.dec_min, centres.dec_max)
            sectors.append(Sector(len(sectors), box, centres, _patches(box)))
    return sectors


def _observe(
    sector: Sector, band: str, pass_number: int, count: int, start: float, busy: list[tuple[float, float]]
) -> pd.DataFrame:
    """Return the visits of one band and pass of a sector, on the best free dates of its season.

    Parameters
    ----------
    sector : Sector
        The sector.
    band : str
        Name of the band.
    pass_number : int
        Number of the pass; even passes are leading.
    count : int
        Number of dithers of every field.
    start : float, MJD
        First day on which the telescope is available.
    busy : list of (float, float), MJD
        Times at which the telescope is not available, sorted.
    """
    tried = set()
    length = 0.0
    for year in range(pass_number // 2, pass_number // 2 + 4):
        for day in _dates(sector, band, pass_number % 2 == 0, start + 365.25 * year):
            time = _free(busy, float(day), length)
            while time not in tried:
                tried.add(time)
                block = _block(sector, band, pass_number, count, time)
                length = block["mjd"].max() - time + PAUSE / 86400
                # a block that overlaps another one starts later; it is made again, because the Sun has moved
                if (later := _free(busy, time, length)) != time:
                    time = later
                elif _allowed(block):
                    return block
    ra, dec = sector.box.centre
    raise UserError(
        f"roman.pointings.start: found no free dates for {band}, pass {pass_number + 1}, around ra {ra:.2f}, "
        f"dec {dec:.2f} in the four years from MJD {start:.0f}: choose a smaller region, fewer dithers or another start"
    )


def _dates(sector: Sector, band: str, leading: bool, start: float) -> np.ndarray:
    """Return the days (MJD) on which a sector can be observed, within a year from `start`, the best ones first.

    They belong to the leading season if `leading` is true, otherwise to the trailing season.
    """
    days = start + np.arange(365.0)
    ra, dec = sector.box.centre
    pa = best_roll(ra, dec, days) + BANDS[band].roll
    # the limits are tested in the middle of the sector and on a circle around it
    bearing = np.radians(np.arange(0, 360, 30))
    radius = _radius(sector)
    x, y = np.append(radius * np.sin(bearing), 0), np.append(radius * np.cos(bearing), 0)
    ring_ra, ring_dec, ring_pa = move(ra, dec, pa[:, None], x, y)
    angle = sun_angle(ring_ra, ring_dec, days[:, None])
    roll = roll_offset(ring_ra, ring_dec, ring_pa, days[:, None])
    sun_allowed = (angle > NEAREST + ANGLE_MARGIN) & (angle < FURTHEST - ANGLE_MARGIN)
    allowed = (sun_allowed & (np.abs(roll) < LARGEST_ROLL - ANGLE_MARGIN)).all(axis=1)
    days = days[allowed & (leads(ra, dec, days) == leading)]
    if not BANDS[band].low_zodiacal:
        return days
    centre = galsim.CelestialCoord(ra * galsim.degrees, dec * galsim.degrees)
    bandpass = galsim_roman_bandpasses()[band]
    epoch = datetime(1858, 11, 17)
    levels = [galsim.roman.getSkyLevel(bandpass, centre, date=epoch + timedelta(days=day)) for day in days]
    return days[np.argsort(levels, kind="stable")]


def _free(busy: list[tuple[float, float]], time: float, length: float) -> float:
    """Return the first time (MJD), not before `time`, that is followed by `length` free days; `busy` is sorted."""
    first = bisect_left(busy, (time, time))
    for begin, end in busy[max(first - 1, 0) :]:
        if begin >= time + length:
            break
        if end > time:
            time = end
    return time


def _allowed(block: pd.DataFrame) -> bool:
    """Return whether all visits of a block keep the limits of the Sun angle and of the roll."""
    angle = sun_angle(block["ra"], block["dec"], block["mjd"])
    roll = roll_offset(block["ra"], block["dec"], block["pa"], block["mjd"])
    return bool(angle.min() > NEAREST and angle.max() < FURTHEST and np.abs(roll).max() < LARGEST_ROLL)


def _block(sector: Sector, band: str, pass_number: int, count: int, mjd: float) -> pd.DataFrame:
    """Return the visits of one band and pass of a sector that begin at a time, MJD.

    Strips of dithered fields are observed in alternating directions.
    """
    ra, dec = sector.box.centre
    pa = float(best_roll(ra, dec, mjd)) + BANDS[band].roll
    columns, rows = (int(np.ceil((_radius(sector) + step) / step)) for step in (LONG_STEP, SHORT_STEP))
    i, j = (values.ravel() for values in np.mgrid[-columns : columns + 1, -rows : rows + 1])
    # the second pass is shifted by half a step, so that the edges and gaps of the two passes do not coincide
    shift = (pass_number % 2) / 2
    field_ra, field_dec, field_pa = move(ra, dec, pa, (i + shift) * LONG_STEP, (j + shift) * SHORT_STEP)
    steps = np.arange(count)
    x, y = (middle + steps.mean() * step for middle, step in zip(_middle(), DITHER, strict=True))
    # fields belong to the sector by the middle of the area that their dithers cover
    middle_ra, middle_dec, _ = move(field_ra, field_dec, field_pa, x, y)
    inside = sector.centres.contains(middle_ra, middle_dec)
    i, j, field_ra, field_dec, field_pa = (values[inside, None] for values in (i, j, field_ra, field_dec, field_pa))
    # (ra, dec, pa) of each field and dither
    pointings = np.stack(move(field_ra, field_dec, field_pa, steps * DITHER[0], steps * DITHER[1]))
    footprints = corners(pointings[0].ravel(), pointings[1].ravel(), pointings[2].ravel(), SHAPE)
    touching, _ = touching_pairs(footprints.reshape(-1, 4, 2), sector.patches)
    needed = np.isin(np.arange(len(i)), touching // (len(SCAS) * count))
    i, j, pointings = i[needed, 0], j[needed, 0], pointings[:, needed]
    # strip after strip, every other one backwards
    _, strip = np.unique(i, return_inverse=True)
    order = np.lexsort((np.where(strip % 2, -j, j), strip))
    strip, pointings = strip[order], pointings[:, order]
    field = np.arange(len(strip)) - np.searchsorted(strip, strip)
    all_ra, all_dec, all_pa = pointings.reshape(3, -1)
    x, y = separations(all_ra[:-1], all_dec[:-1], all_pa[:-1], all_ra[1:], all_dec[1:])
    waits = np.interp(np.hypot(x, y), SLEWS, CADENCE)
    return pd.DataFrame(
        {
            "band": band,
            "mjd": mjd + np.concatenate([[0.0], np.cumsum(waits)]) / 86400,
            "exptime": EXPTIME,
            "ra": all_ra,
            "dec": all_dec,
            "pa": all_pa,
            "pass_number": pass_number,
            "sector": sector.number,
            "strip": np.repeat(strip, count),
            "field": np.repeat(field, count),
            "dither": np.tile(steps, len(strip)),
        }
    )


def _middle() -> tuple[float, float]:
    """Return the mean offset (x, y) of the corners of all SCAs from the centre of the focal plane, degrees."""
    sky = corners([90.0], [0.0], [0.0], SHAPE).reshape(-1, 2)
    x, y = separations(90.0, 0.0, 0.0, sky[:, 0], sky[:, 1])
    return float(x.mean()), float(y.mean())


def _radius(sector: Sector) -> float:
    """Return the largest distance of a field of a sector from the centre of the sector, degrees."""
    middle = unit_vectors(*sector.box.centre)
    cosines = unit_vectors(sector.patches[..., 0], sector.patches[..., 1]) @ middle
    return float(np.degrees(np.arccos(cosines.min()))) + 0.6


def _grown(region: Region, left: float, height: float, right: float | None = None) -> Region:
    """Return a box enlarged by angles, degrees: `left`, `height` (up and down), and `right` (default: as `left`)."""
    low, high = max(region.dec_min - height, -90.0), min(region.dec_max + height, 90.0)
    right = left if right is None else right
    stretch = 1 / np.cos(np.radians(min(max(abs(low), abs(high)), 89.0)))
    if region.width + (left + right) * stretch >= 360:
        return Region(0.0, 360.0, low, high)
    return Region((region.ra_min - left * stretch) % 360, (region.ra_max + right * stretch) % 360, low, high)


def _patches(box: Region, side: float = 0.5) -> np.ndarray:
    """Return polygons (n, 4, 2), degrees, of about `side` degrees that make up a box.

    The edges of polygons are great circles; those of the box in right ascension are not.
    """
    widest = np.cos(np.radians(min(abs(box.dec_min), abs(box.dec_max)) if box.dec_min * box.dec_max > 0 else 0.0))
    columns = max(int(np.ceil(box.width * widest / side)), 3 if box.width > 90 else 1)
    rows = int(np.ceil((box.dec_max - box.dec_min) / side))
    ra = box.ra_min + np.linspace(0, box.width, columns + 1)
    dec = np.linspace(box.dec_min, box.dec_max, rows + 1)
    k, m = (values.ravel() for values in np.mgrid[:columns, :rows])
    points = [(k, m), (k + 1, m), (k + 1, m + 1), (k, m + 1)]
    return np.stack([np.stack([ra[a] % 360, dec[b]], axis=1) for a, b in points], axis=1)
