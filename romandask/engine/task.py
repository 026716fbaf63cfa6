"""Making one unit: the function that a task runs, in a worker or in this process."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field

from romandask.products.images import ImageProduct
from romandask.products.memory import INTERPRETER, peak_memory, release_free_memory, reset_peak
from romandask.products.tables import TableProduct
from romandask.storage.manifest import Record, write_record
from romandask.storage.store import Store

LARGE = 512 << 20
"""Bytes: before a unit that takes more, free memory goes back to the system, whatever was made before it."""


@dataclass(frozen=True)
class Task:
    """One unit to make."""

    index: int
    inputs: str
    """Hash of what it depends on."""
    cost: float
    affinity: str = ""
    """As that of its unit."""
    prerequisites: tuple[int, ...] = ()
    """Numbers of units of the same stage, made in the same run, that must be there before it."""
    parts: dict[str, str] = field(default_factory=dict)
    """What `inputs` is the hash of, by name."""
    why: str = ""
    """The reason for which it is made."""


@dataclass(frozen=True)
class Batch:
    """Units of one stage that are to be made."""

    product: ImageProduct | TableProduct
    tasks: list[Task]
    store: Store
    rank: int = 0
    """Units of a lower one are handed out first."""


@dataclass(frozen=True)
class Outcome:
    """What became of a unit: its record, or the text of its last failure."""

    stage: str
    index: int
    record: Record | None
    failure: str | None = None
    error: BaseException | None = None
    """What was raised, where it is known."""


def given_up(product: ImageProduct | TableProduct, failed: int, lost: list[Task]) -> list[Outcome]:
    """Return what became of the units that come after one that failed."""
    return [Outcome(product.stage, task.index, None, after_failed(product, failed)) for task in lost]


def after_failed(product: ImageProduct | TableProduct, failed: int) -> str:
    """Return why a unit was not made that comes after one that failed."""
    return f"{product.names[failed]}, which comes before it, failed\n"


def make_unit(product: ImageProduct | TableProduct, task: Task, store: Store, *after: Record) -> Record:
    """Make and write one unit, then its record: what a crash leaves in between is made again.

    `after` are records of units that it had to wait for: of a task graph's edges the values.
    """
    start = time.perf_counter()
    if product.bytes_per_unit > LARGE:
        # what lies free in the heap would be beside what this unit takes
        release_free_memory()
    held = reset_peak()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        made = product.write(task.index, store)
    most = peak_memory()
    told = {f"{item.category.__name__}: {item.message}" for item in caught}
    if 0 < product.bytes_per_unit < most - max(held, INTERPRETER):
        told.add(f"{product.stage} took more memory than the {product.bytes_per_unit / 2**30:.2f} GiB that it states")
    record = Record(
        stage=product.stage,
        unit=product.names[task.index],
        inputs=task.inputs,
        output=made.output,
        bytes=made.bytes,
        rows=made.rows,
        seconds=round(time.perf_counter() - start, 3),
        peak_bytes=most,
        parts=task.parts,
        warnings=sorted(told),
    )
    write_record(store, record)
    return record
