"""Staleness: find the units of a stage that are missing or outdated, and keep the failures of earlier runs."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace
from importlib.metadata import version

from romandask.engine.task import Product, Task, stale_reason
from romandask.products.units import Unit
from romandask.storage.manifest import Record, digest, read_records
from romandask.storage.paths import AnyPath, file_names, read_files, remove, write_bytes
from romandask.storage.store import Store

FAILED_BEFORE = "failed before"
FAILURE_SUFFIX = ".failed"
"""Suffix of the files that hold the failure of a unit."""
Source = tuple[str, str]
"""Stage and name of a unit."""


@dataclass(frozen=True, kw_only=True)
class Staleness:
    """The units of a stage, grouped by what a run does with them."""

    tasks: dict[str, Task]
    """Tasks of the units that are stale (missing or outdated), or may become so, and can be made, by name."""
    sources: dict[str, tuple[Source, ...]]
    """Units that a task waits for because the run makes them, by name of the unit, in the order of `make_unit`."""
    kept: int
    """Number of units that are up to date."""
    blocked: list[str]
    """Names of units that cannot be made because an input is missing."""
    failed: list[str]
    """Names of units that are skipped: they failed in an earlier run, and their input hash has not changed since."""
    outdated: list[str]
    """Names of blocked units with a record, which is no longer valid."""


class StoredOutputs:
    """Output hashes of the stored units of a store; the records of a stage are read once, when they are needed."""

    def __init__(self, store: Store):
        self.store = store
        self._outputs: dict[str, dict[str, str]] = {}

    def __call__(self, source: Source) -> str | None:
        """Return the output hash of a unit; None if it is not stored."""
        stage, name = source
        if stage not in self._outputs:
            records = read_records(self.store, stage)
            self._outputs[stage] = {unit: record.output for unit, record in records if record}
        return self._outputs[stage].get(name)


def find_stale(
    product: Product, stored: StoredOutputs, planned: Set[Source] = frozenset(), retry: bool = False
) -> Staleness:
    """Return the units of a stage, grouped by what a run would do with them. Nothing is changed.

    A unit that reads one of the `planned` units may turn out to be up to date when that one is made again and does not
    change; the task decides it.

    Parameters
    ----------
    product : ImageProduct or TableProduct
        Product of the stage.
    stored : StoredOutputs
        Output hashes of the units of the store.
    planned : set of (stage, unit)
        Units of earlier stages that the run makes first.
    retry : bool
        Make again the units that failed in an earlier run.
    """
    records = dict(read_records(stored.store, product.stage))
    failed_inputs = failures(stored.store, product.stage)
    tasks: dict[str, Task] = {}
    sources: dict[str, tuple[Source, ...]] = {}
    prerequisites: dict[str, tuple[str, ...]] = {}
    blocked: list[str] = []
    skipped: list[str] = []
    kept = 0
    for index, unit in enumerate(product.units):
        if any(source not in planned and stored(source) is None for source in unit.inputs):
            blocked.append(unit.name)
            continue
        parts, unknown = _hashes(unit, stored, planned)
        record, failed_hash = records.get(unit.name), failed_inputs.get(unit.name, "")
        input_hash = "" if unknown else digest(product.stage, parts)
        if record is not None and record.inputs == input_hash:
            kept += 1
            continue
        failed_before = bool(failed_hash) and failed_hash == input_hash
        if failed_before and not retry:
            skipped.append(unit.name)
            continue
        tasks[unit.name] = Task(
            index=index,
            parts=parts,
            unknown=tuple(unknown.items()),
            cost=unit.cost,
            why=FAILED_BEFORE if failed_before else _why(unit.name, records, parts | dict.fromkeys(unknown, "")),
            failed_inputs="" if retry else failed_hash,
        )
        sources[unit.name] = tuple(
            source for stage in unknown for source in _sources(unit) if source[0] == stage and source in planned
        )
        if unit.prerequisites:
            prerequisites[unit.name] = unit.prerequisites
    without_prerequisites = _without_prerequisites(prerequisites, {*blocked, *skipped})
    for name in without_prerequisites:
        del tasks[name], sources[name]
    for name, others in prerequisites.items():
        if name in tasks:
            sources[name] += tuple((product.stage, other) for other in others if other in tasks)
    blocked += sorted(without_prerequisites)
    mean = sum(task.cost for task in tasks.values()) / max(1, len(tasks))
    seconds = max(product.seconds_per_unit, 0.01) / max(mean, 1e-9)
    return Staleness(
        tasks={name: replace(task, cost=task.cost * seconds) for name, task in tasks.items()},
        sources=sources,
        kept=kept,
        blocked=blocked,
        failed=skipped,
        outdated=[name for name in blocked if name in records],
    )


def remove_outdated_records(product: Product, store: Store, staleness: Staleness) -> None:
    """Remove the records that are no longer valid of units that cannot be made."""
    for name in staleness.outdated:
        remove(store.record(product.stage, name))


def _sources(unit: Unit) -> tuple[Source, ...]:
    return (*unit.inputs, *unit.optional)


def _hashes(
    unit: Unit, stored: StoredOutputs, planned: Set[Source]
) -> tuple[dict[str, str], dict[str, tuple[str | None, ...]]]:
    """Return the parts of the input hash of a unit that are known, and the outputs of the stages that are not.

    The parts are the settings, the version, and the outputs that the unit reads of each stage.
    """
    outputs: dict[str, list[str | None]] = {}
    waiting: set[str] = set()
    for source in _sources(unit):
        if source in planned:
            waiting.add(source[0])
        outputs.setdefault(source[0], []).append(None if source in planned else stored(source) or "")
    known = {stage: digest(hashes) for stage, hashes in outputs.items() if stage not in waiting}
    parts = {"settings": digest(unit.settings), "version": version("romandask")} | known
    return parts, {stage: tuple(outputs[stage]) for stage in outputs if stage in waiting}


def _why(name: str, records: dict[str, Record | None], parts: dict[str, str]) -> str:
    """Return the reason why a unit is stale."""
    record = records.get(name)
    if record is None:
        return "damaged record" if name in records else "not there"
    return stale_reason(record, parts)


def _without_prerequisites(prerequisites: dict[str, tuple[str, ...]], missing: set[str]) -> set[str]:
    """Return the units with a direct or indirect prerequisite that cannot be made."""
    blocked: set[str] = set()
    while newly_blocked := {
        name for name, names in prerequisites.items() if name not in blocked and set(names) & (missing | blocked)
    }:
        blocked |= newly_blocked
    return blocked


def remove_stray_records(product: Product, store: Store, made: Set[str]) -> None:
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


def remove_failures(store: Store) -> None:
    """Remove the failures of the units of all stages, so that the next run makes these units again."""
    for stage in store.stages():
        for name in failed(store, stage):
            remove(_failure(store, stage, name))


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
