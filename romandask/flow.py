"""The stages in order: what each needs a unit, the plan, the run and the status of a store."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Set
from dataclasses import dataclass, field, replace
from importlib.metadata import version

from romandask.incoming import source_rows
from romandask.pipeline import Pipeline
from romandask.runtime.cluster import Runner
from romandask.runtime.hats import write_catalog_files
from romandask.runtime.images import ImageProduct
from romandask.runtime.lock import locked
from romandask.runtime.manifest import Record, digest, read_record
from romandask.runtime.progress import Reporter
from romandask.runtime.sealed import catalog_files, image_files, seal, sealed, unseal
from romandask.runtime.store import Store, write_bytes, write_json
from romandask.runtime.units import Unit
from romandask.runtime.work import Task
from romandask.stages import Chosen, Product, Stage, stages
from romandask.survey import Survey
from romandask.truth import write_spectra

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


@dataclass
class Summary:
    """What a run did."""

    made: dict[str, int] = field(default_factory=dict)
    kept: dict[str, int] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)
    """stage/unit of units that were set aside, and of those that wait for them."""


def run(
    pipeline: Pipeline, store: Store, runner: Runner, reporter: Reporter, chosen: Chosen | None = None
) -> Summary:  # fmt: skip
    """Make and store, in order, what is missing or no longer what the pipeline asks for.

    Parameters
    ----------
    chosen : stages; None for all. A unit of theirs whose inputs are not stored waits, and is told of.
    """
    summary = Summary()
    with locked(store.root):
        survey = _begin(pipeline, store)
        for stage in (chosen or Chosen()).of(stages(survey)):
            _make_stage(stage, survey, store, runner, reporter, summary)
    return summary


def explain(survey: Survey, chosen: Chosen | None = None) -> list[Explained]:
    """Return, a stage, which units a run would make and why, making nothing.

    What depends on a unit that is to be made is counted with it, though it may turn out the same.
    """
    store, coming = survey.store, set[tuple[str, str]]()
    assert store is not None
    rows = []
    for stage in (chosen or Chosen()).of(stages(survey)):
        product = stage.product(survey)
        tasks, kept, blocked = _tasks(product, store, coming)
        coming |= {(product.stage, product.names[task.index]) for task in tasks}
        reasons = Counter(task.why for task in tasks) + Counter({"an input is missing": len(blocked)})
        rows.append(Explained(stage.name, len(tasks), kept, dict(reasons.most_common())))
    return rows


def ingest(pipeline: Pipeline, store: Store, runner: Runner, reporter: Reporter) -> dict[str, int]:
    """Make and store the truth catalogs alone; return rows `in` the source, `out` and `quarantined`.

    Raises
    ------
    RuntimeError
        If the numbers do not add up.
    """
    summary = Summary()
    with locked(store.root):
        survey = _begin(pipeline, store)
        for stage in stages(survey):
            if stage.name.startswith("truth/"):
                _make_stage(stage, survey, store, runner, reporter, summary)
    catalogs = survey.truth_catalogs
    out = sum(int(product.column("n_rows").sum()) for product in (catalogs.galaxies, catalogs.stars))
    aside = {row["stage"]: row["rows"] for row in run_figures(store)}.get("truth/quarantine", 0)
    counts = {"in": source_rows(survey.incoming_product), "out": out, "quarantined": aside}
    if summary.failed or counts["in"] != counts["out"] + counts["quarantined"]:
        raise RuntimeError(f"rows are missing: {counts}; failed units: {summary.failed}")
    return counts


def _begin(pipeline: Pipeline, store: Store) -> Survey:
    """Store the resolved settings and the packages' versions, and return the survey."""
    write_bytes(store.pipeline, pipeline.to_yaml().encode())
    write_json(store.root / "versions.json", {name: version(name) for name in PACKAGES})
    seal(store, "store", [store.pipeline, store.root / "versions.json"])
    return Survey(pipeline, store)


def _make_stage(
    stage: Stage, survey: Survey, store: Store, runner: Runner, reporter: Reporter, summary: Summary
) -> None:
    _run_stage(stage, stage.product(survey), store, runner, reporter, summary)
    if stage.name == "truth/galaxies":
        write_spectra(survey.truth_catalogs, store)
        seal(store, "truth/seds", sorted(store.images("truth/seds").rglob("*")))


def _run_stage(
    stage: Stage, product: Product, store: Store, runner: Runner, reporter: Reporter, summary: Summary
) -> None:
    tasks, kept, blocked = _tasks(product, store)
    summary.kept[stage.name] = kept
    summary.failed += [f"{stage.name}/{name} (an input is missing)" for name in blocked]
    _drop_strays(product, store)
    made = 0
    if tasks:
        unseal(store, stage.name)
        product.prepare(store)
        # a unit that is made again reads its upstream from the store, never its own former self
        with reporter.stage(stage.name, len(tasks)) as meter:
            for outcome in runner.run(product, tasks, store):
                meter.advance()
                if outcome.record is not None:
                    made += 1
                    continue
                name = product.names[outcome.index]
                summary.failed.append(f"{stage.name}/{name}")
                write_bytes(_failure_path(store, product, name), str(outcome.failure).encode())
    summary.made[stage.name] = made
    if stage.position is not None and (made or not (store.catalog(product.stage) / "hats.properties").exists()):
        write_catalog_files(product, store, *stage.position)  # type: ignore[arg-type]
    if made or not sealed(store, stage.name):
        if isinstance(product, ImageProduct):
            seal(store, stage.name, image_files(store, stage.name, [v.name for v in product.variables]))
        elif stage.position is not None:
            seal(store, stage.name, catalog_files(store, stage.name))


