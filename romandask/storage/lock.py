"""The lock of a store: one driver at a time, and none that has ended or has lost its lease.

A lock names its driver by host, machine (boot and process name space), process id and start time of the process. On the
driver's machine, the lock is valid as long as that process runs. Elsewhere nothing can be said of the process; there
the lock is valid until `LEASE` seconds after the driver last renewed it, which it does every `RENEW_INTERVAL` seconds.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, modification_time, remove, write_bytes, write_new

_LOCK_FILE = ".lock"
RENEW_INTERVAL = 10.0
"""Time between two renewals of a lock, s."""
LEASE = 60.0
"""Time after its last renewal at which a lock of another machine is no longer valid, s."""
_CLOCK_SKEW = 600.0
"""Largest difference between the clocks of two hosts, s, where it cannot be measured."""
_ATTEMPTS = 3
_held: set[str] = set()
"""Ids of the locks that this process holds."""


class Lock:
    """A lock that this process holds.

    Parameters
    ----------
    root : path
        Root of the store.
    """

    def __init__(self, root: AnyPath):
        self._root, self._path = root, root / _LOCK_FILE
        self._content = {
            "host": socket.gethostname(),
            "id": uuid.uuid4().hex,
            "machine": _machine(),
            "pid": os.getpid(),
            "started": _start_time(os.getpid()),
        }
        self._bytes = json.dumps(self._content, sort_keys=True).encode()
        self._lost_to = ""
        self._ended = threading.Event()

    def check(self) -> None:
        """Raise a UserError if another driver has taken the lock."""
        if self._lost_to:
            raise UserError(
                f"{self._root}: {self._lost_to} has taken the store, because this one did not renew its lock for "
                f"{LEASE:.0f} s: wait for it or stop it; the same command resumes"
            )

    def _acquire(self, say: Callable[[str], None]) -> None:
        for _ in range(_ATTEMPTS):
            try:
                write_new(self._path, self._bytes)
                _held.add(str(self._content["id"]))
                return
            except FileExistsError:
                self._take_over(say)
        raise UserError(f"{self._root}: another driver has just taken the store")

    def _take_over(self, say: Callable[[str], None]) -> None:
        """Remove the lock if it is not valid, otherwise raise a UserError."""
        holder = _holder(self._path)
        if holder is None:
            return
        runs, driver = _runs_here(holder), _named(holder)
        if runs:
            raise UserError(f"{self._root}: in use by {driver}; wait for it or stop it")
        if runs is None:
            age = _age(self._path)
            if age < LEASE:
                raise UserError(
                    f"{self._root}: in use by {driver}, which renewed its lock {age:.0f} s ago; if it is gone, the "
                    f"same command takes over in {LEASE - age:.0f} s"
                )
            say(f"taking over from {driver}, which has not renewed its lock for {age:.0f} s")
        remove(self._path)

    def _renew_until_the_end(self) -> None:
        while not self._ended.wait(RENEW_INTERVAL):
            # a store that cannot be reached for a moment is tried again
            with suppress(Exception):
                self._renew()

    def _renew(self) -> None:
        """Set the modification time of the lock to now; note if it is another driver's."""
        holder = _holder(self._path)
        if holder is None:
            # removed by hand, or by a driver that is about to take over
            with suppress(FileExistsError):
                write_new(self._path, self._bytes)
        elif holder.get("id", self._content["id"]) != self._content["id"]:
            self._lost_to = _named(holder)
        elif isinstance(self._path, Path):
            # without a time of our own, so that a file server sets its time
            os.utime(self._path)
        else:
            write_bytes(self._path, self._bytes)

    def _release(self) -> None:
        self._ended.set()
        _held.discard(str(self._content["id"]))
        holder = _holder(self._path)
        if holder is not None and holder.get("id") == self._content["id"]:
            remove(self._path)


@contextmanager
def locked(root: AnyPath, say: Callable[[str], None] = lambda line: None) -> Iterator[Lock]:
    """Hold the lock of a store, and renew it in a thread.

    Parameters
    ----------
    root : path
        Root of the store.
    say : callable
        Receives one line if the lock of a driver on another machine, which has lost its lease, is taken over.

    Raises
    ------
    UserError
        If a running process of this machine holds the lock, or one of another machine that has renewed it.
    """
    lock = Lock(root)
    lock._acquire(say)
    renewal = threading.Thread(target=lock._renew_until_the_end, name="renewal of the lock", daemon=True)
    renewal.start()
    try:
        yield lock
    finally:
        lock._ended.set()
        renewal.join(RENEW_INTERVAL)
        lock._release()


def in_use(root: AnyPath) -> bool:
    """Return whether a driver uses a store. Nothing is written: of a driver elsewhere the clock may be minutes off."""
    path = root / _LOCK_FILE
    holder = _holder(path)
    if holder is None:
        return False
    runs = _runs_here(holder)
    try:
        return time.time() - modification_time(path) < LEASE + _CLOCK_SKEW if runs is None else runs
    except FileNotFoundError:
        return False


def _holder(path: AnyPath) -> dict[str, Any] | None:
    """Return the content of a lock: None if there is no lock, an empty dict if its file cannot be read."""
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _named(holder: dict[str, Any]) -> str:
    """Return the words by which messages name a driver."""
    place = "" if holder.get("host") in (None, socket.gethostname()) else f" on {holder['host']}"
    process = f" (process {holder['pid']})" if holder.get("pid") else ""
    return f"{'a' if place else 'another'} driver{place}{process}"


def _runs_here(holder: dict[str, Any]) -> bool | None:
    """Return whether the process of a lock runs on this machine; None if it is a process of another machine."""
    here = {"host": socket.gethostname(), "machine": _machine()}
    if not holder or any(holder.get(key, own) != own for key, own in here.items()):
        # an empty lock is being written, or was when its driver ended
        return None
    if holder.get("pid") == os.getpid() and holder.get("id", "") not in _held:
        # an earlier process with the number of this one
        return False
    return _runs(holder.get("pid"), holder.get("started"))


def _runs(pid: Any, started: Any) -> bool:
    """Return whether a process that started at a time (see `_start_time`, None if unknown) still runs."""
    if not isinstance(pid, int) or pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        # it is another user's
        pass
    now = _start_time(pid)
    return now is None or (now >= 0 and started in (None, now))


def _age(path: AnyPath) -> float:
    """Return the time since the last renewal of a lock, s, by the clock of the file server, which sets both times."""
    probe = path.parent / f"{path.name}-probe-{uuid.uuid4().hex}"
    write_bytes(probe, b"")
    try:
        return max(0.0, modification_time(probe) - modification_time(path))
    except FileNotFoundError:
        # released meanwhile
        return 0.0
    finally:
        remove(probe)


def _machine() -> str:
    """Return what identifies the process ids of this machine: its boot, and the process name space of a container."""
    with suppress(OSError):
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {os.readlink('/proc/self/ns/pid')}"
    return ""


def _start_time(pid: int) -> int | None:
    """Return when a process started, clock ticks since the boot; -1 if it has ended, None if that cannot be seen."""
    try:
        status = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return None
    # the second field, the name of the program in parentheses, may hold anything
    fields = status[status.rindex(b")") + 2 :].split()
    return -1 if fields[0] in (b"Z", b"X") else int(fields[19])
