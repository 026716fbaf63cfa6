"""Checksums of exported files: a SHA256SUMS beside the files, which `sha256sum -c` reads, with a checksum of itself."""

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
    """Add the checksum of a file to the SHA256SUMS of its folder; the entries of other files stay.

    Parameters
    ----------
    path : Path
        Written file.

    Raises
    ------
    UserError
        If SHA256SUMS cannot be written, or is damaged.
    """
    sums_path = path.with_name(NAME)
    sums: dict[str, str] = {}
    if sums_path.exists():
        sums, is_intact = _read(path.parent)
        if not is_intact:
            raise UserError(f"{sums_path}: {_DAMAGED}: remove it, and export again what the folder holds")
    try:
        write_bytes(sums_path, _text(sums | {path.name: _sum(path)}).encode())
    except OSError as error:
        raise UserError(f"{sums_path}: cannot be written ({error.strerror})") from None


def check(folder: Path) -> Iterator[tuple[str, str]]:
    """Compare the files of a folder with its SHA256SUMS.

    Parameters
    ----------
    folder : Path
        Folder with a SHA256SUMS.

    Yields
    ------
    name : str
        Name of a file.
    problem : str
        What is wrong with the file; empty if it is as it was written.
    """
    sums, is_intact = _read(folder)
    if not is_intact:
        yield NAME, _DAMAGED
    for name, expected in sums.items():
        try:
            yield name, "" if _sum(folder / name) == expected else "not what was written"
        except FileNotFoundError:
            yield name, "is gone"
        except OSError as error:
            yield name, f"cannot be read ({error.strerror})"


def _text(sums: dict[str, str]) -> str:
    """Return the text of SHA256SUMS; its last line is a comment: the number of files, the checksum of the list."""
    lines = "".join(f"{checksum}  {name}\n" for name, checksum in sorted(sums.items()))
    return f"{lines}# {len(sums)} files {hashlib.sha256(lines.encode()).hexdigest()}\n"


def _read(folder: Path) -> tuple[dict[str, str], bool]:
    """Return the checksums of a list by name, and whether the list is as it was written."""
    text = (folder / NAME).read_bytes().decode(errors="replace")
    sums = {name: checksum for checksum, name in _LINE.findall(text)}
    return sums, text == _text(sums)


def _sum(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
