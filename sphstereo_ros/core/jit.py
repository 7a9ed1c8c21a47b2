"""How this package compiles: one decorator, and rows shared out over threads.

Numba's own threading layers cannot be entered from two threads at once (some abort the
process), and their parallel code compiles slowly. So kernels are plain, release the
interpreter lock, and take a range of rows; `rows_in_parallel` runs them on this module's threads.
"""
from __future__ import annotations

import os
from collections import deque
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


_LEAST_ROWS = 64
_PIECES_PER_THREAD = 3


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix='sphstereo')


@cache
def _threads() -> int:
    return max(1, min(os.cpu_count() or 1, 8))


def _work_off(pieces: deque[tuple[int, int]], function: Callable[..., Any],
              args: tuple[Any, ...]) -> None:
    while True:
        try:
            first, last = pieces.popleft()
        except IndexError:
            return
        function(first, last, *args)


def rows_in_parallel(function: Callable[..., Any], rows: int, *args: Any,
                     pieces: int = 0) -> None:
    """Call `function(first, last, *args)` for consecutive ranges that cover `rows` rows.

    The calling thread works too, and waits only for what others have begun: where the other cores
    are busy, it does everything by itself.

    Parameters
    ----------
    function : a kernel that releases the interpreter lock and writes only its own rows
    rows : number of rows
    args : passed on
    pieces : number of ranges, where the result depends on it; 0 = as suits this machine

    """
    suited = min(_threads() * _PIECES_PER_THREAD, rows // _LEAST_ROWS) if _threads() > 1 else 1
    count = min(pieces, rows) or suited
    if count < 2:
        function(0, rows, *args)
        return
    waiting = deque(pairwise(rows * i // count for i in range(count + 1)))
    helpers = _threads() - 1
    jobs = [_pool(helpers).submit(_work_off, waiting, function, args) for _ in range(helpers)]
    _work_off(waiting, function, args)
    for job in jobs:
        if not job.cancel():
            job.result()
