"""Progress: a bar a stage on a terminal, plain lines elsewhere, and never long without a word."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

INTERVAL = 5.0
"""Seconds between plain lines."""
QUIET = 8.0
"""Seconds after which what is being done is said again."""


class Meter(Protocol):
    """Counts the units of a stage."""

    def advance(self, cost: float) -> None:
        """Count one more unit, and its cost."""


@dataclass
class Pace:
    """How far a stage is, and by the cost of its units when it will be done."""

    units: int
    cost: float
    """Of all units, in any measure."""
    start: float
    """Time, seconds."""
    done: int = 0
    spent: float = 0.0
    """Cost of the units that are done."""

    def advance(self, cost: float) -> None:
        """Count one more unit."""
        self.done += 1
        self.spent += cost

    def left(self, now: float) -> float | None:
        """Return seconds until the stage is done; None where nothing is done yet by which to tell."""
        return (now - self.start) * (self.cost - self.spent) / self.spent if self.spent > 0 else None

    def text(self, name: str, now: float) -> str:
        """Return one line."""
        line = f"{name:20s} {self.done}/{self.units} units  {now - self.start:.1f} s"
        left = self.left(now)
        return line if left is None or self.done >= self.units else f"{line}, about {duration(left)} left"


def duration(seconds: float) -> str:
    """Return a length of time as one reads it: 40 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class Reporter:
    """Writes what a run does to a console."""

    def __init__(self, console: Console):
        self.console = console
        self._said = time.monotonic()

    def say(self, text: str) -> None:
        """Write one line."""
        self._said = time.monotonic()
        self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    @contextmanager
    def busy(self, text: Callable[[], str] | str) -> Iterator[None]:
        """Write what is being done, and for how long, whenever nothing has been written for some seconds."""
        ended, start = threading.Event(), time.monotonic()

        def watch() -> None:
            while not ended.wait(0.5):
                if (now := time.monotonic()) - self._said > QUIET:
                    self.say(text() if callable(text) else f"{text}: {duration(now - start)}")

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    @contextmanager
    def stage(self, name: str, units: int, cost: float) -> Iterator[Meter]:
        """Show the progress of a stage of some units, of a cost in all."""
        if self.console.is_terminal:
            columns = (
                TextColumn("{task.description:18s}"), BarColumn(),
                TextColumn("{task.fields[done]}/{task.fields[units]}"), TimeElapsedColumn(), TimeRemainingColumn(),
            )  # fmt: skip
            with Progress(*columns, console=self.console) as progress:
                yield _Bar(progress, name, units, cost)
            self._said = time.monotonic()
        else:
            pace = Pace(units, cost, time.monotonic())
            with self.busy(lambda: pace.text(name, time.monotonic())):
                yield _Lines(self, name, pace)


def busy(text: str) -> AbstractContextManager[None]:
    """Write what a command is doing, and for how long, every few seconds that it takes."""
    return Reporter(Console()).busy(text)


class _Bar:
    def __init__(self, progress: Progress, name: str, units: int, cost: float):
        self._progress, self._done = progress, 0
        self._task = progress.add_task(name, total=cost, done=0, units=units)

    def advance(self, cost: float) -> None:
        self._done += 1
        self._progress.update(self._task, advance=cost, done=self._done)


class _Lines:
    def __init__(self, reporter: Reporter, name: str, pace: Pace):
        self._reporter, self._name, self._pace = reporter, name, pace
        self._last = pace.start

    def advance(self, cost: float) -> None:
        self._pace.advance(cost)
        now = time.monotonic()
        if self._pace.done == self._pace.units or now - self._last > INTERVAL:
            self._last = now
            self._reporter.say(self._pace.text(self._name, now))
