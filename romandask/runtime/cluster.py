"""Running units: on a local cluster of one-thread processes, on an existing cluster, or in this process.

The only module that knows distributed.
"""

from __future__ import annotations

import gc
import itertools
import queue
import re
import socket
import time
import traceback
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import dask
import yaml
from distributed import Client, LocalCluster, performance_report

from romandask.model.errors import UserError
from romandask.model.resources import resource_folder
from romandask.places import Place, write_bytes
from romandask.runtime.images import ImageProduct
from romandask.runtime.manifest import Record
from romandask.runtime.order import Waiting
from romandask.runtime.store import Store
from romandask.runtime.tables import TableProduct
from romandask.runtime.work import Task, make_unit

ATTEMPTS = 3
"""A unit that fails this often is set aside."""
PATIENCE = 60.0
"""Seconds that a run waits for a cluster without workers."""
WAVE = 4
"""Units in flight a thread of a worker: enough to keep it busy, few enough that nothing piles up."""
LONG = 5.0
"""Seconds: longer units are given out one a thread, to those that are free. One that waits behind another on its
worker stays there, for dask moves only units of a kind that it has timed, and others would end with nothing to do."""


@dataclass(frozen=True)
class Outcome:
    """What became of a unit: its record, or the text of its last failure."""

    index: int
    record: Record | None
    failure: str | None = None
    error: BaseException | None = None
    """What was raised, where it is known."""


class Runner(Protocol):
    """Runs the units of a product."""

    description: str

    def run(self, product: ImageProduct | TableProduct, tasks: list[Task], store: Store) -> Iterator[Outcome]:
        """Yield what became of each unit, as they end."""

    def recording(self, path: Place) -> AbstractContextManager[Any]:
        """Write, at the end of the context, a page with what the cluster did in it."""


class InProcess:
    """Runs units one after another in this process, for debugging."""

    description = "in this process"

    def recording(self, path: Place) -> AbstractContextManager[Any]:
        """Write nothing: there is no cluster."""
        return nullcontext()

    def run(self, product: ImageProduct | TableProduct, tasks: list[Task], store: Store) -> Iterator[Outcome]:
        """Yield what became of each unit; a failure is not tried again."""
        waiting = Waiting([replace(task, cost=0.0) for task in tasks])
        while waiting:
            task = waiting.next()
            try:
                yield Outcome(task.index, make_unit(product, task, store))
            except Exception as error:
                yield Outcome(task.index, None, traceback.format_exc(), error)
                yield from _given_up(product, task.index, waiting)


