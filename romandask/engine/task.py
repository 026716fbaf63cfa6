"""Tasks: what is needed to make one unit, and the function that makes it on a worker or in this process."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

from romandask.products.images import ImageProduct
from romandask.products.memory import INTERPRETER, peak_memory, release_free_memory, reset_peak
from romandask.products.tables import TableProduct
from romandask.storage.manifest import Record, digest, read_record, write_record
from romandask.storage.paths import remove
from romandask.storage.store import Store

LARGE_UNIT_BYTES = 512 << 20
"""Peak memory of a unit above which free heap memory is returned to the system before the unit is made, bytes."""
Product = ImageProduct | TableProduct
Outputs = tuple[str | None, ...]
"""Output hashes of units, in order; None for a unit that is made in the same run."""


class FailedBefore(Exception):
    """The unit failed in an earlier run with the same inputs."""


@dataclass(frozen=True)
class Task:
    """One unit to make."""

    index: int
    """Unit number in its product."""
    parts: dict[str, str]
    """Hashes that the input hash combines, by name, as far as they are known before the run."""
    unknown: tuple[tuple[str, Outputs], ...] = ()
    """Stage, and outputs of the units that this one reads of it, for each stage with a unit that the run makes."""
    cost: float = 1.0
    """Expected time of making the unit, s."""
    why: str = ""
    """Reason why the unit is stale."""
    failed_inputs: str = ""
    """Input hash with which the unit failed in an earlier run and is not tried again; empty if it may be tried."""


@dataclass(frozen=True)
class UnitResult:
    """What a task returns: a small summary of the record of its unit."""

    output: str
    """Hash of the content."""
    made: bool
    """False if the unit was up to date."""
    why: str = ""
    """Reason why it was made."""
    seconds: float = 0.0
    bytes: int = 0
    rows: int = 0
    peak_bytes: int = 0
    warnings: tuple[str, ...] = ()


def make_unit(product: Product, task: Task, store: Store, *inputs: UnitResult) -> UnitResult:
    """Make and store one unit unless it is up to date; then write its record.

    The record is written last: a unit whose making was interrupted has none and is made again.

    Parameters
    ----------
    product : ImageProduct or TableProduct
        Product of the stage.
    task : Task
        The unit to make.
    store : Store
        Destination.
    *inputs : UnitResult
        Results of the units that this one is made from and that the same run makes: those that are None in
        `task.unknown`, in order, and then others that must only be made first.

    Raises
    ------
    FailedBefore
        If the unit failed in an earlier run with the same inputs and is not tried again.
    """
    parts = complete_parts(task, [result.output for result in inputs])
    input_hash, name = digest(product.stage, parts), product.names[task.index]
    record = read_record(store, product.stage, name)
    if record is not None and record.inputs == input_hash:
        # another stage was made again with the same result, or this task was computed before and its result was lost
        return _result(record, made=False)
    if task.failed_inputs == input_hash:
        raise FailedBefore(name)
    why = stale_reason(record, parts) if record is not None and task.unknown else task.why
    # without a record, what an interrupted task leaves is not taken for the unit
    remove(store.record(product.stage, name))
    return _result(_made(product, task.index, store, input_hash, parts), made=True, why=why)


def _made(product: Product, index: int, store: Store, input_hash: str, parts: dict[str, str]) -> Record:
    """Make one unit and write its record."""
    start = time.perf_counter()
    if product.bytes_per_unit > LARGE_UNIT_BYTES:
        # memory that earlier units left free in the heap would add to the peak of this unit
        release_free_memory()
    memory_before = reset_peak()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        made = product.write(index, store)
    peak = peak_memory()
    texts = {f"{item.category.__name__}: {item.message}" for item in caught}
    if 0 < product.bytes_per_unit < peak - max(memory_before, INTERPRETER):
        texts.add(f"{product.stage} took more memory than the {product.bytes_per_unit / 2**30:.2f} GiB that it states")
    record = Record(
        stage=product.stage,
        unit=product.names[index],
        inputs=input_hash,
        output=made.output,
        bytes=made.bytes,
        rows=made.rows,
        seconds=round(time.perf_counter() - start, 3),
        peak_bytes=peak,
        parts=parts,
        warnings=sorted(texts),
    )
    write_record(store, record)
    return record


def complete_parts(task: Task, outputs: Sequence[str]) -> dict[str, str]:
    """Return all parts of the input hash of a unit.

    Parameters
    ----------
    task : Task
        The unit.
    outputs : sequence of str
        Output hashes of the units that are None in `task.unknown`, in order; more may follow.
    """
    found = iter(outputs)
    hashes = {
        stage: digest([next(found) if output is None else output for output in known]) for stage, known in task.unknown
    }
    return task.parts | hashes


def stale_reason(record: Record, parts: dict[str, str]) -> str:
    """Return the reason why a unit with a record is stale.

    Parameters
    ----------
    record : Record
        Record of the unit.
    parts : dict of str to str
        Parts of the present input hash.
    """
    if not record.parts:
        return "made by an earlier version"
    changed = sorted(key for key in {*record.parts, *parts} if record.parts.get(key) != parts.get(key))
    if changed == ["version"]:
        return f"made by version {record.parts.get('version')}"
    return f"changed: {', '.join(changed)}"


def _result(record: Record, made: bool, why: str = "") -> UnitResult:
    return UnitResult(
        output=record.output,
        made=made,
        why=why,
        seconds=record.seconds,
        bytes=record.bytes,
        rows=record.rows,
        peak_bytes=record.peak_bytes,
        warnings=tuple(record.warnings),
    )
