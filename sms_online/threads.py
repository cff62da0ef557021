"""One thread for BLAS: a sum that is split over threads is rounded differently for every number of threads.

The same samples must give the same bits, whatever the machine and whoever calls. The matrices are small; threads would
not make them faster either. BLAS is limited for the whole process, while any computation of this package runs in it.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

from threadpoolctl import ThreadpoolController

_lock = Lock()
_running = 0  # computations that run now, of all Python threads
_limit: Any = None


@cache
def _controller() -> ThreadpoolController:
    # NumPy and SciPy each bring a BLAS of their own, and a library has to be loaded to be limited.
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Generator[None]:
    """Limit BLAS to one thread, in a `with` block or as a decorator; the last computation to end gives it back.

    About 50 µs where nothing else runs yet, 1 µs within another: not for every sample.
    """
    global _running, _limit
    with _lock:
        if _running == 0:
            _limit = _controller().limit(limits=1, user_api="blas")
        _running += 1
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            if _running == 0:
                _limit.restore_original_limits()
