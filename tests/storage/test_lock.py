"""The lock of a store: who holds it, for how long, and who takes it over."""

import json
import os
import socket
import subprocess
import sys
import threading
import time

import pytest

from romandask.engine.event_log import Log
from romandask.model.errors import UserError
from romandask.storage import lock
from romandask.storage.lock import in_use, locked


def held_by(path, age: float = 0.0, **changes) -> None:
    """Write the lock that another driver would have, renewed some time ago, s."""
    own = {
        "host": socket.gethostname(),
        "id": "other",
        "machine": lock._machine(),
        "pid": os.getppid(),
        "started": lock._start_time(os.getppid()),
    }
    (path / ".lock").write_text(json.dumps(own | changes))
    os.utime(path / ".lock", (time.time() - age,) * 2)


def taken(path) -> list[str]:
    """Take the lock and return the lines that are said."""
    lines = []
    with locked(path, lines.append):
        assert in_use(path)
        assert json.loads((path / ".lock").read_bytes())["pid"] == os.getpid()
    assert list(path.iterdir()) == [], "the lock is gone, and so are the probes"
    return lines


def test_a_lock_tells_its_driver_and_is_held_once(tmp_path):
    with locked(tmp_path):
        content = json.loads((tmp_path / ".lock").read_bytes())
        assert content["host"] == socket.gethostname()
        assert content["pid"] == os.getpid()
        assert content["started"] == lock._start_time(os.getpid()) > 0
        with pytest.raises(UserError, match=rf"in use by another driver \(process {os.getpid()}\)"), locked(tmp_path):
            pass
    assert not (tmp_path / ".lock").exists()


def test_a_running_process_keeps_its_lock_however_old(tmp_path):
    held_by(tmp_path, age=1e6)
    with pytest.raises(UserError, match=rf"process {os.getppid()}\); wait for it or stop it"), locked(tmp_path):
        pass
    assert in_use(tmp_path)


@pytest.mark.parametrize(
    "changes",
    [
        {"pid": 2**22 + 1},
        {"pid": 0},
        {"pid": 2**70},
        {"pid": "?"},
        {"started": 1},
        {"pid": os.getpid(), "started": lock._start_time(os.getpid())},
    ],
    ids=["gone", "none", "too large", "no number", "reused", "reused by this process"],
)
def test_the_lock_of_a_process_that_has_ended_is_taken_over_at_once(tmp_path, changes):
    held_by(tmp_path, **changes)
    assert not in_use(tmp_path)
    assert taken(tmp_path) == []


def test_a_process_that_nobody_has_waited_for_has_ended(tmp_path):
    child = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    held_by(tmp_path, pid=child.pid, started=None)
    assert taken(tmp_path) == []
    child.wait()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"host": "elsewhere"}, "a driver on elsewhere"),
        ({"machine": "another boot"}, "another driver"),
    ],
)
def test_a_lock_of_another_machine_has_a_lease(tmp_path, changes, words):
    held_by(tmp_path, age=lock.LEASE - 30, **changes)
    with (
        pytest.raises(UserError, match=rf"in use by {words} \(process \d+\), .* takes over in \d\d s"),
        locked(tmp_path),
    ):
        pass
    assert in_use(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    held_by(tmp_path, age=lock.LEASE + 1, **changes)
    (line,) = taken(tmp_path)
    assert line.startswith(f"taking over from {words} (process ")
    held_by(tmp_path, age=lock.LEASE + lock._CLOCK_SKEW + 1, **changes)
    assert not in_use(tmp_path)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff"])
def test_a_lock_that_cannot_be_read_has_a_lease(tmp_path, content):
    """It may be one that is being written."""
    (tmp_path / ".lock").write_bytes(content)
    with pytest.raises(UserError, match="in use by another driver, which renewed"), locked(tmp_path):
        pass
    os.utime(tmp_path / ".lock", (0, 0))
    assert len(taken(tmp_path)) == 1


def until(condition) -> None:
    for _ in range(200):
        if condition():
            return
        time.sleep(0.02)
    raise AssertionError("not in four seconds")


def test_a_lock_is_renewed_and_a_driver_that_loses_it_stops(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "RENEW_INTERVAL", 0.05)
    path = tmp_path / ".lock"
    with locked(tmp_path) as own:
        log = Log(tmp_path / "log", own.check)
        os.utime(path, (0, 0))
        until(lambda: path.stat().st_mtime > 1)
        path.unlink()
        until(path.exists)
        log.write("unit")
        held_by(tmp_path, host="elsewhere")
        until(lambda: own._lost_to)
        with pytest.raises(UserError, match=r"a driver on elsewhere \(process \d+\) has taken the store"):
            log.write("unit")
    assert json.loads(path.read_bytes())["id"] == "other", "a lock of another driver stays"
    assert len((tmp_path / "log" / f"{log.name}.jsonl").read_text().splitlines()) == 1


def test_a_lock_is_released_by_an_error_and_ends_its_thread(tmp_path):
    with pytest.raises(RuntimeError), locked(tmp_path):
        raise RuntimeError
    assert not (tmp_path / ".lock").exists()
    assert "renewal of the lock" not in {thread.name for thread in threading.enumerate()}
