"""The log of a run: one line of JSON an event, in the order in which they happened."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from romandask.storage.paths import AnyPath, file_names, write_bytes

ENDING = ".jsonl"
EVERY = 10.0
"""Seconds after which a part is written of a log whose store takes whole objects alone."""


class Log:
    """Writes the events of one run, a line each; what a crash cuts is the last line, or the last part.

    In a folder of this machine they go to one file; in an object store, where nothing can be appended to, to one object
    every few seconds.
    """

    def __init__(self, folder: AnyPath):
        self.name = f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}"
        self._folder = folder
        self._lines: list[str] = []
        self._parts, self._written = 0, time.monotonic()
        if isinstance(folder, Path):
            folder.mkdir(parents=True, exist_ok=True)

    def beside(self, ending: str) -> AnyPath:
        """Return the file of the log's name with another ending."""
        return self._folder / f"{self.name}{ending}"

    def write(self, event: str, **values: Any) -> None:
        """Write one event with the time (UTC, ISO 8601) at which it happened."""
        line = json.dumps({"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **values})
        if isinstance(self._folder, Path):
            with open(self._folder / f"{self.name}{ENDING}", "a", encoding="utf-8") as file:
                file.write(line + "\n")
            return
        self._lines.append(line + "\n")
        if time.monotonic() - self._written > EVERY or event != "unit":
            self.flush()

    def flush(self) -> None:
        """Write the events that are not yet in the store."""
        if self._lines:
            write_bytes(self.beside(f"-{self._parts:06d}{ENDING}"), "".join(self._lines).encode())
            self._lines, self._parts = [], self._parts + 1
        self._written = time.monotonic()


def runs(folder: AnyPath) -> list[str]:
    """Return the names of the logs of a store, in the order of their runs."""
    return sorted({name.split("-")[0] for name in file_names(folder, ENDING)})


def events(folder: AnyPath, run: str) -> Iterator[dict[str, Any]]:
    """Yield the events of a log; a last line that was cut is left out."""
    for name in file_names(folder, ENDING):
        if name.split("-")[0] != run:
            continue
        for line in (folder / f"{name}{ENDING}").read_text(encoding="utf-8").splitlines():
            try:
                yield json.loads(line)
            except ValueError:
                return


def newest_event(folder: AnyPath) -> dict[str, Any] | None:
    """Return what happened last in the newest run; None where no run has a log."""
    found = runs(folder)
    last = None
    for event in events(folder, found[-1]) if found else ():
        last = event
    return last
