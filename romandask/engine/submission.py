"""Handing units to a cluster in bounded waves: of the first stage first, long units first, each to a free worker."""

from __future__ import annotations

import itertools
import traceback
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from romandask.engine.task import Batch, Outcome, Task, after_failed, given_up, make_unit
from romandask.engine.task_queue import TaskQueue
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct

ATTEMPTS = 3
"""A unit that fails this often is set aside."""
IN_FLIGHT_PER_THREAD = 4
"""Units in flight a thread of a worker: enough to keep it busy, few enough that nothing piles up."""
LONG_UNIT_SECONDS = 5.0
"""Seconds: longer units are given out one a thread, to those that are free. One that waits behind another on its
worker stays there, for dask moves only units of a kind that it has timed, and others would end with nothing to do."""


@dataclass(frozen=True)
class InFlight:
    """A unit that has been handed out."""

    task: Task
    place: str | None
    """The worker that it was meant for; None for any."""


class Submission:
    """The units of a batch: those that wait, those in flight, and what becomes of them."""

    def __init__(self, client: Any, batch: Batch, ended: Callable[[Any], None]):
        self.batch = batch
        self.waiting = TaskQueue(batch.tasks)
        self.long = batch.product.seconds_per_unit > LONG_UNIT_SECONDS
        self.flown: dict[Any, InFlight] = {}
        """Units in flight by their future."""
        self._client, self._ended = client, ended
        self._flying: dict[int, Any] = {}
        self._tries: Counter[int] = Counter()
        self._missing = {task.index for task in batch.tasks}
        self._failed: set[int] = set()
        self._known: dict[str, str] = {}
        self._name, self._token = batch.product.stage.replace("/", "-"), uuid.uuid4().hex[:8]
        self._number = itertools.count()
        # the product goes to every worker once; a task carries only its number and its hash. It is the result of a
        # task, not scattered data: when the workers that hold it die the scheduler can make it again
        self._product = client.submit(_itself, batch.product, key=f"{self._name}-product-{self._token}")

    def __bool__(self) -> bool:
        """True while there is a unit of which it is not known what becomes of it."""
        return bool(self.waiting or self.flown)

    def held(self, task: Task) -> bool:
        """True where a task waits for another in flight."""
        return any(index in self._flying for index in task.prerequisites)

    def submit(self, place: str | None = None) -> InFlight:
        """Hand out the next unit, to a worker or to any."""
        product = self.batch.product
        busy = {one.task.affinity for one in self.flown.values()}
        # what a worker knows of a kin, the PSFs of a detector for example, it need not find again
        task = self.waiting.next(self._known.get(place), busy) if place else self.waiting.next()
        self._tries[task.index] += 1
        # an edge of the graph for each unit that it comes after and that is not there yet
        after = [self._flying[k] for k in task.prerequisites if k in self._flying]
        where: dict[str, Any] = {"workers": [place], "allow_other_workers": True} if place else {}
        future = self._client.submit(
            make_unit,
            self._product,
            task,
            self.batch.store,
            *after,
            key=f"{self._name}-{product.names[task.index]}-{self._token}-{next(self._number)}",
            pure=False,
            priority=-self.batch.rank,
            **where,
        )
        self._flying[task.index] = future
        self.flown[future] = InFlight(task, place)
        if place:
            self._known[place] = task.affinity
        future.add_done_callback(self._ended)
        return self.flown[future]

    def settle(self, future: Any) -> list[Outcome]:
        """Return what became of the unit of a future that has ended, and of those given up with it."""
        product, waiting = self.batch.product, self.waiting
        task = self.flown.pop(future).task
        del self._flying[task.index]
        outcomes = []
        lost = self._failed.intersection(task.prerequisites)
        if future.status == "finished":
            self._missing.discard(task.index)
            outcomes = [Outcome(product.stage, task.index, future.result())]
        elif self._missing.intersection(task.prerequisites) and not lost:
            # it failed with one that it waited for, not by itself
            self._tries[task.index] -= 1
            waiting.again(task)
        elif self._tries[task.index] < ATTEMPTS and not lost:
            waiting.again(task)
        else:
            text = after_failed(product, min(lost)) if lost else _failure(future)
            error = future.exception() if future.status == "error" else None
            others = given_up(product, task.index, waiting.give_up(task.index))
            outcomes = [Outcome(product.stage, task.index, None, text, error), *others]
            self._failed |= {outcome.index for outcome in outcomes}
        future.release()
        return outcomes


def submit_units(waves: Sequence[Submission], threads: dict[str, int]) -> None:
    """Hand out as much as workers should hold: of a wave nothing while one before it has units that could begin.

    Parameters
    ----------
    threads : of each worker, by address
    """
    total = max(1, sum(threads.values()))
    # those that wait for others in flight keep nobody busy
    able = [(wave, one) for wave in waves for one in wave.flown.values() if not wave.held(one.task)]
    room = IN_FLIGHT_PER_THREAD * total - len(able)
    free = total - sum(wave.long for wave, _ in able)
    places = Counter(one.place for wave in waves for one in wave.flown.values() if one.place)
    for wave in waves:
        held = sum(wave.held(one.task) for one in wave.flown.values())
        while wave.waiting and held < IN_FLIGHT_PER_THREAD * total:
            if room <= 0 or (wave.long and free <= 0):
                return
            place = min(threads, key=lambda one: places[one] / max(1, threads[one]), default=None)
            sent = wave.submit(place if wave.long else None)
            if sent.place:
                places[sent.place] += 1
            if wave.held(sent.task):
                held += 1
            else:
                room, free = room - 1, free - wave.long


def _itself(product: ImageProduct | TableProduct) -> ImageProduct | TableProduct:
    return product


def _failure(future: Any) -> str:
    if future.status != "error":
        return f"the task was {future.status}: its worker died, perhaps for want of memory\n"
    error = future.exception()
    return "".join(traceback.format_exception(type(error), error, future.traceback()))
