"""Memory of a process: how much it has held, and how it goes back to the system."""

from __future__ import annotations

import ctypes
import re
import resource
from contextlib import suppress
from pathlib import Path

INTERPRETER = 480 << 20
"""Bytes of a worker between units: Python, what is imported, and what it keeps of detectors and spectra."""


def release_free_memory() -> None:
    """Give free memory to the system, where the C library can: what a unit's first half took is a tenth of a worker."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def reset_peak() -> int:
    """Let `peak_memory` begin anew, where the system can (Linux), and return what it is now: what the process holds."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return peak_memory()


def peak_memory() -> int:
    """Return the most resident memory, bytes, that this process has had since `reset_peak`."""
    try:
        found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        found = None
    return (int(found.group(1)) if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * 1024
