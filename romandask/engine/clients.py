"""Runners: make units on a local cluster of one-thread processes, on an existing cluster, or in this process.

No other module imports distributed.
"""

from __future__ import annotations

import gc
import queue
import re
import socket
import time
import traceback
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from graphlib import TopologicalSorter
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import dask
import yaml
from distributed import Client, KilledWorker, LocalCluster, Nanny, performance_report

from romandask.engine.graph import Key, StageUnits, UnitGraph, begin_stage
from romandask.engine.lost_units import EXIT_TOPIC, Lost, watched_workers
from romandask.engine.staleness import Source
from romandask.engine.task import UnitResult, make_unit
from romandask.model.errors import UserError
from romandask.model.resources import resource_folder
from romandask.storage.paths import AnyPath, write_bytes

START_ATTEMPTS = 3
"""Number of attempts to start a local cluster."""
NO_WORKER_TIMEOUT = 60.0
"""Time that a run waits for a cluster without workers, s."""
POLL_INTERVAL = 2.0
"""Time between two looks for new workers while no task ends, s."""
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
            product = begin_stage(stage.product, graph.store)
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


class OnCluster:
    """Runner that makes the units of a graph on a dask cluster.

    Parameters
    ----------
    client : distributed.Client
        Client of the cluster.
    description : str
        Text for the user.
    restart : callable or None
        Starts missing workers. Called every `POLL_INTERVAL` seconds while no task ends.
    """

    def __init__(self, client: Client, description: str, restart: Callable[[], None] | None = None):
        self._client = client
        self._restart = restart or (lambda: None)
        self.description = description

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Return a context manager that writes dask's performance report: task stream, transfers and profiles."""
        return _recording(self._client, path)

    def run(self, graph: UnitGraph) -> Generator[Ended | Lost, None, None]:
        """Make units and yield the end of each. A failing unit is tried three times.

        Raises
        ------
        UserError
            If the cluster has no worker for a minute.
        """
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        sources = {graph.key((stage.product.stage, name)): (stage.product.stage, name) for stage, name in _units(graph)}
        keys = [*sources]
        with watched_workers(self._client, sources) as losses:
            futures = dict(zip(keys, self._client.get(graph.high_level_graph(), keys, sync=False), strict=True))
            try:
                for future in futures.values():
                    future.add_done_callback(ended.put)
                last_worker_seen = time.monotonic()
                while futures:
                    batch = self._next_ended(ended)
                    yield from self._ends(batch, sources)
                    for future in batch:
                        del futures[future.key]
                        future.release()
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
                if futures:
                    self._client.cancel([*futures.values()], force=True)

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


def _units(graph: UnitGraph) -> Iterator[tuple[StageUnits, str]]:
    return ((stage, name) for stage in graph.stages for name in stage.tasks)


def _failure_text(future: Any, error: BaseException | None) -> str:
    if error is None:
        return f"the task was {future.status}\n"
    if isinstance(error, KilledWorker):
        return f"its worker died {error.allowed_failures + 1} times, perhaps for want of memory\n{error}\n"
    return "".join(traceback.format_exception(type(error), error, future.traceback()))


@contextmanager
def _recording(client: Client, path: AnyPath) -> Iterator[None]:
    # dask writes a local file without external assets (inline); the store receives it as a whole
    with TemporaryDirectory(prefix="romandask-") as folder:
        temporary = Path(folder) / "performance.html"
        report = performance_report(filename=str(temporary), mode="inline")
        with client.as_current():
            report.__enter__()
        try:
            yield
        finally:
            with client.as_current(), suppress(Exception):
                # a report that fails because workers are gone must not fail a finished run
                report.__exit__(None, None, None)
                # the icon is the only external asset of the page
                page = re.sub(r'<link rel="shortcut icon"[^>]*>', "", temporary.read_text(encoding="utf-8"))
                write_bytes(path, page.encode())


