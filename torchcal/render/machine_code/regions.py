"""Regions and rims in machine code: what ``regions.py`` finds by tensors, but for rounding, faster.

Square after square: the faces that may touch it, the cells between its pieces, the face seen in
each cell, once more if a seam was missed, and then the sums over all cells of a face.
"""

from typing import no_type_check

import numpy as np
import torch

from torchcal.render.machine_code.cells import cut_into_cells, ray_of, ray_of_cell
from torchcal.render.machine_code.compiled import compiled, in_threads, parts_of
from torchcal.render.machine_code.vectors import cross, dot, plane, row
from torchcal.render.machine_code.zbuffer import faces_of_tiles, side_of
from torchcal.render.pieces import BEHIND, Pieces
from torchcal.render.regions import CROWDED, PROBES, SHARES, Divided, Regions, Rims
from torchcal.render.seams import CLOSE
from torchcal.render.silhouette import Borders
from torchcal.render.soup import Views
from torchcal.render.squares import Squares, tile_numbers

SEAMS = 16
"""Most seams in one square."""
SEAM = -2
"""Stands for the line of a seam that was missed."""


def divide(squares: Squares, pieces: Pieces, borders: Borders, views: Views) -> Divided:
    """As ``regions.divide``."""
    vertices, surface, projection = views.vertices, views.surface, views.sensor.projection
    count = len(squares.view)
    starts = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(pieces.square.numpy(), minlength=count), out=starts[1:])
    ends = pieces.low.numpy(), pieces.high.numpy(), pieces.range.numpy()
    of_pieces = (starts, *ends, pieces.line.numpy())
    frames = tuple(
        axis.contiguous().numpy() for axis in (squares.origin, squares.along_u, squares.along_v)
    )
    tile = tile_numbers(squares.view, squares.u, squares.v, projection)
    tiles, boxes = faces_of_tiles(tile, views)
    places = tile.numpy(), squares.u.numpy(), squares.v.numpy()
    mesh = vertices.contiguous().numpy(), surface.faces.numpy()
    edges = surface.edges[borders.edge].numpy(), surface.edge_faces[borders.edge].numpy()
    limits = float(views.sensor.near), float(views.sensor.far)

    def of_part(part: tuple[int, int]) -> tuple[np.ndarray, ...]:
        return _divide(part, of_pieces, frames, places, (*tiles, boxes), mesh, edges, limits)

    parts = in_threads(of_part, parts_of(count))
    of_regions, moments, of_rims, levers = (
        torch.from_numpy(np.concatenate(same)) for same in zip(*parts, strict=True)
    )
    regions = Regions.of(of_regions[:, 0], of_regions[:, 1], moments)
    rims = Rims(
        square=of_rims[:, 0],
        border=of_rims[:, 1],
        total_lever=levers[:, :3],
        area_lever=levers[:, 3:],
    )
    return Divided(squares=squares, regions=regions, rims=rims)


@compiled
@no_type_check
def _divide(part, pieces, frames, places, tiles, mesh, edges, limits):
    """Regions (square, face), their moments, rims (square, border), their levers."""
    most, near = _sizes(part, pieces[0], places[0], tiles[0])
    ends = np.empty((most, 2)), np.empty((most, 2)), np.empty((most, 2))
    lines = (ends[0], ends[1], np.empty(most), np.empty(most, np.int64))
    cuts = 2 + 2 * most + most * (most - 1) // 2
    cells = np.empty((cuts * (most + 1), 6)), np.empty(cuts * (most + 1), np.int64)
    face, cuts = np.empty(len(cells[1]), np.int64), np.empty(cuts)
    facing = np.empty((near, 13)), np.empty(near, np.int64)
    region, moments = np.empty((1024, 2), np.int64), np.empty((1024, 6))
    rim, levers = np.empty((1024, 2), np.int64), np.empty((1024, 6))
    regions = rims = 0
    for k in range(part[0], part[1]):
        frame = (row(frames[0], k), row(frames[1], k), row(frames[2], k))
        found = _faces_near(k, places, tiles, mesh, frame, facing)
        number = _lines_of(k, pieces, lines, ends[2])
        if number > CROWDED:
            number = _uncovered(number, lines, ends[2], frame, facing, found)
        count = cut_into_cells(number, lines, cuts, cells)
        _look(count, cells, frame, facing, found, face)
        more = _seams(count, number, cells, face, mesh, frame, lines)
        if more > number:
            number = more
            count = cut_into_cells(number, lines, cuts, cells)
            _look(count, cells, frame, facing, found, face)
        if regions + count > len(region):
            region, moments = _grown(region, count), _grown(moments, count)
        if rims + number > len(rim):
            rim, levers = _grown(rim, number), _grown(levers, number)
        last = regions
        for c in range(count):
            regions = _add_cell((k, face[c]), cells[0][c], last, regions, region, moments)
        rims = _add_rims(
            k, count, (cells, face, lines[3]), mesh, edges, limits, frame, (rims, rim, levers)
        )
    return (
        region[:regions].copy(),
        moments[:regions].copy(),
        rim[:rims].copy(),
        levers[:rims].copy(),
    )


