"""Submission of tasks to a cluster: a bounded number in flight, earlier stages first, long units to free workers."""

from __future__ import annotations

import itertools
import traceback
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from romandask.engine.task import Batch, Outcome, Task, failed_prerequisite_text, make_unit, skipped_outcomes
from romandask.engine.task_queue import TaskQueue
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct

ATTEMPTS = 3
"""Number of attempts after which a failing unit is skipped."""
IN_FLIGHT_PER_THREAD = 4
"""Maximum number of submitted tasks per worker thread: enough to keep the thread busy, few enough to limit the queue
of the scheduler."""
LONG_UNIT_SECONDS = 5.0
"""Wall time per unit above which a stage has at most one task in flight per worker thread, s.

Long tasks are sent to a worker with a free thread. dask moves a queued task to an idle worker only after it has timed
tasks of the same kind, so a second long task would wait behind the first one while other workers have nothing to do.
"""


@dataclass(frozen=True)
class InFlight:
    """A submitted task."""

    task: Task
    worker: str | None
    """Address of the preferred worker; None for any worker."""


class Submission:
    """The tasks of one batch: waiting, in flight and finished.

    Parameters
    ----------
    client : distributed.Client
        Client of the cluster.
    batch : Batch
        Tasks of one stage.
    on_end : callable
        Called with the future of each task that ends.
    """

    def __init__(self, client: Any, batch: Batch, on_end: Callable[[Any], None]):
        self.batch = batch
        self.waiting = TaskQueue(batch.tasks)
        self.long = batch.product.seconds_per_unit > LONG_UNIT_SECONDS
        self.in_flight: dict[Any, InFlight] = {}
        """Submitted tasks by future."""
        self._client, self._on_end = client, on_end
        self._futures: dict[int, Any] = {}
        """Futures of the tasks in flight, by unit number."""
        self._attempts: Counter[int] = Counter()
        self._not_made = {task.index for task in batch.tasks}
        self._failed: set[int] = set()
        self._last_affinity: dict[str, str] = {}
        """Affinity key of the last task that was sent to each worker."""
        self._name, self._token = batch.product.stage.replace("/", "-"), uuid.uuid4().hex[:8]
        self._number = itertools.count()
        # The product is sent to every worker once; a task carries only its number and hash. The product is the result
        # of a task and not scattered, so that the scheduler can recompute it when the workers that hold it die.
        self._product = client.submit(_identity, batch.product, key=f"{self._name}-product-{self._token}")

    def __bool__(self) -> bool:
        """Return whether any task has no outcome yet."""
        return bool(self.waiting or self.in_flight)

    def is_blocked(self, task: Task) -> bool:
        """Return whether a prerequisite of a task is in flight."""
        return any(index in self._futures for index in task.prerequisites)

    def submit(self, worker: str | None = None) -> InFlight:
        """Submit the next task, preferably to a worker with the given address; None for any worker."""
        product = self.batch.product
        busy = {sent.task.affinity for sent in self.in_flight.values()}
        # a worker reuses its cache, for example the PSFs of a detector, for tasks of the same affinity key
        task = self.waiting.next(self._last_affinity.get(worker), busy) if worker else self.waiting.next()
        self._attempts[task.index] += 1
        # the futures of prerequisites in flight are dependencies of the task
        prerequisites = [self._futures[k] for k in task.prerequisites if k in self._futures]
        preference: dict[str, Any] = {"workers": [worker], "allow_other_workers": True} if worker else {}
        future = self._client.submit(
            make_unit,
            self._product,
            task,
            self.batch.store,
            *prerequisites,
            key=f"{self._name}-{product.names[task.index]}-{self._token}-{next(self._number)}",
            pure=False,
            priority=-self.batch.rank,
            **preference,
        )
        self._futures[task.index] = future
        self.in_flight[future] = InFlight(task, worker)
        if worker:
            self._last_affinity[worker] = task.affinity
        future.add_done_callback(self._on_end)
        return self.in_flight[future]

    def settle(self, future: Any) -> list[Outcome]:
        """Process a future that has ended.

        Returns
        -------
        list of Outcome
            Outcome of its task, and of the tasks that are skipped because it failed. Empty if the task is tried again.
        """
        product, waiting = self.batch.product, self.waiting
        task = self.in_flight.pop(future).task
        del self._futures[task.index]
        outcomes = []
        failed_prerequisites = self._failed.intersection(task.prerequisites)
        if future.status == "finished":
            self._not_made.discard(task.index)
            outcomes = [Outcome(product.stage, task.index, future.result())]
        elif self._not_made.intersection(task.prerequisites) and not failed_prerequisites:
            # dask marks it as failed because a prerequisite failed in this attempt: not counted as an attempt
            self._attempts[task.index] -= 1
            waiting.again(task)
        elif self._attempts[task.index] < ATTEMPTS and not failed_prerequisites:
            waiting.again(task)
        else:
            text = (
                failed_prerequisite_text(product, min(failed_prerequisites))
                if failed_prerequisites
                else _failure_text(future)
            )
            error = future.exception() if future.status == "error" else None
            skipped = skipped_outcomes(product, task.index, waiting.give_up(task.index))
            outcomes = [Outcome(product.stage, task.index, None, text, error), *skipped]
            self._failed |= {outcome.index for outcome in outcomes}
        future.release()
        return outcomes


def submit_units(submissions: Sequence[Submission], threads: dict[str, int]) -> None:
    """Submit tasks until the workers have enough.

    Tasks of a later stage are submitted only when no task of an earlier stage can start.

    Parameters
    ----------
    submissions : sequence of Submission
        Submissions, earlier stages first.
    threads : dict of str to int
        Number of threads of each worker, by address.
    """
    total = max(1, sum(threads.values()))
    # tasks that wait for prerequisites in flight occupy no thread
    unblocked = [
        (submission, sent)
        for submission in submissions
        for sent in submission.in_flight.values()
        if not submission.is_blocked(sent.task)
    ]
    room = IN_FLIGHT_PER_THREAD * total - len(unblocked)
    free = total - sum(submission.long for submission, _ in unblocked)
    sent_to = Counter(
        sent.worker for submission in submissions for sent in submission.in_flight.values() if sent.worker
    )
    for submission in submissions:
        blocked = sum(submission.is_blocked(sent.task) for sent in submission.in_flight.values())
        while submission.waiting and blocked < IN_FLIGHT_PER_THREAD * total:
            if room <= 0 or (submission.long and free <= 0):
                return
            worker = min(threads, key=lambda address: sent_to[address] / max(1, threads[address]), default=None)
            sent = submission.submit(worker if submission.long else None)
            if sent.worker:
                sent_to[sent.worker] += 1
            if submission.is_blocked(sent.task):
                blocked += 1
            else:
                room, free = room - 1, free - submission.long


def _identity(product: ImageProduct | TableProduct) -> ImageProduct | TableProduct:
    return product


def _failure_text(future: Any) -> str:
    if future.status != "error":
        return f"the task was {future.status}: its worker died, perhaps for want of memory\n"
    error = future.exception()
    return "".join(traceback.format_exception(type(error), error, future.traceback()))
