"""The course of a run: each stage begins when those that it reads have ended, beside others that are under way."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack, closing
from dataclasses import dataclass, field

from romandask.engine.clients import Runner
from romandask.engine.event_log import Log
from romandask.engine.progress import Board, Meter, Reporter
from romandask.engine.staleness import Staleness, find_stale, remove_stray_records, write_failure
from romandask.engine.task import Batch, Outcome, Task
from romandask.products.hats import write_catalog_files
from romandask.products.images import ImageProduct
from romandask.stage_graph import Product, Stage, reads, tier
from romandask.stages.truth.catalogs import write_spectra
from romandask.storage.checksums import (
    catalog_metadata_files,
    has_checksums,
    image_metadata_files,
    remove_checksums,
    write_checksums,
)
from romandask.storage.paths import files_below
from romandask.storage.store import Store, refuse_full
from romandask.survey import Survey


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


@dataclass(frozen=True)
class Run:
    """What the stages of one run share."""

    survey: Survey
    store: Store
    runner: Runner
    reporter: Reporter
    log: Log
    retry: bool
    summary: Summary = field(default_factory=Summary)
    ends: ExitStack = field(default_factory=ExitStack)
    """What is to be closed at the end."""


def run_stages(stages: list[Stage], this: Run) -> None:
    """Make and store the units of some stages that are missing or no longer what they should be.

    A stage that fails in part is no hindrance: units that need what is not there wait, and are told of.

    Raises
    ------
    UserError
        If the store can take no more: that is no unit's fault, and every other would fail too.
    """
    with this.reporter.board() as board:
        course = _StageRun(stages, this, board)
        with closing(this.runner.run(more=course.ready)) as outcomes:
            for outcome in outcomes:
                course.take(outcome)
    if course.stuck:
        raise RuntimeError(f"stages that wait for one another: {', '.join(course.stuck)}")


@dataclass
class _Active:
    """A stage that is under way."""

    stage: Stage
    product: Product
    tasks: dict[int, Task]
    """What there is to make, by the number of the unit; those that have ended are taken out."""
    meter: Meter


class _StageRun:
    """The stages of a run: those to come, those under way, and what begins and ends them."""

    def __init__(self, stages: list[Stage], this: Run, board: Board):
        self._this, self._board = this, board
        self._ranks = {stage.name: rank for rank, stage in enumerate(stages)}
        self._coming = {stage.name: stage for stage in stages}
        self._going: dict[str, _Active] = {}
        self._reads: dict[str, frozenset[str]] = {}
        self._changed = True

    @property
    def stuck(self) -> list[str]:
        """Names of the stages that have not ended."""
        return [*self._going, *self._coming]

    def ready(self) -> list[Batch]:
        """Begin a stage that can, and return what there is to make of it; where that is nothing, end it and go on.

        One at a time, so that there is work to do while what there is of the next is found.
        """
        while self._changed:
            stage = self._next()
            if stage is None:
                self._changed = False
                break
            del self._coming[stage.name]
            if going := self._begin(stage):
                return [Batch(going.product, [*going.tasks.values()], self._this.store, self._ranks[stage.name])]
        return []

    def take(self, outcome: Outcome) -> None:
        """Log what became of a unit, and end its stage with the last; one that failed is set aside with the reason."""
        this, stage = self._this, outcome.stage
        going, record = self._going[stage], outcome.record
        task, unit = going.tasks.pop(outcome.index), going.product.names[outcome.index]
        going.meter.advance(task.cost, 0.0 if record is None else record.seconds)
        if record is not None:
            this.summary.made[stage] += 1
            figures = {"seconds": record.seconds, "bytes": record.bytes, "rows": record.rows}
            this.log.write(
                "unit",
                stage=stage,
                unit=unit,
                why=task.why,
                **figures,
                peak_bytes=record.peak_bytes,
                warnings=record.warnings,
            )
            this.summary.warnings.update(record.warnings)
        else:
            refuse_full(outcome.error, this.store)
            this.summary.failed.append(f"{stage}/{unit}")
            write_failure(this.store, stage, unit, task.inputs, str(outcome.failure))
            this.log.write("failed", stage=stage, unit=unit, why=task.why, reason=str(outcome.failure))
        if not going.tasks:
            del self._going[stage]
            self._changed = True
            self._end(going.stage, going.product)

    def _next(self) -> Stage | None:
        """Return a stage that can begin."""
        open_ = {*self._coming, *self._going}
        now = min(map(tier, open_), default=0)
        candidates = [stage for stage in self._coming.values() if tier(stage.name) == now]
        with self._this.reporter.busy("putting the stages in order"):
            return next((stage for stage in candidates if not self._read_by(stage) & open_), None)

    def _read_by(self, stage: Stage) -> frozenset[str]:
        if stage.name not in self._reads:
            self._reads[stage.name] = reads(stage.product(self._this.survey)) - {stage.name}
        return self._reads[stage.name]

    def _begin(self, stage: Stage) -> _Active | None:
        """Find what there is to do of a stage; None where it is nothing, and the stage has ended."""
        this = self._this
        with this.reporter.busy(f"{stage.name}: finding what there is to do"):
            product = stage.product(this.survey)
            todo = find_stale(product, this.store, retry=this.retry)
        self._tell(stage.name, todo)
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
        # a unit that is made again reads its upstream from the store, never its own former self
        going = _Active(stage, product, {task.index: task for task in todo.tasks}, meter)
        self._going[stage.name] = going
        return going

    def _tell(self, stage: str, todo: Staleness) -> None:
        summary = self._this.summary
        summary.made[stage], summary.kept[stage] = 0, todo.kept
        summary.failed += [f"{stage}/{name} (an input is missing)" for name in todo.blocked]
        summary.failed += [f"{stage}/{name} (set aside, it failed before)" for name in todo.aside]

    def _end(self, stage: Stage, product: Product) -> None:
        """Write what a stage has but its units: the files of a catalog, spectra, checksums."""
        store = self._this.store
        # what an earlier run left unsealed it did not end
        anew = self._this.summary.made[stage.name] or not has_checksums(store, stage.name)
        if anew or (stage.position is not None and not (store.catalog(stage.name) / "hats.properties").exists()):
            if isinstance(product, ImageProduct):
                write_checksums(
                    store, stage.name, image_metadata_files(store, stage.name, [v.name for v in product.variables])
                )
            elif stage.position is not None:
                write_catalog_files(product, store, *stage.position)
                write_checksums(store, stage.name, catalog_metadata_files(store, stage.name))
        if stage.name == "truth/galaxies":
            write_spectra(self._this.survey.truth_catalogs, store)
            write_checksums(store, "truth/seds", files_below(store.images("truth/seds")))
