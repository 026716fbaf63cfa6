"""Run stages: each begins when those that it reads have ended, beside others that are under way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field

from romandask.engine.clients import Runner
from romandask.engine.event_log import Log
from romandask.engine.progress import Board, Meter, Reporter
from romandask.engine.staleness import (
    Staleness,
    find_stale,
    remove_outdated_records,
    remove_stray_records,
    write_failure,
)
from romandask.engine.task import Batch, Outcome, Task
from romandask.products.hats import write_catalog_files
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct
from romandask.storage.checksums import catalog_metadata_files, has_checksums, remove_checksums, write_checksums
from romandask.storage.paths import AnyPath
from romandask.storage.store import Store, refuse_full

Product = ImageProduct | TableProduct


@dataclass
class Summary:
    """What a run did."""

    begun: int = 0
    """Units that were handed out."""
    made: dict[str, int] = field(default_factory=dict)
    kept: dict[str, int] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)
    """stage/unit of units that were set aside, and of those that wait for them."""
    warnings: Counter[str] = field(default_factory=Counter)
    """What units warned of, and how many did."""


@dataclass(frozen=True, kw_only=True)
class RunnableStage:
    """One product of a stage, as the engine sees it."""

    name: str
    product: Callable[[], Product]
    """Returns the lazy product; called once `known_after` have ended."""
    reads: frozenset[str] = frozenset()
    """Names of the products whose units its units are made from."""
    known_after: frozenset[str] = frozenset()
    """Names of the products whose content decides which units it has."""
    sky: tuple[str, str] | None = None
    """Columns of right ascension and declination where it is a HATS catalog."""
    finish: Callable[[], tuple[str, list[AnyPath]]] | None = None
    """Writes what the stage has beside its units; returns a name and the files, whose checksums are kept under it."""
    ended: Callable[[int], None] = lambda made: None
    """Called when the stage has ended, with the number of units that were made."""


@dataclass(frozen=True)
class Run:
    """What the stages of one run share."""

    store: Store
    runner: Runner
    reporter: Reporter
    log: Log
    retry: bool
    summary: Summary = field(default_factory=Summary)
    ends: ExitStack = field(default_factory=ExitStack)
    """Contexts that are closed when the run ends."""


def run_stages(stages: list[RunnableStage], this: Run) -> None:
    """Make and store the stale units of some stages.

    A unit that fails is skipped: the units that need it wait and are reported, all others go on.

    Raises
    ------
    UserError
        If the store's disk is full or read-only: every other unit would fail too.
    """
    with this.reporter.board() as board:
        schedule = _Schedule(stages, this, board)
        with closing(this.runner.run(more=schedule.ready)) as outcomes:
            for outcome in outcomes:
                schedule.take(outcome)
    if schedule.stuck:
        raise RuntimeError(f"stages that wait for one another: {', '.join(schedule.stuck)}")


@dataclass
class _Active:
    """A stage that is under way."""

    stage: RunnableStage
    product: Product
    tasks: dict[int, Task]
    """Tasks that have not ended, by unit number."""
    meter: Meter


class _Schedule:
    """The stages of a run: those to come, those under way, and what begins and ends them."""

    def __init__(self, stages: list[RunnableStage], this: Run, board: Board):
        self._this, self._board = this, board
        self._ranks = {stage.name: rank for rank, stage in enumerate(stages)}
        self._coming = {stage.name: stage for stage in stages}
        self._active: dict[str, _Active] = {}
        self._changed = True

    @property
    def stuck(self) -> list[str]:
        """Names of the stages that have not ended."""
        return [*self._active, *self._coming]

    def ready(self) -> list[Batch]:
        """Begin the next stage that can begin and return its tasks; a stage without stale units ends at once.

        One stage at a time, so that workers have tasks while the stale units of the next stage are looked for.
        """
        while self._changed:
            stage = self._next()
            if stage is None:
                self._changed = False
                break
            del self._coming[stage.name]
            if active := self._begin(stage):
                return [Batch(active.product, [*active.tasks.values()], self._this.store, self._ranks[stage.name])]
        return []

    def take(self, outcome: Outcome) -> None:
        """Log the outcome of a unit, and end its stage with the last one; a failure is kept with its traceback."""
        this, stage = self._this, outcome.stage
        active, record = self._active[stage], outcome.record
        task, unit = active.tasks.pop(outcome.index), active.product.names[outcome.index]
        active.meter.advance(task.cost, 0.0 if record is None else record.seconds)
        if record is not None:
            this.summary.made[stage] += 1
            this.log.write(
                "unit",
                stage=stage,
                unit=unit,
                why=task.why,
                seconds=record.seconds,
                bytes=record.bytes,
                rows=record.rows,
                peak_bytes=record.peak_bytes,
                warnings=record.warnings,
            )
            this.summary.warnings.update(record.warnings)
        else:
            refuse_full(outcome.error, this.store)
            this.summary.failed.append(f"{stage}/{unit}")
            write_failure(this.store, stage, unit, task.inputs, str(outcome.failure))
            this.log.write("failed", stage=stage, unit=unit, why=task.why, reason=str(outcome.failure))
        if not active.tasks:
            del self._active[stage]
            self._changed = True
            self._end(active.stage, active.product)

    def _next(self) -> RunnableStage | None:
        """Return the first stage that waits for no other; None where there is none."""
        unfinished = {*self._coming, *self._active}
        return next(
            (
                stage
                for stage in self._coming.values()
                if not ((stage.reads | stage.known_after) - {stage.name}) & unfinished
            ),
            None,
        )

    def _begin(self, stage: RunnableStage) -> _Active | None:
        """Find the stale units of a stage; None where there are none, and the stage has ended."""
        this = self._this
        with this.reporter.busy(f"{stage.name}: finding what there is to do"):
            product = stage.product()
            todo = find_stale(product, this.store, retry=this.retry)
            remove_outdated_records(product, this.store, todo)
        self._count(stage.name, todo)
        remove_stray_records(product, this.store, {product.names[task.index] for task in todo.tasks})
        if not todo.tasks:
            self._end(stage, product)
            return None
        remove_checksums(this.store, stage.name)
        product.prepare(this.store)
        if not this.summary.begun:
            this.ends.enter_context(this.runner.recording(this.log.beside(".html")))
        this.summary.begun += len(todo.tasks)
        this.log.write("stage", stage=stage.name, make=len(todo.tasks), keep=todo.kept, blocked=len(todo.blocked))
        meter = self._board.begin(stage.name, len(todo.tasks), sum(task.cost for task in todo.tasks))
        active = _Active(stage, product, {task.index: task for task in todo.tasks}, meter)
        self._active[stage.name] = active
        return active

    def _count(self, stage: str, todo: Staleness) -> None:
        summary = self._this.summary
        summary.made[stage], summary.kept[stage] = 0, todo.kept
        summary.failed += [f"{stage}/{name} (an input is missing)" for name in todo.blocked]
        summary.failed += [f"{stage}/{name} (set aside, it failed before)" for name in todo.failed]

    def _end(self, stage: RunnableStage, product: Product) -> None:
        """Write what a stage has beside its units: the files of a catalog, spectra, checksums."""
        store, made = self._this.store, self._this.summary.made[stage.name]
        # a stage without checksums was not finished by the run that made its last unit
        unfinished = made or not has_checksums(store, stage.name)
        if stage.sky is not None and isinstance(product, TableProduct):
            if unfinished or not (store.catalog(stage.name) / "hats.properties").exists():
                write_catalog_files(product, store, *stage.sky)
                write_checksums(store, stage.name, catalog_metadata_files(store, stage.name))
        elif unfinished and (files := product.metadata_files(store)):
            write_checksums(store, stage.name, files)
        if stage.finish is not None:
            write_checksums(store, *stage.finish())
        stage.ended(made)
