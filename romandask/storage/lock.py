"""One driver a store: a second is refused, a stale lock is taken over."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, remove, write_new

_LOCK = ".lock"


@contextmanager
def locked(root: AnyPath) -> Iterator[None]:
    """Hold the store's lock; UserError where another living driver on this host, or any on another, holds it."""
    path = root / _LOCK
    mine = {"pid": os.getpid(), "host": socket.gethostname()}
    for _ in range(2):
        try:
            write_new(path, json.dumps(mine).encode())
            break
        except FileExistsError:
            _refuse_or_remove(path, mine)
    else:
        raise UserError(f"{root}: another driver has just taken the store")
    try:
        yield
    finally:
        remove(path)


def in_use(root: AnyPath) -> bool:
    """True where a driver holds the store: one on this host that lives, or any on another."""
    held = _holder(root / _LOCK)
    if held is None:
        return False
    return held.get("host", socket.gethostname()) != socket.gethostname() or _alive(int(held.get("pid") or 0))


def _holder(path: AnyPath) -> dict | None:
    """Return who holds a lock; None where nobody does."""
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}


def _refuse_or_remove(path: AnyPath, mine: dict) -> None:
    held = _holder(path) or {}
    if held.get("host", mine["host"]) != mine["host"]:
        raise UserError(f"{path.parent}: in use by a driver on {held['host']}; if it is gone, remove {path}")
    if held.get("pid") and held["pid"] != mine["pid"] and _alive(int(held["pid"])):
        raise UserError(f"{path.parent}: in use by another driver (process {held['pid']}); wait for it or stop it")
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
