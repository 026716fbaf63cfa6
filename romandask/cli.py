"""The command line: no logic of its own. A user's mistake is one line and exit code 2."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

# one thread a process: the workers are the parallelism
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Column, Table  # noqa: E402

from romandask import flow, stages, verification  # noqa: E402
from romandask.calibration import check_files, make_files  # noqa: E402
from romandask.export import export_coadd_psf, export_meds, export_obseq, export_psf, export_truth  # noqa: E402
from romandask.instruments.roman_focal_plane import SCAS  # noqa: E402
from romandask.model.config import read_yaml  # noqa: E402
from romandask.model.errors import UserError  # noqa: E402
from romandask.model.sky import Cone  # noqa: E402
from romandask.pipeline import load_pipeline, pipeline_of  # noqa: E402
from romandask.pixfrac import advice, coverage  # noqa: E402
from romandask.report import dag_svg, write_report  # noqa: E402
from romandask.runtime.cluster import runner  # noqa: E402
from romandask.runtime.progress import Reporter  # noqa: E402
from romandask.runtime.store import Store  # noqa: E402
from romandask.survey import Survey, open_survey  # noqa: E402

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    help="A joint Roman and Rubin synthetic sky survey.",
)
ingest_app = typer.Typer(no_args_is_help=True, help="Bring a real catalog into a store.")
app.add_typer(ingest_app, name="ingest")
export_app = typer.Typer(no_args_is_help=True, help="Write a survey's contents in other formats.")
app.add_typer(export_app, name="export")
calibration_app = typer.Typer(no_args_is_help=True, help="Calibration files of Roman's detectors.")
app.add_typer(calibration_app, name="calibration")

Source = Annotated[
    str, typer.Argument(metavar="PIPELINE", help="A YAML file, or the name of a pipeline that came with the package.")
]
Overrides = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Settings, for example coadds.pixfrac=0.8.")
]
Place = Annotated[Path, typer.Option("--store", help="Folder of the store.")]
Workers = Annotated[int | None, typer.Option("--workers", min=0, help="Local processes; 0 runs in this one.")]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", help="Address of an existing dask scheduler, tcp://host:port.")
]
StoreArgument = Annotated[Path, typer.Argument(metavar="STORE", help="Folder of the store.")]
Spectra = Annotated[
    Path | None, typer.Option("--seds", help="Folder of the spectra that are named; default: seds beside SRC.")
]
Order = Annotated[int, typer.Option("--order", min=3, max=12, help="HEALPix order of the partitions.")]


@app.command()
def plan(
    pipeline: Source,
    overrides: Overrides = None,
    dag: Annotated[Path | None, typer.Option("--dag", help="Write the stages as an SVG picture to this file.")] = None,
) -> None:
    """Show units, bytes and peak memory of every stage; write nothing."""
    settings = load_pipeline(pipeline, overrides)
    rows = stages.plan(Survey(settings))
    table = Table(Column("stage", no_wrap=True), "units", "image bytes", "core hours", "worker memory")
    for row in rows:
        size = f"{row.bytes / 1e9:.2f} GB" if row.bytes else "-"
        hours = f"{row.hours:.2f}" if row.hours else "-"
        table.add_row(row.stage, str(row.units), size, hours, f"{row.memory / 2**30:.2f} GiB")
    total = sum(row.units for row in rows)
    table.add_row(
        "total",
        str(total),
        f"{sum(row.bytes for row in rows) / 1e9:.2f} GB",
        f"{sum(row.hours for row in rows):.2f}",
        f"limit {settings.run.memory_limit:.2f} GiB",
    )
    Console().print(table)
    if dag is not None:
        dag_svg(rows, dag)
        Console().print(f"wrote {dag}", highlight=False)


@app.command()
def pixfrac(pipeline: Source, overrides: Overrides = None) -> None:
    """Show what each pixfrac does to the coadds of Roman's dithers, and recommend one; make nothing."""
    found = coverage(Survey(load_pipeline(pipeline, overrides)).coadd_product("roman"))
    table = Table("band", "exposures", "pixfrac", "empty pixels", "rms / median of weight", "")
    for one in found:
        cells = (str(one.exposures), f"{one.pixfrac:.1f}", f"{one.empty:.2%}", f"{one.uneven:.3f}")
        table.add_row(one.band, *cells, "good" if one.good else "")
    Console().print(table)
    best = advice(found)
    text = "none is good in all bands: more exposures are needed" if best is None else f"coadds.pixfrac={best:g}"
    Console().print(text, highlight=False)


