"""The plan of Roman's Reference High-Latitude Imaging Survey (Troxel et al. 2023, section 3), for any region.

Four nested loops: small diagonal dithers over the chip gaps; steps along the focal plane's short axis, which make a
strip; strips side by side along its long axis, which make a pass; two passes, one with the Sun to the east of the
field (leading) and one with the Sun to the west (trailing), which turns the focal plane by about 180 degrees. The
footprint is cut in sectors; each sector is observed in one go for each band and pass. Steps and times are those of the
mission's observing sequence of November 2023. Nothing is random.
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
from romandask.instruments.roman.focal_plane import corners, move, separations
from romandask.instruments.roman.sun import FURTHEST, LARGEST_ROLL, NEAREST, best_roll, leads, roll_offset, sun_angle
from romandask.kernels.universe.bandpasses import galsim_roman_bandpasses
from romandask.model.errors import UserError
from romandask.model.sky import Region, touching_pairs, unit_vectors

SHAPE = (galsim.roman.n_pix, galsim.roman.n_pix)
EXPTIME = 139.8
"""Seconds."""
LONG_STEP, SHORT_STEP = 0.80, 0.403
"""Steps of the focal plane along its x and y axes, degrees."""
DITHER = (0.01624, 0.02740)
"""Diagonal dither over the chip gaps along the focal plane's x and y axes, degrees."""
SLEWS = (0.0, 0.0319, 0.327, 0.347, 0.456, 0.490, 0.774, 0.935, 1.017, 1.257, 1.55, 2.44, 3.30, 8.06)
"""Slews, degrees, that take CADENCE seconds: medians of the mission's observing sequence (the first is assumed)."""
CADENCE = (169.7, 169.7, 198.6, 200.3, 206.8, 208.2, 221.9, 228.2, 230.1, 239.0, 248.2, 300.0, 334.3, 413.2)
"""From the start of an exposure to the start of the next one after a slew, seconds."""
SECTOR = 3.0
"""Largest side of a sector, degrees."""
OVERLAP = 0.05
"""Fields centred this far, degrees, outside their sector still belong to it where it meets another."""
MARGIN = 0.14
"""The region is covered with this margin, degrees: coadd tiles at its edge reach out of it."""
ROOM = 0.1
"""Kept from the limits of the Sun angle and of the roll, degrees."""
PAUSE = 600.0
"""Between the last exposure of a sector and the first of another one, seconds."""


@dataclass(frozen=True)
class Sector:
    """A part of the footprint that is observed in one go."""

    number: int
    box: Region
    """Every place in it is to be covered."""
    centres: Region
    """Where fields of the sector may be centred: other sectors take what lies further out."""
    patches: np.ndarray
    """Small polygons (n, 4, 2), degrees, that make up the box."""


def reference_plan(
    region: Region, bands: tuple[str, ...], dithers: Mapping[str, tuple[int, ...]], start: float
) -> pd.DataFrame:
    """Return the visits that cover a region, by time; the telescope observes one at a time.

    Parameters
    ----------
    dithers : exposures of every field in each pass, by band
    start : MJD from which on time is given out

    Returns
    -------
    Columns band, mjd, exptime (s), ra, dec, pa (degrees, of the focal plane's centre), visit, pass_number, sector,
    strip (within the sector), field (within the strip), dither.

    Raises
    ------
    UserError
        If no dates within four years suit a sector.
    """
    sectors = sectors_of(region)
    busy: list[tuple[float, float]] = []
    blocks = []
    for number in range(max(len(dithers[band]) for band in bands)):
        # bands that need the dark dates choose first
        for band in sorted(bands, key=lambda name: not BANDS[name].low_zodiacal):
            count = dithers[band][number] if number < len(dithers[band]) else 0
            for sector in sectors if count else ():
                block = _observe(sector, band, number, count, start, busy)
                busy.append((block["mjd"].min(), block["mjd"].max() + PAUSE / 86400))
                busy.sort()
                blocks.append(block)
    visits = pd.concat(blocks).sort_values("mjd", ignore_index=True)
    return visits.assign(visit=np.arange(len(visits)))


