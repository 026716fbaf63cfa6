"""In which order tasks are handed out: dear ones first, kin together, and each after those it comes after."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from romandask.engine.task import Task


class TaskQueue:
    """Tasks that wait for their turn.

    A task is handed out when all that it comes after have been, so that it can be told to wait for them; when one of
    those is given up it is given up too.
    """

    def __init__(self, tasks: Sequence[Task]):
        self._families: dict[str, list[Task]] = {}
        for task in sorted(tasks, key=lambda task: (-task.cost, task.affinity, task.index)):
            self._families.setdefault(task.affinity, []).append(task)
        for family in self._families.values():
            # the next one is at the end
            family.reverse()
        self._back = {task.index for task in tasks}

    def __bool__(self) -> bool:
        return bool(self._back)

    def next(self, kin: str | None = None, busy: Collection[str] = ()) -> Task:
        """Take the first task of which nothing that it comes after waits itself.

        Parameters
        ----------
        kin : whose tasks come first, where there are any
        busy : kin whose tasks come last
        """
        names = sorted(self._families, key=lambda name: (name != kin, name in busy))
        for name in names:
            family = self._families[name]
            for place in range(len(family) - 1, -1, -1):
                if not self._back.intersection(family[place].prerequisites):
                    task = family.pop(place)
                    self._back.discard(task.index)
                    if not family:
                        del self._families[name]
                    return task
        raise RuntimeError("units that come after one another in a circle")

    def again(self, task: Task) -> None:
        """Put back a task that was handed out, to be the next of its kin."""
        self._families.setdefault(task.affinity, []).append(task)
        self._back.add(task.index)

    def give_up(self, index: int) -> list[Task]:
        """Take out the tasks that come after one that has failed, and those after them."""
        lost, gone = {index}, []
        waiting = [task for family in self._families.values() for task in family]
        while found := [task for task in waiting if lost.intersection(task.prerequisites)]:
            lost |= {task.index for task in found}
            gone += found
            waiting = [task for task in waiting if task.index not in lost]
        kept = {name: [task for task in family if task.index not in lost] for name, family in self._families.items()}
        self._families = {name: family for name, family in kept.items() if family}
        self._back -= lost
        return gone
