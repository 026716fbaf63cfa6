"""Folders and files of an export: an exported file appears under its name only when it is complete."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from romandask.model.errors import UserError


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, unless they exist.

    Raises
    ------
    UserError
        If the folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror})") from None


@contextmanager
def completed(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of a file, which replaces the file at the end of the block.

    After an error the temporary file is removed, and an existing file under the final name stays as it was.

    Parameters
    ----------
    path : Path
        Final path of the file.

    Yields
    ------
    Path
        Path to write to.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
