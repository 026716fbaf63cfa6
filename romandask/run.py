"""A run of the stages, what it would do, and the status of a store."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version

from rich.console import Console

from romandask.engine.clients import Client, Runner, on_client
from romandask.engine.event_log import Log, newest_event
from romandask.engine.progress import Reporter
from romandask.engine.run_stages import Run, Summary, run_stages
from romandask.engine.staleness import failed, find_stale
from romandask.pipeline import Pipeline
from romandask.stage_graph import Chosen, plan, stages, tier
from romandask.stages.truth.ingested import source_rows
from romandask.storage.checksums import write_checksums
from romandask.storage.lock import locked
from romandask.storage.manifest import read_record, read_records
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


@dataclass(frozen=True)
class Explained:
    """What a run would do in one stage."""

    stage: str
    made: int
    kept: int
    reasons: dict[str, int]
    """Units that would be made, by why."""


def run(
    pipeline: Pipeline,
    store: Store,
    runner: Runner,
    reporter: Reporter,
    chosen: Chosen | None = None,
    retry: bool = False,
) -> Summary:
    """Make and store what is missing or no longer what the pipeline asks for.

    Parameters
    ----------
    chosen : stages; None for all. A unit of theirs whose inputs are not stored waits, and is told of.
    retry : make again what failed in an earlier run; else it stays aside until something that it depends on changes
    """
    with _running(pipeline, store, runner, reporter, retry) as this:
        run_stages((chosen or Chosen()).of(stages(this.survey)), this)
    return this.summary


def run_on(client: Client, pipeline: Pipeline, store: AnyPath | str, chosen: Chosen | None = None) -> Summary:
    """Make and store what is missing, as `romandask run` does, on the cluster that a dask client is connected to.

    Parameters
    ----------
    client : of a cluster of any kind, its workers of one thread (pipelines/README.md)
    store : folder, or s3://BUCKET/FOLDER
    chosen : stages; None for all

    Returns
    -------
    Summary
        What was made and kept, and what failed. The report is another command, `romandask report`.

    Raises
    ------
    UserError
        If settings or store are not what they should be, or the cluster's workers too small or of another version.
    """
    plan(Survey(pipeline))
    place = Store(parse_path(store))
    runner = on_client(client, pipeline.run.memory_limit)
    place.prepare()
    return run(pipeline, place, runner, Reporter(Console()), chosen)


def explain(survey: Survey, chosen: Chosen | None = None, retry: bool = False) -> list[Explained]:
    """Return, a stage, which units a run would make and why, making nothing.

    What depends on a unit that is to be made is counted with it, though it may turn out the same.
    """
    store, coming = survey.store, set[tuple[str, str]]()
    assert store is not None
    rows = []
    for stage in (chosen or Chosen()).of(stages(survey)):
        product = stage.product(survey)
        todo = find_stale(product, store, coming, retry)
        coming |= {(product.stage, product.names[task.index]) for task in todo.tasks}
        reasons = Counter(task.why for task in todo.tasks)
        reasons += Counter({"an input is missing": len(todo.blocked), "set aside, it failed": len(todo.aside)})
        rows.append(Explained(stage.name, len(todo.tasks), todo.kept, dict(reasons.most_common())))
    return rows


def ingest(pipeline: Pipeline, store: Store, runner: Runner, reporter: Reporter) -> dict[str, int]:
    """Make and store the truth catalogs alone; return rows `in` the source, `out` and `quarantined`.

    Raises
    ------
    RuntimeError
        If the numbers do not add up.
    """
    with _running(pipeline, store, runner, reporter, retry=True) as this:
        survey, summary = this.survey, this.summary
        run_stages([stage for stage in stages(survey) if stage.name.startswith("truth/")], this)
    catalogs = survey.truth_catalogs
    out = sum(int(product.column("n_rows").sum()) for product in (catalogs.galaxies, catalogs.stars))
    aside = {row["stage"]: row["rows"] for row in run_figures(store)}.get("truth/quarantine", 0)
    counts = {"in": source_rows(survey.ingested_product), "out": out, "quarantined": aside}
    if summary.failed or counts["in"] != counts["out"] + counts["quarantined"]:
        raise RuntimeError(f"rows are missing: {counts}; failed units: {summary.failed}")
    return counts


@contextmanager
def _running(pipeline: Pipeline, store: Store, runner: Runner, reporter: Reporter, retry: bool) -> Iterator[Run]:
    """Hold the store, write the resolved settings and the packages' versions, and log how the run begins and ends."""
    with locked(store.root):
        versions = {name: version(name) for name in PACKAGES}
        write_bytes(store.pipeline, pipeline.to_yaml().encode())
        write_json(store.root / "versions.json", versions)
        write_checksums(store, "store", [store.pipeline, store.root / "versions.json"])
        this = Run(Survey(pipeline, store), store, runner, reporter, Log(store.log), retry)
        this.log.write("run", pipeline=pipeline.name, on=runner.description, versions=versions)
        end = "stopped"
        try:
            with this.ends:
                yield this
            end = "done"
        finally:
            made, kept = sum(this.summary.made.values()), sum(this.summary.kept.values())
            this.log.write("end", how=end, made=made, kept=kept, failed=len(this.summary.failed))


def status(survey: Survey) -> list[tuple[str, int, int, int]]:
    """Return (stage, units, done, failed) of every stage of a store; units is -1 where it is not known yet."""
    store = survey.store
    assert store is not None
    rows = []
    for stage in stages(survey):
        aside = len(failed(store, stage.name))
        done = len(store.recorded(stage.name))
        if tier(stage.name) < 2 or all(read_record(store, f"pointings/{name}", "all") for name in survey.instruments):
            units = len(stage.product(survey).units)
        else:
            units = -1
        rows.append((stage.name, units, done, aside))
    return rows


def last_event(survey: Survey) -> str:
    """Return one line about what the newest run of a store did last; empty where none has been logged."""
    assert survey.store is not None
    last = newest_event(survey.store.log)
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
    """Return, a stage, units, seconds of work, bytes, rows and the largest memory of a worker, from the manifest."""
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
