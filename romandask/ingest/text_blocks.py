"""Text files, plain or .gz, read in blocks of bytes: each block has the lines that begin in it."""

from __future__ import annotations

import gzip
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, file_state, local_copy

MAX_LINE_BYTES = 1 << 16
"""Length, bytes, up to which lines are read completely."""
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
"""Bytes before the first line of texts that some editors write."""


def unmarked(data: bytes) -> bytes:
    """Return the beginning of a text without its byte-order mark."""
    return data.removeprefix(BYTE_ORDER_MARK)


def decoded(data: bytes) -> list[str]:
    """Return the lines of a text, which only newlines separate (str.splitlines accepts other characters as well)."""
    lines = data.decode("utf-8", "replace").split("\n")
    return lines if lines[-1] else lines[:-1]


def open_binary(path: AnyPath) -> Any:
    """Open a file for reading; a .gz is recognised by its content and decompressed."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; truth.path must name an instance catalog below data")
    local = local_copy(path)
    with open(local, "rb") as file:
        compressed = file.read(2) == b"\x1f\x8b"
    return gzip.open(local, "rb") if compressed else open(local, "rb")


def iterate_lines(path: AnyPath) -> Iterator[str]:
    with open_binary(path) as file:
        while line := file.readline(MAX_LINE_BYTES):
            yield line.decode("utf-8", "replace").removeprefix("\ufeff")


def lines_of_block(path: AnyPath, start: int, stop: int) -> list[str]:
    """Return the lines whose first byte is in the range from `start` to `stop` (exclusive)."""
    before = max(start - 1, 0)
    # read beyond the block, to the end of its last line
    data = _bytes(path, before, stop - before + MAX_LINE_BYTES)
    if start == 0:
        before, data = before + len(data) - len(unmarked(data)), unmarked(data)
    else:
        # a line that starts before the block belongs to the previous block
        end = data.find(b"\n", 0, stop - before)
        if end < 0:
            return []
        before, data = before + end + 1, data[end + 1 :]
    inside = stop - before
    if inside <= 0:
        return []
    if not data[:inside].endswith(b"\n"):
        end = data.find(b"\n", inside)
        inside = end + 1 if end >= 0 else len(data)
    return decoded(data[:inside])


@dataclass
class _GzipReader:
    """An open .gz that is read sequentially; the end of the text read so far is kept, because blocks overlap."""

    key: tuple[AnyPath, int, int]
    """Path, modification time (ns) and process."""
    file: BinaryIO
    offset: int = 0
    """Offset of the next byte in the uncompressed text."""
    tail: bytes = b""
    """Text before `offset`."""

    def read(self, start: int, length: int) -> bytes:
        tail_start = self.offset - len(self.tail)
        if not tail_start <= start <= self.offset:
            self.file.seek(start)
            self.offset, self.tail, tail_start = start, b"", start
        kept = self.tail[start - tail_start :]
        data = kept + self.file.read(max(length - len(kept), 0))
        self.offset, self.tail = start + len(data), data[-2 * MAX_LINE_BYTES :]
        return data[:length]


_GZIP_LOCK = threading.Lock()
_OPEN_GZIP: list[_GzipReader] = []
"""The .gz that is open in this process, if any."""


def _bytes(path: AnyPath, start: int, length: int) -> bytes:
    """Return a range of bytes of the uncompressed text."""
    with open_binary(path) as file:
        if not isinstance(file, gzip.GzipFile):
            file.seek(start)
            return file.read(length)
    key = (path, file_state(path)[1], os.getpid())
    with _GZIP_LOCK:
        # one .gz stays open per process, so that the next block need not be decompressed from the beginning
        if not _OPEN_GZIP or _OPEN_GZIP[0].key != key:
            for reader in _OPEN_GZIP:
                reader.file.close()
            _OPEN_GZIP[:] = [_GzipReader(key, open_binary(path))]
        return _OPEN_GZIP[0].read(start, length)
