"""Regions and rims in machine code: what ``regions.py`` finds by tensors, but for rounding, faster.

Square after square: the faces that may touch it, the cells between its pieces, the face seen in
each cell, once more if a seam was missed, and then the sums over all cells of a face.
"""

from typing import no_type_check

import numpy as np
import torch

from torchcal.render.machine_code.cells import cut_into_cells, frames_of
from torchcal.render.machine_code.compiled import compiled, in_threads, leaf, parts_of
from torchcal.render.machine_code.cover import faces_near, look, planes_of_tile, uncovered
from torchcal.render.machine_code.rims import add_rims
from torchcal.render.machine_code.seams import SEAMS, add_seams
from torchcal.render.machine_code.vectors import row
from torchcal.render.machine_code.zbuffer import faces_of_tiles
from torchcal.render.pieces import Pieces
from torchcal.render.regions import CROWDED, SHARES, Divided, Regions, Rims
from torchcal.render.silhouette import Borders
from torchcal.render.soup import Views
from torchcal.render.squares import Squares, tile_numbers


def divide(squares: Squares, pieces: Pieces, borders: Borders, views: Views) -> Divided:
    """As ``regions.divide``."""
    vertices, surface, projection = views.vertices, views.surface, views.sensor.projection
    count = len(squares.view)
    starts = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(pieces.square.numpy(), minlength=count), out=starts[1:])
    ends = pieces.low.numpy(), pieces.high.numpy(), pieces.range.numpy()
    of_pieces = (starts, *ends, pieces.line.numpy())
    tile = tile_numbers(squares.view, squares.u, squares.v, projection)
    tiles, boxes = faces_of_tiles(tile, views)
    frames, places = frames_of(squares), (tile.numpy(), squares.u.numpy(), squares.v.numpy())
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
        area_lever=levers[:, 3:6],
        step=levers[:, 6],
    )
    return Divided(squares=squares, regions=regions, rims=rims)


@compiled
@no_type_check
def _divide(part, pieces, frames, places, tiles, mesh, edges, limits):
    """Regions (square, face), their moments, rims (square, border), their levers."""
    room, planes = _room_for(part, pieces[0], places[0], tiles[0])
    lines, _, cells, seen, facing = room
    region, moments = np.empty((1024, 2), np.int64), np.empty((1024, 6))
    rim, levers = np.empty((1024, 2), np.int64), np.empty((1024, 7))
    regions = rims = 0
    tile = -1
    for k in range(part[0], part[1]):
        if places[0][k] != tile:
            tile = places[0][k]
            planes_of_tile(tile, tiles, mesh, planes)
        frame = (row(frames[0], k), row(frames[1], k), row(frames[2], k))
        found = faces_near(k, places, tiles, planes, frame, facing)
        number, count = _cut(k, pieces, found, mesh[1], room)
        if regions + count > len(region):
            region, moments = _grown(region, count), _grown(moments, count)
        if rims + number > len(rim):
            rim, levers = _grown(rim, number), _grown(levers, number)
        last = regions
        for c in range(count):
            regions = _add_cell((k, seen[0][c]), cells[0], c, (last, regions), region, moments)
        shown, borders = (cells, seen, lines[3]), (mesh[0], *edges)
        rims = add_rims(k, count, shown, facing[0], borders, limits, frame, (rims, rim, levers))
    # Copies, so that the room that was not needed is given back.
    return (
        region[:regions].copy(),
        moments[:regions].copy(),
        rim[:rims].copy(),
        levers[:rims].copy(),
    )


@compiled
@no_type_check
def _room_for(part, starts, tile, first):
    """Room for the lines, slabs, cells and faces of any one of some squares."""
    most, near = 1, 1
    for k in range(part[0], part[1]):
        most = max(most, starts[k + 1] - starts[k])
        near = max(near, first[tile[k] + 1] - first[tile[k]])
    most += SEAMS
    slabs = 2 + 2 * most + most * (most - 1) // 2
    number = slabs * (most + 1)
    lines = (
        np.empty((most, 2)),
        np.empty((most, 2)),
        np.empty(most),
        np.empty(most, np.int64),
        np.empty((most, 2)),
    )
    cells = np.empty((number, 6)), np.empty(number, np.int64)
    seen = np.empty(number, np.int64), np.empty(number, np.int64)
    facing = (
        np.empty((near, 12)),
        np.empty(near, np.int64),
        np.empty(near),
        np.empty(near, np.int64),
    )
    return (lines, np.empty(slabs), cells, seen, facing), np.empty((near, 13))


@leaf
@no_type_check
def _cut(k, pieces, found, faces, room):
    """Cuts one square and looks at what its cells show; how many lines and cells there are."""
    lines, slabs, cells, seen, facing = room
    number = _lines_of(k, pieces, lines)
    if number > CROWDED:
        number = uncovered(number, lines, facing, found)
    count = cut_into_cells(number, lines, slabs, cells)
    look(count, cells, facing, found, seen)
    if number <= CROWDED:
        more = add_seams(count, number, (cells, seen), facing, found, faces, lines)
        if more > number:
            number = more
            count = cut_into_cells(number, lines, slabs, cells)
            look(count, cells, facing, found, seen)
    return number, count


@compiled
@no_type_check
def _grown(rows, more):
    """The same rows with room for more."""
    grown = np.empty((2 * len(rows) + more, rows.shape[1]), rows.dtype)
    grown[: len(rows)] = rows
    return grown


@leaf
@no_type_check
def _lines_of(k, pieces, lines):
    """Copies the pieces of a square; how many there are."""
    starts, low, high, ranges, line = pieces
    distance = lines[4]
    number = starts[k + 1] - starts[k]
    for i in range(number):
        j = starts[k] + i
        lines[0][i, 0], lines[0][i, 1] = low[j, 0], low[j, 1]
        lines[1][i, 0], lines[1][i, 1] = high[j, 0], high[j, 1]
        distance[i, 0], distance[i, 1] = ranges[j, 0], ranges[j, 1]
        lines[3][i] = line[j]
    return number


@leaf
@no_type_check
def _add_cell(key, sides, c, span, region, moments):
    """Adds a cell's moments to those of its face; where the regions end after it."""
    first, end = span
    i = end - 1
    while i >= first and region[i, 1] != key[1]:
        i -= 1
    if i < first:
        i = end
        end += 1
        region[i, 0], region[i, 1] = key
        for j in range(6):
            moments[i, j] = 0.0
    height = sides[c, 1] - sides[c, 0]
    area = x_sum = y_sum = xx_sum = xy_sum = yy_sum = 0.0
    for share in SHARES:
        y = sides[c, 0] + share * height
        left = sides[c, 2] + share * (sides[c, 3] - sides[c, 2])
        right = sides[c, 4] + share * (sides[c, 5] - sides[c, 4])
        width, middle = right - left, 0.5 * (left + right)
        weight = 0.5 * height * width
        area += weight
        x_sum += weight * middle
        y_sum += weight * y
        xx_sum += weight * (middle * middle + width * width / 12.0)
        xy_sum += weight * middle * y
        yy_sum += weight * y * y
    moments[i, 0] += area
    moments[i, 1] += x_sum
    moments[i, 2] += y_sum
    moments[i, 3] += xx_sum
    moments[i, 4] += xy_sum
    moments[i, 5] += yy_sum
    return end
