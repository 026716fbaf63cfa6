"""Checksums of exported files, beside them: SHA256SUMS, which `sha256sum -c` reads, and which has a sum of itself."""

from __future__ import annotations

import hashlib
import os
import re
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path

from romandask.model.errors import UserError

NAME = "SHA256SUMS"
_LINE = re.compile(r"([0-9a-f]{64})  (.+)")
_END = re.compile(r"# (\d+) files ([0-9a-f]{64})")


def note(paths: Iterable[Path]) -> None:
    """Add files to the SHA256SUMS of their folders; those of other files stay.

    Raises
    ------
    UserError
        If it cannot be written, or the one that is there is damaged.
    """
    folders: dict[Path, dict[str, str]] = {}
    for path in paths:
        folders.setdefault(path.parent, {})[path.name] = _sum(path)
    for folder, sums in folders.items():
        there, damaged = _read(folder) if (folder / NAME).exists() else ({}, "")
        if damaged:
            raise UserError(f"{folder / NAME}: {damaged}: remove it, and export again what the folder holds")
        lines = "".join(f"{value}  {name}\n" for name, value in sorted((there | sums).items()))
        text = f"{lines}# {len(there | sums)} files {hashlib.sha256(lines.encode()).hexdigest()}\n"
        temporary = folder / f".{NAME}.{uuid.uuid4().hex}.partial"
        try:
            temporary.write_text(text)
            os.replace(temporary, folder / NAME)
        except OSError as error:
            raise UserError(f"{folder / NAME}: cannot be written ({error.strerror})") from None
        finally:
            temporary.unlink(missing_ok=True)


def check(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield each file of a folder's SHA256SUMS, with what is wrong with it; empty where it is as it was written."""
    sums, damaged = _read(folder)
    if damaged:
        yield NAME, damaged
    for name, expected in sums.items():
        try:
            yield name, "" if _sum(folder / name) == expected else "not what was written"
        except FileNotFoundError:
            yield name, "is gone"
        except OSError as error:
            yield name, f"cannot be read ({error.strerror})"


def _read(folder: Path) -> tuple[dict[str, str], str]:
    """Return the sums by name, and what is wrong with the list itself."""
    text = (folder / NAME).read_text(errors="replace")
    *lines, last = text.split("\n")[:-1] or [""]
    found = [_LINE.fullmatch(line) for line in lines]
    end = _END.fullmatch(last)
    sums = {match[2]: match[1] for match in found if match}
    whole = "".join(line + "\n" for line in lines)
    good = end is not None and all(found) and int(end[1]) == len(lines) and text.endswith("\n")
    if not good or end is None or hashlib.sha256(whole.encode()).hexdigest() != end[2]:
        return sums, "the list itself is damaged"
    return sums, ""


def _sum(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
