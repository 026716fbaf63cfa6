"""Commands that write what a survey holds in the files that others read, and those of calibrations."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from romandask.cli.options import Overrides, Source, StoreArgument
from romandask.engine.progress import busy
from romandask.export import sha256sums
from romandask.export.catalogs import export_coadd_psf, export_meds, export_obseq, export_psf, export_truth
from romandask.export.images import export_fits, export_moc, export_obscore
from romandask.export.roman_datamodels import export_asdf, export_mosaics
from romandask.instruments.roman.calibration import check_files, make_files
from romandask.instruments.roman.focal_plane import SCAS
from romandask.model.errors import UserError
from romandask.model.sky import Cone
from romandask.pipeline import load_pipeline
from romandask.report.sky_viewer import write_sky_viewer
from romandask.survey import Survey, open_survey

export_app = typer.Typer(no_args_is_help=True)
calibration_app = typer.Typer(no_args_is_help=True)
Folder = Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the files.")]
Exposures = Annotated[list[str], typer.Option("--exposure", help="Name, for example H158-12-7; may be repeated.")]


def _wrote(paths: Iterable[Path]) -> None:
    """Say what was written, as it is, and write its checksums beside it."""
    for path in paths:
        sha256sums.note(path)
        Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


@export_app.callback()
def exporting(context: typer.Context) -> None:
    """Write a survey's contents in other formats."""
    context.with_resource(busy("exporting"))


@calibration_app.callback()
def calibrating(context: typer.Context) -> None:
    """Calibration files of Roman's detectors."""
    context.with_resource(busy("on calibration files"))


@export_app.command("truth")
def export_truth_files(store: StoreArgument, out: Folder) -> None:
    """Write the truth as galaxies.fits and stars.fits, and its spectra as seds.hdf5."""
    _wrote(export_truth(open_survey(store), out))


@export_app.command("obseq")
def export_visits(
    pipeline: Source,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="FITS file.")],
    overrides: Overrides = None,
) -> None:
    """Write all Roman visits of a pipeline as an observing sequence (FITS) that GalSim-based tools read."""
    count = export_obseq(Survey(load_pipeline(pipeline, overrides)), out)
    sha256sums.note(out)
    Console().print(f"wrote {count} visits to {out}", highlight=False, soft_wrap=True)


@export_app.command("fits")
def export_fits_images(
    store: StoreArgument,
    out: Folder,
    survey: Annotated[str | None, typer.Option("--survey", help="Default: the one of the finest pixels.")] = None,
    exposure: Annotated[list[str] | None, typer.Option("--exposure", help="Name; may be repeated.")] = None,
    tile: Annotated[list[str] | None, typer.Option("--tile", help="Name; may be repeated.")] = None,
    band: Annotated[list[str] | None, typer.Option("--band", help="Of tiles; may be repeated; default: all.")] = None,
) -> None:
    """Write exposures or tiles as FITS with SCI, ERR and DQ, one file an exposure, or tile and band."""
    found = open_survey(store)
    survey = found.sharpest if survey is None else survey
    if survey not in found.instruments:
        raise UserError(f"--survey {survey}: this survey has {', '.join(found.instruments)}")
    if not exposure and not tile:
        raise UserError("export fits needs --exposure or --tile, one or more")
    _wrote(export_fits(found, out, survey, exposure or [], tile or [], band or []))


@export_app.command("asdf")
def export_asdf_images(
    store: StoreArgument,
    out: Folder,
    exposure: Annotated[
        list[str] | None, typer.Option("--exposure", help="Name, for example H158-12-7; may be repeated.")
    ] = None,
    tile: Annotated[list[str] | None, typer.Option("--tile", help="Name; may be repeated.")] = None,
    band: Annotated[list[str] | None, typer.Option("--band", help="Of tiles; may be repeated; default: all.")] = None,
) -> None:
    """Write Roman exposures as level 2 images, tiles as level 3 mosaics, in ASDF, as roman_datamodels reads them."""
    found = open_survey(store)
    if not exposure and not tile:
        raise UserError("export asdf needs --exposure or --tile, one or more")
    _wrote(export_asdf(found, out, exposure) if exposure else [])
    _wrote(export_mosaics(found, out, tile, band or []) if tile else [])


