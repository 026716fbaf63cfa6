"""Runners: make the units of a graph in this process, or on a dask cluster."""

from __future__ import annotations

import queue
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import Any, Protocol

from romandask.engine.graph import PRODUCTS, Key, StageUnits, UnitGraph, begin_stage
from romandask.engine.lost_units import Lost, watched_workers
from romandask.engine.staleness import Source
from romandask.engine.task import UnitResult, make_unit
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

NO_WORKER_TIMEOUT = 60.0
"""Time that a run waits for a cluster without workers, s."""
POLL_INTERVAL = 2.0
"""Time between two looks for new workers while no task ends, s."""
PIECE = 40_000
"""Largest number of units that are submitted at a time: see docs/developer/run.md."""
BATCH = 200
"""Largest number of results that are fetched at a time."""


@dataclass(frozen=True)
class Ended:
    """End of a task: the result of its unit, or why there is none."""

    source: Source
    """Stage and name of the unit."""
    result: UnitResult | None
    failure: str = ""
    """Why the unit was not made, usually a traceback."""
    error: BaseException | None = None
    """Exception of the last attempt, which may be that of an input."""


class Runner(Protocol):
    """Interface of the runners."""

    description: str
    """Text for the user, for example the address of the dashboard."""

    def run(self, graph: UnitGraph) -> Generator[Ended | Lost, None, None]:
        """Make the units of a graph and yield the end of each as soon as it is known."""

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Return a context manager that writes a performance report of the cluster (HTML) to `path` when it exits."""


class InProcess:
    """Runner that makes units one after another in this process, for debugging."""

    description = "in this process"

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Return a context manager that does nothing, because there is no cluster to report on."""
        return nullcontext()

    def run(self, graph: UnitGraph) -> Generator[Ended | Lost, None, None]:
        """Make units, one stage after another, and yield the end of each. A failed unit is not tried again."""
        results: dict[Source, UnitResult] = {}
        for stage in graph.stages:
            product = stage.product
            begin_stage(product, graph.store)
            for name in _after_their_sources(product.stage, stage):
                source, needed = (product.stage, name), stage.sources[name]
                if any(other not in results for other in needed):
                    yield Ended(source, None)
                    continue
                try:
                    result = make_unit(product, stage.tasks[name], graph.store, *(results[other] for other in needed))
                except Exception as error:
                    yield Ended(source, None, traceback.format_exc(), error)
                else:
                    results[source] = result
                    yield Ended(source, result)


def _after_their_sources(stage_name: str, stage: StageUnits) -> Iterator[str]:
    """Return the names of the units of a stage, each after those of the same stage that it waits for."""
    sorter: TopologicalSorter[str] = TopologicalSorter()
    for name in stage.tasks:
        sorter.add(name, *(other for source, other in stage.sources[name] if source == stage_name))
    return iter(sorter.static_order())


class _Submitted:
    """The units of a graph that have been submitted to a cluster.

    Parameters
    ----------
    client : distributed.Client
        Client of the cluster.
    graph : UnitGraph
        The whole graph.
    on_end : callable
        Called with the future of each unit that has ended.
    """

    def __init__(self, client: Any, graph: UnitGraph, on_end: Callable[[Any], None]):
        self._client, self._graph, self._on_end = client, graph, on_end
        self.futures: dict[Any, Any] = {}
        """Futures of the units that have not ended, by key."""
        self._begun: dict[str, Any] = {}
        """Futures of the products, and of the first tasks of the stages of which units were submitted."""
        self._outputs: dict[Source, str] = {}
        self._not_made: set[Source] = set()

    def add(self, units: set[Source]) -> Iterator[Ended]:
        """Submit a piece of the graph, and yield the ends of its units that need a unit that failed before."""
        piece = self._graph.part(units, self._outputs)
        skipped = set(_skipped(piece, self._not_made)) if self._not_made else set()
        if skipped:
            self._not_made |= skipped
            piece = piece.part(units - skipped, {})
        stages = {stage.product.stage: self._graph.begin_key(stage.product.stage) for stage in piece.stages}
        stages[PRODUCTS] = self._graph.products_key
        begins = {stage: key for stage, key in stages.items() if stage not in self._begun}
        keys = [self._graph.key(source) for source in piece.units()]
        with warnings.catch_warnings():
            # a piece of a graph is large, and that is known
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            found = self._client.get(piece.high_level_graph(self._begun.keys()), [*begins.values(), *keys], sync=False)
        self._begun |= dict(zip(begins, found[: len(begins)], strict=True))
        for key, future in zip(keys, found[len(begins) :], strict=True):
            self.futures[key] = future
            future.add_done_callback(self._on_end)
        for source in skipped:
            yield Ended(source, None)

    def note(self, ended: Ended) -> None:
        """Note the end of a unit, which later pieces may need."""
        if ended.result is not None:
            self._outputs[ended.source] = ended.result.output
        else:
            self._not_made.add(ended.source)

    def release(self, ended: list[Any]) -> None:
        """Release futures that have ended."""
        for future in ended:
            del self.futures[future.key]
            future.release()

    def cancel(self) -> None:
        """Cancel what has not ended."""
        if self.futures:
            self._client.cancel([*self.futures.values()], force=True)
        for future in self._begun.values():
            future.release()


