"""The manifest: one record per unit, written after the data. A unit is stored if and only if it has a record."""

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
    """The manifest entry of a stored unit."""

    stage: str
    unit: str
    inputs: str
    """Input hash: hash of everything that the content of the unit depends on."""
    output: str
    """Hash of the content, independent of compression."""
    bytes: int
    """Uncompressed size, bytes."""
    rows: int
    """Number of rows of a table, or of pixels of an image."""
    seconds: float
    """Wall time of making and writing the unit, s."""
    peak_bytes: int
    """Peak resident memory of the worker while it made the unit, bytes."""
    warnings: list[str] = field(default_factory=list)
    """Warnings raised while the unit was made."""
    parts: dict[str, str] = field(default_factory=dict)
    """Hashes that `inputs` combines: settings, version and, by stage name, the outputs of each stage that was read."""


def read_record(store: Store, stage: str, unit: str) -> Record | None:
    """Return the record of a unit, or None if it is missing, unreadable or damaged."""
    try:
        return _parse(store.record(stage, unit).read_bytes())
    except OSError:
        return None


def read_records(store: Store, stage: str) -> Iterator[tuple[str, Record | None]]:
    """Yield the names of the recorded units of a stage, sorted, with their records; None for a damaged record."""
    for name, content in read_files(store.records(stage), ".json"):
        yield name, _parse(content)


def _parse(content: bytes) -> Record | None:
    try:
        fields = json.loads(content)
        check = fields.pop("check")
        return Record(**fields) if check == digest(fields) else None
    except (ValueError, TypeError, KeyError, AttributeError):
        return None


def write_record(store: Store, record: Record) -> None:
    """Write a record atomically, with a hash of its content, by which `read_record` rejects a damaged one."""
    content = asdict(record)
    write_json(store.record(record.stage, record.unit), {**content, "check": digest(content)})


class Digest:
    """Incremental hash (BLAKE2b, 16 bytes) of a sequence of values."""

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=16)

    def add(self, part: Any) -> None:
        """Add a value: bytes by their content, an array by type, shape and content, any other value by its JSON."""
        if isinstance(part, bytes):
            self._hash.update(part)
        elif isinstance(part, np.ndarray):
            self._hash.update(f"{part.dtype.str}{part.shape}".encode())
            self._hash.update(np.ascontiguousarray(part).data)
        else:
            self._hash.update(json.dumps(part, sort_keys=True, default=str).encode())
        self._hash.update(b"\0")

    def value(self) -> str:
        """Return the hash of the values added so far, in hexadecimal."""
        return self._hash.hexdigest()


def digest(*parts: Any) -> str:
    """Return the hash of a sequence of values (see `Digest.add`)."""
    total = Digest()
    for part in parts:
        total.add(part)
    return total.value()
