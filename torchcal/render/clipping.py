"""Pieces in machine code, for the CPU: the same as in ``pieces.py`` but for rounding, faster."""

from typing import no_type_check

import numpy as np
import torch
from torch import Tensor

from torchcal.render.compiled import compiled
from torchcal.render.raster import _cross, _dot, _plane
from torchcal.render.squares import Squares


def clipped_and_seen(
    ends: Tensor,
    squares: Squares,
    square: Tensor,
    line: Tensor,
    corners: Tensor,
    behind: float,
) -> tuple[Tensor, Tensor]:
    """Both ends (x, y, range) of each pair's piece, and which pairs have one that may be seen.

    Args:
        ends: Two points (m) of each line.
        squares: The pixels.
        square: Of each pair, in order.
        line: Of each pair.
        corners: Of the face at each square's centre (m); 0 where there is none.
        behind: Share of the range by which pieces are behind that face.
    """
    points = np.empty((len(square), 2, 3))
    seen = np.zeros(len(square), np.bool_)
    frames = tuple(
        axis.contiguous().numpy() for axis in (squares.along_u, squares.along_v, squares.origin)
    )
    indices = square.numpy(), line.numpy()
    _clip(ends.contiguous().numpy(), frames, *indices, corners.numpy(), behind, points, seen)
    return torch.from_numpy(points), torch.from_numpy(seen)


@compiled
@no_type_check
def _clip(ends, frames, square, line, corners, behind, points, seen):
    to_u, to_v, origin = frames
    last, fills = -1, False
    x_axis = y_axis = z_axis = gradient = (0.0, 0.0, 0.0)
    size = 1.0
    for i in range(len(square)):
        k = square[i]
        if k != last:
            last = k
            u, v, o = _row(to_u, k), _row(to_v, k), _row(origin, k)
            x_axis, y_axis, z_axis = _cross(v, o), _cross(o, u), _cross(u, v)
            size = _dot(u, x_axis)
            fills, gradient = _front(corners[k], u, v, o)
        a, b = ends[line[i], 0], ends[line[i], 1]
        start = (_dot(x_axis, a) / size, _dot(y_axis, a) / size, _dot(z_axis, a) / size)
        end = (_dot(x_axis, b) / size, _dot(y_axis, b) / size, _dot(z_axis, b) / size)
        begin, finish = _share(start, end)
        if not begin < finish:
            continue
        hidden = fills
        for j in range(2):
            share = finish if j else begin
            x = start[0] + share * (end[0] - start[0])
            y = start[1] + share * (end[1] - start[1])
            t = start[2] + share * (end[2] - start[2])
            points[i, j, 0] = min(max(x / t, -0.5), 0.5)
            points[i, j, 1] = min(max(y / t, -0.5), 0.5)
            points[i, j, 2] = t
            if fills:
                near = x * gradient[0] + y * gradient[1] + t * gradient[2]
                hidden &= 1.0 < (1.0 - behind) * near
        if points[i, 0, 1] > points[i, 1, 1]:
            for j in range(3):
                points[i, 0, j], points[i, 1, j] = points[i, 1, j], points[i, 0, j]
        seen[i] = not hidden


@compiled
@no_type_check
def _share(start, end):
    """Where a line enters and leaves the pyramid of a square's rays, as shares of its length."""
    begin, finish = 0.0, 1.0
    for axis in range(2):
        for sign in (1.0, -1.0):
            a = 0.5 * start[2] + sign * start[axis]
            b = 0.5 * end[2] + sign * end[axis]
            if a < 0 and b < 0:
                return 1.0, 0.0
            if a < 0:
                begin = max(begin, a / (a - b))
            if b < 0:
                finish = min(finish, a / (a - b))
    return begin, finish


@compiled
@no_type_check
def _front(corners, u, v, o):
    """Whether a face fills a square; 1 / range is x, y and 1 times what comes with it."""
    a, b, c = corners[0], corners[1], corners[2]
    normal = _plane(a, b, c)
    offset = _dot(normal, a)
    fills = abs(offset) > 0.0
    for first, last in ((a, b), (b, c), (c, a)):
        step = (last[0] - first[0], last[1] - first[1], last[2] - first[2])
        side = _cross(first, step)
        middle = _dot(side, o) if offset > 0 else -_dot(side, o)
        fills &= middle > 0.5 * (abs(_dot(side, u)) + abs(_dot(side, v)))
    if not fills:
        return False, (0.0, 0.0, 0.0)
    return True, (_dot(normal, u) / offset, _dot(normal, v) / offset, _dot(normal, o) / offset)


@compiled
@no_type_check
def _row(points, k):
    return (points[k, 0], points[k, 1], points[k, 2])
