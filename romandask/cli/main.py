"""The command line: no logic of its own. A user's mistake is one line and exit code 2."""

from __future__ import annotations

import logging
import os
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated

# one thread a process: the workers are the parallelism
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.live import Live  # noqa: E402
from rich.table import Column, Table  # noqa: E402

from romandask import run as running  # noqa: E402
from romandask.cli.calibration import calibration_app  # noqa: E402
from romandask.cli.export import export_app  # noqa: E402
from romandask.cli.ingest import ingest_app  # noqa: E402
from romandask.cli.options import Scheduler, StoreOption, Workers, resumable  # noqa: E402
from romandask.engine.clients import runner  # noqa: E402
from romandask.engine.progress import Reporter, busy, duration  # noqa: E402
from romandask.export import sha256sums  # noqa: E402
from romandask.export.options import Overrides, Source, StoreArgument  # noqa: E402
from romandask.model.errors import UserError  # noqa: E402
from romandask.pipeline import load_pipeline  # noqa: E402
from romandask.report.page import write_report  # noqa: E402
from romandask.report.reference import reference as data_products  # noqa: E402
from romandask.report.stage_diagram import dag_svg  # noqa: E402
from romandask.stage_graph import Selection, stage_products  # noqa: E402
from romandask.stages.coadds.pixfrac import advice, coverage  # noqa: E402
from romandask.storage.lock import in_use  # noqa: E402
from romandask.storage.store import FULL, Store  # noqa: E402
from romandask.survey import Survey, open_survey  # noqa: E402

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    help="A joint Roman and Rubin synthetic sky survey.",
)
app.add_typer(ingest_app, name="ingest")
app.add_typer(export_app, name="export")
app.add_typer(calibration_app, name="calibration")
WATCHED = 3.0
"""Seconds between two looks at a store that is watched."""


@app.command()
def plan(
    pipeline: Source,
    overrides: Overrides = None,
    dag: Annotated[Path | None, typer.Option("--dag", help="Write the stages as an SVG picture to this file.")] = None,
) -> None:
    """Show units, bytes and peak memory of every stage; write nothing."""
    settings = load_pipeline(pipeline, overrides)
    with busy("planning"):
        survey = Survey(settings)
        rows = running.plan(survey)
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
        with busy("drawing the stages"):
            dag_svg(survey, rows, dag)
        Console().print(f"wrote {dag}", highlight=False)


@app.command()
def pixfrac(pipeline: Source, overrides: Overrides = None) -> None:
    """Show what each pixfrac does to the coadds of Roman's dithers, and recommend one; make nothing."""
    with busy("drizzling weights"):
        survey = Survey(load_pipeline(pipeline, overrides))
        found = coverage(survey.output(f"coadds/{survey.sharpest}"))
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
    store: StoreOption,
    overrides: Overrides = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="A stage alone, coadds or coadds/roman; may be repeated.")
    ] = None,
    start: Annotated[str | None, typer.Option("--from", help="This stage and those after it in the plan.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say which units would be made and why, and make none.")
    ] = False,
    explain: Annotated[bool, typer.Option("--explain", help="Say why units are made, then make them.")] = False,
    retry: Annotated[
        bool, typer.Option("--retry-failed", help="Make again what failed before and was set aside.")
    ] = False,
) -> None:
    """Make and store everything that is missing, then the report. The same command resumes."""
    survey = Survey(load_pipeline(pipeline, overrides), Store(store))
    settings, reporter = survey.pipeline, Reporter(Console())
    selection = Selection(tuple(only or ()), start)
    with reporter.busy("planning"):
        planned = running.plan(survey)
        selection.of(stage_products(survey))
    if dry_run or explain:
        with reporter.busy("finding what there is to do"):
            _explain(survey, selection, retry, reporter)
    if dry_run:
        return
    began = time.monotonic()
    count = settings.run.workers if workers is None else workers
    with resumable(), runner(count, settings.run.memory_limit, scheduler) as execution:
        Store(store).prepare()
        hours = sum(row.hours for row in planned)
        reporter.say(f"{settings.name}: {execution.description}")
        reporter.say(f"{sum(row.units for row in planned)} units, {duration(hours * 3600)} of a core by the plan")
        summary = running.run(survey, execution, reporter, selection, retry)
    made, kept = sum(summary.made.values()), sum(summary.kept.values())
    if made == 0 and not summary.failed:
        reporter.say(f"nothing to do: all {kept} units of {store} are done")
    else:
        reporter.say(f"made {made} units, kept {kept}, in {time.monotonic() - began:.0f} s")
    for text, count in summary.warnings.most_common():
        reporter.say(f"warning of {count} units: {text}")
    for name in summary.failed:
        reporter.say(f"failed: {name}")
    if summary.failed:
        reporter.say(f"the reasons are in {store}/manifest/<stage>/<unit>.failed; --retry-failed makes them again")
        raise typer.Exit(1)
    page = Store(store).report / "index.html"
    if only or start:
        return
    if made or not page.exists():
        with reporter.busy("writing the report"):
            path = write_report(open_survey(store))
        reporter.say(f"report: {path}")


