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
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import dask
import yaml
from distributed import Client, LocalCluster, performance_report

from romandask.engine.submission import Submission, submit_units
from romandask.engine.task import Batch, Outcome, make_unit, skipped_outcomes
from romandask.engine.task_queue import TaskQueue
from romandask.model.errors import UserError
from romandask.model.resources import resource_folder
from romandask.storage.paths import AnyPath, write_bytes

START_ATTEMPTS = 3
"""Number of attempts to start a local cluster."""
NO_WORKER_TIMEOUT = 60.0
"""Time that a run waits for a cluster without workers, s."""
POLL_INTERVAL = 2.0
"""Time between two looks for new workers while no task ends, s."""
NextBatches = Callable[[], Iterable[Batch]]
"""Returns the batches that can start now; empty if there are none."""


def _no_batches() -> Iterable[Batch]:
    return ()


class Runner(Protocol):
    """Interface of the runners."""

    description: str
    """Text for the user, for example the address of the dashboard."""

    def run(self, *batches: Batch, more: NextBatches = _no_batches) -> Generator[Outcome, None, None]:
        """Make units and yield the outcome of each as soon as it is known.

        Parameters
        ----------
        *batches : Batch
            Units to make.
        more : callable
            Returns further batches. Called repeatedly, until it returns none, at the beginning and after each outcome
            has been processed.
        """

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Return a context manager that writes a performance report of the cluster (HTML) to `path` when it exits."""


class InProcess:
    """Runner that makes units one after another in this process, for debugging."""

    description = "in this process"

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Return a context manager that does nothing, because there is no cluster to report on."""
        return nullcontext()

    def run(self, *batches: Batch, more: NextBatches = _no_batches) -> Generator[Outcome, None, None]:
        """Make units, one stage after another, and yield the outcome of each. A failed unit is not tried again."""
        pending = [*batches]
        while True:
            while new := [*more()]:
                pending += new
            if not pending:
                return
            pending.sort(key=lambda batch: batch.rank)
            yield from _run_in_process(pending.pop(0))


def _run_in_process(batch: Batch) -> Iterator[Outcome]:
    # with equal costs, the queue is in the order of affinity keys and unit numbers
    product, waiting = batch.product, TaskQueue([replace(task, cost=0.0) for task in batch.tasks])
    while waiting:
        task = waiting.next()
        try:
            yield Outcome(product.stage, task.index, make_unit(product, task, batch.store))
        except Exception as error:
            yield Outcome(product.stage, task.index, None, traceback.format_exc(), error)
            yield from skipped_outcomes(product, task.index, waiting.give_up(task.index))


class OnCluster:
    """Runner that makes units on a dask cluster, those of several stages at the same time.

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

    def run(self, *batches: Batch, more: NextBatches = _no_batches) -> Generator[Outcome, None, None]:
        """Make units and yield the outcome of each. A failed unit is tried up to three times.

        Raises
        ------
        UserError
            If the cluster has no worker for a minute.
        """
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        submissions = [Submission(self._client, batch, ended.put) for batch in batches]
        last_worker_seen = time.monotonic()
        try:
            while True:
                # `more` may be slow: tasks are submitted between two calls of it
                new = [Submission(self._client, batch, ended.put) for batch in more()]
                submissions = sorted(filter(None, [*submissions, *new]), key=lambda one: one.batch.rank)
                threads = self._threads()
                last_worker_seen = time.monotonic() if threads else last_worker_seen
                submit_units(submissions, threads)
                if not submissions and not new:
                    return
                future = self._next_ended(ended, 0.0 if new else POLL_INTERVAL)
                if future is not None:
                    yield from next(one for one in submissions if future in one.in_flight).settle(future)
                elif time.monotonic() - last_worker_seen > NO_WORKER_TIMEOUT:
                    raise UserError(
                        f"no worker has been left for {NO_WORKER_TIMEOUT:.0f} s: start workers, or look for what ends "
                        "them (memory: raise run.memory_limit); the same command resumes"
                    )
        finally:
            in_flight = [future for submission in submissions for future in submission.in_flight]
            if in_flight:
                self._client.cancel(in_flight, force=True)

    def _threads(self) -> dict[str, int]:
        """Return the number of threads of each worker, by address."""
        workers = self._client.scheduler_info(n_workers=-1)["workers"]
        return {address: worker["nthreads"] for address, worker in workers.items()}

    def _next_ended(self, ended: queue.SimpleQueue[Any], timeout: float) -> Any | None:
        """Return the future of the next task that ends, or None after `timeout` seconds."""
        try:
            return ended.get(timeout=timeout)
        except queue.Empty:
            self._restart()
            return None


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


def _local_cluster(workers: int, memory_limit: int) -> LocalCluster:
    """Start one-thread worker processes on the loopback interface; start again if one dies during its start."""
    reason = ""
    for _ in range(START_ATTEMPTS):
        try:
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
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
