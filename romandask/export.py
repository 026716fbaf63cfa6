"""Export: what a survey holds, in the files that others read."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from romandask.formats import obseq, psf_image, truth_files
from romandask.model.errors import UserError
from romandask.runtime.products import TableProduct
from romandask.survey import Survey


def export_truth(survey: Survey, folder: Path) -> list[Path]:
    """Write galaxies.fits, stars.fits and seds.hdf5 of a stored survey and return where they are.

    Raises
    ------
    UserError
        If the truth is not all there, or the folder cannot be written.
    """
    catalogs = survey.truth_catalogs
    for product in (catalogs.galaxies, catalogs.stars):
        missing = [name for k, name in enumerate(product.names) if not product.has(k)]
        if missing:
            raise UserError(
                f"{product.stage} is not all there: {len(missing)} of {len(product.names)} units are missing, first "
                f"{missing[0]}; run the survey first"
            )
    _prepare(folder)
    bins = max(len(catalogs.edges) - 1, 0)
    written = []
    for product in (catalogs.galaxies, catalogs.stars):
        path = folder / f"{product.stage.split('/')[1]}.fits"
        truth_files.write_fits(path, product.schema, _parts(product), len(product.column("ra")), bins)
        written.append(path)
    path = folder / "seds.hdf5"
    truth_files.write_spectra(path, catalogs.library, catalogs.edges)
    return [*written, path]


def export_obseq(survey: Survey, path: Path) -> int:
    """Write all Roman visits as an observing sequence and return their number.

    Raises
    ------
    UserError
        If the survey has no Roman, or the file cannot be written.
    """
    visits = survey.visits("roman")
    _prepare(path.parent)
    obseq.write(path, visits)
    return len(visits)


def export_psf(survey: Survey, folder: Path, names: list[str]) -> list[Path]:
    """Write the PSF images of some Roman exposures, one FITS file each, and return where they are.

    Raises
    ------
    UserError
        If the survey has no such exposure, or the folder cannot be written.
    """
    product = survey.psf_product("roman")
    places = {name: index for index, name in enumerate(product.names)}
    for name in names:
        if name not in places:
            close = difflib.get_close_matches(name, places, n=1, cutoff=0.0)
            raise UserError(f"exposure {name!r}: this survey has {len(places)}, nearest {', '.join(close) or 'none'}")
    _prepare(folder)
    attributes = product.variables[0].attributes
    table = survey.pointings("roman")
    written = []
    for name in names:
        path = folder / f"psf-{name}.fits"
        image = product.load(places[name])["psf"]
        row = table.iloc[places[name]].to_dict()
        psf_image.write(path, image, attributes["oversampling"], attributes["pixel_scale"], row)
        written.append(path)
    return written


def _parts(product: TableProduct) -> Iterator[pd.DataFrame]:
    for index in range(len(product.names)):
        yield product.load(index)


def _prepare(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror})") from None