def sectors_of(region: Region) -> list[Sector]:
    """Return the sectors, of at most 3 x 3 degrees, into which a region with its margin is cut."""
    whole = _grown(region, MARGIN, MARGIN)
    lines = int(np.ceil((whole.dec_max - whole.dec_min) / SECTOR))
    heights = np.linspace(whole.dec_min, whole.dec_max, lines + 1)
    found: list[Sector] = []
    for low, high in zip(heights[:-1], heights[1:], strict=True):
        width = whole.width * np.cos(np.radians(min(abs(low), abs(high)) if low * high > 0 else 0.0))
        polar = max(-low, high) + 1.0 >= 90
        columns = 1 if polar and whole.width == 360 else int(np.ceil(width / SECTOR))
        sides = whole.ra_min + np.linspace(0, whole.width, columns + 1)
        for left, right in zip(sides[:-1], sides[1:], strict=True):
            box = Region(left % 360, right % 360, low, high)
            # outside the region nobody else takes a field: there they may be centred as far out as they reach in
            reach = [1.0 if edge else OVERLAP for edge in (left == sides[0], right == sides[-1])]
            if columns == 1 or whole.width == 360:
                reach = [1.0 if columns == 1 else OVERLAP] * 2
            bottom = low - (1.0 if low == heights[0] else OVERLAP)
            top = high + (1.0 if high == heights[-1] else OVERLAP)
            centres = _grown(Region(left % 360, right % 360, bottom, top), reach[0], 0.0, reach[1])
            if polar and columns == 1:
                centres = Region(0.0, 360.0, centres.dec_min, centres.dec_max)
            found.append(Sector(len(found), box, centres, _patches(box)))
    return found


def _observe(
    sector: Sector, band: str, number: int, count: int, start: float, busy: list[tuple[float, float]]
) -> pd.DataFrame:
    """Return one band and pass of a sector, on the best dates of its season that are free."""
    tried = set()
    length = 0.0
    for year in range(number // 2, number // 2 + 4):
        for day in _dates(sector, band, number % 2 == 0, start + 365.25 * year):
            time = _free(busy, float(day), length)
            while time not in tried:
                tried.add(time)
                block = _block(sector, band, number, count, time)
                length = block["mjd"].max() - time + PAUSE / 86400
                # where the block meets another one it starts later, and is made anew because the Sun has moved on
                if (later := _free(busy, time, length)) != time:
                    time = later
                elif _allowed(block):
                    return block
    ra, dec = sector.box.centre
    raise UserError(
        f"roman.pointings.start: found no free dates for {band}, pass {number + 1}, around ra {ra:.2f}, dec {dec:.2f} "
        f"in the four years from MJD {start:.0f}: choose a smaller region, fewer dithers or another start"
    )


def _dates(sector: Sector, band: str, leading: bool, start: float) -> np.ndarray:
    """Return the days (MJD) of a year from `start` on which a sector can be observed, the best ones first."""
    days = start + np.arange(365.0)
    ra, dec = sector.box.centre
    pa = best_roll(ra, dec, days) + BANDS[band].roll
    around = np.radians(np.arange(0, 360, 30))
    radius = _radius(sector)
    ring = move(ra, dec, pa[:, None], np.append(radius * np.sin(around), 0), np.append(radius * np.cos(around), 0))
    angle = sun_angle(*ring[:2], days[:, None])
    off = roll_offset(*ring, days[:, None])
    good = ((angle > NEAREST + ROOM) & (angle < FURTHEST - ROOM) & (np.abs(off) < LARGEST_ROLL - ROOM)).all(axis=1)
    days = days[good & (leads(ra, dec, days) == leading)]
    if not BANDS[band].low_zodiacal:
        return days
    place = galsim.CelestialCoord(ra * galsim.degrees, dec * galsim.degrees)
    bandpass = galsim_roman_bandpasses()[band]
    epoch = datetime(1858, 11, 17)
    levels = [galsim.roman.getSkyLevel(bandpass, place, date=epoch + timedelta(days=day)) for day in days]
    return days[np.argsort(levels, kind="stable")]


def _free(busy: list[tuple[float, float]], time: float, length: float) -> float:
    """Return the first time (MJD) from `time` on from which `length` days are free; `busy` is in order."""
    first = bisect_left(busy, (time, time))
    for begin, end in busy[max(first - 1, 0) :]:
        if begin >= time + length:
            break
        if end > time:
            time = end
    return time


def _allowed(block: pd.DataFrame) -> bool:
    angle = sun_angle(block["ra"], block["dec"], block["mjd"])
    off = roll_offset(block["ra"], block["dec"], block["pa"], block["mjd"])
    return bool(angle.min() > NEAREST and angle.max() < FURTHEST and np.abs(off).max() < LARGEST_ROLL)


def _block(sector: Sector, band: str, number: int, count: int, mjd: float) -> pd.DataFrame:
    """Return the visits of one band and pass of a sector from a time on: strips of dithered fields, to and fro."""
    ra, dec = sector.box.centre
    pa = float(best_roll(ra, dec, mjd)) + BANDS[band].roll
    strips, lines = (int(np.ceil((_radius(sector) + step) / step)) for step in (LONG_STEP, SHORT_STEP))
    i, j = (values.ravel() for values in np.mgrid[-strips : strips + 1, -lines : lines + 1])
    # the second pass is shifted by half a tile, so that edges and gaps of the two do not coincide
    shift = (number % 2) / 2
    field_ra, field_dec, field_pa = move(ra, dec, pa, (i + shift) * LONG_STEP, (j + shift) * SHORT_STEP)
    steps = np.arange(count)
    x, y = (middle + steps.mean() * step for middle, step in zip(_middle(), DITHER, strict=True))
    at_ra, at_dec, _ = move(field_ra, field_dec, field_pa, x, y)
    inside = sector.centres.contains(at_ra, at_dec)
    i, j, field_ra, field_dec, field_pa = (values[inside, None] for values in (i, j, field_ra, field_dec, field_pa))
    places = np.stack(move(field_ra, field_dec, field_pa, steps * DITHER[0], steps * DITHER[1]))
    boxes = corners(places[0].ravel(), places[1].ravel(), places[2].ravel(), SHAPE)
    touching, _ = touching_pairs(boxes.reshape(-1, 4, 2), sector.patches)
    needed = np.isin(np.arange(len(i)), touching // (18 * count))
    i, j, places = i[needed, 0], j[needed, 0], places[:, needed]
    # strips in turn, every other one backwards
    _, strip = np.unique(i, return_inverse=True)
    order = np.lexsort((np.where(strip % 2, -j, j), strip))
    strip, places = strip[order], places[:, order]
    field = np.arange(len(strip)) - np.searchsorted(strip, strip)
    all_ra, all_dec, all_pa = places.reshape(3, -1)
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
            "pass_number": number,
            "sector": sector.number,
            "strip": np.repeat(strip, count),
            "field": np.repeat(field, count),
            "dither": np.tile(steps, len(strip)),
        }
    )


