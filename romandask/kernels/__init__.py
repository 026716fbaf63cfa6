"""Numerical work on one unit: arrays in, arrays out; no dask, no files."""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as _numpy  # noqa: F401
import scipy.linalg as _linalg  # noqa: F401
from threadpoolctl import threadpool_limits

from romandask.model.cache import cache_folder, is_writable

# The rounding of sums in linear algebra depends on the number of threads; pixels must not depend on the number of
# cores. NumPy and SciPy have each their own library, which must be loaded to be limited.
threadpool_limits(limits=1, user_api="blas")


def _choose_cache() -> None:
    """Let numba keep compiled code in the first place that can be written: the package, the user's cache, /tmp.

    Numba looks for a place when a function is decorated, and raises an error if it finds none. NUMBA_CACHE_DIR, if the
    user has set it, comes first; worker processes inherit the variable.
    """
    chosen, package = os.environ.get("NUMBA_CACHE_DIR"), Path(__file__).parent
    if chosen and is_writable(Path(chosen)):
        return
    if all(is_writable(path.parent / "__pycache__") for path in package.rglob("__init__.py")):
        return
    folder = cache_folder("numba")
    if folder is None:
        # imported here, because no other case needs numba before a kernel does
        from numba.core.dispatcher import Dispatcher  # noqa: PLC0415

        # nothing can be written: every process compiles what it needs
        dispatcher_class: Any = Dispatcher
        dispatcher_class.enable_caching = lambda dispatcher: None
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        # numba has read the environment already
        sys.modules["numba"].config.CACHE_DIR = str(folder)


_choose_cache()
