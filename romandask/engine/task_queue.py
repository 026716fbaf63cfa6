"""Order of tasks: most expensive first, tasks with the same affinity key together, prerequisites first."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from romandask.engine.task import Task


class TaskQueue:
    """Tasks of one stage that have not been submitted.

    A task is taken only after all its prerequisites have been taken, so that it can be submitted with dependencies on
    them. A task is removed when one of its prerequisites has failed.
    """

    def __init__(self, tasks: Sequence[Task]):
        self._by_affinity: dict[str, list[Task]] = {}
        for task in sorted(tasks, key=lambda task: (-task.cost, task.affinity, task.index)):
            self._by_affinity.setdefault(task.affinity, []).append(task)
        for group in self._by_affinity.values():
            # reversed, so that the next task is popped from the end
            group.reverse()
        self._waiting = {task.index for task in tasks}

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def next(self, affinity: str | None = None, busy: Collection[str] = ()) -> Task:
        """Take the first task that has no prerequisite in the queue.

        Parameters
        ----------
        affinity : str or None
            Affinity key whose tasks are taken first.
        busy : collection of str
            Affinity keys whose tasks are taken last.

        Raises
        ------
        RuntimeError
            If the prerequisites are circular.
        """
        keys = sorted(self._by_affinity, key=lambda key: (key != affinity, key in busy))
        for key in keys:
            group = self._by_affinity[key]
            for position in range(len(group) - 1, -1, -1):
                if not self._waiting.intersection(group[position].prerequisites):
                    task = group.pop(position)
                    self._waiting.discard(task.index)
                    if not group:
                        del self._by_affinity[key]
                    return task
        raise RuntimeError("the prerequisites of the units are circular")

    def again(self, task: Task) -> None:
        """Put back a task, as the next one of its affinity key."""
        self._by_affinity.setdefault(task.affinity, []).append(task)
        self._waiting.add(task.index)

    def give_up(self, index: int) -> list[Task]:
        """Remove and return the tasks that depend, directly or indirectly, on the unit number `index`."""
        skipped, removed = {index}, []
        waiting = [task for group in self._by_affinity.values() for task in group]
        while dependents := [task for task in waiting if skipped.intersection(task.prerequisites)]:
            skipped |= {task.index for task in dependents}
            removed += dependents
            waiting = [task for task in waiting if task.index not in skipped]
        kept = {key: [task for task in group if task.index not in skipped] for key, group in self._by_affinity.items()}
        self._by_affinity = {key: group for key, group in kept.items() if group}
        self._waiting -= skipped
        return removed
