"""Rims of a square in machine code: as ``regions.rims_of`` finds them."""

from typing import no_type_check

from torchcal.render.machine_code.cells import ray_of
from torchcal.render.machine_code.compiled import leaf
from torchcal.render.machine_code.cover import inverse_range
from torchcal.render.machine_code.seams import SEAM
from torchcal.render.machine_code.vectors import cross, dot, row
from torchcal.render.regions import SHARES


@leaf
@no_type_check
def add_rims(k, count, shown, forms, borders, limits, frame, rims):
    """Adds the rims of a square, one for each of its pieces; where the rims end after it."""
    (sides, piece), (face, place), line = shown
    end, rim, levers = rims
    vertices, edges, edge_faces = borders
    before = end
    for c in range(count):
        border = line[piece[c]] if piece[c] >= 0 else SEAM
        if not 0 <= border < len(edges) or face[c] == face[c + 1]:
            continue
        own, seen = (edge_faces[border, 0], edge_faces[border, 1]), (face[c], face[c + 1])
        if seen == own or seen == (own[1], own[0]):
            continue  # At an edge both of whose faces are seen the range does not jump.
        i = end - 1
        while i >= before and rim[i, 1] != border:
            i -= 1
        if i < before:
            i = end
            end += 1
            rim[i, 0], rim[i, 1] = k, border
            levers[i, :] = 0.0
        first, last = row(vertices, edges[border, 0]), row(vertices, edges[border, 1])
        normal = cross(first, (last[0] - first[0], last[1] - first[1], last[2] - first[2]))
        start = sides[c, 4], sides[c, 0]
        delta = sides[c, 5] - sides[c, 4], sides[c, 1] - sides[c, 0]
        pair = place[c], place[c + 1]
        _add_lever((start, delta), normal, pair, forms, limits, frame, (levers, i))
    return end


@leaf
@no_type_check
def _add_lever(side, normal, pair, forms, limits, frame, lever):
    """What the motion of the side between two cells changes, and its step: see ``Rims``."""
    (start, (dx, dy)), (levers, i) = side, lever
    rate = -(dx * dx + dy * dy) / (dot(normal, frame[1]) * dy - dot(normal, frame[2]) * dx)
    for share in SHARES:
        point = start[0] + share * dx, start[1] + share * dy
        ray = ray_of(frame, point)
        near, far = _range(pair[0], point, forms, limits), _range(pair[1], point, forms, limits)
        met = (1.0 if near != 0.0 else 0.0) - (1.0 if far != 0.0 else 0.0)
        if near != far:
            levers[i, 6] = max(levers[i, 6], abs(near - far) / min(near, far))
        for axis in range(3):
            levers[i, axis] += 0.5 * rate * (near - far) * ray[axis]
            levers[i, 3 + axis] += 0.5 * rate * met * ray[axis]


@leaf
@no_type_check
def _range(place, point, forms, limits):
    """Where the plane of a face near is met; 0 beyond the limits and where there is no face."""
    if place < 0:
        return 0.0
    distance = 1.0 / inverse_range(forms, place, point)
    return distance if limits[0] <= distance <= limits[1] else 0.0
