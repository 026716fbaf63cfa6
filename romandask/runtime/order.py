"""In which order tasks are handed out: dear ones first, kin together, and each after those it comes after."""

from __future__ import annotations

from collections.abc import Sequence

from romandask.runtime.work import Task


class Waiting:
    """Tasks that wait for their turn.

    A task is handed out when all that it comes after have been, so that it can be told to wait for them; when one of
    those is given up it is given up too.
    """

    def __init__(self, tasks: Sequence[Task]):
        # the next one is at the end
        self._tasks = sorted(tasks, key=lambda task: (-task.cost, task.kin, task.index))[::-1]
        self._back = {task.index for task in tasks}

    def __bool__(self) -> bool:
        return bool(self._tasks)

    def next(self) -> Task:
        """Take the first task of which nothing that it comes after waits itself."""
        for place in range(len(self._tasks) - 1, -1, -1):
            if not self._back.intersection(self._tasks[place].after):
                task = self._tasks.pop(place)
                self._back.discard(task.index)
                return task
        raise RuntimeError("units that come after one another in a circle")

    def again(self, task: Task) -> None:
        """Put back a task that was handed out, to be the next."""
        self._tasks.append(task)
        self._back.add(task.index)

    def give_up(self, index: int) -> list[Task]:
        """Take out the tasks that come after one that has failed, and those after them."""
        lost, gone = {index}, []
        while found := [task for task in self._tasks if lost.intersection(task.after)]:
            lost |= {task.index for task in found}
            gone += found
            self._tasks = [task for task in self._tasks if task.index not in lost]
        self._back -= lost
        return gone
