"""Progress of a run: bars of the run and of its active stages on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

LINE_INTERVAL = 5.0
"""Minimum time between two plain lines of a stage, s."""
TOTAL = "all stages"
"""Name of the progress of the whole run."""
SHOWN_STAGES = 4
"""Largest number of active stages in a plain line."""
KNOWN_SHARE = 0.005
"""Share of the cost from which on the remaining time is estimated: the first units are the smallest."""
MAX_SILENCE = 8.0
"""Time without output after which the current activity is printed again, s."""


class Meter(Protocol):
    """Counter of the finished units of a stage."""

    def advance(self, cost: float, seconds: float = math.inf) -> None:
        """Count one more unit.

        Parameters
        ----------
        cost : float
            Cost of the unit, in the unit of the total cost of the stage.
        seconds : float
            Wall time of making the unit, s.
        """


@dataclass(kw_only=True)
class Pace:
    """Progress of a stage, with an estimate of the remaining time from the cost of its units."""

    units: int
    """Number of units of the stage that the run makes."""
    cost: float
    """Total cost of these units, in any unit."""
    start: float
    """Start time of the stage, s."""
    done: int = 0
    """Number of finished units."""
    cost_done: float = 0.0
    """Total cost of the finished units."""
    seconds_worked: float = 0.0
    """Time during which units of this stage were made, s. Excludes the time when other stages had the workers."""
    last_end: float = 0.0
    """Time at which the last unit finished, s; 0 before the first one."""

    def expect(self, units: int, cost: float) -> None:
        """Add units to make, and the sum of their costs."""
        self.units, self.cost = self.units + units, self.cost + cost

    def advance(self, cost: float, now: float, seconds: float = math.inf) -> None:
        """Count one more unit, which finished at the time `now` and took the wall time `seconds`."""
        self.seconds_worked += min(now - (self.last_end or self.start), seconds)
        self.done, self.cost_done, self.last_end = self.done + 1, self.cost_done + cost, now

    def seconds_left(self) -> float | None:
        """Return the estimated remaining time, s; None if the stage has finished, or too few units to tell have."""
        known = self.cost_done > KNOWN_SHARE * self.cost and self.done < self.units
        return self.seconds_worked * (self.cost - self.cost_done) / self.cost_done if known else None

    def text(self, name: str, now: float) -> str:
        """Return one line with the name of the stage, its finished units, and elapsed and remaining time."""
        line = f"{name:20s} {self.done}/{self.units} units  {now - self.start:.1f} s"
        left = self.seconds_left()
        return line if left is None else f"{line}, about {duration(left)} left"


def duration(seconds: float) -> str:
    """Return a time span as text in s, min or h: `40 s`, `12 min`, `3.5 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class Reporter:
    """Writer of the messages and the progress of a run to a console."""

    def __init__(self, console: Console):
        self.console = console
        self._last_output = time.monotonic()

    def say(self, text: str) -> None:
        """Write one line."""
        self._last_output = time.monotonic()
        self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    @contextmanager
    def busy(self, text: Callable[[], str] | str) -> Iterator[None]:
        """Write the current activity and its duration after every `MAX_SILENCE` seconds without output.

        Parameters
        ----------
        text : str or callable
            The activity, or a function that returns the whole line; an empty line is not written.
        """
        ended, start = threading.Event(), time.monotonic()

        def watch() -> None:
            while not ended.wait(0.5):
                if (now := time.monotonic()) - self._last_output > MAX_SILENCE:
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
        """Show the progress of stages, several of which may be active at the same time."""
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
            self._last_output = time.monotonic()
        else:
            lines = _Lines(self)
            with self.busy(lines.text):
                yield lines


class Board(Protocol):
    """Display of the progress of a run and of its active stages."""

    def expect(self, units: int, cost: float) -> None:
        """Add units to those that the whole run makes, and the sum of their costs."""

    def begin(self, name: str, units: int, cost: float, seconds: float = 0.0) -> Meter:
        """Show a stage until all its units are counted.

        Parameters
        ----------
        name : str
            Name of the stage.
        units : int
            Number of units to make.
        cost : float
            Total cost of these units.
        seconds : float
            Time since the first unit of the stage was begun, s.
        """


def busy(text: str) -> AbstractContextManager[None]:
    """Write the activity of a command and its duration to standard output, every few seconds."""
    return Reporter(Console()).busy(text)


class _Bars:
    """Display of one bar per active stage and one of the whole run, on a terminal."""

    def __init__(self, reporter: Reporter, progress: Progress):
        self._reporter, self._progress = reporter, progress
        self._total = Pace(units=0, cost=0.0, start=time.monotonic())
        self._bar: TaskID | None = None

    def expect(self, units: int, cost: float) -> None:
        self._total.expect(units, cost)
        if self._bar is None:
            self._bar = self._progress.add_task(TOTAL, total=0.0, done=0, units=0, left="")
        self._progress.update(self._bar, total=self._total.cost, units=self._total.units)

    def begin(self, name: str, units: int, cost: float, seconds: float = 0.0) -> Meter:
        return _Bar(self, name, Pace(units=units, cost=cost, start=time.monotonic() - seconds))

    def advance_total(self, cost: float) -> None:
        if self._bar is not None:
            self._total.advance(cost, time.monotonic())
            self._update(self._bar, self._total, cost)

    def add(self, name: str, pace: Pace) -> TaskID:
        """Add the bar of a stage."""
        return self._progress.add_task(name, total=pace.cost, done=0, units=pace.units, left="")

    def advance(self, bar: TaskID, name: str, pace: Pace, cost: float) -> None:
        """Advance the bar of a stage, and remove it after the last unit."""
        self._update(bar, pace, cost)
        if pace.done == pace.units:
            # one plain line replaces the bar of a finished stage, so that bars show active stages only
            self._progress.remove_task(bar)
            self._reporter.say(pace.text(name, time.monotonic()))
        self.advance_total(cost)

    def _update(self, bar: TaskID, pace: Pace, cost: float) -> None:
        left = pace.seconds_left()
        text = "" if left is None else f"{duration(left)} left"
        self._progress.update(bar, advance=cost, done=pace.done, left=text)


class _Bar:
    def __init__(self, bars: _Bars, name: str, pace: Pace):
        self._bars, self._name, self._pace = bars, name, pace
        self._bar = bars.add(name, pace)

    def advance(self, cost: float, seconds: float = math.inf) -> None:
        self._pace.advance(cost, time.monotonic(), seconds)
        self._bars.advance(self._bar, self._name, self._pace, cost)


class _Lines:
    """Display of plain lines, for output that is not a terminal."""

    def __init__(self, reporter: Reporter):
        self._reporter = reporter
        self._active: dict[str, Pace] = {}
        self._total = Pace(units=0, cost=0.0, start=time.monotonic())
        self._last_line = time.monotonic()

    def expect(self, units: int, cost: float) -> None:
        self._total.expect(units, cost)

    def begin(self, name: str, units: int, cost: float, seconds: float = 0.0) -> Meter:
        self._active[name] = Pace(units=units, cost=cost, start=time.monotonic() - seconds)
        return _Line(self, name)

    def text(self) -> str:
        """Return one line with the progress of the run and of each active stage."""
        active = [f"{name} {pace.done}/{pace.units}" for name, pace in self._active.copy().items()]
        if len(active) > SHOWN_STAGES:
            active[SHOWN_STAGES - 1 :] = [f"{len(active) - SHOWN_STAGES + 1} more"]
        stages = ", ".join(active)
        total = self._total.text(TOTAL, time.monotonic()) if self._total.units else ""
        return ": ".join(filter(None, (total, stages)))

    def advance(self, name: str, cost: float, seconds: float) -> None:
        """Count a unit of a stage; print the stage after its last unit, and the progress of the run now and then."""
        now, pace = time.monotonic(), self._active[name]
        pace.advance(cost, now, seconds)
        self._total.advance(cost, now)
        if pace.done == pace.units:
            del self._active[name]
            self._reporter.say(pace.text(name, now))
        elif now - self._last_line > LINE_INTERVAL:
            self._last_line = now
            self._reporter.say(self.text())


class _Line:
    def __init__(self, lines: _Lines, name: str):
        self._lines, self._name = lines, name

    def advance(self, cost: float, seconds: float = math.inf) -> None:
        self._lines.advance(self._name, cost, seconds)
