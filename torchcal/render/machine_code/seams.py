"""Seams within a square, in machine code: as ``seams.seams_missed`` finds them."""

from typing import no_type_check

import numpy as np

from torchcal.render.machine_code.cells import ray_of, ray_of_cell
from torchcal.render.machine_code.compiled import compiled
from torchcal.render.machine_code.cover import is_inside
from torchcal.render.machine_code.vectors import dot
from torchcal.render.seams import FLUSH, INSET

SEAMS = 16
"""Most seams in one square."""
SEAM = -2
"""Stands for the line of a seam that was missed."""


@compiled
@no_type_check
def add_seams(count, number, shown, facing, found, faces, frame, lines):
    """Adds the lines in which faces pass through what is seen in cells; how many lines there are.

    A face in a cell whose plane is in front in a corner of it meets what is seen.
    """
    planes, name, least, order = facing
    (sides, _), (_, spot) = shown
    before = number
    for c in range(count):
        place = spot[c]
        if place < 0:
            continue
        own = _inverse(planes[place], frame)
        farthest = 1.0 / min(_in_corners(own, sides[c]))
        for k in range(found):
            i = order[k]
            if least[i] > farthest or number - before == SEAMS:
                break
            if i == place:
                continue
            other = _inverse(planes[i], frame)
            gap = (other[0] - own[0], other[1] - own[1], other[2] - own[2])
            if max(_in_corners(gap, sides[c])) > FLUSH * own[2]:
                related = _are_related(faces, name[place], name[i])
                if not related and _reaches_into(planes[i], sides[c], frame):
                    number = _add_seam(gap, before, number, lines)
    return number


@compiled
@no_type_check
def _reaches_into(plane, sides, frame):
    """Whether a face holds the middle of a cell or a place near one of its corners."""
    if is_inside(plane, ray_of_cell(sides, frame)):
        return True
    x = 0.25 * (sides[2] + sides[3] + sides[4] + sides[5])
    y = 0.5 * (sides[0] + sides[1])
    for k in range(4):
        u = sides[2 + k] + INSET * (x - sides[2 + k])
        v = sides[k % 2] + INSET * (y - sides[k % 2])
        if is_inside(plane, ray_of(frame, u, v)):
            return True
    return False


@compiled
@no_type_check
def _in_corners(plane, sides):
    """What is linear in x and y in the corners of a cell."""
    low, high = plane[1] * sides[0] + plane[2], plane[1] * sides[1] + plane[2]
    return (
        plane[0] * sides[2] + low,
        plane[0] * sides[3] + high,
        plane[0] * sides[4] + low,
        plane[0] * sides[5] + high,
    )


@compiled
@no_type_check
def _are_related(faces, a, b):
    """Whether two faces have a common vertex."""
    for i in range(3):
        for j in range(3):
            if faces[a, i] == faces[b, j]:
                return True
    return False


@compiled
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


@compiled
@no_type_check
def _inverse(p, frame):
    """1 / range on a face's plane: the factors of x, y and 1."""
    origin, to_u, to_v = frame
    normal = (p[9], p[10], p[11])
    return dot(normal, to_u) / p[12], dot(normal, to_v) / p[12], dot(normal, origin) / p[12]
