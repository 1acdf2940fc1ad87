"""What covers a square, in machine code: the faces that may reach into it, and which is first."""

from typing import no_type_check

import numpy as np

from torchcal.render.machine_code.cells import middle_of_cell
from torchcal.render.machine_code.compiled import leaf
from torchcal.render.machine_code.vectors import dot, plane, row
from torchcal.render.machine_code.zbuffer import side_of
from torchcal.render.pieces import BEHIND
from torchcal.render.regions import PROBES

NEARLY = 1.0 + 1e-6
"""What is farther than a hit by this factor is behind it, however it was rounded."""
STEPS = (1750, 701, 301, 132, 57, 23, 10, 4, 1)
"""Ciura's distances over which values are sorted by insertion."""


@leaf
@no_type_check
def planes_of_tile(tile, tiles, mesh, planes):
    """Enters the sides and the plane of every face of a tile; an offset of 0 where it has none."""
    first, entries, _ = tiles
    vertices, faces = mesh
    for i in range(first[tile + 1] - first[tile]):
        f = entries[first[tile] + i]
        corner = row(vertices, faces[f, 0])
        normal = plane(corner, row(vertices, faces[f, 1]), row(vertices, faces[f, 2]))
        offset = dot(normal, corner)
        for j in range(3):
            side = side_of(vertices, faces[f, j], faces[f, (j + 1) % 3], offset)
            for axis in range(3):
                planes[i, 3 * j + axis] = side[axis]
        for axis in range(3):
            planes[i, 9 + axis] = normal[axis]
        planes[i, 12] = offset


@leaf
@no_type_check
def faces_near(k, places, tiles, planes, frame, facing):
    """Enters the faces that may reach into a square, by what is linear in it; how many there are.

    Their sides and 1 / range are the factors of x, y and 1.
    """
    tile, column, line = places
    first, entries, boxes = tiles
    forms, number, least, order = facing
    begin, u, v, found = first[tile[k]], column[k], line[k], 0
    for i in range(begin, first[tile[k] + 1]):
        f = entries[i]
        # Boxes hold the centres of pixels, squares reach half a pixel farther.
        if not (
            boxes[f, 0] <= u + 1 and u <= boxes[f, 2] and boxes[f, 1] <= v + 1 and v <= boxes[f, 3]
        ):
            continue
        offset, touches = planes[i - begin, 12], True
        for j in range(4):
            size = offset if j == 3 else 1.0
            x, y, middle = _form(planes, i - begin, j, frame, size)
            forms[found, 3 * j], forms[found, 3 * j + 1], forms[found, 3 * j + 2] = x, y, middle
            most = middle + 0.5 * (abs(x) + abs(y))
            touches &= most >= 0.0
        if touches and abs(offset) > 0.0 and most > 0.0:
            number[found], least[found] = f, 1.0 / most
            found += 1
    _sort(found, least, order)
    return found


@leaf
@no_type_check
def _form(planes, i, j, frame, size):
    """The factors of x, y and 1 of one of a face's normals over a size."""
    origin, to_u, to_v = frame
    normal = planes[i, 3 * j], planes[i, 3 * j + 1], planes[i, 3 * j + 2]
    return dot(normal, to_u) / size, dot(normal, to_v) / size, dot(normal, origin) / size


@leaf
@no_type_check
def _sort(count, values, order):
    """Enters the places of some values in ascending order: by insertion over ever less distance."""
    for i in range(count):
        order[i] = i
    for step in STEPS:
        for i in range(step, count):
            this, j = order[i], i
            while j >= step and values[order[j - step]] > values[this]:
                order[j] = order[j - step]
                j -= step
            order[j] = this


@leaf
@no_type_check
def look(count, cells, facing, found, seen):
    """The first face in the middle of each cell, and its place among those near; -1: none."""
    (sides, _), (face, place) = cells, seen
    for c in range(count):
        _, k = _first(middle_of_cell(sides, c), facing, found)
        face[c], place[c] = facing[1][k] if k >= 0 else -1, k


@leaf
@no_type_check
def uncovered(number, lines, facing, found):
    """Leaves out pieces that are behind a face at both ends and in the middle; how many stay."""
    low, high, _, line, distance = lines
    stay = 0
    for i in range(number):
        covered = True
        for share in PROBES:
            x = low[i, 0] + share * (high[i, 0] - low[i, 0])
            y = low[i, 1] + share * (high[i, 1] - low[i, 1])
            # Inverse ranges are linear in the image.
            inverse = (1.0 - share) / distance[i, 0] + share / distance[i, 1]
            if covered:
                nearest, _ = _first((x, y), facing, found)
                covered = nearest * inverse < 1.0 - BEHIND
        if not covered:
            for axis in range(2):
                low[stay, axis], high[stay, axis] = low[i, axis], high[i, axis]
            line[stay] = line[i]
            stay += 1
    return stay


@leaf
@no_type_check
def _first(point, facing, found):
    """Range of the face that is first at a point, and its place: as in the z-buffer."""
    forms, number, least, order = facing
    depth, first = np.float32(np.inf), -1
    for k in range(found):
        i = order[k]
        if least[i] > NEARLY * depth:
            break
        if is_inside(forms, i, point):
            t = np.float32(1.0 / inverse_range(forms, i, point))
            if 0.0 < t < depth or (t == depth and number[i] < number[first]):
                depth, first = t, i
    return depth, first


@leaf
@no_type_check
def is_inside(forms, i, point):
    """Whether a point of a square is within the sides of a face near."""
    inside = True
    for j in range(3):
        inside &= _value(forms, i, j, point) >= 0.0
    return inside


@leaf
@no_type_check
def inverse_range(forms, i, point):
    """1 / range at which the ray of a point of a square meets the plane of a face near."""
    return _value(forms, i, 3, point)


@leaf
@no_type_check
def _value(forms, i, j, point):
    return forms[i, 3 * j] * point[0] + forms[i, 3 * j + 1] * point[1] + forms[i, 3 * j + 2]
