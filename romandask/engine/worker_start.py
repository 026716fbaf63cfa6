"""What the driver sees to before local worker processes start: signals, the resource tracker, and the main guard."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory

from romandask.model.errors import UserError

_MARK = "_ROMANDASK_NO_MAIN_GUARD"
"""Environment variable with the path of a file that a worker creates if it runs the script of its driver again."""


@contextmanager
def sigint_blocked() -> Iterator[None]:
    """Block SIGINT in this thread, and in all threads and processes that it starts meanwhile.

    Ctrl-C goes to all processes of a terminal. The driver handles it and ends its workers; they would print tracebacks.
    A process inherits the blocked signals of the thread that starts it, one that replaces a dead worker too.
    """
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def start_resource_tracker() -> None:
    """Start multiprocessing's tracker of semaphores before anything else does.

    It removes the semaphores of processes that could not do so: of a worker that was killed, or of a driver that ended
    at once. Its warning of these "leaked semaphore objects" would be the last line of a run and says nothing to a user.
    Besides, it unblocks SIGINT in the thread that starts it, which must not be the thread that starts workers.
    """
    filters = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore::UserWarning:multiprocessing.resource_tracker"
    try:
        resource_tracker.ensure_running()
    finally:
        del os.environ["PYTHONWARNINGS"]
        if filters is not None:
            os.environ["PYTHONWARNINGS"] = filters


@contextmanager
def main_guard_demanded() -> Iterator[None]:
    """Raise a UserError that says so if worker processes run the script of the driver again, as they must not.

    A worker process imports the main module of its driver before anything else. Without a main guard, it comes here
    again; it leaves a mark for the driver and ends, without the traceback that multiprocessing would print.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        if mark := os.environ.get(_MARK):
            Path(mark).touch()
        sys.exit(1)
    with TemporaryDirectory(prefix="romandask-") as folder:
        os.environ[_MARK] = str(Path(folder) / "no-main-guard")
        try:
            yield
        except UserError:
            if not script_ran_again():
                raise
            script = getattr(sys.modules["__main__"], "__file__", "the script")
            raise UserError(
                f"{script}: worker processes import this script, and must not run it again: put what it does below "
                'if __name__ == "__main__":'
            ) from None
        finally:
            del os.environ[_MARK]


def script_ran_again() -> bool:
    """Return whether a worker has run the script of this driver again."""
    return Path(os.environ.get(_MARK, "")).is_file()
