"""Staleness: find the units of a stage that are missing or outdated, and keep the failures of earlier runs."""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass, replace
from importlib.metadata import version

from romandask.engine.task import Task
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.storage.manifest import Record, digest, read_records
from romandask.storage.paths import AnyPath, file_names, read_files, remove, write_bytes
from romandask.storage.store import Store

FAILED_BEFORE = "failed before"
FAILURE_SUFFIX = ".failed"
"""Suffix of the files that hold the failure of a unit."""


@dataclass(frozen=True, kw_only=True)
class Staleness:
    """The units of a stage, grouped by what a run does with them."""

    tasks: list[Task]
    """Stale units (missing or outdated) that can be made."""
    kept: int
    """Number of units that are up to date."""
    blocked: list[str]
    """Names of units that cannot be made because an input is missing."""
    failed: list[str]
    """Names of units that are skipped: they failed in an earlier run, and their input hash has not changed since."""
    outdated: list[str]
    """Names of units with a record that is no longer valid."""


def find_stale(
    product: ImageProduct | TableProduct,
    store: Store,
    planned: Set[tuple[str, str]] = frozenset(),
    retry: bool = False,
) -> Staleness:
    """Return the units of a stage, grouped by what a run would do with them. Nothing is changed.

    Parameters
    ----------
    product : ImageProduct or TableProduct
        Product of the stage.
    store : Store
        Store with the records.
    planned : set of (stage, unit)
        Units of earlier stages that a run would make first; used to explain a run without making anything.
    retry : bool
        Make again the units that failed in an earlier run.
    """
    outputs: dict[str, dict[str, str]] = {}

    def output(source: tuple[str, str]) -> str | None:
        if source in planned:
            return "to be made"
        stage, name = source
        if stage not in outputs:
            outputs[stage] = {unit: record.output for unit, record in read_records(store, stage) if record}
        return outputs[stage].get(name)

    records, failed_inputs = dict(read_records(store, product.stage)), failures(store, product.stage)
    tasks: dict[str, Task] = {}
    prerequisites: dict[str, tuple[str, ...]] = {}
    blocked: list[str] = []
    skipped: list[str] = []
    outdated: list[str] = []
    kept = 0
    for index, unit in enumerate(product.units):
        if any(output(source) is None for source in unit.inputs):
            blocked.append(unit.name)
            outdated += [unit.name] if unit.name in records else []
            continue
        parts = _parts(unit, output)
        inputs, record = digest(product.stage, parts), records.get(unit.name)
        if record is not None and record.inputs == inputs:
            kept += 1
            continue
        failed_before = failed_inputs.get(unit.name) == inputs
        if failed_before and not retry:
            skipped.append(unit.name)
            continue
        why = FAILED_BEFORE if failed_before else _why(unit.name, records, parts)
        outdated += [unit.name] if unit.name in records else []
        tasks[unit.name] = Task(index, inputs, unit.cost, unit.affinity, parts=parts, why=why)
        prerequisites[unit.name] = unit.prerequisites
    without_prerequisites = _without_prerequisites(prerequisites, {*blocked, *skipped})
    ready = [
        replace(task, prerequisites=tuple(tasks[other].index for other in prerequisites[name] if other in tasks))
        for name, task in tasks.items()
        if name not in without_prerequisites
    ]
    return Staleness(
        tasks=ready,
        kept=kept,
        blocked=blocked + sorted(without_prerequisites),
        failed=skipped,
        outdated=outdated,
    )


def remove_outdated_records(product: ImageProduct | TableProduct, store: Store, staleness: Staleness) -> None:
    """Remove the records that are no longer valid."""
    for name in staleness.outdated:
        remove(store.record(product.stage, name))


def _parts(unit: Unit, output: Callable[[tuple[str, str]], str | None]) -> dict[str, str]:
    """Return the parts of the input hash of a unit: settings, version, and the outputs it reads of each stage."""
    outputs: dict[str, list[str | None]] = {}
    for source in (*unit.inputs, *unit.optional):
        outputs.setdefault(source[0], []).append(output(source))
    return {"settings": digest(unit.settings), "version": version("romandask")} | {
        stage: digest(hashes) for stage, hashes in outputs.items()
    }


def _why(name: str, records: dict[str, Record | None], parts: dict[str, str]) -> str:
    """Return the reason why a unit is stale."""
    record = records.get(name)
    if record is None:
        return "damaged record" if name in records else "not there"
    if not record.parts:
        return "made by an earlier version"
    changed = sorted(key for key in {*record.parts, *parts} if record.parts.get(key) != parts.get(key))
    if changed == ["version"]:
        return f"made by version {record.parts.get('version')}"
    return f"changed: {', '.join(changed)}"


def _without_prerequisites(prerequisites: dict[str, tuple[str, ...]], missing: set[str]) -> set[str]:
    """Return the units with a direct or indirect prerequisite that cannot be made."""
    blocked: set[str] = set()
    while newly_blocked := {
        name for name, names in prerequisites.items() if name not in blocked and set(names) & (missing | blocked)
    }:
        blocked |= newly_blocked
    return blocked


def remove_stray_records(product: ImageProduct | TableProduct, store: Store, made: Set[str]) -> None:
    """Remove the records and failures of units that a stage no longer has, and the failures of units to be made now.

    Parameters
    ----------
    product : ImageProduct or TableProduct
        Product of the stage.
    store : Store
        Store with the records.
    made : set of str
        Names of the units that the run makes.
    """
    names = set(product.names)
    for name in store.recorded(product.stage):
        if name not in names:
            remove(store.record(product.stage, name))
    for name in failed(store, product.stage):
        if name not in names or name in made:
            remove(_failure(store, product.stage, name))


def failed(store: Store, stage: str) -> list[str]:
    """Return the names of the units of a stage that failed."""
    return file_names(store.records(stage), FAILURE_SUFFIX)


def failures(store: Store, stage: str) -> dict[str, str]:
    """Return the input hashes, at the time of the failure, of the units of a stage that failed."""
    files = read_files(store.records(stage), FAILURE_SUFFIX)
    return {name: text.split(b"\n", 1)[0].decode(errors="replace").removeprefix("inputs ") for name, text in files}


def write_failure(store: Store, stage: str, unit: str, inputs: str, text: str) -> None:
    """Write the failure text and the input hash of a unit. The unit is skipped until its input hash changes."""
    write_bytes(_failure(store, stage, unit), f"inputs {inputs}\n{text}".encode())


def _failure(store: Store, stage: str, unit: str) -> AnyPath:
    return store.records(stage) / f"{unit}{FAILURE_SUFFIX}"
