"""Interrupts of a command: Ctrl-C (SIGINT) and SIGTERM, which batch systems and Kubernetes send."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
RESUMABLE = "stopped; the same command resumes"


class _Stopped(KeyboardInterrupt):
    """The first signal; a KeyboardInterrupt, because no library takes that for an error of its own."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


@contextmanager
def resumable(text: str = RESUMABLE) -> Iterator[None]:
    """Turn SIGINT and SIGTERM into one line on standard error and exit code 130 or 143.

    The first signal stops the work in order: locks are released and workers end. A second one ends the process at once;
    its local workers end when they notice that it is gone.

    Parameters
    ----------
    text : str
        The line. Stored units stay, so the same command resumes.
    """
    # handlers can be set in the main thread only; elsewhere, signals are the concern of who started the thread
    of_main_thread = threading.current_thread() is threading.main_thread()
    previous = {number: signal.signal(number, _stop) for number in _SIGNALS} if of_main_thread else {}
    try:
        yield
    except KeyboardInterrupt as stop:
        print(text, file=sys.stderr)
        number = stop.number if isinstance(stop, _Stopped) else signal.SIGINT
        raise typer.Exit(128 + number) from None
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _stop(number: int, frame: Any) -> None:
    for each in _SIGNALS:
        signal.signal(each, _end_at_once)
    raise _Stopped(number)


def _end_at_once(number: int, frame: Any) -> None:
    os._exit(128 + number)
