"""Progress: a bar a stage on a terminal, plain lines elsewhere, and never long without a word."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

INTERVAL = 5.0
"""Seconds between plain lines."""
QUIET = 8.0
"""Seconds after which what is being done is said again."""


class Meter(Protocol):
    """Counts the units of a stage."""

    def advance(self, cost: float, seconds: float = math.inf) -> None:
        """Count one more unit, its cost, and how long it took."""


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
    worked: float = 0.0
    """Seconds in which units of it were made: other stages may have had the workers in between."""
    last: float = 0.0
    """When the last one was done."""

    def advance(self, cost: float, now: float, seconds: float = math.inf) -> None:
        """Count one more unit, that was done now and took some seconds."""
        self.worked += min(now - (self.last or self.start), seconds)
        self.done, self.spent, self.last = self.done + 1, self.spent + cost, now

    def left(self) -> float | None:
        """Return seconds of work until the stage is done; None where it is, or nothing by which to tell."""
        known = self.spent > 0 and self.done < self.units
        return self.worked * (self.cost - self.spent) / self.spent if known else None

    def text(self, name: str, now: float) -> str:
        """Return one line."""
        line = f"{name:20s} {self.done}/{self.units} units  {now - self.start:.1f} s"
        left = self.left()
        return line if left is None else f"{line}, about {duration(left)} left"


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
        """Write what is being done, and for how long, whenever nothing has been written for some seconds.

        Where `text` returns nothing, there is nothing to say.
        """
        ended, start = threading.Event(), time.monotonic()

        def watch() -> None:
            while not ended.wait(0.5):
                if (now := time.monotonic()) - self._said > QUIET:
                    line = text() if callable(text) else f"{text}: {duration(now - start)}"
                    if line:
                        self.say(line)

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    @contextmanager
    def board(self) -> Iterator[Board]:
        """Show the progress of stages, several of which may be under way."""
        if self.console.is_terminal:
            columns = (
                TextColumn("{task.description:18s}"),
                BarColumn(),
                TextColumn("{task.fields[done]}/{task.fields[units]}"),
                TimeElapsedColumn(),
                TextColumn("{task.fields[left]}"),
            )
            with Progress(*columns, console=self.console) as progress:
                yield _Bars(self, progress)
            self._said = time.monotonic()
        else:
            lines = _Lines(self)
            with self.busy(lines.text):
                yield lines


class Board(Protocol):
    """The progress of the stages that are under way."""

    def begin(self, name: str, units: int, cost: float) -> Meter:
        """Show a stage of some units, of a cost in all, until all of them are counted."""


def busy(text: str) -> AbstractContextManager[None]:
    """Write what a command is doing, and for how long, every few seconds that it takes."""
    return Reporter(Console()).busy(text)


class _Bars:
    def __init__(self, reporter: Reporter, progress: Progress):
        self._reporter, self._progress = reporter, progress

    def begin(self, name: str, units: int, cost: float) -> Meter:
        return _Bar(self._reporter, self._progress, name, Pace(units, cost, time.monotonic()))


class _Bar:
    def __init__(self, reporter: Reporter, progress: Progress, name: str, pace: Pace):
        self._reporter, self._progress, self._name, self._pace = reporter, progress, name, pace
        self._task = progress.add_task(name, total=pace.cost, done=0, units=pace.units, left="")

    def advance(self, cost: float, seconds: float = math.inf) -> None:
        self._pace.advance(cost, time.monotonic(), seconds)
        left = self._pace.left()
        text = "" if left is None else f"{duration(left)} left"
        self._progress.update(self._task, advance=cost, done=self._pace.done, left=text)
        if self._pace.done == self._pace.units:
            # bars are of what is under way; of what is done one line stays
            self._progress.remove_task(self._task)
            self._reporter.say(self._pace.text(self._name, time.monotonic()))


class _Lines:
    def __init__(self, reporter: Reporter):
        self._reporter = reporter
        self._going: dict[str, Pace] = {}

    def begin(self, name: str, units: int, cost: float) -> Meter:
        pace = self._going[name] = Pace(units, cost, time.monotonic())
        return _Line(self._reporter, name, pace, self._going)

    def text(self) -> str:
        return "\n".join(pace.text(name, time.monotonic()) for name, pace in self._going.copy().items())


class _Line:
    def __init__(self, reporter: Reporter, name: str, pace: Pace, going: dict[str, Pace]):
        self._reporter, self._name, self._pace, self._going = reporter, name, pace, going
        self._last = pace.start

    def advance(self, cost: float, seconds: float = math.inf) -> None:
        now = time.monotonic()
        self._pace.advance(cost, now, seconds)
        done = self._pace.done == self._pace.units
        if done:
            del self._going[self._name]
        if done or now - self._last > INTERVAL:
            self._last = now
            self._reporter.say(self._pace.text(self._name, now))
