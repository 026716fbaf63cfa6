"""Running units: on a local cluster of one-thread processes, on an existing cluster, or in this process.

The only module that knows distributed.
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
from romandask.engine.task import Batch, Outcome, given_up, make_unit
from romandask.engine.task_queue import TaskQueue
from romandask.model.errors import UserError
from romandask.model.resources import resource_folder
from romandask.storage.paths import AnyPath, write_bytes

STARTS = 3
"""Times that local workers are started before a run gives up."""
PATIENCE = 60.0
"""Seconds that a run waits for a cluster without workers."""
More = Callable[[], Iterable[Batch]]


def _no_more() -> Iterable[Batch]:
    return ()


class Runner(Protocol):
    """Runs the units of stages."""

    description: str

    def run(self, *begin: Batch, more: More = _no_more) -> Generator[Outcome, None, None]:
        """Yield what became of each unit, as they end.

        Parameters
        ----------
        begin : what is to be made
        more : asked at the beginning, and when what was yielded has been taken, for what can be made now; again until
            there is nothing
        """

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Write, at the end of the context, a page with what the cluster did in it."""


class InProcess:
    """Runs units one after another in this process, for debugging."""

    description = "in this process"

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Write nothing: there is no cluster."""
        return nullcontext()

    def run(self, *begin: Batch, more: More = _no_more) -> Generator[Outcome, None, None]:
        """Yield what became of each unit, a stage after the other; a failure is not tried again."""
        batches = [*begin]
        while True:
            while new := [*more()]:
                batches += new
            if not batches:
                return
            batches.sort(key=lambda batch: batch.rank)
            yield from _one_by_one(batches.pop(0))


def _one_by_one(batch: Batch) -> Iterator[Outcome]:
    product, waiting = batch.product, TaskQueue([replace(task, cost=0.0) for task in batch.tasks])
    while waiting:
        task = waiting.next()
        try:
            yield Outcome(product.stage, task.index, make_unit(product, task, batch.store))
        except Exception as error:
            yield Outcome(product.stage, task.index, None, traceback.format_exc(), error)
            yield from given_up(product, task.index, waiting.give_up(task.index))


class OnCluster:
    """Runs units on a dask cluster, those of several stages side by side; results are released at once."""

    def __init__(self, client: Client, description: str, restart: Callable[[], None] | None = None):
        self._client = client
        self._restart = restart or (lambda: None)
        self.description = description

    def recording(self, path: AnyPath) -> AbstractContextManager[Any]:
        """Write dask's performance report: task stream, transfers, profiles of workers and scheduler."""
        return _recording(self._client, path)

    def run(self, *begin: Batch, more: More = _no_more) -> Generator[Outcome, None, None]:
        """Yield what became of each unit; one that fails is tried up to three times.

        Raises
        ------
        UserError
            If for a minute there is no worker.
        """
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        waves = [Submission(self._client, batch, ended.put) for batch in begin]
        seen = time.monotonic()
        try:
            while True:
                # as long as there are more they are asked for; in between workers get what they can do
                new = [Submission(self._client, batch, ended.put) for batch in more()]
                waves = sorted(filter(None, [*waves, *new]), key=lambda wave: wave.batch.rank)
                threads = self._threads()
                seen = time.monotonic() if threads else seen
                submit_units(waves, threads)
                if not waves and not new:
                    return
                future = self._next(ended, 0.0 if new else 2.0)
                if future is not None:
                    yield from next(wave for wave in waves if future in wave.flown).settle(future)
                elif time.monotonic() - seen > PATIENCE:
                    raise UserError(
                        f"no worker has been left for {PATIENCE:.0f} s: start workers, or look for what ends them "
                        "(memory: raise run.memory_limit); the same command resumes"
                    )
        finally:
            left = [future for wave in waves for future in wave.flown]
            if left:
                self._client.cancel(left, force=True)

    def _threads(self) -> dict[str, int]:
        workers = self._client.scheduler_info(n_workers=-1)["workers"]
        return {address: worker["nthreads"] for address, worker in workers.items()}

    def _next(self, ended: queue.SimpleQueue[Any], patience: float) -> Any | None:
        """Return the next task that ends; None after some seconds, for there may be workers that have nothing yet."""
        try:
            return ended.get(timeout=patience)
        except queue.Empty:
            self._restart()
            return None


