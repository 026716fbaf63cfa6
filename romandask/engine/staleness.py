"""Staleness: the units of a stage that are missing or outdated, and those that failed before."""

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
FAILED = ".failed"
"""Ending of the files that say why a unit failed."""


@dataclass(frozen=True, kw_only=True)
class Staleness:
    """The units of a stage by what a run does with them."""

    tasks: list[Task]
    """Stale units, missing or outdated, that can be made."""
    kept: int
    """Number of units that are up to date."""
    blocked: list[str]
    """Units that cannot be made because an input is missing."""
    failed: list[str]
    """Units that failed before and whose inputs have not changed since: they are skipped."""
    outdated: list[str]
    """Units that have a record which no longer holds."""


def find_stale(
    product: ImageProduct | TableProduct,
    store: Store,
    coming: Set[tuple[str, str]] = frozenset(),
    retry: bool = False,
) -> Staleness:
    """Return the units of a stage by what a run would do with them. Nothing is changed.

    Parameters
    ----------
    coming : set of (stage, unit)
        Units of earlier stages that will be made first, where a run is only explained.
    retry : bool
        Make again what failed before.
    """
    outputs: dict[str, dict[str, str]] = {}

    def output(source: tuple[str, str]) -> str | None:
        if source in coming:
            return "to be made"
        stage, name = source
        if stage not in outputs:
            outputs[stage] = {unit: record.output for unit, record in read_records(store, stage) if record}
        return outputs[stage].get(name)

    records, failed_with = dict(read_records(store, product.stage)), failures(store, product.stage)
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
        failed_before = failed_with.get(unit.name) == inputs
        if failed_before and not retry:
            skipped.append(unit.name)
            continue
        why = FAILED_BEFORE if failed_before else _why(unit.name, records, parts)
        outdated += [unit.name] if unit.name in records else []
        tasks[unit.name] = Task(index, inputs, unit.cost, unit.affinity, parts=parts, why=why)
        prerequisites[unit.name] = unit.prerequisites
    held = _held(prerequisites, {*blocked, *skipped})
    ready = [
        replace(task, prerequisites=tuple(tasks[other].index for other in prerequisites[name] if other in tasks))
        for name, task in tasks.items()
        if name not in held
    ]
    return Staleness(tasks=ready, kept=kept, blocked=blocked + sorted(held), failed=skipped, outdated=outdated)


def remove_outdated_records(product: ImageProduct | TableProduct, store: Store, found: Staleness) -> None:
    """Remove the records of units that are to be made again, or cannot be."""
    for name in found.outdated:
        remove(store.record(product.stage, name))


def _parts(unit: Unit, output: Callable[[tuple[str, str]], str | None]) -> dict[str, str]:
    """Return what a unit depends on, by name: its settings, the version, and what it reads of each stage."""
    read: dict[str, list[str | None]] = {}
    for source in (*unit.inputs, *unit.optional):
        read.setdefault(source[0], []).append(output(source))
    return {"settings": digest(unit.settings), "version": version("romandask")} | {
        stage: digest(found) for stage, found in read.items()
    }


def _why(name: str, records: dict[str, Record | None], parts: dict[str, str]) -> str:
    """Return why a unit is made."""
    record = records.get(name)
    if record is None:
        return "damaged record" if name in records else "not there"
    if not record.parts:
        return "made by an earlier version"
    changed = sorted(key for key in {*record.parts, *parts} if record.parts.get(key) != parts.get(key))
    if changed == ["version"]:
        return f"made by version {record.parts.get('version')}"
    return f"changed: {', '.join(changed)}"


def _held(prerequisites: dict[str, tuple[str, ...]], missing: set[str]) -> set[str]:
    """Return the units of which a prerequisite, or a prerequisite of that, cannot be made."""
    held: set[str] = set()
    while found := {
        name for name, before in prerequisites.items() if name not in held and set(before) & (missing | held)
    }:
        held |= found
    return held


def remove_stray_records(product: ImageProduct | TableProduct, store: Store, made: Set[str]) -> None:
    """Remove the records of units that a stage no longer has, and the failures of those and of what is `made` now."""
    names = set(product.names)
    for name in store.recorded(product.stage):
        if name not in names:
            remove(store.record(product.stage, name))
    for name in failed(store, product.stage):
        if name not in names or name in made:
            remove(_failure(store, product.stage, name))


def failed(store: Store, stage: str) -> list[str]:
    """Return the units of a stage that failed."""
    return file_names(store.records(stage), FAILED)


def failures(store: Store, stage: str) -> dict[str, str]:
    """Return the units of a stage that failed, each with the hash of what it depended on then."""
    found = read_files(store.records(stage), FAILED)
    return {name: text.split(b"\n", 1)[0].decode(errors="replace").removeprefix("inputs ") for name, text in found}


def write_failure(store: Store, stage: str, unit: str, inputs: str, text: str) -> None:
    """Write why a unit failed, and the hash of what it depends on: until that changes it stays set aside."""
    write_bytes(_failure(store, stage, unit), f"inputs {inputs}\n{text}".encode())


def _failure(store: Store, stage: str, unit: str) -> AnyPath:
    return store.records(stage) / f"{unit}{FAILED}"
