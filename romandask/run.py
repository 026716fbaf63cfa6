"""Plan, run and explain a survey, and the status of a store: one path for the command line and for Python."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version

from rich.console import Console

from romandask.engine.clients import Client, Runner, on_client
from romandask.engine.event_log import Log, newest_event
from romandask.engine.progress import Reporter
from romandask.engine.run_stages import Run, RunnableStage, Summary, run_stages
from romandask.engine.staleness import failed, find_stale
from romandask.engine.verify import Verified, forget, verify
from romandask.model.errors import UserError
from romandask.pipeline import Pipeline
from romandask.products.memory import INTERPRETER
from romandask.stage_graph import Selection, StageProduct, stage_products
from romandask.stages.truth.ingested import source_rows
from romandask.storage.checksums import write_checksums
from romandask.storage.lock import locked
from romandask.storage.manifest import read_records
from romandask.storage.paths import AnyPath, parse_path, write_bytes
from romandask.storage.store import Store, write_json
from romandask.survey import Survey

PACKAGES = (
    "romandask",
    "astropy",
    "camb",
    "dask",
    "distributed",
    "drizzle",
    "galsim",
    "glass",
    "healpy",
    "numba",
    "numpy",
    "pyarrow",
    "scipy",
    "sep",
    "xarray",
    "zarr",
)
"""Packages whose versions are written into the store."""


@dataclass(frozen=True, kw_only=True)
class PlannedStage:
    """A row of the plan."""

    stage: str
    units: int
    bytes: int
    """Uncompressed size of the images; 0 for tables, whose size depends on what is found."""
    memory: int
    """Peak memory of a worker, bytes."""
    hours: float
    """Hours of one core, as measured on a laptop."""


@dataclass(frozen=True, kw_only=True)
class ExplainedStage:
    """What a run would do in one stage."""

    stage: str
    made: int
    kept: int
    reasons: dict[str, int]
    """Number of units that would be made, by reason."""


@dataclass(frozen=True, kw_only=True)
class StageStatus:
    """Units of a stage in a store."""

    stage: str
    units: int | None
    """None while the stages that decide it have not been made."""
    done: int
    failed: int


def plan(survey: Survey) -> list[PlannedStage]:
    """Return units, bytes and peak memory of every stage; nothing is made but the pointings.

    Raises
    ------
    UserError
        If a unit does not fit the memory of a worker, or an input file is not as it should be.
    """
    limit, products = survey.pipeline.run.memory_limit, stage_products(survey)
    _ignore_stale_lists(survey, products)
    rows = []
    for one in products:
        product = survey.product(one.name)
        memory = product.bytes_per_unit + INTERPRETER
        if memory > limit * 2**30 and product.units:
            raise UserError(
                f"{one.name} {product.names[0]} needs {memory / 2**30:.1f} GiB, worker limit {limit:.1f} GiB: "
                f"{one.stage.shrink_with}, or raise run.memory_limit"
            )
        hours = len(product.units) * product.seconds_per_unit / 3600
        rows.append(
            PlannedStage(
                stage=one.name, units=len(product.units), bytes=product.stored_bytes, memory=memory, hours=hours
            )
        )
    return rows


def run(
    survey: Survey, runner: Runner, reporter: Reporter, selection: Selection | None = None, retry: bool = False
) -> Summary:
    """Make and store the stale units of a survey.

    Parameters
    ----------
    survey : Survey
        With a store.
    selection : Selection or None
        Stages; None for all. A unit of theirs whose inputs are not stored is skipped and reported.
    retry : bool
        Make again what failed in an earlier run; else it is skipped until something that it depends on changes.
    """
    selected = (selection or Selection()).of(stage_products(survey))
    with _running(survey, selected, runner, reporter, retry) as this:
        run_stages(runnable(survey, selected), this)
    return this.summary


def run_on(client: Client, pipeline: Pipeline, store: AnyPath | str, selection: Selection | None = None) -> Summary:
    """Make and store what is stale, as `romandask run` does, on the cluster that a dask client is connected to.

    Parameters
    ----------
    client : distributed.Client
        Of a cluster of any kind whose workers have one thread each.
    pipeline : Pipeline
        Settings of the survey (`load_pipeline`).
    store : str or path
        Folder, or s3://BUCKET/FOLDER.
    selection : Selection or None
        Stages; None for all.

    Returns
    -------
    Summary
        Numbers of units made and kept, and the units that failed. The report is another command, `romandask report`.

    Raises
    ------
    UserError
        If settings or store are not as they should be, or the workers are too small or of another version.
    """
    survey = Survey(pipeline, Store(parse_path(store)))
    plan(survey)
    runner = on_client(client, pipeline.run.memory_limit)
    _store_of(survey).prepare()
    return run(survey, runner, Reporter(Console()), selection)


def explain(survey: Survey, selection: Selection | None = None, retry: bool = False) -> list[ExplainedStage]:
    """Return, stage by stage, how many units a run would make and why, making nothing.

    A unit that depends on a unit that will be made is counted, though its inputs may turn out the same.
    """
    selected = (selection or Selection()).of(stage_products(survey))
    _ignore_stale_lists(survey, selected)
    store, coming = _store_of(survey), set[tuple[str, str]]()
    rows = []
    for one in selected:
        product = survey.product(one.name)
        todo = find_stale(product, store, coming, retry)
        coming |= {(product.stage, product.names[task.index]) for task in todo.tasks}
        reasons = Counter(task.why for task in todo.tasks)
        reasons += Counter({"an input is missing": len(todo.blocked), "set aside, it failed": len(todo.failed)})
        rows.append(
            ExplainedStage(stage=one.name, made=len(todo.tasks), kept=todo.kept, reasons=dict(reasons.most_common()))
        )
    return rows


def ingest(survey: Survey, runner: Runner, reporter: Reporter) -> dict[str, int]:
    """Make and store the truth catalogs alone; return rows `in` the source, `out` and `quarantined`.

    Raises
    ------
    RuntimeError
        If the numbers do not add up.
    """
    selected = Selection(("truth",)).of(stage_products(survey))
    with _running(survey, selected, runner, reporter, retry=True) as this:
        run_stages(runnable(survey, selected), this)
    tables = [survey.product(name) for name in ("truth/galaxies", "truth/stars")]
    out = sum(int(table.column("n_rows").sum()) for table in tables)
    quarantined = {row["stage"]: row["rows"] for row in run_figures(_store_of(survey))}.get("truth/quarantine", 0)
    counts = {"in": source_rows(survey.product("truth/ingested")), "out": out, "quarantined": quarantined}
    if this.summary.failed or counts["in"] != counts["out"] + counts["quarantined"]:
        raise RuntimeError(f"rows are missing: {counts}; failed units: {this.summary.failed}")
    return counts


def status(survey: Survey) -> list[StageStatus]:
    """Return the units of every stage of a store: all of them, those done and those that failed."""
    store = _store_of(survey)
    products = stage_products(survey)
    done = {one.name: len(store.recorded(one.name)) for one in products}
    rows = []
    for one in products:
        known = all(done[name] for name in one.known_after)
        units = len(survey.product(one.name).units) if known else None
        rows.append(StageStatus(stage=one.name, units=units, done=done[one.name], failed=len(failed(store, one.name))))
    return rows


def verify_store(survey: Survey, only: str | None = None) -> Iterator[Verified]:
    """Yield, stage by stage, which units are not as they were written; nothing is changed."""
    yield from verify(runnable(survey, stage_products(survey)), _store_of(survey), only)


def forget_damaged(survey: Survey, verified: Verified) -> None:
    """Remove the records of the damaged units of a stage, so that the next run makes them again."""
    forget(_store_of(survey), verified)


def last_event(survey: Survey) -> str:
    """Return one line about what the newest run of a store did last; empty where none has been logged."""
    last = newest_event(_store_of(survey).log)
    if last is None:
        return ""
    what = {
        "run": "it began, on {on}",
        "stage": "{stage}: {make} units to make",
        "unit": "{stage}/{unit} was made in {seconds} s",
        "failed": "{stage}/{unit} failed",
        "end": "it ended ({how}): made {made}, kept {kept}, failed {failed}",
    }
    return f"newest run, {last['time']}: {what[last['event']].format(**last)}"


def run_figures(store: Store) -> list[dict]:
    """Return, stage by stage, units, seconds of work, bytes, rows and peak memory of a worker, from the manifest."""
    rows = []
    for stage in store.stages():
        records = [record for _, record in read_records(store, stage) if record]
        if records:
            rows.append(
                {
                    "stage": stage,
                    "units": len(records),
                    "seconds": sum(record.seconds for record in records),
                    "bytes": sum(record.bytes for record in records),
                    "rows": sum(record.rows for record in records),
                    "peak_bytes": max(record.peak_bytes for record in records),
                    "warnings": sum(len(record.warnings) for record in records),
                }
            )
    return rows


def stored_versions(store: Store) -> dict[str, str]:
    """Return the package versions that the store was made with."""
    return json.loads((store.root / "versions.json").read_text())


def runnable(survey: Survey, products: list[StageProduct]) -> list[RunnableStage]:
    """Return products of a survey as the engine runs them."""
    deciding = {name for one in products for name in one.known_after}
    return [_runnable(survey, one, deciding) for one in products]


def _runnable(survey: Survey, one: StageProduct, deciding: set[str]) -> RunnableStage:
    stage = one.stage

    def ended(made: int) -> None:
        if one.name in deciding:
            survey.use_stored(one.name)

    finish = None if stage.finish is None else partial(stage.finish, survey, _store_of(survey))
    return RunnableStage(
        name=one.name,
        product=lambda: survey.product(one.name),
        reads=one.reads,
        known_after=one.known_after,
        sky=stage.sky,
        finish=finish,
        ended=ended,
    )


def _ignore_stale_lists(survey: Survey, products: list[StageProduct]) -> None:
    """Let a survey make anew what decides which units some products have, where the store's is stale."""
    if survey.store is None:
        return
    for name in sorted({name for one in products for name in one.known_after}):
        todo = find_stale(survey.product(name), survey.store)
        if todo.tasks or todo.failed:
            survey.ignore_stored(name)


@contextmanager
def _running(
    survey: Survey, products: list[StageProduct], runner: Runner, reporter: Reporter, retry: bool
) -> Iterator[Run]:
    """Hold the store, write the resolved settings and package versions, and log how the run begins and ends."""
    store = _store_of(survey)
    with locked(store.root):
        versions = {name: version(name) for name in PACKAGES}
        write_bytes(store.pipeline, survey.pipeline.to_yaml().encode())
        write_json(store.root / "versions.json", versions)
        write_checksums(store, "store", [store.pipeline, store.root / "versions.json"])
        _ignore_stale_lists(survey, products)
        this = Run(store, runner, reporter, Log(store.log), retry)
        this.log.write("run", pipeline=survey.pipeline.name, on=runner.description, versions=versions)
        end = "stopped"
        try:
            with this.ends:
                yield this
            end = "done"
        finally:
            made, kept = sum(this.summary.made.values()), sum(this.summary.kept.values())
            this.log.write("end", how=end, made=made, kept=kept, failed=len(this.summary.failed))


def _store_of(survey: Survey) -> Store:
    if survey.store is None:
        raise UserError("this survey has no store: open one with romandask.open, or run a pipeline with --store")
    return survey.store