def _middle() -> tuple[float, float]:
    """Return the mean of the corners of all SCAs along the focal plane's axes, degrees."""
    sky = corners([90.0], [0.0], [0.0], SHAPE).reshape(-1, 2)
    x, y = separations(90.0, 0.0, 0.0, sky[:, 0], sky[:, 1])
    return float(x.mean()), float(y.mean())


def _radius(sector: Sector) -> float:
    """Return how far from the sector's centre its fields may be centred, degrees."""
    middle = unit_vectors(*sector.box.centre)
    cosines = unit_vectors(sector.patches[..., 0], sector.patches[..., 1]) @ middle
    return float(np.degrees(np.arccos(cosines.min()))) + 0.6


def _grown(region: Region, left: float, height: float, right: float | None = None) -> Region:
    """Return a box grown by angles (degrees) to the left, above and below, and to the right (as to the left)."""
    low, high = max(region.dec_min - height, -90.0), min(region.dec_max + height, 90.0)
    right = left if right is None else right
    stretch = 1 / np.cos(np.radians(min(max(abs(low), abs(high)), 89.0)))
    if region.width + (left + right) * stretch >= 360:
        return Region(0.0, 360.0, low, high)
    return Region((region.ra_min - left * stretch) % 360, (region.ra_max + right * stretch) % 360, low, high)


def _patches(box: Region, side: float = 0.5) -> np.ndarray:
    """Return small polygons that make up a box: their edges are great circles and its own are not."""
    widest = np.cos(np.radians(min(abs(box.dec_min), abs(box.dec_max)) if box.dec_min * box.dec_max > 0 else 0.0))
    columns = max(int(np.ceil(box.width * widest / side)), 3 if box.width > 90 else 1)
    lines = int(np.ceil((box.dec_max - box.dec_min) / side))
    ra = box.ra_min + np.linspace(0, box.width, columns + 1)
    dec = np.linspace(box.dec_min, box.dec_max, lines + 1)
    k, m = (values.ravel() for values in np.mgrid[:columns, :lines])
    points = [(k, m), (k + 1, m), (k + 1, m + 1), (k, m + 1)]
    return np.stack([np.stack([ra[a] % 360, dec[b]], axis=1) for a, b in points], axis=1)
