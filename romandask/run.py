"""Plan, run, explain and verify a survey, and report the status of its store, from the command line and Python."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from rich.console import Console

from romandask.engine.clients import Client, on_client
from romandask.engine.event_log import Log, newest_event
from romandask.engine.progress import Reporter
from romandask.engine.run_stages import Run, Summary, run_stages
from romandask.engine.runners import Runner
from romandask.engine.staleness import StoredOutputs, failed, find_stale
from romandask.engine.verify import Verified, forget, verify
from romandask.model.errors import UserError
from romandask.pipeline import Pipeline
from romandask.products.memory import INTERPRETER
from romandask.stage_graph import Selection, StageProduct, stage_products
from romandask.stages.truth.colours import colour_note
from romandask.stages.truth.ingested import source_rows
from romandask.storage.checksums import write_checksums
from romandask.storage.lock import locked
from romandask.storage.manifest import read_records
from romandask.storage.paths import AnyPath, parse_path, write_bytes
from romandask.storage.store import Store, write_json
from romandask.survey import Survey
from romandask.survey_graph import ignore_stale_unit_lists, runnable, store_of

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
"""Packages whose versions are written to the store."""


@dataclass(frozen=True, kw_only=True)
class PlannedStage:
    """What a plan says about one product."""

    stage: str
    """Name of the product, for example `coadds/roman`."""
    units: int
    """Number of units."""
    bytes: int
    """Uncompressed size of the images, bytes; 0 for tables, whose number of rows is not known in advance."""
    memory: int
    """Peak memory of a worker, bytes."""
    hours: float
    """Time on one core of a laptop, hours."""


@dataclass(frozen=True, kw_only=True)
class ExplainedStage:
    """What a run would do with the units of one product."""

    stage: str
    """Name of the product."""
    made: int
    """Number of units that would be made."""
    kept: int
    """Number of units that are up to date."""
    reasons: dict[str, int]
    """Number of units by the reason why they would be made, or could not be made."""


@dataclass(frozen=True, kw_only=True)
class StageStatus:
    """Number of units of one product in a store."""

    stage: str
    """Name of the product."""
    units: int | None
    """Number of units of the product; None as long as the products that determine it have not been made."""
    done: int
    """Number of units that are stored."""
    failed: int
    """Number of units that failed."""


def plan(survey: Survey) -> list[PlannedStage]:
    """Return the number of units, size, peak memory and time of every product. Only pointings are computed.

    Raises
    ------
    UserError
        If a unit does not fit into the memory of a worker, or an input file cannot be used.
    """
    limit, products = survey.pipeline.run.memory_limit, stage_products(survey)
    ignore_stale_unit_lists(survey, products)
    rows = []
    for declared in products:
        product = survey.product(declared.name)
        memory = product.bytes_per_unit + INTERPRETER
        if memory > limit * 2**30 and product.units:
            raise UserError(
                f"{declared.name} {product.names[0]} needs {memory / 2**30:.1f} GiB, worker limit {limit:.1f} GiB: "
                f"{declared.stage.shrink_with}, or raise run.memory_limit"
            )
        hours = len(product.units) * product.seconds_per_unit / 3600
        rows.append(
            PlannedStage(
                stage=declared.name, units=len(product.units), bytes=product.stored_bytes, memory=memory, hours=hours
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
        Survey with a store.
    runner : Runner
        Makes the units: in this process, on worker processes or on a cluster.
    reporter : Reporter
        Shows the progress.
    selection : Selection, optional
        Products to make, by default all. A selected unit whose inputs are not stored is skipped and reported.
    retry : bool
        Try again the units that failed in an earlier run. Otherwise they are skipped until something that they depend
        on changes.

    Returns
    -------
    Summary
        Numbers of units made and kept, and the units that failed.

    Raises
    ------
    UserError
        If the survey has no store or no such product, another run uses the store, or the store cannot be written.
    """
    selected = (selection or Selection()).of(stage_products(survey))
    with _running(survey, selected, runner, reporter, retry) as current_run:
        run_stages(runnable(survey, selected), current_run)
    return current_run.summary


def run_on(client: Client, pipeline: Pipeline, store: AnyPath | str, selection: Selection | None = None) -> Summary:
    """Make and store the stale units of a survey, as `romandask run` does, on the cluster of a dask client.

    The report is not written; `romandask report` does that.

    Parameters
    ----------
    client : distributed.Client
        Client of a cluster of any kind, whose workers have one thread each.
    pipeline : Pipeline
        Settings of the survey (see `load_pipeline`).
    store : str or path
        Folder of the store, or s3://BUCKET/FOLDER.
    selection : Selection, optional
        Products to make, by default all.

    Returns
    -------
    Summary
        Numbers of units made and kept, and the units that failed.

    Raises
    ------
    UserError
        If the settings or the store cannot be used, or the workers have too little memory or another version of
        romandask.
    """
    survey = Survey(pipeline, Store(parse_path(store)))
    plan(survey)
    runner = on_client(client, pipeline.run.memory_limit)
    store_of(survey).prepare()
    return run(survey, runner, Reporter(Console()), selection)


