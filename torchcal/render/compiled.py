"""What the modules in machine code share. It needs numba: only they import it."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from numba import njit

_Task = TypeVar("_Task")

compiled = njit(nogil=True, cache=True, error_model="numpy")
"""Without fast-math: results are those of the same operations on tensors, to the last bit."""


def in_threads(work: Callable[[_Task], None], tasks: Sequence[_Task]) -> None:
    """Does all tasks, in as many threads as torch has."""
    threads = min(torch.get_num_threads(), len(tasks))
    if threads < 2:
        for task in tasks:
            work(task)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, tasks))
