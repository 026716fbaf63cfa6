"""Pointings: one row an exposure (visit x detector) that touches the survey's tiles, with its footprint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from romandask.formats import obseq, opsim
from romandask.instruments.exposure import Exposure, Instrument, exposure_of
from romandask.model.errors import UserError
from romandask.model.sky import Region, chord, radec, touching_pairs, unit_vectors
from romandask.model.tiles import Tile

READERS: dict[str, Callable[[Path], pd.DataFrame]] = {"obseq": obseq.read, "opsim": opsim.read}
CORNERS = tuple(f"{axis}_{k}" for k in range(4) for axis in ("ra", "dec"))


def pointings(
    instrument: Instrument, settings, data: Path, region: Region, tiles: list[Tile], side: float, seed: int
) -> pd.DataFrame:
    """Return the exposures whose footprints touch a tile, by visit and detector (schema: catalogs/pointings.yaml).

    Parameters
    ----------
    settings : the instrument's `pointings` section; its path lies below `data`
    side : arcsec, of the padded tiles

    Raises
    ------
    UserError
        If the file cannot be read, or no exposure touches the region in one of the bands.
    """
    if settings.source in READERS:
        if not settings.path:
            raise UserError(f"{instrument.name}.pointings.path is needed with source: {settings.source}")
        visits = READERS[settings.source](data / settings.path)
        origin = str(data / settings.path)
    else:
        visits = instrument.plan(region, seed)
        origin = f"{instrument.name}.pointings ({settings.source})"
    visits = visits[visits["band"].isin(instrument.bands)]
    corners = np.stack([tile.corners(side) for tile in tiles])
    rows = _exposures(instrument, visits[_near(visits, corners, instrument.field_radius)], corners)
    missing = [band for band in instrument.bands if band not in set(rows["band"])]
    if missing:
        ra, dec = region.centre
        raise UserError(
            f"{origin}: no exposure of {instrument.name} in {', '.join(missing)} touches the region around "
            f"ra {ra:.3f}, dec {dec:.3f}: change region, the pointings or {instrument.name}.bands"
        )
    return rows


def corners_of(table: pd.DataFrame) -> np.ndarray:
    """Return the footprints (n, 4, 2), degrees, of a pointings table."""
    return table[list(CORNERS)].to_numpy(float).reshape(-1, 4, 2)


def _near(visits: pd.DataFrame, corners: np.ndarray, radius: float) -> np.ndarray:
    """True where a visit's field may reach a tile."""
    vectors = unit_vectors(visits["ra"], visits["dec"])
    tiles = unit_vectors(corners[..., 0], corners[..., 1]).reshape(-1, 3)
    centre = tiles.mean(axis=0)
    spread = np.linalg.norm(tiles - centre, axis=1).max()
    return np.linalg.norm(vectors - centre, axis=1) < spread + chord(radius * 3600)


def _exposures(instrument: Instrument, visits: pd.DataFrame, corners: np.ndarray) -> pd.DataFrame:
    vectors = unit_vectors(corners[..., 0], corners[..., 1]).reshape(-1, 3)
    middle = vectors.mean(axis=0) / np.linalg.norm(vectors.mean(axis=0))
    ra, dec = (float(value) for value in radec(middle))
    radius = np.degrees(2 * np.arcsin(np.linalg.norm(vectors - middle, axis=1).max() / 2))
    rows: list[dict] = []
    for _, visit in visits.assign(detector=0).iterrows():
        first = exposure_of(visit)
        try:
            footprints = instrument.footprints(first, ra, dec, radius)
        except (ValueError, RuntimeError) as error:
            raise UserError(
                f"{instrument.name} visit {first.visit} (MJD {first.mjd:.2f}, ra {first.ra:.3f}, dec {first.dec:.3f}): "
                f"cannot be pointed: {error}"
            ) from None
        if not footprints:
            continue
        detectors = list(footprints)
        touching, _ = touching_pairs(np.stack(list(footprints.values())), corners)
        for k in np.unique(touching):
            rows.append(_row(replace(first, detector=detectors[k]), footprints[detectors[k]]))
    columns = [*_row(_BLANK, np.zeros((4, 2)))]
    return pd.DataFrame(rows, columns=columns).sort_values(["visit", "detector"], ignore_index=True)


_BLANK = Exposure(0, 0, "", 0.0, 0.0, 0.0, 0.0, 0.0)


def _row(exposure: Exposure, corners: np.ndarray) -> dict:
    return vars(exposure) | dict(zip(CORNERS, corners.ravel().tolist(), strict=True))
