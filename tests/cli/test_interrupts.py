"""A run that is stopped by a signal: what it says, its exit code, its lock and its workers."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from conftest import MINI

from romandask.storage.lock import locked

pytestmark = pytest.mark.slow


def running(folder: Path) -> subprocess.Popen:
    """Start a run with two workers in a process group of its own, and wait until units are made."""
    run = subprocess.Popen(
        [sys.executable, "-m", "romandask", "run", "tiny", "--store", "s", "--workers", "2", *MINI],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    for line in run.stdout:
        if line.startswith("truth/"):
            break
    assert len(processes_of(run)) >= 3, "the driver and its workers"
    return run


def processes_of(run: subprocess.Popen) -> list[psutil.Process]:
    """Return the processes of the session of a run that have not ended."""
    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == run.pid and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except (ProcessLookupError, psutil.NoSuchProcess):
            continue
    return found


def all_end(run: subprocess.Popen) -> bool:
    for _ in range(100):
        if not processes_of(run):
            return True
        time.sleep(0.1)
    return False


@pytest.mark.parametrize(
    ("number", "of_all", "code"),
    [(signal.SIGINT, True, 130), (signal.SIGTERM, False, 143), (signal.SIGTERM, True, 143)],
    ids=["Ctrl-C", "SIGTERM", "SIGTERM of all processes"],
)
def test_a_signal_ends_a_run_with_one_line_and_releases_the_store(tmp_path, number, of_all, code):
    """A terminal sends SIGINT, and some batch systems SIGTERM, to all processes of a job."""
    run = running(tmp_path)
    (os.killpg if of_all else os.kill)(run.pid, number)
    output, errors = run.communicate(timeout=100)
    assert run.returncode == code
    assert errors == "stopped; the same command resumes\n"
    assert "Traceback" not in output
    assert all_end(run)
    assert not (tmp_path / "s" / ".lock").exists()
    assert '"how": "stopped"' in next((tmp_path / "s" / "log").glob("*.jsonl")).read_text().splitlines()[-1]


def test_a_second_signal_ends_a_run_at_once_and_its_lock_does_not_count(tmp_path):
    run = running(tmp_path)
    os.killpg(run.pid, signal.SIGINT)
    time.sleep(0.3)
    os.killpg(run.pid, signal.SIGTERM)
    _, errors = run.communicate(timeout=20)
    assert run.returncode == 143
    assert errors == ""
    assert all_end(run)
    with locked(tmp_path / "s"):
        pass


def test_a_signal_during_the_start_of_a_run_ends_it_with_one_line(tmp_path):
    command = [sys.executable, "-m", "romandask", "run", "tiny", "--store", "s", *MINI]
    run = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    # the handlers are set before the libraries are imported
    while run.poll() is None and not any("numpy" in mapped.path for mapped in psutil.Process(run.pid).memory_maps()):
        time.sleep(0.05)
    run.terminate()
    output, errors = run.communicate(timeout=100)
    assert run.returncode == 143
    assert (output, errors) == ("", "stopped; the same command resumes\n")
    assert not (tmp_path / "s").exists()
