"""Rims of a square in machine code: as ``regions.rims_of`` finds them."""

from typing import no_type_check

from torchcal.render.machine_code.cells import ray_of
from torchcal.render.machine_code.compiled import compiled
from torchcal.render.machine_code.seams import SEAM
from torchcal.render.machine_code.vectors import cross, dot, plane, row
from torchcal.render.regions import SHARES


@compiled
@no_type_check
def add_rims(k, count, cells, mesh, edges, limits, frame, rims):
    """Adds the rims of a square, one for each of its pieces; where the rims end after it."""
    (sides, piece), face, line = cells
    end, rim, levers = rims
    first = end
    for c in range(count):
        border = line[piece[c]] if piece[c] >= 0 else SEAM
        if not 0 <= border < len(edges[0]) or face[c] == face[c + 1]:
            continue
        pair, own = (face[c], face[c + 1]), edges[1][border]
        if (own[0] == pair[0] and own[1] == pair[1]) or (own[0] == pair[1] and own[1] == pair[0]):
            continue  # At an edge both of whose faces are seen the range does not jump.
        i = end - 1
        while i >= first and rim[i, 1] != border:
            i -= 1
        if i < first:
            i = end
            end += 1
            rim[i, 0], rim[i, 1] = k, border
            levers[i] = 0.0
        a, b = row(mesh[0], edges[0][border, 0]), row(mesh[0], edges[0][border, 1])
        _add_lever(sides[c], (a, b), pair, mesh, limits, frame, levers[i])
    return end


@compiled
@no_type_check
def _add_lever(sides, ends, pair, mesh, limits, frame, lever):
    """What the motion of the side between two cells changes, and its step: see ``Rims``."""
    dx, dy = sides[5] - sides[4], sides[1] - sides[0]
    first, last = ends
    along = (last[0] - first[0], last[1] - first[1], last[2] - first[2])
    normal = cross(first, along)
    rate = -(dx * dx + dy * dy) / (dot(normal, frame[1]) * dy - dot(normal, frame[2]) * dx)
    for share in SHARES:
        x, y = sides[4] + share * dx, sides[0] + share * dy
        ray = ray_of(frame, x, y)
        near, far = _range(pair[0], ray, mesh, limits), _range(pair[1], ray, mesh, limits)
        met = (1.0 if near != 0.0 else 0.0) - (1.0 if far != 0.0 else 0.0)
        if near != far:
            lever[6] = max(lever[6], abs(near - far) / min(near, far))
        for axis in range(3):
            lever[axis] += 0.5 * rate * (near - far) * ray[axis]
            lever[3 + axis] += 0.5 * rate * met * ray[axis]


@compiled
@no_type_check
def _range(face, ray, mesh, limits):
    """Where a ray meets a face's plane; 0 beyond the limits and where there is no face."""
    if face < 0:
        return 0.0
    vertices, faces = mesh
    corner = vertices[faces[face, 0]]
    normal = plane(corner, vertices[faces[face, 1]], vertices[faces[face, 2]])
    distance = dot(normal, corner) / dot(normal, ray)
    return distance if limits[0] <= distance <= limits[1] else 0.0
