"""What covers a square, in machine code: the faces that may reach into it, and which is first."""

from typing import no_type_check

import numpy as np

from torchcal.render.machine_code.cells import ray_of, ray_of_cell
from torchcal.render.machine_code.compiled import compiled
from torchcal.render.machine_code.vectors import cross, dot, plane
from torchcal.render.machine_code.zbuffer import side_of
from torchcal.render.pieces import BEHIND
from torchcal.render.regions import PROBES

NEARLY = 1.0 + 1e-6
"""What is farther than a hit by this factor is behind it, however it was rounded."""
FEW = 32
"""More values than this are not sorted by insertion."""


@compiled
@no_type_check
def faces_near(k, places, tiles, mesh, frame, facing):
    """Enters the sides and planes of the faces that may reach into a square; how many there are.

    In the square ranges are linear in space: no face is nearer than the nearest of its corners.
    """
    tile, column, line = places
    first, entries, boxes = tiles
    vertices, faces = mesh
    origin, to_u, to_v = frame
    planes, number, least, order = facing
    ahead = cross(to_u, to_v)
    size = dot(ahead, origin)
    u, v, found = column[k], line[k], 0
    for i in range(first[tile[k]], first[tile[k] + 1]):
        f = entries[i]
        # Boxes hold the centres of pixels, squares reach half a pixel farther.
        if not (
            boxes[f, 0] <= u + 1 and u <= boxes[f, 2] and boxes[f, 1] <= v + 1 and v <= boxes[f, 3]
        ):
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        normal = plane(vertices[a], vertices[b], vertices[c])
        offset = dot(normal, vertices[a])
        touches = abs(offset) > 0.0
        for j in range(3):
            start, end = faces[f, j], faces[f, (j + 1) % 3]
            side = side_of(vertices, start, end, offset)
            reach = 0.5 * (abs(dot(side, to_u)) + abs(dot(side, to_v)))
            touches &= dot(side, origin) + reach >= 0.0
            if not touches:
                break
            for axis in range(3):
                planes[found, 3 * j + axis] = side[axis]
        if touches:
            for axis in range(3):
                planes[found, 9 + axis] = normal[axis]
            planes[found, 12] = offset
            number[found] = f
            ends = dot(ahead, vertices[a]), dot(ahead, vertices[b]), dot(ahead, vertices[c])
            least[found] = min(ends[0] / size, ends[1] / size, ends[2] / size)
            found += 1
    _sort(found, least, order)
    return found


@compiled
@no_type_check
def _sort(count, values, order):
    """Enters the places of some values in ascending order: mostly a few, by insertion."""
    if count > FEW:
        order[:count] = np.argsort(values[:count])
        return
    for i in range(count):
        j = i
        while j > 0 and values[order[j - 1]] > values[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i


@compiled
@no_type_check
def look(count, cells, frame, facing, found, seen):
    """The face that the ray of each cell meets first, and its place among those near; -1: none."""
    face, place = seen
    for c in range(count):
        _, k = _first(ray_of_cell(cells[0][c], frame), facing, found)
        face[c], place[c] = facing[1][k] if k >= 0 else -1, k


@compiled
@no_type_check
def uncovered(number, lines, frame, facing, found):
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
                nearest, _ = _first(ray_of(frame, x, y), facing, found)
                covered = nearest * inverse < 1.0 - BEHIND
        if not covered:
            for axis in range(2):
                low[stay, axis], high[stay, axis] = low[i, axis], high[i, axis]
            line[stay] = line[i]
            stay += 1
    return stay


@compiled
@no_type_check
def _first(ray, facing, found):
    """Range of the face that a ray meets first, and its place: as in the z-buffer."""
    planes, number, least, order = facing
    depth, first = np.float32(np.inf), -1
    for k in range(found):
        i = order[k]
        if least[i] > NEARLY * depth:
            break
        if is_inside(planes[i], ray):
            p = planes[i]
            t = np.float32(p[12] / (p[9] * ray[0] + p[10] * ray[1] + p[11] * ray[2]))
            if 0.0 < t < depth or (t == depth and number[i] < number[first]):
                depth, first = t, i
    return depth, first


@compiled
@no_type_check
def is_inside(p, ray):
    """Whether a ray is within the sides of a face."""
    inside = p[0] * ray[0] + p[1] * ray[1] + p[2] * ray[2] >= 0.0
    inside &= p[3] * ray[0] + p[4] * ray[1] + p[5] * ray[2] >= 0.0
    inside &= p[6] * ray[0] + p[7] * ray[1] + p[8] * ray[2] >= 0.0
    return inside