def _tasks(
    product: Product, store: Store, coming: Set[tuple[str, str]] | None = None
) -> tuple[list[Task], int, list[str]]:
    """Return the units to make, how many are done, and those that wait for an input that is missing.

    The records of units that are to be made, or cannot be, are removed, but in a plan.

    Parameters
    ----------
    coming : in a plan, units of earlier stages that will be made; None in a run
    """
    outputs: dict[tuple[str, str], str | None] = dict.fromkeys(coming or (), "to be made")
    forget = coming is None

    def output(source: tuple[str, str]) -> str | None:
        if source not in outputs:
            record = read_record(store, *source)
            outputs[source] = record.output if record else None
        return outputs[source]

    tasks: dict[str, Task] = {}
    blocked: list[str] = []
    waiting: dict[str, tuple[str, ...]] = {}
    kept = 0
    for index, unit in enumerate(product.units):
        if any(output(source) is None for source in unit.inputs):
            blocked.append(unit.name)
            if forget:
                store.record(product.stage, unit.name).unlink(missing_ok=True)
            continue
        parts = _parts(unit, output)
        inputs, record = digest(product.stage, parts), read_record(store, product.stage, unit.name)
        if record is not None and record.inputs == inputs:
            kept += 1
            continue
        why = _why(store, product.stage, unit.name, record, parts)
        if forget:
            store.record(product.stage, unit.name).unlink(missing_ok=True)
        tasks[unit.name] = Task(index, inputs, unit.cost, unit.kin, parts=parts, why=why)
        waiting[unit.name] = unit.after
    held = _held(waiting, set(blocked))
    chosen = [
        replace(task, after=tuple(tasks[other].index for other in waiting[name] if other in tasks))
        for name, task in tasks.items()
        if name not in held
    ]
    return chosen, kept, blocked + sorted(held)


def _parts(unit: Unit, output: Callable[[tuple[str, str]], str | None]) -> dict[str, str]:
    """Return what a unit depends on, by name: its settings, the version, and what it reads of each stage."""
    read: dict[str, list[str | None]] = {}
    for source in (*unit.inputs, *unit.optional):
        read.setdefault(source[0], []).append(output(source))
    return {"settings": digest(unit.settings), "version": version("romandask")} | {
        stage: digest(found) for stage, found in read.items()
    }


def _why(store: Store, stage: str, name: str, record: Record | None, parts: dict[str, str]) -> str:
    """Return why a unit is made."""
    if record is None:
        return "damaged record" if store.record(stage, name).exists() else "not there"
    if not record.parts:
        return "made by an earlier version"
    changed = sorted(key for key in {*record.parts, *parts} if record.parts.get(key) != parts.get(key))
    if changed == ["version"]:
        return f"made by version {record.parts.get('version')}"
    return f"changed: {', '.join(changed)}"


def _held(waiting: dict[str, tuple[str, ...]], missing: set[str]) -> set[str]:
    """Return the units that cannot be made because one that they come after cannot."""
    held: set[str] = set()
    while found := {name for name, after in waiting.items() if name not in held and set(after) & (missing | held)}:
        held |= found
    return held


def _drop_strays(product: Product, store: Store) -> None:
    """Remove the records of units that the stage no longer has, and of failures that are tried again."""
    names = set(product.names)
    for path in store.records(product.stage):
        if path.stem not in names:
            path.unlink()
    for path in store.record(product.stage, "x").parent.glob("*.failed"):
        path.unlink()


def _failure_path(store: Store, product: Product, name: str):
    return store.record(product.stage, name).with_suffix(".failed")


def status(survey: Survey) -> list[tuple[str, int, int, int]]:
    """Return (stage, units, done, failed) of every stage of a store; units is -1 where it is not known yet."""
    store = survey.store
    assert store is not None
    rows = []
    for stage in stages(survey):
        folder = store.record(stage.name, "x").parent
        failed = len(list(folder.glob("*.failed")))
        done = len(store.records(stage.name))
        known = stage.name.startswith(("truth/", "pointings/"))
        if known or all(read_record(store, f"pointings/{name}", "all") for name in survey.instruments):
            units = len(stage.product(survey).units)
        else:
            units = -1
        rows.append((stage.name, units, done, failed))
    return rows


def run_figures(store: Store) -> list[dict]:
    """Return, a stage, units, seconds of work, bytes, rows and the largest memory of a worker, from the manifest."""
    rows = []
    for folder in sorted(path for path in (store.root / "manifest").glob("*/*") if path.is_dir()):
        stage = f"{folder.parent.name}/{folder.name}"
        records = [record for path in store.records(stage) if (record := read_record(store, stage, path.stem))]
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
