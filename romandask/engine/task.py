"""Tasks: what is needed to make one unit, and the function that makes it on a worker or in this process."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field

from romandask.products.images import ImageProduct
from romandask.products.memory import INTERPRETER, peak_memory, release_free_memory, reset_peak
from romandask.products.tables import TableProduct
from romandask.storage.manifest import Record, write_record
from romandask.storage.store import Store

LARGE_UNIT_BYTES = 512 << 20
"""Peak memory of a unit above which free heap memory is returned to the system before the unit is made, bytes."""


@dataclass(frozen=True)
class Task:
    """One unit to make."""

    index: int
    """Unit number in its product."""
    inputs: str
    """Input hash."""
    cost: float
    """Relative cost of the unit; more expensive units are made first."""
    affinity: str = ""
    """Affinity key: units with the same key share cached data of a worker."""
    prerequisites: tuple[int, ...] = ()
    """Numbers of units of the same stage that this run makes and that must be finished before this one."""
    parts: dict[str, str] = field(default_factory=dict)
    """Hashes that `inputs` combines, by name."""
    why: str = ""
    """Reason why the unit is stale."""


@dataclass(frozen=True)
class Batch:
    """Tasks of one stage."""

    product: ImageProduct | TableProduct
    tasks: list[Task]
    store: Store
    rank: int = 0
    """Position of the stage in the plan. Batches of lower rank are submitted first."""


@dataclass(frozen=True)
class Outcome:
    """Result of a task: the record of the unit, or the text of its last failure."""

    stage: str
    index: int
    """Unit number."""
    record: Record | None
    """None if the unit was not made."""
    failure: str | None = None
    """Why the unit was not made, usually a traceback."""
    error: BaseException | None = None
    """Exception of the last attempt, if known."""


def skipped_outcomes(product: ImageProduct | TableProduct, failed: int, skipped: list[Task]) -> list[Outcome]:
    """Return the outcomes of tasks that are skipped because the unit number `failed` was not made."""
    return [Outcome(product.stage, task.index, None, failed_prerequisite_text(product, failed)) for task in skipped]


def failed_prerequisite_text(product: ImageProduct | TableProduct, failed: int) -> str:
    """Return the failure text of a unit whose prerequisite, the unit number `failed`, was not made."""
    return f"{product.names[failed]}, which comes before it, failed\n"


def make_unit(product: ImageProduct | TableProduct, task: Task, store: Store, *prerequisites: Record) -> Record:
    """Make and store one unit, then write its record.

    The record is written last: a unit whose making was interrupted has none and is made again.

    Parameters
    ----------
    product : ImageProduct or TableProduct
        Product of the stage.
    task : Task
        The unit to make.
    store : Store
        Destination.
    *prerequisites : Record
        Records of the prerequisites. They are not used; as arguments they make dask run the prerequisites first.

    Returns
    -------
    Record
        Manifest entry of the unit.
    """
    start = time.perf_counter()
    if product.bytes_per_unit > LARGE_UNIT_BYTES:
        # memory that earlier units left free in the heap would add to the peak of this unit
        release_free_memory()
    memory_before = reset_peak()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        made = product.write(task.index, store)
    peak = peak_memory()
    texts = {f"{item.category.__name__}: {item.message}" for item in caught}
    if 0 < product.bytes_per_unit < peak - max(memory_before, INTERPRETER):
        texts.add(f"{product.stage} took more memory than the {product.bytes_per_unit / 2**30:.2f} GiB that it states")
    record = Record(
        stage=product.stage,
        unit=product.names[task.index],
        inputs=task.inputs,
        output=made.output,
        bytes=made.bytes,
        rows=made.rows,
        seconds=round(time.perf_counter() - start, 3),
        peak_bytes=peak,
        parts=task.parts,
        warnings=sorted(texts),
    )
    write_record(store, record)
    return record
