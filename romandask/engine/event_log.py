"""Event log of a run: one line of JSON for each event, in chronological order."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from romandask.storage.paths import AnyPath, file_names, write_bytes

LOG_SUFFIX = ".jsonl"
FLUSH_INTERVAL = 10.0
"""Time between two writes of a log to an object store, s."""


class Log:
    """Writer of the event log of one run, one line for each event.

    In a local folder, every event is appended to one file. An object store cannot append, so there the log is a
    sequence of objects, and a new one is written every `FLUSH_INTERVAL` seconds. After a crash, at most the last line
    or the last object is incomplete.

    Parameters
    ----------
    folder : path
        Folder of the logs of a store. A local folder is created.
    check : callable
        Called before each event is written. Raises an error if the run must stop.
    """

    def __init__(self, folder: AnyPath, check: Callable[[], None] = lambda: None):
        self._check = check
        self.name = f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}"
        self._folder = folder
        self._lines: list[str] = []
        self._parts_written, self._last_flush = 0, time.monotonic()
        if isinstance(folder, Path):
            folder.mkdir(parents=True, exist_ok=True)

    def path_with(self, suffix: str) -> AnyPath:
        """Return the path of a file in the log folder, named after this log, with the given suffix."""
        return self._folder / f"{self.name}{suffix}"

    def write(self, event: str, **values: Any) -> None:
        """Write one event with the current time (UTC, ISO 8601)."""
        self._check()
        line = json.dumps({"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **values})
        if isinstance(self._folder, Path):
            with open(self._folder / f"{self.name}{LOG_SUFFIX}", "a", encoding="utf-8") as file:
                file.write(line + "\n")
            return
        self._lines.append(line + "\n")
        if time.monotonic() - self._last_flush > FLUSH_INTERVAL or event != "unit":
            self.flush()

    def flush(self) -> None:
        """Write the events that are not yet in the object store."""
        if self._lines:
            write_bytes(self.path_with(f"-{self._parts_written:06d}{LOG_SUFFIX}"), "".join(self._lines).encode())
            self._lines, self._parts_written = [], self._parts_written + 1
        self._last_flush = time.monotonic()


def runs(folder: AnyPath) -> list[str]:
    """Return the names of the logs in a folder, oldest run first."""
    return sorted({name.split("-")[0] for name in file_names(folder, LOG_SUFFIX)})


def events(folder: AnyPath, run: str) -> Iterator[dict[str, Any]]:
    """Yield the events of the log of a run, up to the first incomplete line."""
    for name in file_names(folder, LOG_SUFFIX):
        if name.split("-")[0] != run:
            continue
        for line in (folder / f"{name}{LOG_SUFFIX}").read_text(encoding="utf-8").splitlines():
            try:
                yield json.loads(line)
            except ValueError:
                return


def newest_event(folder: AnyPath) -> dict[str, Any] | None:
    """Return the last event of the newest run, or None if the folder has no log."""
    names = runs(folder)
    last = None
    for event in events(folder, names[-1]) if names else ():
        last = event
    return last
