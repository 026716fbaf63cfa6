"""The manifest: one record a unit, written after its data. A unit is done if and only if its record says so."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from romandask.storage.paths import read_files
from romandask.storage.store import Store, write_json


@dataclass(frozen=True)
class Record:
    """What is known of a unit that has been stored."""

    stage: str
    unit: str
    inputs: str
    """Hash of everything that the unit depends on."""
    output: str
    """Hash of what was made, independent of compression."""
    bytes: int
    """Uncompressed size."""
    rows: int
    """Rows of a table, pixels of an image."""
    seconds: float
    peak_bytes: int
    """Most resident memory of the worker while it made it."""
    warnings: list[str] = field(default_factory=list)
    parts: dict[str, str] = field(default_factory=dict)
    """What `inputs` is the hash of: settings, version, and the outputs of each stage that is read, by its name."""


def read_record(store: Store, stage: str, unit: str) -> Record | None:
    """Return the record of a unit; None where there is none, or where it cannot be read or is damaged."""
    try:
        return _parsed(store.record(stage, unit).read_bytes())
    except OSError:
        return None


def read_records(store: Store, stage: str) -> Iterator[tuple[str, Record | None]]:
    """Yield the units of a stage that have a record, in order, and their records; None where one is damaged."""
    for name, content in read_files(store.records(stage), ".json"):
        yield name, _parsed(content)


def _parsed(text: bytes) -> Record | None:
    try:
        content = json.loads(text)
        check = content.pop("check")
        return Record(**content) if check == digest(content) else None
    except (ValueError, TypeError, KeyError, AttributeError):
        return None


def write_record(store: Store, record: Record) -> None:
    """Write a record, atomically, with a hash of itself: one that is damaged is none."""
    content = asdict(record)
    write_json(store.record(record.stage, record.unit), {**content, "check": digest(content)})


class Digest:
    """A hash of values that come one after another."""

    def __init__(self) -> None:
        self._state = hashlib.blake2b(digest_size=16)

    def add(self, part: Any) -> None:
        """Add mappings and sequences by their sorted JSON, arrays and bytes by their content."""
        if isinstance(part, bytes):
            self._state.update(part)
        elif isinstance(part, np.ndarray):
            self._state.update(f"{part.dtype.str}{part.shape}".encode())
            self._state.update(np.ascontiguousarray(part).data)
        else:
            self._state.update(json.dumps(part, sort_keys=True, default=str).encode())
        self._state.update(b"\0")

    def value(self) -> str:
        """Return the hash of what was added."""
        return self._state.hexdigest()


def digest(*parts: Any) -> str:
    """Return a hash of values (see Digest)."""
    state = Digest()
    for part in parts:
        state.add(part)
    return state.value()
