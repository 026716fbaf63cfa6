"""Resident memory of a process: its peak, and the release of free memory to the operating system."""

from __future__ import annotations

import ctypes
import re
import resource
from contextlib import suppress
from pathlib import Path

INTERPRETER = 520 << 20
"""Bytes that a worker holds between units: Python, modules, products, and cached detector and spectral data."""


def release_free_memory() -> None:
    """Return free heap memory to the operating system, if the C library can (glibc).

    What the first half of a unit leaves free on the heap is about a tenth of a worker's memory.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def reset_peak() -> int:
    """Reset the peak that `peak_memory` reports, and return the memory that the process holds now, bytes.

    Only Linux can reset the peak; elsewhere the peak since the start of the process is returned.
    """
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return peak_memory()


def peak_memory() -> int:
    """Return the peak resident memory, bytes, of this process since the last `reset_peak`."""
    try:
        match = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        match = None
    return (int(match.group(1)) if match else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * 1024
