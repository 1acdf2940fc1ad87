"""Seams within a square, in machine code: as ``seams.seams_missed`` finds them."""

from typing import no_type_check

import numpy as np

from torchcal.render.machine_code.compiled import leaf
from torchcal.render.machine_code.cover import is_inside
from torchcal.render.seams import FLUSH, INSET

SEAMS = 16
"""Most seams in one square."""
SEAM = -2
"""Stands for the line of a seam that was missed."""


@leaf
@no_type_check
def add_seams(count, number, shown, facing, found, faces, lines):
    """Adds the lines in which faces pass through what is seen in cells; how many lines there are.

    Near a corner of the cell another face is in front of the one that is seen in the middle.
    """
    forms, name, least, order = facing
    (sides, _), (_, spot) = shown
    before = number
    for c in range(count):
        place = spot[c]
        if place < 0:
            continue
        own = forms[place, 9], forms[place, 10], forms[place, 11]
        nearest, flush = min(_in_corners(own, sides, c)), FLUSH * own[2]
        for k in range(found):
            i = order[k]
            if least[i] * nearest > 1.0 or number - before == SEAMS:
                break
            gap = forms[i, 9] - own[0], forms[i, 10] - own[1], forms[i, 11] - own[2]
            ahead = gap[2] + 0.5 * (abs(gap[0]) + abs(gap[1])) > flush
            if ahead and _is_ahead((i, place), gap, flush, forms, sides, c):
                if not _are_related(faces, name[place], name[i]):
                    number = _add_seam(gap, before, number, lines)
    return number


@leaf
@no_type_check
def _is_ahead(pair, gap, flush, forms, sides, c):
    """Whether near a corner of a cell both faces are there and the first one is in front."""
    ahead = _in_corners(gap, sides, c)
    for corner in range(4):
        if ahead[corner] > flush:
            point = _near_corner(corner, sides, c)
            if is_inside(forms, pair[0], point) and is_inside(forms, pair[1], point):
                return True
    return False


@leaf
@no_type_check
def _near_corner(corner, sides, c):
    """A place (x, y) near a corner of a cell: as ``seams.near_corners``."""
    x = 0.25 * (sides[c, 2] + sides[c, 3] + sides[c, 4] + sides[c, 5])
    y = 0.5 * (sides[c, 0] + sides[c, 1])
    u, v = sides[c, 2 + corner], sides[c, corner % 2]
    return u + INSET * (x - u), v + INSET * (y - v)


@leaf
@no_type_check
def _in_corners(plane, sides, c):
    """What is linear in x and y in the corners of a cell."""
    low, high = plane[1] * sides[c, 0] + plane[2], plane[1] * sides[c, 1] + plane[2]
    return (
        plane[0] * sides[c, 2] + low,
        plane[0] * sides[c, 3] + high,
        plane[0] * sides[c, 4] + low,
        plane[0] * sides[c, 5] + high,
    )


@leaf
@no_type_check
def _are_related(faces, a, b):
    """Whether two faces have a common vertex."""
    for i in range(3):
        for j in range(3):
            if faces[a, i] == faces[b, j]:
                return True
    return False


@leaf
@no_type_check
def _add_seam(gap, before, number, lines):
    """Adds the line where a gap closes if it crosses the square and is not yet there."""
    x, y, offset = gap
    size = np.sqrt(x * x + y * y)
    if not abs(offset) < size:
        return number
    # From the point nearest to the middle along the line, upwards, to the square's sides.
    point = (-offset * x / size / size, -offset * y / size / size)
    along = (-y / size, x / size) if x > 0.0 else (y / size, -x / size)
    first, last = -2.0, 2.0
    for axis in range(2):
        if abs(along[axis]) > 0.0:
            reach, middle = abs(0.5 / along[axis]), -point[axis] / along[axis]
            first, last = max(first, middle - reach), min(last, middle + reach)
    low, high, _, line, _ = lines
    for axis in range(2):
        low[number, axis] = min(max(point[axis] + first * along[axis], -0.5), 0.5)
        high[number, axis] = min(max(point[axis] + last * along[axis], -0.5), 0.5)
    line[number] = SEAM
    known = first >= last
    for i in range(before, number):
        same = low[i, 0] == low[number, 0] and low[i, 1] == low[number, 1]
        known |= same and high[i, 0] == high[number, 0] and high[i, 1] == high[number, 1]
    return number if known else number + 1
