"""What there is to do of a stage: units that are not there, or not as they would be made now; and those that failed."""

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


@dataclass(frozen=True)
class Staleness:
    """The units of a stage by what is to be done with them."""

    tasks: list[Task]
    kept: int
    """Units that are there as they should be."""
    blocked: list[str]
    """Units of which an input is missing."""
    aside: list[str]
    """Units that failed, with inputs that have not changed since."""


def find_stale(
    product: ImageProduct | TableProduct,
    store: Store,
    coming: Set[tuple[str, str]] | None = None,
    retry: bool = False,
) -> Staleness:
    """Return what is to be done; the records of units that are to be made, or cannot be, are removed, but in a plan.

    Parameters
    ----------
    coming : in a plan, units of earlier stages that will be made; None in a run
    retry : make what failed, too
    """
    forget, coming = coming is None, coming or set()
    stored: dict[str, dict[str, str]] = {}

    def output(source: tuple[str, str]) -> str | None:
        if source in coming:
            return "to be made"
        stage, name = source
        if stage not in stored:
            stored[stage] = {unit: record.output for unit, record in read_records(store, stage) if record}
        return stored[stage].get(name)

    records, failed_with = dict(read_records(store, product.stage)), failures(store, product.stage)
    tasks: dict[str, Task] = {}
    blocked: list[str] = []
    aside: list[str] = []
    waiting: dict[str, tuple[str, ...]] = {}
    kept = 0
    for index, unit in enumerate(product.units):
        if any(output(source) is None for source in unit.inputs):
            blocked.append(unit.name)
            if forget and unit.name in records:
                remove(store.record(product.stage, unit.name))
            continue
        parts = _parts(unit, output)
        inputs, record = digest(product.stage, parts), records.get(unit.name)
        if record is not None and record.inputs == inputs:
            kept += 1
            continue
        again = failed_with.get(unit.name) == inputs
        if again and not retry:
            aside.append(unit.name)
            continue
        why = FAILED_BEFORE if again else _why(unit.name, records, parts)
        if forget and unit.name in records:
            remove(store.record(product.stage, unit.name))
        tasks[unit.name] = Task(index, inputs, unit.cost, unit.affinity, parts=parts, why=why)
        waiting[unit.name] = unit.prerequisites
    held = _held(waiting, {*blocked, *aside})
    chosen = [
        replace(task, prerequisites=tuple(tasks[other].index for other in waiting[name] if other in tasks))
        for name, task in tasks.items()
        if name not in held
    ]
    return Staleness(chosen, kept, blocked + sorted(held), aside)


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


def _held(waiting: dict[str, tuple[str, ...]], missing: set[str]) -> set[str]:
    """Return the units that cannot be made because one that they come after cannot."""
    held: set[str] = set()
    while found := {name for name, after in waiting.items() if name not in held and set(after) & (missing | held)}:
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
