"""Run stages: plan their stale units as one graph, let a runner make them, and write what belongs to no unit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field

from romandask.engine.event_log import Log
from romandask.engine.graph import StageUnits, UnitGraph
from romandask.engine.lost_units import Lost
from romandask.engine.progress import Board, Meter, Reporter
from romandask.engine.runners import Ended, Runner
from romandask.engine.staleness import (
    Source,
    Staleness,
    StoredOutputs,
    find_stale,
    remove_outdated_records,
    remove_stray_records,
    write_failure,
)
from romandask.engine.task import FailedBefore, Product, Task, complete_parts
from romandask.products.hats import write_catalog_files
from romandask.products.tables import TableProduct
from romandask.storage.checksums import catalog_metadata_files, has_checksums, write_checksums
from romandask.storage.manifest import digest
from romandask.storage.paths import AnyPath
from romandask.storage.store import Store, refuse_full

INPUT_MISSING = "an input is missing"
SKIPPED = "skipped, it failed before"


@dataclass(kw_only=True)
class Summary:
    """Summary of a run."""

    begun: int = 0
    """Number of tasks that were submitted."""
    made: dict[str, int] = field(default_factory=dict)
    """Number of units made, by stage."""
    kept: dict[str, int] = field(default_factory=dict)
    """Number of units that were up to date, by stage."""
    failed: list[str] = field(default_factory=list)
    """stage/unit of the units that failed or were skipped."""
    warnings: Counter[str] = field(default_factory=Counter)
    """Number of units that raised each warning, by text."""
    lost: Counter[str] = field(default_factory=Counter)
    """Number of units that were lost with their worker while they were made, by the reason why the worker ended."""


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
    last: bool = False
    """True if no stage reads this one: its units are made when workers have nothing else to do."""
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

    All stages whose units can be listed are one graph. Stages whose units depend on the content of others follow in a
    second one. A unit that fails is skipped, and so are the units that need it; all other units are made.

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
    check_order(stages)
    pending = stages
    with this.reporter.board() as board:
        while pending:
            chosen = listable(pending)
            _GraphRun(chosen, this, board).run()
            pending = [stage for stage in pending if stage not in chosen]


def check_order(stages: list[RunnableStage]) -> None:
    """Raise a RuntimeError if a stage needs a later one: it would wait for ever."""
    later = {stage.name for stage in stages}
    for stage in stages:
        later.discard(stage.name)
        if needed := sorted((stage.reads | stage.known_after) & later):
            raise RuntimeError(f"stages that wait for one another: {', '.join([stage.name, *needed])}")


def listable(pending: list[RunnableStage]) -> list[RunnableStage]:
    """Return the stages of the next graph.

    These are all pending stages if their units can be listed; otherwise those whose content decides which units others
    have, and the stages that these need.

    Parameters
    ----------
    pending : list of RunnableStage
        Stages that have not ended, each after those that it needs.
    """
    names = {stage.name for stage in pending}
    deciding = {name for stage in pending for name in stage.known_after} & names
    if not deciding:
        return pending
    wanted = set(deciding)
    for stage in reversed(pending):
        if stage.name in wanted:
            wanted |= (stage.reads | stage.known_after) & names
    return [stage for stage in pending if stage.name in wanted and not stage.known_after & names]


def write_stage_files(
    product: Product,
    store: Store,
    sky: tuple[str, str] | None,
    finish: Callable[[], tuple[str, list[AnyPath]]] | None,
) -> None:
    """Write the files of a stage that belong to no unit: catalog metadata, spectra and checksums.

    Parameters
    ----------
    product : ImageProduct or TableProduct
        Product whose units are stored.
    store : Store
        Store of the product.
    sky, finish
        As in `RunnableStage`.
    """
    if sky is not None and isinstance(product, TableProduct):
        write_catalog_files(product, store, *sky)
        write_checksums(store, product.stage, catalog_metadata_files(store, product.stage))
    elif files := product.metadata_files(store):
        write_checksums(store, product.stage, files)
    if finish is not None:
        write_checksums(store, *finish())


@dataclass
class _Active:
    """A stage with tasks in the graph."""

    stage: RunnableStage
    product: Product
    todo: Staleness
    left: int
    """Number of tasks without an outcome."""
    meter: Meter | None = None


class _GraphRun:
    """The run of one graph: its stages, and what is known of its units."""

    def __init__(self, stages: list[RunnableStage], this: Run, board: Board):
        self._stages, self._this, self._board = stages, this, board
        self._active: dict[str, _Active] = {}
        self._outputs: dict[Source, str] = {}
        """Output hashes of the units that this run has made or found to be up to date."""
        self._not_made: set[Source] = set()
        """Units that failed in this round, and units that need them."""
        self._unclear: list[Ended] = []
        """Units with an error that may be that of an input."""
        self._blocked: dict[str, list[str]] = {}
        """Names of the units of each stage that lack an input."""

    def run(self) -> None:
        """Make the stale units; then those of which only optional inputs failed, without these inputs."""
        stages, retry, first = self._stages, self._this.retry, True
        while stages:
            self._not_made.clear()
            graph = self._plan(stages, retry, first)
            if len(graph):
                self._make(graph)
            again = {stage for stage, _ in self._not_made}
            stages, retry, first = [stage for stage in stages if stage.name in again], False, False
        summary = self._this.summary
        for stage in self._stages:
            summary.failed += [f"{stage.name}/{name} ({INPUT_MISSING})" for name in self._blocked[stage.name]]
            stage.ended(summary.made[stage.name])

    def _plan(self, stages: list[RunnableStage], retry: bool, first: bool) -> UnitGraph:
        """Find the stale units of some stages and return their graph; end the stages without stale units."""
        this, stored = self._this, StoredOutputs(self._this.store)
        planned: set[Source] = set()
        self._active = {}
        for stage in stages:
            with this.reporter.busy(f"{stage.name}: finding what there is to do"):
                product = stage.product()
                todo = find_stale(product, stored, planned, retry)
                remove_outdated_records(product, this.store, todo)
                if first:
                    remove_stray_records(product, this.store, todo.tasks.keys())
                    this.summary.made[stage.name], this.summary.kept[stage.name] = 0, todo.kept
                    this.summary.failed += [f"{stage.name}/{name} ({SKIPPED})" for name in todo.failed]
            self._blocked[stage.name] = todo.blocked
            if todo.tasks:
                planned |= {(stage.name, name) for name in todo.tasks}
                self._active[stage.name] = _Active(stage, product, todo, len(todo.tasks))
                blocked = len(todo.blocked)
                this.log.write("stage", stage=stage.name, make=len(todo.tasks), keep=todo.kept, blocked=blocked)
            elif first:
                self._end(stage, product)
        units = [
            StageUnits(product=one.product, tasks=one.todo.tasks, sources=one.todo.sources, last=one.stage.last)
            for one in self._active.values()
        ]
        return UnitGraph(units, this.store)

    def _make(self, graph: UnitGraph) -> None:
        this = self._this
        if not this.summary.begun:
            this.ends.enter_context(this.runner.recording(this.log.path_with(".html")))
        this.summary.begun += len(graph)
        tasks = [task for stage in graph.stages for task in stage.tasks.values()]
        self._board.expect(len(tasks), sum(task.cost for task in tasks))
        with closing(this.runner.run(graph)) as events:
            for event in events:
                if isinstance(event, Lost):
                    self._lost(event)
                else:
                    self._process(event)
        unclear, self._unclear = self._unclear, []
        for ended in unclear:
            self._process(ended, last=True)

    def _lost(self, lost: Lost) -> None:
        """Log a unit that was lost with its worker; dask makes it again."""
        self._this.summary.lost[lost.reason] += 1
        self._this.log.write("lost", stage=lost.source[0], unit=lost.source[1], reason=lost.reason)

    def _process(self, ended: Ended, last: bool = False) -> None:
        """Count and log a unit that has ended, store its failure, and end the stage after its last unit."""
        this, (stage, unit) = self._this, ended.source
        active = self._active[stage]
        task, result = active.todo.tasks[unit], ended.result
        if result is not None:
            self._outputs[ended.source] = result.output
            counts = this.summary.made if result.made else this.summary.kept
            counts[stage] += 1
            if result.made:
                figures = dict(seconds=result.seconds, bytes=result.bytes, rows=result.rows)
                more = dict(peak_bytes=result.peak_bytes, warnings=list(result.warnings))
                this.log.write("unit", stage=stage, unit=unit, why=result.why, **figures, **more)
                this.summary.warnings.update(result.warnings)
        elif isinstance(ended.error, FailedBefore):
            self._not_made.add(ended.source)
            this.summary.failed.append(f"{stage}/{unit} ({SKIPPED})")
        elif all(source in self._outputs for source in active.todo.sources[unit]):
            refuse_full(ended.error, this.store)
            self._not_made.add(ended.source)
            self._failed(active, unit, task, ended.failure)
        elif not last:
            # dask gives the error of an input to all units that need it; the outcome of the inputs may still come
            self._unclear.append(ended)
            return
        else:
            self._not_made.add(ended.source)
        active.left -= 1
        if active.meter is None:
            units = active.todo.tasks.values()
            seconds = 0.0 if result is None else result.seconds
            active.meter = self._board.begin(stage, len(units), sum(each.cost for each in units), seconds)
        active.meter.advance(task.cost, 0.0 if result is None or not result.made else result.seconds)
        if not active.left:
            self._end(active.stage, active.product)

    def _failed(self, active: _Active, unit: str, task: Task, failure: str) -> None:
        """Log and store the failure of a unit."""
        this, stage = self._this, active.stage.name
        this.summary.failed.append(f"{stage}/{unit}")
        outputs = [self._outputs[source] for source in active.todo.sources[unit]]
        inputs = digest(stage, complete_parts(task, outputs))
        write_failure(this.store, stage, unit, inputs, failure)
        this.log.write("failed", stage=stage, unit=unit, why=task.why, reason=failure)

    def _end(self, stage: RunnableStage, product: Product) -> None:
        """Write the files of a stage that belong to no unit, if there is a new unit or the files are missing."""
        store = self._this.store
        # the run that made the last unit of a stage without checksums was interrupted before it wrote them
        written = has_checksums(store, stage.name)
        if stage.sky is not None:
            written &= (store.catalog(stage.name) / "hats.properties").exists()
        if self._this.summary.made[stage.name] or not written:
            write_stage_files(product, store, stage.sky, stage.finish)