@compiled
@no_type_check
def _sizes(part, starts, tile, first):
    """Most pieces of a square, with room for seams, and most faces of its tile."""
    most, near = 1, 1
    for k in range(part[0], part[1]):
        most = max(most, starts[k + 1] - starts[k])
        near = max(near, first[tile[k] + 1] - first[tile[k]])
    return most + SEAMS, near


@compiled
@no_type_check
def _grown(rows, more):
    """The same rows with room for more."""
    grown = np.empty((2 * len(rows) + more, rows.shape[1]), rows.dtype)
    grown[: len(rows)] = rows
    return grown


@compiled
@no_type_check
def _faces_near(k, places, tiles, mesh, frame, facing):
    """Enters the sides and planes of the faces that may reach into a square; how many there are."""
    tile, column, line = places
    first, entries, boxes = tiles
    vertices, faces = mesh
    origin, to_u, to_v = frame
    planes, number = facing
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
            for axis in range(3):
                planes[found, 3 * j + axis] = side[axis]
        if touches:
            for axis in range(3):
                planes[found, 9 + axis] = normal[axis]
            planes[found, 12] = offset
            number[found] = f
            found += 1
    return found


@compiled
@no_type_check
def _lines_of(k, pieces, lines, distance):
    """Copies the pieces of a square; how many there are."""
    starts, low, high, ranges, line = pieces
    number = starts[k + 1] - starts[k]
    for i in range(number):
        j = starts[k] + i
        lines[0][i, 0], lines[0][i, 1] = low[j, 0], low[j, 1]
        lines[1][i, 0], lines[1][i, 1] = high[j, 0], high[j, 1]
        distance[i, 0], distance[i, 1] = ranges[j, 0], ranges[j, 1]
        lines[3][i] = line[j]
    return number


@compiled
@no_type_check
def _uncovered(number, lines, distance, frame, facing, found):
    """Leaves out pieces that are behind a face at both ends and in the middle; how many stay."""
    low, high, _, line = lines
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
def _look(count, cells, frame, facing, found, face):
    """The face that the ray of each cell meets first."""
    for c in range(count):
        _, face[c] = _first(ray_of_cell(cells[0][c], frame), facing, found)


@compiled
@no_type_check
def _first(ray, facing, found):
    """Range and face that a ray meets first: as in the z-buffer."""
    planes, number = facing
    depth, face = np.float32(np.inf), -1
    for i in range(found):
        p = planes[i]
        inside = p[0] * ray[0] + p[1] * ray[1] + p[2] * ray[2] >= 0.0
        inside &= p[3] * ray[0] + p[4] * ray[1] + p[5] * ray[2] >= 0.0
        inside &= p[6] * ray[0] + p[7] * ray[1] + p[8] * ray[2] >= 0.0
        if inside:
            t = np.float32(p[12] / (p[9] * ray[0] + p[10] * ray[1] + p[11] * ray[2]))
            if 0.0 < t < depth:
                depth, face = t, number[i]
    return depth, face


@compiled
@no_type_check
def _seams(count, number, cells, face, mesh, frame, lines):
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
    # From the point nearest to the middle along the line, as far as the square's sides.
    point = (-offset * x / size / size, -offset * y / size / size)
    along = (-y / size, x / size)
    first, last = -2.0, 2.0
    for axis in range(2):
        if along[axis] != 0.0:
            one_end, other_end = (
                (-0.5 - point[axis]) / along[axis],
                (0.5 - point[axis]) / along[axis],
            )
            first, last = max(first, min(one_end, other_end)), min(last, max(one_end, other_end))
        elif abs(point[axis]) > 0.5:
            return number
    if first >= last:
        return number
    if along[1] < 0.0:
        first, last = last, first
    low, high, _, line = lines
    for end, share in ((low, first), (high, last)):
        for axis in range(2):
            end[number, axis] = min(max(point[axis] + share * along[axis], -0.5), 0.5)
    line[number] = SEAM
    for i in range(before, number):
        if low[i, 0] == low[number, 0] and low[i, 1] == low[number, 1]:
            if high[i, 0] == high[number, 0] and high[i, 1] == high[number, 1]:
                return number
    return number + 1


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


@compiled
@no_type_check
def _add_cell(key, sides, first, end, region, moments):
    """Adds a cell's moments to those of its face; where the regions end after it."""
    i = end - 1
    while i >= first and region[i, 1] != key[1]:
        i -= 1
    if i < first:
        i = end
        end += 1
        region[i, 0], region[i, 1] = key
        moments[i] = 0.0
    height = sides[1] - sides[0]
    for share in SHARES:
        y = sides[0] + share * height
        left = sides[2] + share * (sides[3] - sides[2])
        right = sides[4] + share * (sides[5] - sides[4])
        width, middle = right - left, 0.5 * (left + right)
        weight = 0.5 * height * width
        moments[i, 0] += weight
        moments[i, 1] += weight * middle
        moments[i, 2] += weight * y
        moments[i, 3] += weight * (middle * middle + width * width / 12.0)
        moments[i, 4] += weight * middle * y
        moments[i, 5] += weight * y * y
    return end


@compiled
@no_type_check
def _add_rims(k, count, cells, mesh, edges, limits, frame, rims):
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
    """What the motion of the side between two cells changes: see ``regions.Rims``."""
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
