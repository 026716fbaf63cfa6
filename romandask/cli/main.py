"""Main commands of the command line. A mistake of the user ends with one line on standard error and exit code 2.

Commands import what they need when they run, so that help, version and completion are there at once.
"""

from __future__ import annotations

import logging
import os
import sys
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

# one thread per process, because the workers are the parallelism; set before the libraries are imported
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402
from rich.console import Console  # noqa: E402

from romandask import __version__  # noqa: E402
from romandask.cli.calibration import calibration_app  # noqa: E402
from romandask.cli.export import export_app  # noqa: E402
from romandask.cli.ingest import ingest_app  # noqa: E402
from romandask.cli.interrupts import resumable  # noqa: E402
from romandask.cli.options import Scheduler, StoreOption, Workers  # noqa: E402
from romandask.engine.progress import Reporter, busy, duration  # noqa: E402
from romandask.export import sha256sums  # noqa: E402
from romandask.export.options import Overrides, Source, StoreArgument  # noqa: E402
from romandask.model.errors import UserError  # noqa: E402
from romandask.storage.lock import in_use  # noqa: E402

if TYPE_CHECKING:
    from rich.table import Table

    from romandask.stage_graph import Selection
    from romandask.survey import Survey

app = typer.Typer(
    add_completion=True,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
)
app.add_typer(ingest_app, name="ingest")
app.add_typer(export_app, name="export")
app.add_typer(calibration_app, name="calibration")
WATCH_INTERVAL = 3.0
"""Time between two updates of `status --watch`, s."""


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"romandask {__version__}")
        raise typer.Exit


