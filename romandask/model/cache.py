"""Folders for files that can be made again: compiled code, and copies of objects of an object store."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path


def cache_folder(name: str) -> Path | None:
    """Return a folder for cached files, the first that can be written.

    Tried are `romandask` in the user's cache (XDG_CACHE_HOME, by default ~/.cache), and a folder of this user alone in
    the temporary folder.

    Parameters
    ----------
    name : str
        Name of the folder below these.

    Returns
    -------
    Path or None
        The folder, which exists; None if no place can be written.
    """
    with suppress(RuntimeError):
        # RuntimeError: this user has no home
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "romandask" / name
        if is_writable(folder):
            return folder
    with suppress(OSError):
        # OSError: there is no temporary folder either
        own = Path(tempfile.gettempdir()) / f"romandask-{os.getuid()}"
        own.mkdir(mode=0o700, exist_ok=True)
        state = own.stat(follow_symlinks=False)
        # what is cached is executed: a folder that others may write is not used
        if state.st_uid == os.getuid() and not state.st_mode & 0o022 and is_writable(own / name):
            return own / name
    return None


def is_writable(folder: Path) -> bool:
    """Return whether files can be created in a folder, which is made if it does not exist."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # permission bits do not tell: the file system may be read-only or full
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"0")
    except OSError:
        return False
    return True