def _explain(survey: Survey, selection: Selection, retry: bool, reporter: Reporter) -> None:
    for row in running.explain(survey, selection, retry):
        if row.made or row.reasons:
            reasons = ", ".join(f"{count} {why}" for why, count in row.reasons.items())
            reporter.say(f"{row.stage:22s} make {row.made}, keep {row.kept}: {reasons}")
    reporter.say("every other unit is kept")


@app.command()
def status(
    store: StoreArgument,
    watch: Annotated[bool, typer.Option("--watch", help="Show it again and again while a run goes on.")] = False,
) -> None:
    """Show units done, missing and failed, a line a stage, and what the newest run did last."""
    with busy("looking at the store"):
        survey = open_survey(store)
        table = _status(survey)
    if not watch:
        Console().print(table)
        return
    with resumable("no longer watched; the run goes on"), Live(table, auto_refresh=False) as live:
        while in_use(store):
            time.sleep(WATCHED)
            live.update(_status(survey), refresh=True)


def _status(survey: Survey) -> Table:
    table = Table(
        "stage", "units", "done", "missing", "failed", caption=running.last_event(survey), caption_justify="left"
    )
    for row in running.status(survey):
        units = "?" if row.units is None else str(row.units)
        missing = "?" if row.units is None else str(row.units - row.done)
        table.add_row(row.stage, units, str(row.done), missing, str(row.failed))
    return table


@app.command()
def verify(
    store: StoreArgument,
    only: Annotated[str | None, typer.Option("--only", help="A stage, for example coadds/roman.")] = None,
    forget: Annotated[
        bool, typer.Option("--forget", help="Remove the records of what is damaged: the next run makes it anew.")
    ] = False,
) -> None:
    """Read every stored byte and compare it with what the manifest says was written; exported files too."""
    # files may have been exported into the folder of a store, which then is what is meant
    if isinstance(store, Path) and (store / sha256sums.NAME).is_file() and not (store / "pipeline.yaml").exists():
        if only or forget:
            raise UserError(f"{store}: exported files have no stages and no records: verify them without options")
        _verify_files(store)
        return
    units = damaged = 0
    with busy("reading every byte"):
        survey = open_survey(store)
        for found in running.verify_store(survey, only):
            units, damaged = units + found.units, damaged + len(found.damaged)
            for name, why in found.damaged:
                print(f"damaged: {found.stage}/{name}: {why}")
            if forget and found.damaged:
                running.forget_damaged(survey, found)
    if damaged:
        print(
            f"{damaged} damaged: " + ("run again, they are made anew" if forget else "verify --forget, then run again")
        )
        raise typer.Exit(1)
    print(f"{store}: {units} units are as they were written")


def _verify_files(folder: Path) -> None:
    with busy("reading every byte"):
        found = list(sha256sums.check(folder))
    damaged = [(name, why) for name, why in found if why]
    for name, why in damaged:
        print(f"damaged: {folder / name}: {why}")
    if damaged:
        print(f"{len(damaged)} damaged: export them again")
        raise typer.Exit(1)
    print(f"{folder}: {len(found)} files are as they were written")


@app.command()
def report(store: StoreArgument) -> None:
    """Write the report, one page without external assets, and say where it is."""
    with busy("writing the report"):
        path = write_report(open_survey(store))
    Console().print(f"report: {path}", highlight=False, soft_wrap=True)


@app.command()
def reference() -> None:
    """Print the data-product reference (Markdown): every table and image, with columns, units and axes."""
    print(data_products(), end="")


def main() -> None:
    """Run the command line."""
    # when several chunks of a damaged file fail at once, asyncio logs all but the one that is raised
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    # and those that had not begun are warned of
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    try:
        app()
    except OSError as error:
        # a disk that is full, or may not be written, is met wherever something is written
        if error.errno not in FULL:
            raise
        print(f"error: {error.filename}: {error.strerror}: make room; the same command resumes", file=sys.stderr)
        sys.exit(2)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
