"""Seams within a square, in machine code: as ``seams.seams_missed`` finds them."""

from typing import no_type_check

import numpy as np

from torchcal.render.machine_code.cells import ray_of
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

    Near a corner of the cell another face is in front of the one that is seen in the middle.
    """
    planes, name, least, order = facing
    (sides, _), (_, spot) = shown
    before = number
    for c in range(count):
        place = spot[c]
        if place < 0:
            continue
        own = _inverse(planes[place], frame)
        nearest = min(_in_corners(own, sides[c]))
        for k in range(found):
            i = order[k]
            if least[i] * nearest > 1.0 or number - before == SEAMS:
                break
            other = _inverse(planes[i], frame)
            gap = (other[0] - own[0], other[1] - own[1], other[2] - own[2])
            for corner in range(4):
                if _in_corners(gap, sides[c])[corner] > FLUSH * own[2]:
                    ray = _near_corner(corner, sides[c], frame)
                    both = is_inside(planes[i], ray) and is_inside(planes[place], ray)
                    if both and not _are_related(faces, name[place], name[i]):
                        number = _add_seam(gap, before, number, lines)
                        break
    return number


@compiled
@no_type_check
def _near_corner(corner, sides, frame):
    """The ray of a place near a corner of a cell: as ``seams.near_corners``."""
    x = 0.25 * (sides[2] + sides[3] + sides[4] + sides[5])
    y = 0.5 * (sides[0] + sides[1])
    u, v = sides[2 + corner], sides[corner % 2]
    return ray_of(frame, u + INSET * (x - u), v + INSET * (y - v))


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
