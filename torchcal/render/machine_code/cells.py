"""Cells of one square in machine code: the same as ``cells.py`` cuts."""

from typing import no_type_check

import numpy as np

from torchcal.render.cells import THIN
from torchcal.render.machine_code.compiled import leaf
from torchcal.render.squares import Squares


def frames_of(squares: Squares) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rays at the middle of squares, and how they turn along x and along y."""
    origin, to_u, to_v = (
        axis.contiguous().numpy() for axis in (squares.origin, squares.along_u, squares.along_v)
    )
    return origin, to_u, to_v


@leaf
@no_type_check
def cut_into_cells(number, lines, cuts, cells):
    """Enters the cells (y, left x, right x: lower and upper) and the pieces at their right.

    Args:
        number: Of pieces.
        lines: Their lower ends, upper ends, room for their slopes, numbers, ranges at both ends.
        cuts: Room for the y of all slabs.
        cells: Where the cells are entered.
    """
    low, high, slope, _, _ = lines
    for i in range(number):
        height = high[i, 1] - low[i, 1]
        slope[i] = 0.0 if height < THIN else (high[i, 0] - low[i, 0]) / height
    slabs, count = _cuts(number, lines, cuts), 0
    for j in range(slabs - 1):
        if cuts[j + 1] - cuts[j] > THIN:
            count = _slab(number, (cuts[j], cuts[j + 1]), lines, count, cells)
    return count


@leaf
@no_type_check
def middle_of_cell(sides, c):
    """The centroid (x, y) of a cell: see ``cells.Cells``."""
    a, b = sides[c, 4] - sides[c, 2], sides[c, 5] - sides[c, 3]
    share = (a + 2.0 * b) / (3.0 * (a + b)) if a + b > 0.0 else 0.5
    low, high = 0.5 * (sides[c, 2] + sides[c, 4]), 0.5 * (sides[c, 3] + sides[c, 5])
    return low + share * (high - low), sides[c, 0] + share * (sides[c, 1] - sides[c, 0])


@leaf
@no_type_check
def ray_of(frame, point):
    """The ray of a point of a square: see ``Squares.rays``."""
    (o, u, v), (x, y) = frame, point
    return (o[0] + x * u[0] + y * v[0], o[1] + x * u[1] + y * v[1], o[2] + x * u[2] + y * v[2])


@leaf
@no_type_check
def _cuts(number, lines, cuts):
    """Sorts the y of the square's sides and of the ends and meetings of its pieces."""
    low, high, slope, _, _ = lines
    cuts[0], cuts[1] = -0.5, 0.5
    count = 2
    for i in range(number):
        cuts[count], cuts[count + 1] = low[i, 1], high[i, 1]
        count += 2
        for j in range(i + 1, number):
            first, last = max(low[i, 1], low[j, 1]), min(high[i, 1], high[j, 1])
            if first < last:
                a = _x(low, slope, i, first) - _x(low, slope, j, first)
                b = _x(low, slope, i, last) - _x(low, slope, j, last)
                if a * b < 0:
                    cuts[count] = first + (last - first) * (a / (a - b))
                    count += 1
    # Insertion: there are few.
    for i in range(1, count):
        value, j = cuts[i], i
        while j > 0 and cuts[j - 1] > value:
            cuts[j] = cuts[j - 1]
            j -= 1
        cuts[j] = value
    return count


@leaf
@no_type_check
def _slab(number, slab, lines, at, cells):
    """Enters the cells of one slab from left to right; where the next slab's begin."""
    low, high, slope, _, _ = lines
    sides, piece = cells
    middle = 0.5 * (slab[0] + slab[1])
    first = at
    for i in range(number):
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


@leaf
@no_type_check
def _x(low, slope, i, y):
    return low[i, 0] + slope[i] * (y - low[i, 1])
