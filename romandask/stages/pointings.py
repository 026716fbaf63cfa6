"""Pointings: one row an exposure (visit x detector) that touches the survey's tiles, with its footprint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from romandask.ingest import obseq, opsim
from romandask.instruments.exposure import EXPOSURE_COLUMNS
from romandask.instruments.instrument import Instrument
from romandask.model.errors import UserError
from romandask.model.sky import Region, chord, touching_pairs, unit_vectors
from romandask.model.tiles import Tile
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.stage import Stage, SurveyContext
from romandask.storage.paths import AnyPath, access_errors_explained, file_state, resolve_below

READERS: dict[str, Callable[[AnyPath], pd.DataFrame]] = {"obseq": obseq.read, "opsim": opsim.read}
CORNERS = tuple(f"{axis}_{k}" for k in range(4) for axis in ("ra", "dec"))


def pointings(
    instrument: Instrument, settings, data: AnyPath, region: Region, tiles: list[Tile], side: float, seed: int
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
    every = visits(instrument, settings, data, region, seed)
    origin = (
        f"{instrument.name}.pointings ({settings.source})"
        if settings.path is None
        else str(resolve_below(data, settings.path))
    )
    every = every[every["band"].isin(instrument.bands)]
    corners = np.stack([tile.corners(side) for tile in tiles])
    near = every[_near(every, corners, instrument.field_radius)]
    if (refused := instrument.refused(near)).any():
        first = near[refused].iloc[0]
        raise UserError(
            f"{origin}: {int(refused.sum())} visits of {instrument.name} cannot be pointed, the first is visit "
            f"{first['visit']} (MJD {first['mjd']:.2f}, ra {first['ra']:.3f}, dec {first['dec']:.3f}): the Sun is too "
            f"near or too far there: correct the pointings"
        )
    rows = _exposures(instrument, near, corners)
    missing = [band for band in instrument.bands if band not in set(rows["band"])]
    if missing:
        ra, dec = region.centre
        raise UserError(
            f"{origin}: no exposure of {instrument.name} in {', '.join(missing)} touches the region around "
            f"ra {ra:.3f}, dec {dec:.3f}: change region, the pointings or {instrument.name}.bands"
        )
    return rows


def visits(instrument: Instrument, settings, data: AnyPath, region: Region, seed: int) -> pd.DataFrame:
    """Return all visits of the observing sequence, whether or not they touch the region."""
    if settings.source not in READERS:
        return instrument.plan(region, seed)
    if not settings.path:
        raise UserError(f"{instrument.name}.pointings.path is needed with source: {settings.source}")
    place = resolve_below(data, settings.path)
    with access_errors_explained(place):
        return READERS[settings.source](place)


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


def _exposures(instrument: Instrument, visits: pd.DataFrame, tiles: np.ndarray) -> pd.DataFrame:
    """Return a row for each detector of the visits that touches a tile (tiles, 4, 2), by visit and detector."""
    footprints = instrument.footprints(visits).reshape(-1, 4, 2)
    touching = np.unique(touching_pairs(footprints, tiles)[0])
    visit, detector = np.divmod(touching, len(instrument.detectors))
    rows = visits.iloc[visit].assign(detector=np.array(instrument.detectors, int)[detector])
    rows = rows[list(EXPOSURE_COLUMNS)].reset_index(drop=True)
    outline = pd.DataFrame(footprints[touching].reshape(-1, 8), columns=list(CORNERS))
    return pd.concat([rows, outline], axis=1).sort_values(["visit", "detector"], ignore_index=True)


@dataclass(frozen=True, kw_only=True)
class MakePointings:
    """Makes the pointings table of one instrument."""

    instrument: Instrument
    settings: Any
    """The `pointings` section of its block in the pipeline."""
    data: AnyPath
    region: Region
    tiles: tuple[Tile, ...]
    side: float
    """Of the padded tiles, arcsec."""
    seed: int

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of the one unit."""
        return pointings(self.instrument, self.settings, self.data, self.region, list(self.tiles), self.side, self.seed)


def build_pointings(context: SurveyContext, survey: str) -> TableProduct:
    """Return the lazy pointings of an instrument: one unit."""
    pipeline = context.pipeline
    block = pipeline.block(survey)
    settings = {
        "settings": block.model_dump(),
        "region": pipeline.region.model_dump(),
        "seed": pipeline.seed,
        "coadds": pipeline.coadds.model_dump(exclude={"pixfrac"}),
        "source": _source_state(context.data, block.pointings.path),
    }
    maker = MakePointings(
        instrument=context.instruments[survey],
        settings=block.pointings,
        data=context.data,
        region=context.region,
        tiles=tuple(context.tiles),
        side=pipeline.coadds.grid().side,
        seed=pipeline.seed,
    )
    return TableProduct(
        stage=f"pointings/{survey}",
        units=(Unit("all", settings),),
        make=maker,
        schema=schema("pointings"),
        bytes_per_unit=1 << 30,
    )


def _source_state(data: AnyPath, path: str | None) -> Any:
    """Return what identifies the content of a source file without reading it."""
    if path is None:
        return None
    file = resolve_below(data, path)
    return (path, *file_state(file)) if file.is_file() else (path,)


POINTINGS = Stage(
    name="pointings",
    per_survey=True,
    build=build_pointings,
    unit="instrument",
    summary="Exposures (visit and detector) that touch the tiles: a generated plan or cadence, an observing sequence "
    "(FITS) or an OpSim database.",
    tables={"pointings": "pointings/<survey>.parquet"},
)