def explain(survey: Survey, selection: Selection | None = None, retry: bool = False) -> list[ExplainedStage]:
    """Return how many units of each product a run would make, and why. Nothing is made.

    Units that depend on a unit that would be made are counted, although its content may turn out to be unchanged.

    Parameters
    ----------
    survey : Survey
        Survey with a store.
    selection, retry
        As in `run`.
    """
    selected = (selection or Selection()).of(stage_products(survey))
    ignore_stale_unit_lists(survey, selected)
    stored, to_be_made = StoredOutputs(store_of(survey)), set[tuple[str, str]]()
    rows = []
    for declared in selected:
        product = survey.product(declared.name)
        todo = find_stale(product, stored, to_be_made, retry)
        to_be_made |= {(product.stage, name) for name in todo.tasks}
        reasons = Counter(task.why for task in todo.tasks.values())
        reasons += Counter({"an input is missing": len(todo.blocked), "skipped after failure": len(todo.failed)})
        rows.append(
            ExplainedStage(
                stage=declared.name, made=len(todo.tasks), kept=todo.kept, reasons=dict(reasons.most_common())
            )
        )
    return rows


def ingest(survey: Survey, runner: Runner, reporter: Reporter) -> dict[str, int]:
    """Make and store only the truth catalogs of a survey.

    Returns
    -------
    dict of str to int
        Number of rows `in` the source catalogs, `out` in the truth catalogs, and `quarantined`.

    Raises
    ------
    RuntimeError
        If a unit failed, or `in` is not the sum of `out` and `quarantined`.
    """
    selected = Selection(("truth",)).of(stage_products(survey))
    with _running(survey, selected, runner, reporter, retry=True) as current_run:
        run_stages(runnable(survey, selected), current_run)
    tables = [survey.output(name) for name in ("truth/galaxies", "truth/stars")]
    out = sum(int(table.column("n_rows").sum()) for table in tables)
    quarantined = {row["stage"]: row["rows"] for row in run_figures(store_of(survey))}.get("truth/quarantine", 0)
    counts = {"in": source_rows(survey.output("truth/ingested")), "out": out, "quarantined": quarantined}
    failures = current_run.summary.failed
    if failures or counts["in"] != counts["out"] + counts["quarantined"]:
        raise RuntimeError(f"rows are missing: {counts}; failed units: {failures}")
    if note := colour_note(survey.output("truth/ingested"), survey.bandpasses):
        reporter.say(note)
    return counts


def status(survey: Survey) -> list[StageStatus]:
    """Return the number of units of every product: all units, those that are stored, and those that failed."""
    store = store_of(survey)
    products = stage_products(survey)
    done = {product.name: len(store.recorded(product.name)) for product in products}
    rows = []
    for product in products:
        name, units_known = product.name, all(done[source] for source in product.known_after)
        units = len(survey.product(name).units) if units_known else None
        rows.append(StageStatus(stage=name, units=units, done=done[name], failed=len(failed(store, name))))
    return rows


def verify_store(survey: Survey, only: str | None = None) -> Iterator[Verified]:
    """Yield, for each product, the stored units whose content is not what was written. Nothing is changed.

    Parameters
    ----------
    survey : Survey
        Survey with a store.
    only : str, optional
        Name of one product; by default all are verified.
    """
    yield from verify(runnable(survey, stage_products(survey)), store_of(survey), only)


def forget_damaged(survey: Survey, verified: Verified) -> None:
    """Remove the records of the damaged units of a product, so that the next run makes them again."""
    forget(store_of(survey), verified)


def last_event(survey: Survey) -> str:
    """Return one line about the last event of the newest run of a store; empty if no run has been logged."""
    event = newest_event(store_of(survey).log)
    if event is None:
        return ""
    templates = {
        "run": "it began, on {on}",
        "stage": "{stage}: {make} units to make",
        "unit": "{stage}/{unit} was made in {seconds} s",
        "failed": "{stage}/{unit} failed",
        "end": "it ended ({how}): made {made}, kept {kept}, failed {failed}",
    }
    return f"newest run, {event['time']}: {templates[event['event']].format(**event)}"


def run_figures(store: Store) -> list[dict[str, Any]]:
    """Return what the manifest says about each product.

    Returns
    -------
    list of dict
        `stage`, `units`, `seconds` (working time of all workers), `bytes`, `rows`, `peak_bytes` (largest peak memory of
        a worker) and `warnings` (their number), one entry per product with units.
    """
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
    """Return the versions of packages, by name, that the store was made with."""
    return json.loads((store.root / "versions.json").read_text())


@contextmanager
def _running(
    survey: Survey, products: list[StageProduct], runner: Runner, reporter: Reporter, retry: bool
) -> Iterator[Run]:
    """Lock the store, write the settings and package versions, and log the start and the end of the run."""
    store = store_of(survey)
    with locked(store.root, reporter.say) as lock:
        versions = {name: version(name) for name in PACKAGES}
        write_bytes(store.pipeline, survey.pipeline.to_yaml().encode())
        write_json(store.root / "versions.json", versions)
        write_checksums(store, "store", [store.pipeline, store.root / "versions.json"])
        ignore_stale_unit_lists(survey, products)
        current_run = Run(store, runner, reporter, Log(store.log, lock.check), retry)
        current_run.log.write("run", pipeline=survey.pipeline.name, on=runner.description, versions=versions)
        end = "stopped"
        try:
            with current_run.ends:
                yield current_run
            end = "done"
        finally:
            summary = current_run.summary
            made, kept = sum(summary.made.values()), sum(summary.kept.values())
            current_run.log.write("end", how=end, made=made, kept=kept, failed=len(summary.failed))
