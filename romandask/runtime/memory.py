"""Memory of a process, and how it goes back to the system."""

from __future__ import annotations

import ctypes


def give_back() -> None:
    """Give free memory to the system, where the C library can: what a unit's first half took is a tenth of a worker."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