@contextmanager
def runner(workers: int, memory_limit: float, scheduler: str | None = None) -> Iterator[Runner]:
    """Return a context manager with a runner.

    Parameters
    ----------
    workers : int
        Number of local worker processes; 0 makes the units in this process. Ignored if `scheduler` is given.
    memory_limit : float
        Memory of each worker, GiB.
    scheduler : str or None
        Address of the scheduler of an existing cluster, for example tcp://host:8786.

    Raises
    ------
    UserError
        If no scheduler answers, its workers have too little memory or another version of romandask, or the local
        workers cannot be started.
    """
    if scheduler is None and workers == 0:
        yield InProcess()
        return
    if scheduler is not None:
        if not re.fullmatch(r"(tcp|tls)://\S+:\d+", scheduler):
            raise UserError(f"--scheduler {scheduler}: write tcp://host:port, or tls://host:port")
        with _connected(scheduler) as client:
            yield on_client(client, memory_limit, f"--scheduler {scheduler}")
        return
    settings = yaml.safe_load((resource_folder("pipelines") / "cluster" / "workers.yaml").read_text())
    with (
        dask.config.set(dask.config.merge({"distributed": dask.config.get("distributed")}, settings)),
        _local_cluster(workers, int(memory_limit * 2**30)) as cluster,
        Client(cluster) as client,
    ):
        # dask does not restart a worker that dies during its start; scaling to the wanted number does
        description = f"{workers} local workers, dashboard {cluster.dashboard_link}"
        yield OnCluster(client, description, lambda: cluster.scale(workers))


def _connected(scheduler: str) -> Client:
    try:
        return Client(scheduler, timeout="20s")
    except (OSError, ValueError, TypeError, TimeoutError, RuntimeError) as error:
        # dask raises TypeError for tls:// without certificates
        reason = str(error) or type(error).__name__
    # A client that could not connect closes itself when it is collected. It is collected now, because the close would
    # wait for ever while another client starts in this process.
    gc.collect()
    raise UserError(f"--scheduler {scheduler}: no dask scheduler answers there ({reason})")


def on_client(client: Client, memory_limit: float, cluster_name: str = "the cluster") -> OnCluster:
    """Return a runner on the cluster of a client.

    Parameters
    ----------
    client : distributed.Client
        Connected client.
    memory_limit : float
        Memory that each worker must have, GiB.
    cluster_name : str
        Name of the cluster in error messages.

    Raises
    ------
    UserError
        If the workers have too little memory or another version of romandask.
    """
    _check_workers(client, cluster_name, memory_limit)
    return OnCluster(
        client, f"cluster at {client.scheduler_info(n_workers=0)['address']}, dashboard {client.dashboard_link}"
    )


class ReportingNanny(Nanny):
    """Nanny that logs an event with the exit code when its worker process ends."""

    def _on_worker_exit_sync(self, exitcode: int) -> None:
        if self.worker_address is not None:
            self.log_event(EXIT_TOPIC, {"worker": self.worker_address, "exitcode": exitcode})
        super()._on_worker_exit_sync(exitcode)


def _local_cluster(workers: int, memory_limit: int) -> LocalCluster:
    """Start one-thread worker processes on the loopback interface; start again if one dies during its start."""
    reason = ""
    for _ in range(START_ATTEMPTS):
        try:
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                worker_class=ReportingNanny,
                host="127.0.0.1",
                dashboard_address=f"127.0.0.1:{_free_port(8787)}",
                memory_limit=memory_limit,
                silence_logs=50,
            )
        except RuntimeError as error:
            reason = str(error.__cause__ or error)
    raise UserError(
        f"{workers} local workers cannot be started ({reason}): free memory or processes, or run with --workers 0"
    )


def _check_workers(client: Client, cluster_name: str, memory_limit: float) -> None:
    """Check memory and version of the workers present now. Workers that join later are not checked."""
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    smallest = min((worker["memory_limit"] or float("inf") for worker in workers), default=float("inf"))
    # a worker started with "--memory-limit 2GB" has 7% less than 2 GiB and is accepted
    if smallest < 0.93 * memory_limit * 2**30:
        raise UserError(
            f"{cluster_name}: a worker has {smallest / 2**30:.2f} GiB, run.memory_limit is {memory_limit:g}: "
            "start workers with --memory-limit, or lower run.memory_limit"
        )
    try:
        versions = set(client.run(_version).values())
    except (ImportError, AttributeError) as error:
        raise UserError(f"{cluster_name}: a worker cannot load romandask ({error}): install it there") from None
    if versions - {version("romandask")}:
        raise UserError(
            f"{cluster_name}: a worker has romandask {', '.join(sorted(versions))}, this is "
            f"{version('romandask')}: install the same everywhere"
        )


def _version() -> str:
    return version("romandask")


def _free_port(wanted: int) -> int:
    """Return the wanted port if it is free on the loopback interface, else 0 (any port)."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return 0
    return wanted
