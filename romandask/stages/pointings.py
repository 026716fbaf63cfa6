"""Pointings table of an instrument: the exposures (visit and detector) that touch a tile, with their footprints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

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

READERS: dict[str, Callable[..., pd.DataFrame]] = {"obseq": obseq.read, "opsim": opsim.read}
"""Reader of each format of observing sequences, by the setting `source`."""
CORNERS = tuple(f"{axis}_{k}" for k in range(4) for axis in ("ra", "dec"))
"""Columns with the corners of the footprint, degrees, in order along its outline."""


class PointingsSettings(Protocol):
    """The `pointings` section of an instrument's settings, as far as all instruments share it."""

    @property
    def source(self) -> str:
        """Format of the observing sequence, a key of `READERS`; any other value selects the instrument's own plan."""

    @property
    def path(self) -> str | None:
        """Path of the observing sequence, relative to the data folder."""

    @property
    def read_options(self) -> Mapping[str, str | None]:
        """Further arguments of the reader, by name."""


def pointings(
    instrument: Instrument,
    settings: PointingsSettings,
    data: AnyPath,
    region: Region,
    tiles: list[Tile],
    side: float,
    seed: int,
) -> pd.DataFrame:
    """Return the exposures whose footprints touch a tile, sorted by visit and detector.

    Parameters
    ----------
    instrument : Instrument
        Instrument of the exposures.
    settings : PointingsSettings
        The `pointings` section of the instrument's settings.
    data : path
        Folder that `settings.path` is relative to.
    region : Region
        Region that a generated plan covers.
    tiles : list of Tile
        Tiles of the survey.
    side : float, arcsec
        Side of the padded tiles.
    seed : int
        Seed of the survey.

    Returns
    -------
    DataFrame
        One row per exposure (schema: catalogs/pointings.yaml).

    Raises
    ------
    UserError
        If the file cannot be read, the telescope cannot point to one of the visits near the tiles, or no exposure in
        one of the bands touches a tile.
    """
    planned = visits(instrument, settings, data, region, seed)
    origin = (
        f"{instrument.name}.pointings ({settings.source})"
        if settings.path is None
        else str(resolve_below(data, settings.path))
    )
    planned = planned[planned["band"].isin(instrument.bands)]
    corners = np.stack([tile.corners(side) for tile in tiles])
    near = planned[_near(planned, corners, instrument.field_radius)]
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


def visits(
    instrument: Instrument, settings: PointingsSettings, data: AnyPath, region: Region, seed: int
) -> pd.DataFrame:
    """Return the visits of the observing sequence in the instrument's bands, wherever they point.

    Visits in other bands may be among them; their values may be missing or wrong.

    Parameters are as in `pointings`.

    Raises
    ------
    UserError
        If the file cannot be read, or the settings lack its path.
    """
    if settings.source not in READERS:
        return instrument.plan(region, seed)
    if not settings.path:
        raise UserError(f"{instrument.name}.pointings.path is needed with source: {settings.source}")
    file = resolve_below(data, settings.path)
    with access_errors_explained(file):
        return READERS[settings.source](file, bands=instrument.bands, **settings.read_options)


def corners_of(table: pd.DataFrame) -> np.ndarray:
    """Return the corners of the footprints in a pointings table, shape (n, 4, 2), degrees."""
    return table[list(CORNERS)].to_numpy(float).reshape(-1, 4, 2)


def _near(visits: pd.DataFrame, corners: np.ndarray, radius: float) -> np.ndarray:
    """Return a mask of the visits whose field of view may reach a tile.

    Parameters
    ----------
    visits : DataFrame
        Visits with the columns ra and dec, degrees.
    corners : ndarray, shape (tiles, 4, 2), degrees
        Corners of the tiles.
    radius : float, degrees
        Radius of the field of view.
    """
    boresights = unit_vectors(visits["ra"], visits["dec"])
    corner_vectors = unit_vectors(corners[..., 0], corners[..., 1]).reshape(-1, 3)
    centre = corner_vectors.mean(axis=0)
    spread = np.linalg.norm(corner_vectors - centre, axis=1).max()
    return np.linalg.norm(boresights - centre, axis=1) < spread + chord(radius * 3600)


def _exposures(instrument: Instrument, visits: pd.DataFrame, tiles: np.ndarray) -> pd.DataFrame:
    """Return one row per detector of the visits that touches a tile, sorted by visit and detector.

    `tiles` holds the corners of the tiles, shape (tiles, 4, 2), degrees.
    """
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
    settings: PointingsSettings
    """The `pointings` section of the instrument's settings."""
    data: AnyPath
    """Folder that the paths of source files are relative to."""
    region: Region
    tiles: tuple[Tile, ...]
    side: float
    """Side of the padded tiles, arcsec."""
    seed: int
    """Seed of the survey."""

    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of the only unit."""
        return pointings(self.instrument, self.settings, self.data, self.region, list(self.tiles), self.side, self.seed)


def build_pointings(context: SurveyContext, survey: str) -> TableProduct:
    """Return the lazy pointings table of an instrument, which has a single unit."""
    pipeline = context.pipeline
    block = pipeline.block(survey)
    settings = {
        "settings": block.model_dump(),
        "region": pipeline.region.model_dump(),
        "seed": pipeline.seed,
        "coadds": pipeline.coadds.model_dump(exclude={"pixfrac", "patch_pixels"}),
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
        units=(Unit(name="all", settings=settings),),
        make=maker,
        schema=schema("pointings"),
        bytes_per_unit=1 << 30,
    )


def _source_state(data: AnyPath, path: str | None) -> Any:
    """Return the path, size and modification time of a source file, which identify its content without reading it."""
    if path is None:
        return None
    file = resolve_below(data, path)
    return (path, *file_state(file)) if file.is_file() else (path,)


POINTINGS = Stage(
    name="pointings",
    per_survey=True,
    build=build_pointings,
    unit="instrument",
    summary="Exposures (visit and detector) that touch a tile, from a generated plan or cadence, an observing sequence "
    "(FITS) or an OpSim database.",
    tables={"pointings": "pointings/<survey>.parquet"},
)
