"""The number of threads of the numerical libraries, on which the order of sums and so the last bits depend."""

from __future__ import annotations

import importlib
import os
from collections.abc import Generator
from contextlib import contextmanager

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextmanager
def limited_threads(threads: int) -> Generator[None]:
    """Limit the threads of BLAS and OpenCV in this process."""
    import cv2
    from threadpoolctl import threadpool_limits

    importlib.import_module("scipy.linalg")  # its BLAS must be loaded to be limited
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        with threadpool_limits(threads):
            yield
    finally:
        cv2.setNumThreads(before)


@contextmanager
def thread_environment(threads: int) -> Generator[None]:
    """Limit the threads of processes started in the `with` block, regardless of the environment."""
    before = {variable: os.environ.get(variable) for variable in VARIABLES}
    os.environ.update(dict.fromkeys(VARIABLES, str(threads)))
    try:
        yield
    finally:
        for variable, value in before.items():
            if value is None:
                del os.environ[variable]
            else:
                os.environ[variable] = value