def _skipped(graph: UnitGraph, not_made: set[Source]) -> Iterator[Source]:
    """Yield the units of a graph that need, directly or indirectly, a unit that was not made."""
    missing = set(not_made)
    for stage in graph.stages:
        for name in _after_their_sources(stage.product.stage, stage):
            if name in stage.tasks and not missing.isdisjoint(stage.sources[name]):
                missing.add((stage.product.stage, name))
                yield stage.product.stage, name


class OnCluster:
    """Runner that makes the units of a graph on a dask cluster.

    Parameters
    ----------
    client : distributed.Client
        Client of the cluster.
    description : str
        Text for the user.
    recorded : callable
        Returns a context manager that writes dask's performance report to a path.
    restart : callable
        Starts missing workers. Called every `POLL_INTERVAL` seconds while no task ends.
    """

    def __init__(
        self,
        client: Any,
        description: str,
        recorded: Callable[[AnyPath], AbstractContextManager[Any]] = nullcontext,
        restart: Callable[[], None] = lambda: None,
    ):
        self._client, self._recorded, self._restart = client, recorded, restart
        self.description = description

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Return a context manager that writes dask's performance report: task stream, transfers and profiles."""
        return self._recorded(path)

    def run(self, graph: UnitGraph) -> Generator[Ended | Lost, None, None]:
        """Make units and yield the end of each. A failing unit is tried three times.

        Raises
        ------
        UserError
            If the cluster has no worker for a minute.
        """
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        sources = {graph.key(source): source for source in graph.units()}
        waiting, submitted = graph.pieces(PIECE), _Submitted(self._client, graph, ended.put)
        last_worker_seen = time.monotonic()
        with watched_workers(self._client, sources) as losses:
            try:
                while waiting or submitted.futures:
                    if waiting and len(submitted.futures) < PIECE / 2:
                        yield from submitted.add(waiting.pop(0))
                    batch = self._next_ended(ended)
                    for end in self._ends(batch, sources):
                        submitted.note(end)
                        yield end
                    submitted.release(batch)
                    yield from losses.known()
                    if batch or self._client.scheduler_info(n_workers=0)["n_workers"]:
                        last_worker_seen = time.monotonic()
                    elif time.monotonic() - last_worker_seen > NO_WORKER_TIMEOUT:
                        raise UserError(
                            f"no worker has been left for {NO_WORKER_TIMEOUT:.0f} s: start workers, or look for what "
                            "ends them (memory: raise run.memory_limit); the same command resumes"
                        )
                yield from losses.known(wait=False)
            finally:
                submitted.cancel()

    def _next_ended(self, ended: queue.SimpleQueue[Any]) -> list[Any]:
        """Return the futures that have ended; wait up to `POLL_INTERVAL` for the first one."""
        try:
            batch = [ended.get(timeout=POLL_INTERVAL)]
        except queue.Empty:
            self._restart()
            return []
        while len(batch) < BATCH and not ended.empty():
            batch.append(ended.get())
        return batch

    def _ends(self, batch: list[Any], sources: dict[Key, Source]) -> Iterator[Ended]:
        """Yield the ends of some futures; results are fetched together."""
        finished = {future.key: future for future in batch if future.status == "finished"}
        results = self._client.gather(finished, errors="skip") if finished else {}
        for future in batch:
            source = sources[future.key]
            if future.key in results:
                yield Ended(source, results[future.key])
                continue
            error = future.exception() if future.status == "error" else None
            yield Ended(source, None, _failure_text(future, error), error)


def _failure_text(future: Any, error: BaseException | None) -> str:
    if error is None:
        return f"the task was {future.status}\n"
    if type(error).__name__ == "KilledWorker":
        return (
            f"its worker died {getattr(error, 'allowed_failures', 0) + 1} times, perhaps for want of memory\n{error}\n"
        )
    return "".join(traceback.format_exception(type(error), error, future.traceback()))