@contextmanager
def _recording(client: Client, path: AnyPath) -> Iterator[None]:
    # one page without external assets, written whole
    with TemporaryDirectory(prefix="romandask-") as folder:
        temporary = Path(folder) / "performance.html"
        report = performance_report(filename=str(temporary), mode="inline")
        with client.as_current():
            report.__enter__()
        try:
            yield
        finally:
            with client.as_current(), suppress(Exception):
                # a run that is done is done, though its workers are gone and cannot be asked
                report.__exit__(None, None, None)
                # but for its icon the page needs nothing from elsewhere
                page = re.sub(r'<link rel="shortcut icon"[^>]*>', "", temporary.read_text(encoding="utf-8"))
                write_bytes(path, page.encode())


@contextmanager
def runner(workers: int, memory_limit: float, scheduler: str | None = None) -> Iterator[Runner]:
    """Yield a runner: on the cluster at `scheduler`, on `workers` local processes, or, for 0, in this process.

    Parameters
    ----------
    memory_limit : GiB a worker

    Raises
    ------
    UserError
        If no scheduler answers, or its workers are too small or have another version.
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
        # a worker that dies while it starts is not started again by dask; to scale to what is wanted starts it
        description = f"{workers} local workers, dashboard {cluster.dashboard_link}"
        yield OnCluster(client, description, lambda: cluster.scale(workers))


def _connected(scheduler: str) -> Client:
    try:
        return Client(scheduler, timeout="20s")
    except (OSError, ValueError, TypeError, TimeoutError, RuntimeError) as error:
        # TypeError: tls:// without certificates
        reason = str(error) or type(error).__name__
    # a client that could not begin closes itself when it is collected: now, for while another one starts in this
    # process it would wait for ever
    gc.collect()
    raise UserError(f"--scheduler {scheduler}: no dask scheduler answers there ({reason})")


def on_client(client: Client, memory_limit: float, place: str = "the cluster") -> OnCluster:
    """Return a runner on the cluster that a client is connected to.

    Parameters
    ----------
    memory_limit : GiB a worker
    place : what an error calls the cluster

    Raises
    ------
    UserError
        If its workers are too small or have another version.
    """
    _check_workers(client, place, memory_limit)
    return OnCluster(
        client, f"cluster at {client.scheduler_info(n_workers=0)['address']}, dashboard {client.dashboard_link}"
    )


def _local_cluster(workers: int, memory_limit: int) -> LocalCluster:
    """Start processes of one thread on the loopback; again where one dies before it has begun."""
    reason = ""
    for _ in range(STARTS):
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


def _check_workers(client: Client, place: str, memory_limit: float) -> None:
    """Look at the workers that are there: others may come, and go."""
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    smallest = min((worker["memory_limit"] or float("inf") for worker in workers), default=float("inf"))
    # what a shell calls 2 GB is 7% less than 2 GiB
    if smallest < 0.93 * memory_limit * 2**30:
        raise UserError(
            f"{place}: a worker has {smallest / 2**30:.2f} GiB, run.memory_limit is {memory_limit:g}: "
            "start workers with --memory-limit, or lower run.memory_limit"
        )
    try:
        versions = set(client.run(_version).values())
    except (ImportError, AttributeError) as error:
        raise UserError(f"{place}: a worker cannot load romandask ({error}): install it there") from None
    if versions - {version("romandask")}:
        raise UserError(
            f"{place}: a worker has romandask {', '.join(sorted(versions))}, this is "
            f"{version('romandask')}: install the same everywhere"
        )


def _version() -> str:
    return version("romandask")


def _free_port(wanted: int) -> int:
    """Return a port of the loopback if it is free, else 0 (any)."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return 0
    return wanted
