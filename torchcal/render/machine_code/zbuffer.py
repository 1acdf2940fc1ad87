"""The hard z-buffer in machine code: the same answer as by tensors, faster.

Each thread enters all faces into rows of its own, so the answer does not depend on their number.
"""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection, pixel_grid
from torchcal.render.boxes import pixel_boxes, tile_cones
from torchcal.render.machine_code.compiled import in_threads, leaf
from torchcal.render.machine_code.vectors import cross, dot, plane
from torchcal.render.soup import Views
from torchcal.render.squares import TILE, tiles_of

CULLED = 64
"""Faces whose box has more pixels than this are culled by tiles."""
ROWS = 64
"""Rows that a thread takes at a time."""


def visible_faces(
    vertices: Float[Tensor, "view vertex 3"], faces: Int[Tensor, "face 3"], projection: Projection
) -> Int[Tensor, "view h w"]:
    """As ``visibility.visible_faces``, for tensors on the CPU."""
    shape = (len(vertices), projection.height, projection.width)
    winner = np.full(shape, -1)
    depth = np.full(shape, np.inf, np.float32)
    grid = pixel_grid(projection, dtype=vertices.dtype, device=vertices.device)
    rays = projection.rays(*grid).movedim(-1, 0).contiguous().numpy()
    optics = (rays, *_cones_of_tiles(projection, vertices))
    boxes = pixel_boxes(vertices, faces, projection).numpy()
    corners = vertices.contiguous().numpy()

    def enter(task: tuple[int, int]) -> None:
        view, row = task
        rows = (row, min(row + ROWS, projection.height))
        target = (depth[view], winner[view])
        _enter(corners[view], faces.numpy(), boxes[view], optics, rows, target)

    tasks = [(i, row) for i in range(len(vertices)) for row in range(0, projection.height, ROWS)]
    in_threads(enter, tasks)
    return torch.from_numpy(winner)