@app.command()
def run(
    pipeline: Source,
    store: Place,
    overrides: Overrides = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="A stage alone, coadds or coadds/roman; may be repeated.")
    ] = None,
    start: Annotated[str | None, typer.Option("--from", help="This stage and those after it.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say which units would be made and why, and make none.")
    ] = False,
    explain: Annotated[bool, typer.Option("--explain", help="Say why units are made, then make them.")] = False,
) -> None:
    """Make and store everything that is missing, then the report. The same command resumes."""
    settings = load_pipeline(pipeline, overrides)
    reporter = Reporter(Console())
    stages.plan(Survey(settings))
    place, chosen = Store(store.resolve()), stages.Chosen(tuple(only or ()), start)
    if dry_run or explain:
        _explain(Survey(settings, place), chosen, reporter)
    if dry_run:
        return
    chosen.of(stages.stages(Survey(settings)))
    place.prepare()
    began = time.monotonic()
    count = settings.run.workers if workers is None else workers
    with resumable(), runner(count, settings.run.memory_limit, scheduler) as execution:
        reporter.say(f"{settings.name}: {execution.description}")
        summary = flow.run(settings, place, execution, reporter, chosen)
    made, kept = sum(summary.made.values()), sum(summary.kept.values())
    if made == 0 and not summary.failed:
        reporter.say(f"nothing to do: all {kept} units of {store} are done")
    else:
        reporter.say(f"made {made} units, kept {kept}, in {time.monotonic() - began:.0f} s")
    for name in summary.failed:
        reporter.say(f"failed: {name}")
    if summary.failed:
        reporter.say(f"the reasons are in {store}/manifest/<stage>/<unit>.failed; the same command tries again")
        raise typer.Exit(1)
    page = place.report / "index.html"
    if only or start:
        return
    if made or not page.exists():
        reporter.say(f"report: {write_report(open_survey(store))}")


def _explain(survey: Survey, chosen: stages.Chosen, reporter: Reporter) -> None:
    for row in flow.explain(survey, chosen):
        if row.made or row.reasons:
            reasons = ", ".join(f"{count} {why}" for why, count in row.reasons.items())
            reporter.say(f"{row.stage:22s} make {row.made}, keep {row.kept}: {reasons}")
    reporter.say("every other unit is kept")


@app.command()
def status(store: StoreArgument) -> None:
    """Show units done, missing and failed, a line a stage."""
    table = Table("stage", "units", "done", "missing", "failed")
    for name, units, done, failed in flow.status(open_survey(store)):
        known = units >= 0
        table.add_row(name, str(units) if known else "?", str(done), str(units - done) if known else "?", str(failed))
    Console().print(table)


@app.command()
def verify(
    store: StoreArgument,
    only: Annotated[str | None, typer.Option("--only", help="A stage, for example coadds/roman.")] = None,
    forget: Annotated[
        bool, typer.Option("--forget", help="Remove the records of what is damaged: the next run makes it anew.")
    ] = False,
) -> None:
    """Read every stored byte and compare it with what the manifest says was written."""
    survey, units, damaged = open_survey(store), 0, 0
    for found in verification.verify(survey, only):
        units, damaged = units + found.units, damaged + len(found.damaged)
        for name, why in found.damaged:
            print(f"damaged: {found.stage}/{name}: {why}")
        if forget and found.damaged:
            verification.forget(survey, found)
    if damaged:
        print(
            f"{damaged} damaged: " + ("run again, they are made anew" if forget else "verify --forget, then run again")
        )
        raise typer.Exit(1)
    print(f"{store}: {units} units are as they were written")


@app.command()
def report(store: StoreArgument) -> None:
    """Write the report, one page without external assets, and say where it is."""
    Console().print(f"report: {write_report(open_survey(store))}", highlight=False, soft_wrap=True)


@ingest_app.command()
def skycatalogs(
    source: Annotated[Path, typer.Argument(metavar="SRC", help="Folder of skyCatalogs files, or its YAML file.")],
    store: Place,
    seds: Spectra = None,
    order: Order = 5,
    workers: Workers = 0,
) -> None:
    """Bring skyCatalogs in as HATS catalogs, with fluxes in all ten bands; bad rows go to quarantine."""
    _ingest(source, {"source": "skycatalogs", "path": str(source.resolve())}, store, seds, order, workers)


@ingest_app.command("instance-catalog")
def instance_catalog(
    source: Annotated[Path, typer.Argument(metavar="SRC", help="A phoSim instance catalog, text or .gz.")],
    store: Place,
    seds: Spectra = None,
    order: Order = 5,
    workers: Workers = 0,
) -> None:
    """Bring a DC2 instance catalog in: components of one galaxy become one row, shears are given the on-sky sign."""
    _ingest(source, {"source": "instance_catalog", "path": str(source.resolve())}, store, seds, order, workers)


