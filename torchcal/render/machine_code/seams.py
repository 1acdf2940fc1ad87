"""Seams within a square, in machine code: as ``seams.seams_missed`` finds them."""

from typing import no_type_check

import numpy as np

from torchcal.render.machine_code.compiled import compiled
from torchcal.render.machine_code.vectors import dot, plane
from torchcal.render.seams import CLOSE

SEAMS = 16
"""Most seams in one square."""
SEAM = -2
"""Stands for the line of a seam that was missed."""


@compiled
@no_type_check
def add_seams(count, number, cells, face, mesh, frame, lines):
    """Adds the seams between faces seen in cells one upon the other; how many lines there are."""
    sides, before = cells[0], number
    begin = middle = 0
    for end in range(1, count + 1):
        if end < count and sides[end, 0] == sides[middle, 0]:
            continue
        # The slab from ``middle`` to ``end`` lies upon the one from ``begin`` to ``middle``.
        for i in range(begin, middle):
            for j in range(middle, end):
                width = min(sides[i, 5], sides[j, 4]) - max(sides[i, 3], sides[j, 2])
                a, b = min(face[i], face[j]), max(face[i], face[j])
                known = width <= CLOSE or a < 0 or a == b or number - before == SEAMS
                if not known and not _are_related(mesh[1], a, b):
                    number = _add_seam(a, b, mesh, frame, before, number, lines)
        begin, middle = middle, end
    return number


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
def _add_seam(a, b, mesh, frame, before, number, lines):
    """Adds the line in which two planes meet if it crosses the square and is not yet there."""
    one, other = _inverse(a, mesh, frame), _inverse(b, mesh, frame)
    x, y, offset = one[0] - other[0], one[1] - other[1], one[2] - other[2]
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
    low, high, _, line = lines
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
def _inverse(face, mesh, frame):
    """1 / range on a face's plane: the factors of x, y and 1."""
    vertices, faces = mesh
    corner = vertices[faces[face, 0]]
    normal = plane(corner, vertices[faces[face, 1]], vertices[faces[face, 2]])
    offset = dot(normal, corner)
    origin, to_u, to_v = frame
    return dot(normal, to_u) / offset, dot(normal, to_v) / offset, dot(normal, origin) / offset
