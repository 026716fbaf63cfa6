"""Checksums of exported files, beside them: SHA256SUMS, which `sha256sum -c` reads, and which has a sum of itself."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path

from romandask.model.errors import UserError
from romandask.storage.paths import write_bytes

NAME = "SHA256SUMS"
_LINE = re.compile(r"^([0-9a-f]{64})  (.+)$", re.MULTILINE)
_DAMAGED = "the list itself is damaged"


def note(path: Path) -> None:
    """Add a file to the SHA256SUMS of its folder; those of other files stay.

    Raises
    ------
    UserError
        If it cannot be written, or the one that is there is damaged.
    """
    listed = path.with_name(NAME)
    there: dict[str, str] = {}
    if listed.exists():
        there, whole = _read(path.parent)
        if not whole:
            raise UserError(f"{listed}: {_DAMAGED}: remove it, and export again what the folder holds")
    try:
        write_bytes(listed, _text(there | {path.name: _sum(path)}).encode())
    except OSError as error:
        raise UserError(f"{listed}: cannot be written ({error.strerror})") from None


def check(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield each file of a folder's SHA256SUMS, with what is wrong with it; empty where it is as it was written."""
    sums, whole = _read(folder)
    if not whole:
        yield NAME, _DAMAGED
    for name, expected in sums.items():
        try:
            yield name, "" if _sum(folder / name) == expected else "not what was written"
        except FileNotFoundError:
            yield name, "is gone"
        except OSError as error:
            yield name, f"cannot be read ({error.strerror})"


def _text(sums: dict[str, str]) -> str:
    """Return the list of some sums by name, its last line a comment with their number and the sum of the others."""
    lines = "".join(f"{value}  {name}\n" for name, value in sorted(sums.items()))
    return f"{lines}# {len(sums)} files {hashlib.sha256(lines.encode()).hexdigest()}\n"


def _read(folder: Path) -> tuple[dict[str, str], bool]:
    """Return the sums of a list by name, and whether it is as it was written."""
    text = (folder / NAME).read_bytes().decode(errors="replace")
    sums = {name: value for value, name in _LINE.findall(text)}
    return sums, text == _text(sums)


def _sum(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
