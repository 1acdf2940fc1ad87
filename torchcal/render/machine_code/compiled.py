"""What the modules in machine code share. It needs numba: only they import it."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from numba import njit

_Task = TypeVar("_Task")
_Done = TypeVar("_Done")

PART = 512
"""Things that a thread takes at a time."""

_njit: Any = njit  # its stubs do not know ``_nrt``

compiled = njit(nogil=True, cache=True, error_model="numpy")
"""Without fast-math: results are those of the same operations on tensors, to the last bit."""
leaf = _njit(nogil=True, cache=True, error_model="numpy", _nrt=False)
"""The same for functions that make no arrays: none of them counts references to those it is given,
which would cost more than most of them do, above all where threads count the same ones."""


def in_threads(work: Callable[[_Task], _Done], tasks: Sequence[_Task]) -> list[_Done]:
    """Does all tasks, in as many threads as torch has; what they return, in order."""
    threads = min(torch.get_num_threads(), len(tasks))
    if threads < 2:
        return [work(task) for task in tasks]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, tasks))


def parts_of(count: int) -> list[tuple[int, int]]:
    """Begins and ends of parts of so many things, of a size that is worth a task."""
    return [(at, min(at + PART, count)) for at in range(0, count, PART)] or [(0, 0)]
