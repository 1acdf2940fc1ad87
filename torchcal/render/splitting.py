"""Cells in machine code, for the CPU: the same as ``cells.py`` to the last bit, faster."""

from typing import no_type_check

import numpy as np
import torch

from torchcal.render.cells import THIN, Cells
from torchcal.render.compiled import compiled
from torchcal.render.pieces import Pieces


def cells_of(pieces: Pieces, squares: int) -> Cells:
    """As ``cells.cells_of``."""
    starts = np.zeros(squares + 1, np.int64)
    np.cumsum(np.bincount(pieces.square.numpy(), minlength=squares), out=starts[1:])
    low, high = pieces.low.contiguous().numpy(), pieces.high.contiguous().numpy()
    square, sides, piece = _cells(starts, low, high)
    sides = torch.from_numpy(sides)
    return Cells(
        square=torch.from_numpy(square),
        y=sides[:, 0:2],
        left=sides[:, 2:4],
        right=sides[:, 4:6],
        piece=torch.from_numpy(piece),
    )


@compiled
@no_type_check
def _cells(starts, low, high):
    """Squares, sides (y, left x, right x: lower and upper) and pieces at the right of all cells."""
    most, total = 0, 0
    for k in range(len(starts) - 1):
        count = starts[k + 1] - starts[k]
        cuts = 1 + 2 * count + count * (count - 1) // 2
        most = max(most, cuts + 1)
        total += cuts * (count + 1) if count else 0
    square, piece = np.empty(total, np.int64), np.empty(total, np.int64)
    sides = np.empty((total, 6))
    cuts, slope = np.empty(most), np.empty(len(low))
    for i in range(len(low)):
        height = high[i, 1] - low[i, 1]
        slope[i] = 0.0 if height < THIN else (high[i, 0] - low[i, 0]) / height
    at = 0
    for k in range(len(starts) - 1):
        begin, end = starts[k], starts[k + 1]
        if begin < end:
            number = _cuts(begin, end, low, high, slope, cuts)
            for j in range(number - 1):
                if cuts[j + 1] - cuts[j] > THIN:
                    slab = (cuts[j], cuts[j + 1])
                    after = _slab(begin, end, slab, (low, high, slope), at, sides, piece)
                    square[at:after] = k
                    at = after
    return square[:at].copy(), sides[:at].copy(), piece[:at].copy()


@compiled
@no_type_check
def _cuts(begin, end, low, high, slope, cuts):
    """Sorts the y of the square's sides and of the ends and meetings of its pieces."""
    cuts[0], cuts[1] = -0.5, 0.5
    number = 2
    for i in range(begin, end):
        cuts[number], cuts[number + 1] = low[i, 1], high[i, 1]
        number += 2
        for j in range(i + 1, end):
            first, last = max(low[i, 1], low[j, 1]), min(high[i, 1], high[j, 1])
            if first < last:
                a = _x(low, slope, i, first) - _x(low, slope, j, first)
                b = _x(low, slope, i, last) - _x(low, slope, j, last)
                if a * b < 0:
                    cuts[number] = first + (last - first) * (a / (a - b))
                    number += 1
    cuts[:number].sort()
    return number


@compiled
@no_type_check
def _slab(begin, end, slab, lines, at, sides, piece):
    """Enters the cells of one slab from left to right; where the next slab's begin."""
    low, high, slope = lines
    middle = 0.5 * (slab[0] + slab[1])
    first = at
    for i in range(begin, end):
        if low[i, 1] <= slab[0] and high[i, 1] >= slab[1]:
            # Insertion: the pieces at the right of the cells stay sorted at the slab's middle.
            x, j = _x(low, slope, i, middle), at
            while j > first and _x(low, slope, piece[j - 1], middle) > x:
                piece[j] = piece[j - 1]
                j -= 1
            piece[j] = i
            at += 1
    piece[at] = -1
    for k in range(2):
        left = -0.5
        for j in range(first, at + 1):
            right = 0.5
            if piece[j] >= 0:
                right = min(max(_x(low, slope, piece[j], slab[k]), -0.5), 0.5)
            sides[j, k], sides[j, 2 + k], sides[j, 4 + k] = slab[k], left, max(left, right)
            left = right
    return at + 1


@compiled
@no_type_check
def _x(low, slope, i, y):
    return low[i, 0] + slope[i] * (y - low[i, 1])
