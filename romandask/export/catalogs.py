"""Export: what a survey holds, in the files that others read."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from romandask.export import meds, psf_images, truth_files
from romandask.ingest import obseq
from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.stages.cutouts import Wanted, located
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
    prepare(folder)
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
        If the file cannot be written.
    """
    visits = survey.visits(survey.sharpest)
    prepare(path.parent)
    obseq.write(path, visits)
    return len(visits)


def export_psf(survey: Survey, folder: Path, names: list[str]) -> list[Path]:
    """Write the PSF images of some Roman exposures, one FITS file each, and return where they are.

    Raises
    ------
    UserError
        If the survey has no such exposure, or the folder cannot be written.
    """
    product = survey.output(f"psfs/{survey.sharpest}")
    indices = indices_of(product, names, "exposure", "this survey")
    prepare(folder)
    attributes = product.variables[0].attributes
    table = survey.pointings(survey.sharpest)
    written = []
    for name, index in zip(names, indices, strict=True):
        path = folder / f"psf-{name}.fits"
        image = product.load(index)["psf"]
        row = table.iloc[index].to_dict()
        psf_images.write(path, image, attributes["oversampling"], attributes["pixel_scale"], row)
        written.append(path)
    return written


def export_coadd_psf(
    survey: Survey, path: Path, ra: float, dec: float, bands: list[str], scale: float | None
) -> list[Path]:
    """Write the PSF of Roman's coadds at a place (degrees), one FITS file a band, and return where they are.

    Raises
    ------
    UserError
        If there is no exposure of a band there, or the folder cannot be written.
    """
    every = survey.instruments[survey.sharpest].bands
    images = {band: survey.psf(ra, dec, band, scale=scale) for band in bands or every}
    prepare(path)
    written = []
    for band, image in images.items():
        written.append(path / f"psf-{band}-{ra:.5f}_{dec:+.5f}.fits")
        psf_images.write_coadd(written[-1], image.values, {**image.attrs, "ra": ra, "dec": dec, "band": band})
    return written


def export_meds(survey: Survey, folder: Path, of: Wanted, bands: list[str], size: int, catalog: str) -> list[Path]:
    """Write multi-epoch cutouts of objects from Roman's exposures, one MEDS file a band, and return where they are.

    Images are in electrons, less the expected background; an object that no exposure of a band sees has no cutouts.

    Raises
    ------
    UserError
        If objects, bands or size are not what the survey has, or the folder cannot be written.
    """
    objects = located(of, survey.tables(catalog), catalog)
    bands = bands or list(survey.instruments[survey.sharpest].bands)
    layers = ("image", "background", "weight", "dq", "psf")
    every = {band: survey.cutouts(objects, layers, (band,), size) for band in bands}
    prepare(folder)
    names = survey.output(f"exposures/{survey.sharpest}").names
    exptimes = dict(zip(names, survey.pointings(survey.sharpest)["exptime"], strict=True))
    written = []
    for band, found in every.items():
        units, image = np.unique(found["unit"].to_numpy(), return_inverse=True)
        exptime = np.array([exptimes[name] for name in units])
        zero = 2.5 * np.log10(survey.instruments[survey.sharpest].bandpass(band).ab_photons() * exptime)
        derivatives = found["jacobian"].to_numpy()
        columns = {name: found[name].to_numpy() for name in ("object", "column", "row")}
        columns |= {name: found[f"{name}_image"].to_numpy() for name in ("x", "y")}
        for k, name in enumerate(("dudx", "dudy", "dvdx", "dvdy")):
            columns[name] = derivatives[:, k // 2, k % 2]
        catalogue = meds.Catalog(
            objects,
            pd.DataFrame(columns | {"image": image}),
            pd.DataFrame({"name": units, "magzp": zero}),
            size,
        )
        path = folder / f"meds-{band}.fits"
        meds.write(path, catalogue, _blocks(found))
        written.append(path)
    return written


def _blocks(found: xr.Dataset) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """Yield the planes of the cutouts of one exposure after another."""
    stop = 0
    for count in found["image"].chunks[0] if found.sizes["cutout"] else ():
        rows, stop = slice(stop, stop + count), stop + count
        part = found.isel(cutout=rows).load()
        planes = {name: part[name].to_numpy() for name in ("weight", "dq", "psf")}
        # beyond an image's edge both are 0
        yield rows, planes | {"image": (part["image"] - part["background"]).to_numpy()}


def _parts(product: TableProduct) -> Iterator[pd.DataFrame]:
    for index in range(len(product.names)):
        yield product.load(index)


def indices_of(product: ImageProduct, names: Sequence[str], kind: str, holder: str) -> list[int]:
    """Return the units of some names; UserError, with the nearest name, where the holder has none of it."""
    places = {name: index for index, name in enumerate(product.names)}
    for name in names:
        if name not in places:
            close = difflib.get_close_matches(name, places, n=1, cutoff=0.0)
            raise UserError(f"{kind} {name!r}: {holder} has {len(places)}, nearest {', '.join(close) or 'none'}")
    return [places[name] for name in names]


def prepare(folder: Path) -> None:
    """Make a folder; UserError where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror})") from None