@app.callback()
def main_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Make and read a joint synthetic sky survey of Roman and Rubin."""


@app.command()
def plan(
    pipeline: Source,
    overrides: Overrides = None,
    dag: Annotated[Path | None, typer.Option("--dag", help="Write a diagram of the stages to this SVG file.")] = None,
) -> None:
    """Show the units, image bytes, core hours and worker memory of every stage, without making anything."""
    from romandask import run as running
    from romandask.cli.plan_table import print_plan
    from romandask.pipeline import load_pipeline
    from romandask.report.stage_diagram import write_stage_diagram
    from romandask.survey import Survey

    settings = load_pipeline(pipeline, overrides)
    with busy("planning"):
        survey = Survey(settings)
        rows = running.plan(survey)
    print_plan(rows, settings.run.memory_limit, Console())
    if dag is not None:
        with busy("drawing the stages"):
            write_stage_diagram(survey, rows, dag)
        Console().print(f"wrote {dag}", highlight=False)


@app.command()
def pixfrac(pipeline: Source, overrides: Overrides = None) -> None:
    """Compare values of coadds.pixfrac on the Roman dithers and recommend one, without making anything."""
    from rich.table import Table

    from romandask.pipeline import load_pipeline
    from romandask.stages.coadds.pixfrac import advice, coverage
    from romandask.survey import Survey

    with busy("drizzling weights"):
        survey = Survey(load_pipeline(pipeline, overrides))
        rows = coverage(survey.output(f"coadds/{survey.sharpest}"))
    table = Table("band", "exposures", "pixfrac", "empty pixels", "rms / median of weight", "")
    for row in rows:
        cells = (str(row.exposures), f"{row.pixfrac:.1f}", f"{row.empty:.2%}", f"{row.uneven:.3f}")
        table.add_row(row.band, *cells, "good" if row.good else "")
    Console().print(table)
    best = advice(rows)
    text = "none is good in all bands: more exposures are needed" if best is None else f"coadds.pixfrac={best:g}"
    Console().print(text, highlight=False)


@app.command()
@resumable()
def run(
    pipeline: Source,
    store: StoreOption,
    overrides: Overrides = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Run only this stage, for example coadds or coadds/roman; may be repeated."),
    ] = None,
    start: Annotated[
        str | None, typer.Option("--from", help="Run this stage and the stages after it in the plan.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show which units would be made and why, without making them.")
    ] = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Show which units will be made and why, then make them.")
    ] = False,
    retry: Annotated[
        bool, typer.Option("--retry-failed", help="Also make the units that failed in an earlier run.")
    ] = False,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write the report once all stages are done.")
    ] = True,
) -> None:
    """Make and store all missing and outdated units, then write the report. The same command resumes a run."""
    from romandask import run as running
    from romandask.engine.clients import runner
    from romandask.pipeline import load_pipeline
    from romandask.report.page import write_report
    from romandask.stage_graph import Selection, stage_products
    from romandask.storage.store import Store
    from romandask.survey import Survey, open_survey

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
    start_time = time.monotonic()
    count = settings.run.workers if workers is None else workers
    with runner(count, settings.run.memory_limit, scheduler) as execution:
        Store(store).prepare()
        hours = sum(row.hours for row in planned)
        reporter.say(f"{settings.name}: {execution.description}")
        reporter.say(f"{sum(row.units for row in planned)} units, {duration(hours * 3600)} of a core by the plan")
        summary = running.run(survey, execution, reporter, selection, retry)
    made, kept = sum(summary.made.values()), sum(summary.kept.values())
    if made == 0 and not summary.failed:
        reporter.say(f"nothing to do: all {kept} units of {store} are done")
    else:
        reporter.say(f"made {made} units, kept {kept}, in {time.monotonic() - start_time:.0f} s")
    for reason, units in summary.lost.most_common():
        reporter.say(f"{units} units were lost with their worker and made again: {reason}")
    for text, units in summary.warnings.most_common():
        reporter.say(f"warning of {units} units: {text}")
    for name in summary.failed:
        reporter.say(f"failed: {name}")
    if summary.failed:
        reporter.say(f"the reasons are in {store}/manifest/<stage>/<unit>.failed; --retry-failed makes them again")
        raise typer.Exit(1)
    page = Store(store).report / "index.html"
    if only or start or not report:
        return
    if made or not page.exists():
        with reporter.busy("writing the report"):
            path = write_report(open_survey(store))
        reporter.say(f"report: {path}")


def _explain(survey: Survey, selection: Selection, retry: bool, reporter: Reporter) -> None:
    from romandask import run as running

    for row in running.explain(survey, selection, retry):
        if row.made or row.reasons:
            reasons = ", ".join(f"{count} {reason}" for reason, count in row.reasons.items())
            reporter.say(f"{row.stage:22s} make {row.made}, keep {row.kept}: {reasons}")
    reporter.say("every other unit is kept")


@app.command()
def status(
    store: StoreArgument,
    watch: Annotated[bool, typer.Option("--watch", help="Update the table until the run in progress ends.")] = False,
) -> None:
    """Show the units done, missing and failed of each stage, and the last event of the newest run."""
    from rich.live import Live

    from romandask.survey import open_survey

    with busy("looking at the store"):
        survey = open_survey(store)
        table = _status(survey)
    if not watch:
        Console().print(table)
        return
    with resumable("no longer watched; the run goes on"), Live(table, auto_refresh=False) as live:
        while in_use(store):
            time.sleep(WATCH_INTERVAL)
            live.update(_status(survey), refresh=True)


def _status(survey: Survey) -> Table:
    from rich.table import Table

    from romandask import run as running

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
    only: Annotated[
        str | None, typer.Option("--only", help="Verify only this stage, for example coadds/roman.")
    ] = None,
    forget: Annotated[
        bool,
        typer.Option("--forget", help="Remove the records of damaged units, so that the next run makes them again."),
    ] = False,
) -> None:
    """Compare every stored byte of a store, or of a folder of exported files, with its recorded hash."""
    # a folder with both a store and exported files counts as a store
    if isinstance(store, Path) and (store / sha256sums.NAME).is_file() and not (store / "pipeline.yaml").exists():
        if only or forget:
            raise UserError(f"{store}: exported files have no stages and no records: verify them without options")
        _verify_files(store)
        return
    from romandask import run as running
    from romandask.survey import open_survey

    units = damaged = 0
    with busy("reading every byte"):
        survey = open_survey(store)
        for result in running.verify_store(survey, only):
            units, damaged = units + result.units, damaged + len(result.damaged)
            for name, damage in result.damaged:
                print(f"damaged: {result.stage}/{name}: {damage}")
            if forget and result.damaged:
                running.forget_damaged(survey, result)
    if damaged:
        print(
            f"{damaged} damaged: " + ("run again, they are made anew" if forget else "verify --forget, then run again")
        )
        raise typer.Exit(1)
    print(f"{store}: {units} units are as they were written")


def _verify_files(folder: Path) -> None:
    with busy("reading every byte"):
        checked = list(sha256sums.check(folder))
    damaged = [(name, damage) for name, damage in checked if damage]
    for name, damage in damaged:
        print(f"damaged: {folder / name}: {damage}")
    if damaged:
        print(f"{len(damaged)} damaged: export them again")
        raise typer.Exit(1)
    print(f"{folder}: {len(checked)} files are as they were written")


@app.command()
def report(store: StoreArgument) -> None:
    """Write the report of a store, one HTML page without external assets."""
    from romandask.report.page import write_report
    from romandask.survey import open_survey

    with busy("writing the report"):
        path = write_report(open_survey(store))
    Console().print(f"report: {path}", highlight=False, soft_wrap=True)


@app.command()
def reference() -> None:
    """Print the reference of all tables and images (Markdown), with columns, units and axes."""
    from romandask.report.reference import reference as data_product_reference

    print(data_product_reference(), end="")


def _warning_line(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Return a warning as one line without the place in the code, which says nothing to a user."""
    return f"warning: {message}\n" if category is UserWarning else f"warning: {category.__name__}: {message}\n"


def main() -> None:
    """Run the command line."""
    # when reads of several chunks of a damaged file fail, one error is raised; asyncio logs the others
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    # and Python warns of the reads that had not started
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    warnings.formatwarning = _warning_line
    try:
        app()
    except OSError as error:
        from romandask.storage.store import FULL

        # any write can meet a full or read-only disk
        if error.errno not in FULL:
            raise
        print(f"error: {error.filename}: {error.strerror}: make room; the same command resumes", file=sys.stderr)
        sys.exit(2)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
