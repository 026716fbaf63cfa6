"""The log of a run: one line of JSON an event, in the order in which they happened."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any


class Log:
    """Writes the events of one run to a file of its own, a line each; what a crash cuts is the last line."""

    def __init__(self, folder: Path):
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}.jsonl"

    def write(self, event: str, **values: Any) -> None:
        """Write one event with the time (UTC, ISO 8601) at which it happened."""
        line = json.dumps({"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **values})
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(line + "\n")


def newest(folder: Path) -> Path | None:
    """Return the log of the newest run."""
    return max(folder.glob("*.jsonl"), default=None)


def events(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the events of a log; a last line that was cut is left out."""
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            yield json.loads(line)
        except ValueError:
            return