def faces_of_tiles(
    tile: Int[Tensor, " square"], views: Views
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """The faces that may reach into some tiles, in ascending order, and the boxes of all faces.

    Args:
        tile: Numbers of the tiles that are asked for.
        views: In double precision.

    Returns:
        Where the faces of each tile begin, for all tiles and the one beyond the last; the faces.
    """
    projection, own_faces = views.sensor.projection, views.own_faces
    columns, rows = tiles_of(projection)
    wanted = np.zeros(views.count * rows * columns, np.bool_)
    wanted[tile.numpy()] = True
    own = views.vertices.view(views.count, -1, 3)
    boxes = pixel_boxes(own, own_faces, projection).flatten(0, 1).numpy()
    optics = _cones_of_tiles(projection, views.vertices, wider=1)
    vertices, faces = views.vertices.contiguous().numpy(), views.surface.faces.numpy()
    mesh = vertices, faces, boxes, len(own_faces)
    count = np.zeros(len(wanted) + 1, np.int64)
    none = np.empty(0, np.int64)
    _enter_tiles(mesh, optics, wanted, count, none)
    first = np.zeros(len(count), np.int64)
    np.cumsum(count[:-1], out=first[1:])
    entries = np.empty(first[-1], np.int64)
    _enter_tiles(mesh, optics, wanted, first.copy(), entries)
    return (first, entries), boxes


def _cones_of_tiles(
    projection: Projection, like: Tensor, wider: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Axes ``(rows, columns, 3)`` and sines ``(rows, columns)`` of the cones about all tiles."""
    v = torch.arange(0, projection.height, TILE)
    u = torch.arange(0, projection.width, TILE)
    low = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
    axis, sine = tile_cones(low - wider, low + TILE + wider, projection, like)
    return axis.numpy(), sine.numpy()


@leaf
@no_type_check
def _enter(vertices, faces, boxes, optics, rows, target):
    """Enters all faces of one view into some rows of the range and face images ``target``."""
    for face in range(len(faces)):
        left, right = boxes[face, 0], boxes[face, 2]
        top, bottom = max(boxes[face, 1], rows[0]), min(boxes[face, 3], rows[1])
        if left < right and top < bottom:
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            normal = plane(vertices[a], vertices[b], vertices[c])
            offset = dot(normal, vertices[a])
            if abs(offset) > 0.0:
                sides = (
                    side_of(vertices, a, b, offset),
                    side_of(vertices, b, c, offset),
                    side_of(vertices, c, a, offset),
                )
                box = (left, right, top, bottom)
                _draw(face, box, (*sides, normal), offset, optics, target)


@leaf
@no_type_check
def _enter_tiles(mesh, optics, wanted, place, entries):
    """Counts the faces of tiles, and enters them from each tile's place on if there is room."""
    vertices, faces, boxes, of_view = mesh
    axes, sines = optics
    rows, columns = sines.shape
    for face in range(len(faces)):
        # Squares reach half a pixel beyond the centres that boxes hold.
        left, right = max(boxes[face, 0] - 1, 0), boxes[face, 2] + 1
        top, bottom = max(boxes[face, 1] - 1, 0), boxes[face, 3] + 1
        left, right = left // TILE, min((right + TILE - 1) // TILE, columns)
        top, bottom = top // TILE, min((bottom + TILE - 1) // TILE, rows)
        if boxes[face, 0] >= boxes[face, 2] + 1 or left >= right or top >= bottom:
            continue
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        offset = dot(plane(vertices[a], vertices[b], vertices[c]), vertices[a])
        if not abs(offset) > 0.0:
            continue
        sides = (
            side_of(vertices, a, b, offset),
            side_of(vertices, b, c, offset),
            side_of(vertices, c, a, offset),
        )
        small = (right - left) * (bottom - top) == 1
        for row in range(top, bottom):
            for column in range(left, right):
                tile = (face // of_view * rows + row) * columns + column
                if wanted[tile] and (
                    small or _may_touch(sides, axes[row, column], sines[row, column])
                ):
                    if len(entries):
                        entries[place[tile]] = face
                    place[tile] += 1


@leaf
@no_type_check
def _draw(face, box, planes, offset, optics, target):
    """Enters one face at the pixels of its box, without the tiles that it does not touch."""
    left, right, top, bottom = box
    rays, axes, sines = optics
    culled = (right - left) * (bottom - top) > CULLED
    for row in range(top // TILE, (bottom + TILE - 1) // TILE):
        for column in range(left // TILE, (right + TILE - 1) // TILE):
            if culled and not _may_touch(planes[:3], axes[row, column], sines[row, column]):
                continue
            begin, end = max(left, column * TILE), min(right, (column + 1) * TILE)
            for v in range(max(top, row * TILE), min(bottom, (row + 1) * TILE)):
                span = (v, begin, end)
                _draw_span(face, span, planes, offset, rays, target)


@leaf
@no_type_check
def _draw_span(face, span, planes, offset, rays, target):
    """Enters one face at neighbouring pixels of a row: free of branches, so it is vectorised."""
    v, begin, end = span
    a, b, c, normal = planes
    x_row, y_row, z_row = rays[0, v], rays[1, v], rays[2, v]
    depth_row, winner_row = target[0][v], target[1][v]
    for u in range(begin, end):
        ray = (x_row[u], y_row[u], z_row[u])
        inside = (dot(a, ray) >= 0) & (dot(b, ray) >= 0) & (dot(c, ray) >= 0)
        t = np.float32(offset / dot(normal, ray))
        # A tie stays with the face that was entered first.
        nearer = inside & (t > 0) & (t < depth_row[u])
        depth_row[u] = t if nearer else depth_row[u]
        winner_row[u] = face if nearer else winner_row[u]


@leaf
@no_type_check
def _may_touch(sides, axis, sine):
    """Whether a face may reach into a cone."""
    for side in sides:
        if dot(side, axis) + np.sqrt(dot(side, side)) * sine < 0:
            return False
    return True


@leaf
@no_type_check
def side_of(vertices, start, end, offset):
    """Normal of the plane through the sensor and a side, towards the inside of the face.

    Both faces of an edge take its vertices in the same order, so no ray slips between them.
    """
    first, last = vertices[min(start, end)], vertices[max(start, end)]
    x, y, z = cross(first, (last[0] - first[0], last[1] - first[1], last[2] - first[2]))
    if (start < end) == (offset > 0):
        return x, y, z
    return -x, -y, -z
