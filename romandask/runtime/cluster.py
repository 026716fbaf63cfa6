"""Running units: on a local cluster of one-thread processes, on an existing cluster, or in this process.

The only module that knows distributed.
"""

from __future__ import annotations

import itertools
import queue
import socket
import time
import traceback
import uuid
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import dask
from distributed import Client, LocalCluster

from romandask.model.errors import UserError
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


class Runner(Protocol):
    """Runs the units of a product."""

    description: str

    def run(self, product: ImageProduct | TableProduct, tasks: list[Task], store: Store) -> Iterator[Outcome]:
        """Yield what became of each unit, as they end."""


class InProcess:
    """Runs units one after another in this process, for debugging."""

    description = "in this process"

    def run(self, product: ImageProduct | TableProduct, tasks: list[Task], store: Store) -> Iterator[Outcome]:
        """Yield what became of each unit; a failure is not tried again."""
        waiting = Waiting([replace(task, cost=0.0) for task in tasks])
        while waiting:
            task = waiting.next()
            try:
                yield Outcome(task.index, make_unit(product, task, store))
            except Exception:
                yield Outcome(task.index, None, traceback.format_exc())
                yield from _given_up(product, task.index, waiting)


class OnCluster:
    """Runs units on a dask cluster, in bounded waves, long units first; results are released at once."""

    def __init__(self, client: Client, description: str):
        self._client = client
        self.description = description

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
                    yield Outcome(task.index, None, text)
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
                if self._client.scheduler_info(n_workers=-1)["workers"]:
                    alone_since = None
                    continue
                alone_since = alone_since or time.monotonic()
                if time.monotonic() - alone_since > PATIENCE:
                    raise UserError(
                        f"no worker has been left for {PATIENCE:.0f} s: start workers, or look for what ends them "
                        "(memory: raise run.memory_limit); the same command resumes"
                    ) from None


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
    memory_limit : GiB a local worker
    """
    if scheduler is None and workers == 0:
        yield InProcess()
        return
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout="20s")
        except (OSError, ValueError, TimeoutError) as error:
            raise UserError(
                f"--scheduler {scheduler}: no dask scheduler answers there ({type(error).__name__})"
            ) from None
        with client:
            yield OnCluster(client, f"cluster at {scheduler}, dashboard {client.dashboard_link}")
        return
    quiet = {
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.target": False,
        # a worker that pauses for its heap, with nothing to do, never comes back; one task runs at a time anyway
        "distributed.worker.memory.pause": False,
        "distributed.admin.large-graph-warning-threshold": "100MB",
        # the threads that decode chunks would each keep a heap of their own, and a worker twice what it uses
        "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 2,
        # large arrays go back to the system at once, not to a heap that grows from unit to unit (with 32 MB it passed a
        # worker's limit); smaller ones are kept for what comes next, for fresh pages cost time
        "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 8 << 20,
        "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 16 << 20,
    }
    with (
        dask.config.set(quiet),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=f"127.0.0.1:{_free_port(8787)}",
            memory_limit=int(memory_limit * 2**30),
            silence_logs=50,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield OnCluster(client, f"{workers} local workers, dashboard {cluster.dashboard_link}")


def _free_port(wanted: int) -> int:
    """Return a port of the loopback if it is free, else 0 (any)."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return 0
    return wanted
