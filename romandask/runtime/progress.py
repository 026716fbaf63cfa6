"""Progress: a bar a stage on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

INTERVAL = 5.0
"""Seconds between plain lines."""


class Meter(Protocol):
    """Counts the units of a stage."""

    def advance(self) -> None:
        """Count one more unit."""


class Reporter:
    """Writes what a run does to a console."""

    def __init__(self, console: Console):
        self.console = console

    def say(self, text: str) -> None:
        """Write one line."""
        self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    @contextmanager
    def stage(self, name: str, units: int) -> Iterator[Meter]:
        """Show the progress of a stage."""
        if self.console.is_terminal:
            columns = (
                TextColumn("{task.description:18s}"), BarColumn(), MofNCompleteColumn(),
                TimeElapsedColumn(), TimeRemainingColumn(),
            )  # fmt: skip
            with Progress(*columns, console=self.console) as progress:
                yield _Bar(progress, name, units)
        else:
            yield _Lines(self, name, units)


class _Bar:
    def __init__(self, progress: Progress, name: str, units: int):
        self._progress, self._task = progress, progress.add_task(name, total=units)

    def advance(self) -> None:
        self._progress.advance(self._task)


class _Lines:
    def __init__(self, reporter: Reporter, name: str, units: int):
        self._reporter, self._name, self._units = reporter, name, units
        self._done, self._start, self._last = 0, time.monotonic(), time.monotonic()

    def advance(self) -> None:
        self._done += 1
        now = time.monotonic()
        if self._done == self._units or now - self._last > INTERVAL:
            self._last = now
            self._reporter.say(f"{self._name:20s} {self._done}/{self._units} units  {now - self._start:.1f} s")