class OnCluster:
    """Runs units on a dask cluster, in bounded waves, long units first; results are released at once."""

    def __init__(self, client: Client, description: str, restart: Callable[[], None] | None = None):
        self._client = client
        self._restart = restart or (lambda: None)
        self.description = description

    def recording(self, path: Place) -> AbstractContextManager[Any]:
        """Write dask's performance report: task stream, transfers, profiles of workers and scheduler."""
        return _recording(self._client, path)

    def run(self, product: ImageProduct | TableProduct, tasks: list[Task], store: Store) -> Iterator[Outcome]:
        """Yield what became of each unit; one that fails is tried up to three times."""
        waiting = Waiting(tasks)
        tries = {task.index: 0 for task in tasks}
        # the product goes to every worker once; a task carries only its number and its hash. It is the result of a
        # task, not scattered data: when the workers that hold it die the scheduler can make it again
        name = product.stage.replace("/", "-")
        token = uuid.uuid4().hex[:8]
        shared = self._client.submit(_itself, product, key=f"{name}-product-{token}")
        flying: dict[int, Any] = {}
        futures: dict[Any, Task] = {}
        missing = {task.index for task in tasks}
        failed: set[int] = set()
        number = itertools.count()
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()

        places: dict[Any, str] = {}
        known: dict[str, str] = {}

        def submit() -> None:
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
            threads = {address: worker["nthreads"] for address, worker in workers.items()}
            total = max(1, sum(threads.values()))
            long = product.seconds_per_unit > LONG
            held = sum(any(k in flying for k in task.after) for task in futures.values())
            while waiting and len(futures) < WAVE * total and len(futures) - held < (total if long else WAVE * total):
                place = _freest(threads, places) if long else None
                busy = {task.kin for task in futures.values()}
                # what a worker knows of a kin, the PSFs of a detector for example, it need not find again
                task = waiting.next(known.get(place), busy) if place else waiting.next()
                tries[task.index] += 1
                key = f"{name}-{product.names[task.index]}-{token}-{next(number)}"
                # an edge of the graph for each unit that it comes after and that is not there yet
                after = [flying[k] for k in task.after if k in flying]
                where: dict[str, Any] = {"workers": [place], "allow_other_workers": True} if place else {}
                future = self._client.submit(make_unit, shared, task, store, *after, key=key, pure=False, **where)
                flying[task.index] = future
                futures[future] = task
                if place:
                    places[future], known[place] = place, task.kin
                held += bool(after)
                future.add_done_callback(ended.put)

        try:
            submit()
            while futures:
                future = self._next(ended)
                task = futures.pop(future)
                del flying[task.index]
                places.pop(future, None)
                if future.status == "finished":
                    missing.discard(task.index)
                    yield Outcome(task.index, future.result())
                elif missing.intersection(task.after) and not failed.intersection(task.after):
                    # it failed with one that it waited for, not by itself
                    tries[task.index] -= 1
                    waiting.again(task)
                elif tries[task.index] < ATTEMPTS and not failed.intersection(task.after):
                    waiting.again(task)
                else:
                    before = failed.intersection(task.after)
                    text = _after_failed(product, min(before)) if before else _failure(future)
                    yield Outcome(task.index, None, text, future.exception() if future.status == "error" else None)
                    given_up = _given_up(product, task.index, waiting)
                    failed |= {task.index, *(outcome.index for outcome in given_up)}
                    yield from given_up
                future.release()
                submit()
        finally:
            if futures:
                self._client.cancel(list(futures), force=True)

    def _next(self, ended: queue.SimpleQueue[Any]) -> Any:
        """Return the next task that ends; UserError where no worker is left for a minute to end one."""
        alone_since: float | None = None
        while True:
            try:
                return ended.get(timeout=2.0)
            except queue.Empty:
                self._restart()
                if self._client.scheduler_info(n_workers=-1)["workers"]:
                    alone_since = None
                    continue
                alone_since = alone_since or time.monotonic()
                if time.monotonic() - alone_since > PATIENCE:
                    raise UserError(
                        f"no worker has been left for {PATIENCE:.0f} s: start workers, or look for what ends them "
                        "(memory: raise run.memory_limit); the same command resumes"
                    ) from None


@contextmanager
def _recording(client: Client, path: Place) -> Iterator[None]:
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


def _given_up(product: ImageProduct | TableProduct, failed: int, waiting: Waiting) -> list[Outcome]:
    text = _after_failed(product, failed)
    return [Outcome(task.index, None, text) for task in waiting.give_up(failed)]


def _after_failed(product: ImageProduct | TableProduct, failed: int) -> str:
    return f"{product.names[failed]}, which comes before it, failed\n"


def _itself(product: ImageProduct | TableProduct) -> ImageProduct | TableProduct:
    return product


def _freest(threads: dict[str, int], places: dict[Any, str]) -> str | None:
    """Return the worker with the fewest tasks a thread; None without workers."""
    tasks = Counter(places.values())
    return min(threads, key=lambda address: tasks[address] / max(1, threads[address]), default=None)


def _failure(future: Any) -> str:
    if future.status != "error":
        return f"the task was {future.status}: its worker died, perhaps for want of memory\n"
    error = future.exception()
    lines = traceback.format_exception(type(error), error, future.traceback())
    return "".join(lines)


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
    for _ in range(ATTEMPTS):
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
