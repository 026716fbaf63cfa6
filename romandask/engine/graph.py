"""The graph of a run: a dask collection with a layer for each stage, a task for each stale unit, and an edge for each
unit that a unit is made from."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import dask.threaded
from dask._task_spec import Task as DaskTask
from dask._task_spec import TaskRef
from dask.base import DaskMethodsMixin
from dask.highlevelgraph import HighLevelGraph, MaterializedLayer
from dask.order import order

from romandask.engine.staleness import Source
from romandask.engine.task import Product, Task, UnitResult, make_unit
from romandask.storage.checksums import remove_checksums
from romandask.storage.store import Store

RETRIES = 2
"""Number of times that dask tries a failing unit again."""
GROUP = 200
"""Number of units whose end is awaited by one task, so that no task has thousands of dependencies."""
Key = tuple[str, str]
"""Key of a dask task: name of the layer, and name of the unit."""
PRODUCTS = "products"
"""Name of the layer whose only task returns all products of a graph."""


@dataclass(frozen=True, kw_only=True)
class StageUnits:
    """The units of one stage that a graph makes."""

    product: Product
    tasks: dict[str, Task]
    """Tasks by name of the unit."""
    sources: dict[str, tuple[Source, ...]]
    """Units of the graph that each unit waits for, by name of the unit, in the order of `make_unit`."""
    last: bool = False
    """True if no stage reads this one: its units are made when workers have nothing else to do."""
    finish: Callable[[Product, Store], None] | None = None
    """Writes the files of the stage that belong to no unit, when all units are stored; must be picklable."""


@dataclass(frozen=True)
class Products:
    """The products of the stages of a graph.

    They share what they are made from: together they take a tenth of the memory of a worker that copies of each, with
    all that is upstream, would take.
    """

    by_stage: Mapping[str, Product]


@dataclass(frozen=True, eq=False)
class UnitGraph(DaskMethodsMixin):
    """The stale units of a survey as a lazy dask collection.

    `compute()` makes and stores the units and returns a dict of `UnitResult` by "<stage>/<unit>". It runs on threads
    unless another scheduler is chosen: a client of a cluster, or one of dask's own. A unit that fails raises its
    exception, as any dask collection does; `romandask.run` sets failures aside and continues.
    """

    stages: Sequence[StageUnits]
    """Stages in the order of the plan."""
    store: Store
    """Store that the units are written to and that they read their inputs from."""
    futures: Mapping[Key, Any] | None = None
    """Futures of the tasks of a persisted collection."""
    token: str = field(default_factory=lambda: f"0{uuid.uuid4().hex[:7]}")
    """Part of the keys of the tasks. It begins with a digit, so that dask leaves it out of the names of task groups."""
    whole: Products | None = None
    """Products of the graph of which this one is a part."""

    @classmethod
    def of(cls, product: Product, store: Store) -> UnitGraph:
        """Return the graph of all units of one product that have no record; their inputs must be stored."""
        tasks = {name: Task(index, {"stage": product.stage}) for index, name in enumerate(product.names)}
        return cls([StageUnits(product=product, tasks=tasks, sources=dict.fromkeys(tasks, ()))], store)

    def __len__(self) -> int:
        return sum(len(stage.tasks) for stage in self.stages)

    def __repr__(self) -> str:
        return f"UnitGraph({len(self)} units of {len(self.stages)} stages)"

    def units(self) -> list[Source]:
        """Return all units of the graph, in the order of the stages."""
        return [(stage.product.stage, name) for stage in self.stages for name in stage.tasks]

    def layer(self, stage: str) -> str:
        """Return the name of the layer of a stage."""
        return f"{stage}-{self.token}"

    def key(self, source: Source) -> Key:
        """Return the key of the task of a unit."""
        return self.layer(source[0]), source[1]

    @property
    def products(self) -> Products:
        """Products of all stages, and of those of the graph of which this one is a part."""
        return self.whole or Products({stage.product.stage: stage.product for stage in self.stages})

    @property
    def products_key(self) -> Key:
        """Key of the task that returns the products, which all others need."""
        return self.layer(PRODUCTS), "all"

    def begin_key(self, stage: str) -> Key:
        """Return the key of the task that prepares the arrays of a stage and returns its name, which its units need."""
        return f"begin-{self.layer(stage)}", "arrays"

    def unit_tasks(self, stage: StageUnits) -> Iterator[tuple[Key, DaskTask]]:
        """Yield the tasks of the units of a stage by key."""
        name = stage.product.stage
        products, begun = TaskRef(self.products_key), TaskRef(self.begin_key(name))
        for unit, task in stage.tasks.items():
            key = self.key((name, unit))
            inputs = [TaskRef(self.key(source)) for source in stage.sources[unit]]
            # a data producer is sent to a worker only when the worker has a free thread: see docs/developer/run.md
            yield key, DaskTask(key, _make, products, begun, task, self.store, *inputs, _data_producer=True)

    def end_tasks(self, stage: StageUnits) -> Iterator[tuple[Key, DaskTask]]:
        """Yield the tasks that write the files of a stage after its last unit; the last one is the end of the stage."""
        name = stage.product.stage
        waiting = [self.key((name, unit)) for unit in stage.tasks]
        level = 0
        while len(waiting) > GROUP:
            groups = [waiting[first : first + GROUP] for first in range(0, len(waiting), GROUP)]
            waiting = [("wait-" + self.layer(name), f"{level}-{number}") for number in range(len(groups))]
            for key, group in zip(waiting, groups, strict=True):
                yield key, DaskTask(key, _all_made, *map(TaskRef, group))
            level += 1
        key, needed = ("end-" + self.layer(name), "files"), (self.products_key, self.begin_key(name), *waiting)
        yield key, DaskTask(key, _finish, stage.finish, self.store, *map(TaskRef, needed))

    def __dask_graph__(self) -> HighLevelGraph | Mapping[Key, Any]:
        return self.high_level_graph() if self.futures is None else self.futures

    def high_level_graph(self, begun: Set[str] = frozenset()) -> HighLevelGraph:
        """Return the graph with a layer for each stage.

        Parameters
        ----------
        begun : set of str
            Stages whose first task (`begin_key`) was submitted before, and PRODUCTS if the task of the products was.
        """
        layers: dict[str, MaterializedLayer] = {}
        dependencies: dict[str, set[str]] = {}
        products = self.layer(PRODUCTS)
        if PRODUCTS not in begun:
            key = self.products_key
            layers[products], dependencies[products] = (
                MaterializedLayer({key: DaskTask(key, _held, self.products)}),
                set(),
            )
        for stage in self.stages:
            name = self.layer(stage.product.stage)
            tasks = dict(self.unit_tasks(stage))
            if stage.product.stage not in begun:
                key = self.begin_key(stage.product.stage)
                tasks[key] = DaskTask(key, _begin, TaskRef(self.products_key), stage.product.stage, self.store)
            if stage.finish is not None:
                tasks |= dict(self.end_tasks(stage))
            layers[name] = MaterializedLayer(tasks, annotations={"retries": RETRIES, "priority": -int(stage.last)})
            read = {source[0] for sources in stage.sources.values() for source in sources}
            dependencies[name] = {products, *(self.layer(other) for other in read)} - {name}
        present = set(layers)
        return HighLevelGraph(layers, {name: needed & present for name, needed in dependencies.items()})

    def pieces(self, size: int) -> list[set[Source]]:
        """Return the units in pieces of a size, so that no unit is in an earlier piece than one that it waits for.

        Units follow the order in which dask would run them, from one place on the sky to the next; units of stages that
        no other stage reads come last.

        Parameters
        ----------
        size : int
            Largest number of units of a piece.
        """
        units = self.units()
        if len(units) <= size:
            return [set(units)]
        last = {stage.product.stage for stage in self.stages if stage.last}
        edges: dict[Any, DaskTask] = {
            (stage.product.stage, name): DaskTask((stage.product.stage, name), len, *map(TaskRef, stage.sources[name]))
            for stage in self.stages
            for name in stage.tasks
        }
        place = order(edges)
        units.sort(key=lambda source: (source[0] in last, place[source]))
        return [set(units[first : first + size]) for first in range(0, len(units), size)]

    def part(self, units: Set[Source], outputs: Mapping[Source, str]) -> UnitGraph:
        """Return the graph of some units.

        Parameters
        ----------
        units : set of Source
            Units of the graph that is returned. They may wait for other units, whose tasks were submitted before.
        outputs : mapping of Source to str
            Output hashes of the units that have been made; no unit waits for them.
        """
        stages = []
        for stage in self.stages:
            names = [name for name in stage.tasks if (stage.product.stage, name) in units]
            if names:
                known = {name: _with_outputs(stage.tasks[name], stage.sources[name], outputs) for name in names}
                tasks = {name: task for name, (task, _) in known.items()}
                sources = {name: waiting for name, (_, waiting) in known.items()}
                stages.append(replace(stage, tasks=tasks, sources=sources))
        return replace(self, stages=stages, whole=self.products)

    def __dask_keys__(self) -> list[Key]:
        ends = [
            ("end-" + self.layer(stage.product.stage), "files") for stage in self.stages if stage.finish is not None
        ]
        return [*map(self.key, self.units()), *ends]

    def __dask_layers__(self) -> tuple[str, ...]:
        return (self.layer(PRODUCTS), *(self.layer(stage.product.stage) for stage in self.stages))

    def __dask_tokenize__(self) -> str:
        return self.token

    __dask_scheduler__ = staticmethod(dask.threaded.get)
    __dask_optimize__ = None

    def __dask_postcompute__(self) -> tuple[Callable[..., dict[str, UnitResult]], tuple[Any, ...]]:
        return _by_name, ([f"{stage}/{name}" for stage, name in self.units()],)

    def __dask_postpersist__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return partial(_persisted, self), ()


def _with_outputs(
    task: Task, sources: tuple[Source, ...], outputs: Mapping[Source, str]
) -> tuple[Task, tuple[Source, ...]]:
    """Return a task in which the outputs of units that have been made are known, and the units it still waits for."""
    if not any(source in outputs for source in sources):
        return task, sources
    waiting = iter(sources)
    unknown = []
    for stage, known in task.unknown:
        found = [outputs.get(next(waiting)) if output is None else output for output in known]
        unknown.append((stage, tuple(found)))
    return replace(task, unknown=tuple(unknown)), tuple(source for source in sources if source not in outputs)


_BEGIN = threading.Lock()


def begin_stage(product: Product, store: Store) -> None:
    """Create the arrays of a product in a store.

    It may be called again while units are written, when the worker that had the result is lost: what exists and is
    right is not written again.
    """
    with _BEGIN:
        remove_checksums(store, product.stage)
        product.prepare(store)


def _held(products: Products) -> Products:
    return products


def _begin(products: Products, stage: str, store: Store) -> str:
    begin_stage(products.by_stage[stage], store)
    return stage


def _make(products: Products, stage: str, task: Task, store: Store, *inputs: UnitResult) -> UnitResult:
    return make_unit(products.by_stage[stage], task, store, *inputs)


def _all_made(*units: Any) -> int:
    return len(units)


def _finish(finish: Callable[[Product, Store], None], store: Store, products: Products, stage: str, *made: Any) -> str:
    finish(products.by_stage[stage], store)
    return stage


def _persisted(graph: UnitGraph, futures: Mapping[Key, Any], rename: Any = None) -> UnitGraph:
    return replace(graph, futures=futures)


def _by_name(results: Sequence[Any], names: Sequence[str]) -> dict[str, UnitResult]:
    return dict(zip(names, results, strict=False))