@ingest_app.command()
def table(
    columns: Annotated[
        Path,
        typer.Argument(
            metavar="MAP", help="YAML with sections galaxies and stars, each with path and columns (ours: the file's)."
        ),
    ],
    store: Place,
    seds: Spectra = None,
    order: Order = 5,
    workers: Workers = 0,
) -> None:
    """Bring Parquet or FITS tables in, with a map of their columns."""
    sections = read_yaml(columns)
    unknown = sorted(set(sections) - {"galaxies", "stars"})
    if unknown or not sections:
        raise UserError(f"{columns}: holds {', '.join(unknown) or 'nothing'}; expected sections galaxies and stars")
    content: dict[str, Any] = {"source": "table"}
    for section, key in (("galaxies", "galaxy_table"), ("stars", "star_table")):
        if isinstance(sections.get(section), dict) and "path" in sections[section]:
            # as the map's author sees it
            path = columns.resolve().parent / str(sections[section]["path"])
            content[key] = sections[section] | {"path": str(path)}
        elif section in sections:
            raise UserError(f"{columns}: section {section} must hold path and columns")
    _ingest(columns, content, store, seds, order, workers)


def _ingest(
    source: Path, truth: dict[str, Any], store: Path, seds: Path | None, order: int, workers: int | None
) -> None:
    content = {
        "name": "ingest",
        "seed": 0,
        "region": {"ra": [0, 360], "dec": [-90, 90]},
        "truth": {**truth, "order": order, "seds": str((seds or source.resolve().parent / "seds").resolve())},
        "roman": {},
        "rubin": {},
    }
    settings = pipeline_of(content, str(source))
    place = Store(store.resolve())
    survey = Survey(settings)
    survey.incoming_product  # noqa: B018  opened, so that a wrong source is known before anything is written
    place.prepare()
    reporter = Reporter(Console())
    with resumable(), runner(workers or 0, settings.run.memory_limit) as execution:
        counts = flow.ingest(settings, place, execution, reporter)
    reporter.say(f"rows in {counts['in']} = rows out {counts['out']} + quarantined {counts['quarantined']}")


@export_app.command("truth")
def export_truth_files(
    store: StoreArgument, out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the files.")]
) -> None:
    """Write the truth as galaxies.fits and stars.fits, and its spectra as seds.hdf5."""
    for path in export_truth(open_survey(store), out):
        Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


@export_app.command("obseq")
def export_visits(
    pipeline: Source,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="FITS file.")],
    overrides: Overrides = None,
) -> None:
    """Write all Roman visits of a pipeline as an observing sequence (FITS) that GalSim-based tools read."""
    count = export_obseq(Survey(load_pipeline(pipeline, overrides)), out)
    Console().print(f"wrote {count} visits to {out}", highlight=False, soft_wrap=True)


@export_app.command("psf")
def export_psf_images(
    store: StoreArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the files.")],
    exposure: Annotated[list[str], typer.Option("--exposure", help="Name, for example H158-12-7; may be repeated.")],
) -> None:
    """Write PSF images of Roman exposures (FITS): a unit star, 8 samples a pixel."""
    for path in export_psf(open_survey(store), out, exposure):
        Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


@export_app.command("coadd-psf")
def export_coadd_psf_images(
    store: StoreArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the files.")],
    at: Annotated[tuple[float, float], typer.Option("--at", metavar="RA DEC", help="Degrees.")],
    band: Annotated[list[str] | None, typer.Option("--band", help="May be repeated; default: all.")] = None,
    scale: Annotated[
        float | None,
        typer.Option("--scale", min=1e-3, help="Arcsec between samples; default: the coadd's own pixels."),
    ] = None,
) -> None:
    """Write the PSF of Roman's coadds at a place: a unit star as the exposures there have it, drizzled (FITS)."""
    for path in export_coadd_psf(open_survey(store), out, *at, band or [], scale):
        Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


@export_app.command("meds")
def export_meds_files(
    store: StoreArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the files.")],
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
    for path in export_meds(open_survey(store), out, of, band or [], size, catalog):
        Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


@calibration_app.command("make")
def calibration_make(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the files.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same files from the same seed.")] = 0,
    sca: Annotated[list[int] | None, typer.Option("--sca", help="SCA, 1-18; may be repeated; default: all.")] = None,
) -> None:
    """Make calibration files of made-up detectors, with the statistics of the real ones: 1.6 GB an SCA."""
    for path in make_files(out, seed, sca or SCAS):
        Console().print(f"wrote {path}", highlight=False, soft_wrap=True)


@calibration_app.command("check")
def calibration_check(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of sca01.fits to sca18.fits.")],
) -> None:
    """Check that calibration files have every extension of table 1 of Troxel et al. (2023), with its type and shape."""
    for path in check_files(folder):
        Console().print(f"{path}: as it should be", highlight=False, soft_wrap=True)


@contextmanager
def resumable() -> Iterator[None]:
    """Turn an interrupt into one line: what is stored stays, and the same command goes on from there."""
    try:
        yield
    except KeyboardInterrupt:
        print("stopped; the same command resumes", file=sys.stderr)
        raise typer.Exit(130) from None


def main() -> None:
    """Run the command line."""
    # when several chunks of a damaged file fail at once, asyncio logs all but the one that is raised
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    try:
        app()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
