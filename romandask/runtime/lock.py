"""One driver a store: a second is refused, a stale lock is taken over."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from romandask.model.errors import UserError


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Hold the store's lock; UserError where another living driver on this host, or any on another, holds it."""
    path = root / ".lock"
    mine = {"pid": os.getpid(), "host": socket.gethostname()}
    for _ in range(2):
        try:
            with open(path, "x") as file:
                json.dump(mine, file)
            break
        except FileExistsError:
            _refuse_or_remove(path, mine)
    else:
        raise UserError(f"{root}: another driver has just taken the store")
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _refuse_or_remove(path: Path, mine: dict) -> None:
    try:
        held = json.loads(path.read_text())
    except (OSError, ValueError):
        held = {}
    if held.get("host", mine["host"]) != mine["host"]:
        raise UserError(f"{path.parent}: in use by a driver on {held['host']}; if it is gone, remove {path}")
    if held.get("pid") and held["pid"] != mine["pid"] and _alive(int(held["pid"])):
        raise UserError(f"{path.parent}: in use by another driver (process {held['pid']}); wait for it or stop it")
    path.unlink(missing_ok=True)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