@export_app.command("page")
def export_page(store: StoreArgument, out: Folder) -> None:
    """Write the coadds as one page to drag and zoom in, both telescopes at the same place: OUT/index.html."""
    path = write_sky_viewer(open_survey(store), out)
    Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


@export_app.command("obscore")
def export_obscore_table(
    store: StoreArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File: .vot, .xml, .fits or .parquet.")],
) -> None:
    """Write a table of all stored exposures and tiles in ObsCore's columns, as archives describe observations."""
    count = export_obscore(open_survey(store), out)
    sha256sums.note(out)
    Console().print(f"wrote {count} images to {out}", highlight=False, soft_wrap=True)


@export_app.command("moc")
def export_area_maps(store: StoreArgument, out: Folder) -> None:
    """Write where exposures and tiles lie on the sky, a MOC (FITS) each product and band."""
    _wrote(export_moc(open_survey(store), out))


@export_app.command("psf")
def export_psf_images(
    store: StoreArgument,
    out: Folder,
    exposure: Exposures,
) -> None:
    """Write PSF images of Roman exposures (FITS): a unit star, 8 samples a pixel."""
    _wrote(export_psf(open_survey(store), out, exposure))


@export_app.command("coadd-psf")
def export_coadd_psf_images(
    store: StoreArgument,
    out: Folder,
    at: Annotated[tuple[float, float], typer.Option("--at", metavar="RA DEC", help="Degrees.")],
    band: Annotated[list[str] | None, typer.Option("--band", help="May be repeated; default: all.")] = None,
    scale: Annotated[
        float | None,
        typer.Option("--scale", min=1e-3, help="Arcsec between samples; default: the coadd's own pixels."),
    ] = None,
) -> None:
    """Write the PSF of Roman's coadds at a place: a unit star as the exposures there have it, drizzled (FITS)."""
    _wrote(export_coadd_psf(open_survey(store), out, *at, band or [], scale))


@export_app.command("meds")
def export_meds_files(
    store: StoreArgument,
    out: Folder,
    ids: Annotated[list[int] | None, typer.Option("--id", help="Id of an object; may be repeated.")] = None,
    cone: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--cone", metavar="RA DEC RADIUS", help="All objects there: degrees, degrees, arcsec."),
    ] = None,
    band: Annotated[list[str] | None, typer.Option("--band", help="May be repeated; default: all.")] = None,
    size: Annotated[int, typer.Option("--size", help="Pixels a side, even.")] = 48,
    catalog: Annotated[str, typer.Option("--catalog", help="Whose objects: truth, roman or rubin.")] = "truth",
) -> None:
    """Write cutouts of objects from all Roman exposures that see them, with WCS and PSF: one MEDS file a band."""
    if (ids is None) == (cone is None):
        raise UserError("export meds needs --id (one or more) or --cone, not both")
    of = Cone(*cone) if cone is not None else ids or []
    _wrote(export_meds(open_survey(store), out, of, band or [], size, catalog))


@calibration_app.command("make")
def calibration_make(
    out: Folder,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same files from the same seed.")] = 0,
    sca: Annotated[list[int] | None, typer.Option("--sca", help="SCA, 1-18; may be repeated; default: all.")] = None,
) -> None:
    """Make calibration files of made-up detectors, with the statistics of the real ones: 1.6 GB an SCA."""
    _wrote(make_files(out, seed, sca or SCAS))


@calibration_app.command("check")
def calibration_check(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of sca01.fits to sca18.fits.")],
) -> None:
    """Check that calibration files have every extension of table 1 of Troxel et al. (2023), with its type and shape."""
    for path in check_files(folder):
        Console().print(f"{path}: as it should be", highlight=False, soft_wrap=True)
