"""Multi-order coverage maps (MOC, FITS) of stored images, one for each product and band. Needs the package mocpy."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord

from romandask.export.command import export_command, report_written
from romandask.export.files import completed, make_folder
from romandask.export.observations import observed_images
from romandask.export.options import Folder, StoreArgument
from romandask.model.errors import UserError
from romandask.survey import Survey, open_survey

AREA_ORDER = 14
"""HEALPix order of the maps: cells of 13 arcsec."""


def export_moc(survey: Survey, folder: Path) -> list[Path]:
    """Write the area of each stored image product and band as a MOC.

    Parameters
    ----------
    survey : Survey
        Stored survey.
    folder : Path
        Folder of the files.

    Returns
    -------
    list of Path
        Written files.

    Raises
    ------
    UserError
        If no image is stored, the folder cannot be created, or the package mocpy is not installed.
    """
    footprints: dict[tuple[str, str], list[np.ndarray]] = {}
    for observed in observed_images(survey):
        stage = observed.images.stage
        polygons: dict[str, list[np.ndarray]] = {}
        for index in observed.stored():
            observation = observed.observation(index)
            polygons.setdefault(observation.band, []).append(observation.corners)
        footprints |= {(stage, band): polygons[band] for band in sorted(polygons)}
    if not footprints:
        raise UserError("no image is stored yet: run the survey first")
    make_folder(folder)
    written = []
    for (stage, band), corners in footprints.items():
        path = folder / f"{stage.replace('/', '-')}-{band}.moc.fits"
        write_moc(path, corners, AREA_ORDER)
        written.append(path)
    return written


def write_moc(path: Path, polygons: Sequence[np.ndarray], order: int) -> None:
    """Write the union of polygons as a MOC.

    Parameters
    ----------
    path : Path
        FITS file.
    polygons : sequence of ndarray, shape (k, 2), degrees
        Right ascension and declination of the vertices of each polygon.
    order : int
        HEALPix order of the smallest cells.

    Raises
    ------
    UserError
        If the package mocpy is not installed.
    """
    if find_spec("mocpy") is None:
        raise UserError("maps of areas need the package mocpy: pip install 'romandask[moc]'")
    from mocpy import MOC  # noqa: PLC0415  an extra

    rings = [SkyCoord(vertices[:, 0], vertices[:, 1], unit="deg") for vertices in polygons]
    maps = MOC.from_polygons(rings, max_depth=order)
    union = maps[0].union(*maps[1:]) if len(maps) > 1 else maps[0]
    with completed(path) as temporary:
        union.save(temporary, format="fits", overwrite=True)


@export_command("moc")
def command(store: StoreArgument, out: Folder) -> None:
    """Write the area on the sky of exposures and tiles: a MOC (FITS) for each product and band."""
    report_written(export_moc(open_survey(store), out))
