"""How this package compiles: one decorator, and rows shared out over threads.

Numba's own threading layers cannot be entered from two threads at once (some abort the
process), and their parallel code compiles slowly. So kernels are plain, release the
interpreter lock, and take a range of rows; `rows_in_parallel` runs them on this module's threads.
"""
from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar, cast

import numba

F = TypeVar('F', bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` with Numba: cached on disk, without the interpreter lock."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model='numpy')(function))


def fast_kernel(function: F) -> F:
    """Compile like `kernel`, with re-ordered arithmetic: not for code that meets NaN or Inf."""
    jit = numba.njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
    return cast(F, jit(function))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix='sphstereo')


def rows_in_parallel(function: Callable[..., Any], rows: int, *args: Any) -> None:
    """Call `function(first, last, *args)` for consecutive ranges that cover `rows` rows.

    Parameters
    ----------
    function : a kernel that releases the interpreter lock and writes only its own rows
    rows : number of rows
    args : passed on

    """
    threads = max(1, min(os.cpu_count() or 1, 8))
    if threads == 1 or rows < 64:
        function(0, rows, *args)
        return
    edges = [rows * i // threads for i in range(threads + 1)]
    jobs = [_pool(threads).submit(function, a, b, *args)
            for a, b in pairwise(edges)]
    for job in jobs:
        job.result()
