"""The lock of a store: one driver at a time. A lock whose process has ended is taken over."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, remove, write_new

_LOCK_FILE = ".lock"


@contextmanager
def locked(root: AnyPath) -> Iterator[None]:
    """Hold the lock of a store.

    Parameters
    ----------
    root : path
        Root of the store.

    Raises
    ------
    UserError
        If a running process on this host, or any process on another host, holds the lock.
    """
    path = root / _LOCK_FILE
    own = {"pid": os.getpid(), "host": socket.gethostname()}
    for _ in range(2):
        try:
            write_new(path, json.dumps(own).encode())
            break
        except FileExistsError:
            _refuse_or_remove(path, own)
    else:
        raise UserError(f"{root}: another driver has just taken the store")
    try:
        yield
    finally:
        remove(path)


def in_use(root: AnyPath) -> bool:
    """Return whether a running process on this host, or any process on another host, holds the lock of a store."""
    holder = _holder(root / _LOCK_FILE)
    if holder is None:
        return False
    return holder.get("host", socket.gethostname()) != socket.gethostname() or _alive(int(holder.get("pid") or 0))


def _holder(path: AnyPath) -> dict[str, Any] | None:
    """Return the process that holds a lock: None if there is no lock, an empty dict if its file cannot be read."""
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}


def _refuse_or_remove(path: AnyPath, own: dict[str, Any]) -> None:
    holder = _holder(path) or {}
    if holder.get("host", own["host"]) != own["host"]:
        raise UserError(f"{path.parent}: in use by a driver on {holder['host']}; if it is gone, remove {path}")
    if holder.get("pid") and holder["pid"] != own["pid"] and _alive(int(holder["pid"])):
        raise UserError(f"{path.parent}: in use by another driver (process {holder['pid']}); wait for it or stop it")
    remove(path)


def _alive(pid: int) -> bool:
    if pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
