"""Run stages: each starts when the stages that it reads have ended; several may be active at the same time."""

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


@dataclass(kw_only=True)
class Summary:
    """Summary of a run."""

    begun: int = 0
    """Number of stale units of the stages that started."""
    made: dict[str, int] = field(default_factory=dict)
    """Number of units made, by stage."""
    kept: dict[str, int] = field(default_factory=dict)
    """Number of units that were up to date, by stage."""
    failed: list[str] = field(default_factory=list)
    """stage/unit of the units that failed or were skipped."""
    warnings: Counter[str] = field(default_factory=Counter)
    """Number of units that raised each warning, by text."""


@dataclass(frozen=True, kw_only=True)
class RunnableStage:
    """One product of a stage, as the engine sees it."""

    name: str
    product: Callable[[], Product]
    """Returns the lazy product; called after the stages in `known_after` have ended."""
    reads: frozenset[str] = frozenset()
    """Names of the products whose units the units of this stage read."""
    known_after: frozenset[str] = frozenset()
    """Names of the products whose content determines the units of this stage."""
    sky: tuple[str, str] | None = None
    """Names of the columns of right ascension and declination, for a HATS catalog; None for other products."""
    finish: Callable[[], tuple[str, list[AnyPath]]] | None = None
    """Writes the files of the stage that belong to no unit. Returns a name for their checksums, and their paths."""
    ended: Callable[[int], None] = lambda made: None
    """Called with the number of units made when the stage has ended."""


@dataclass(frozen=True)
class Run:
    """Resources that the stages of one run share."""

    store: Store
    runner: Runner
    reporter: Reporter
    log: Log
    retry: bool
    """Make again the units that failed in an earlier run."""
    summary: Summary = field(default_factory=Summary)
    ends: ExitStack = field(default_factory=ExitStack)
    """Context managers that exit when the run ends."""


def run_stages(stages: list[RunnableStage], this: Run) -> None:
    """Make and store the stale units of some stages.

    A unit that fails is skipped, and so are the units that need it; all other units are made.

    Parameters
    ----------
    stages : list of RunnableStage
        Stages in the order of the plan.
    this : Run
        Store, runner and log; its summary is filled.

    Raises
    ------
    UserError
        If the disk of the store is full or read-only, because all other units would fail too.
    RuntimeError
        If stages wait for one another.
    """
    with this.reporter.board() as board:
        schedule = _Schedule(stages, this, board)
        with closing(this.runner.run(more=schedule.ready)) as outcomes:
            for outcome in outcomes:
                schedule.process(outcome)
    if schedule.unfinished:
        raise RuntimeError(f"stages that wait for one another: {', '.join(schedule.unfinished)}")


@dataclass
class _Active:
    """A stage whose tasks have been submitted."""

    stage: RunnableStage
    product: Product
    tasks: dict[int, Task]
    """Tasks without an outcome, by unit number."""
    meter: Meter


class _Schedule:
    """Schedule of the stages of a run: pending and active stages, and the start and end of each."""

    def __init__(self, stages: list[RunnableStage], this: Run, board: Board):
        self._this, self._board = this, board
        self._ranks = {stage.name: rank for rank, stage in enumerate(stages)}
        self._pending = {stage.name: stage for stage in stages}
        self._active: dict[str, _Active] = {}
        self._check_pending = True
        """Whether a stage may have become able to start since the last search for one."""

    @property
    def unfinished(self) -> list[str]:
        """Names of the stages that have not ended."""
        return [*self._active, *self._pending]

    def ready(self) -> list[Batch]:
        """Start the next stage that can start, and return its tasks; a stage without stale units ends immediately.

        Starts one stage per call, so that workers have tasks while the stale units of the next stage are found.
        """
        while self._check_pending:
            stage = self._next()
            if stage is None:
                self._check_pending = False
                break
            del self._pending[stage.name]
            if active := self._begin(stage):
                return [Batch(active.product, [*active.tasks.values()], self._this.store, self._ranks[stage.name])]
        return []

    def process(self, outcome: Outcome) -> None:
        """Log the outcome of a unit, store its failure with the traceback, and end the stage after its last unit."""
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
            self._check_pending = True
            self._end(active.stage, active.product)

    def _next(self) -> RunnableStage | None:
        """Return the first pending stage that waits for no other stage, or None."""
        unfinished = set(self.unfinished)
        return next(
            (
                stage
                for stage in self._pending.values()
                if not ((stage.reads | stage.known_after) - {stage.name}) & unfinished
            ),
            None,
        )

    def _begin(self, stage: RunnableStage) -> _Active | None:
        """Find the stale units of a stage and start it; without stale units, end it and return None."""
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
            this.ends.enter_context(this.runner.recording(this.log.path_with(".html")))
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
        summary.failed += [f"{stage}/{name} (skipped, it failed before)" for name in todo.failed]

    def _end(self, stage: RunnableStage, product: Product) -> None:
        """Write the files of a stage that belong to no unit: catalog metadata, spectra and checksums."""
        store, made = self._this.store, self._this.summary.made[stage.name]
        # the run that made the last unit of a stage without checksums was interrupted before it wrote them
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
