"""Pieces in machine code, for the CPU: the same as in ``pieces.py`` but for rounding, faster."""

from typing import no_type_check

import numpy as np
import torch
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.render.machine_code.cells import frames_of
from torchcal.render.machine_code.compiled import leaf
from torchcal.render.machine_code.vectors import cross, dot, plane, row
from torchcal.render.silhouette import Strokes
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
    pairs = frames_of(squares), square.numpy(), line.numpy()
    _clip(ends.contiguous().numpy(), *pairs, corners.numpy(), behind, points, seen)
    return torch.from_numpy(points), torch.from_numpy(seen)


def crossed_pixels(strokes: Strokes, projection: Projection) -> tuple[Tensor, Tensor, Tensor]:
    """As ``pieces.crossed_pixels``."""
    start, end = strokes.start.contiguous().numpy(), strokes.end.contiguous().numpy()
    lines = start, end, strokes.margin.numpy()
    size = projection.width, projection.height
    found = np.empty((3, _cross_pixels(lines, size, np.empty((3, 0), np.int64))), np.int64)
    _cross_pixels(lines, size, found)
    stroke, u, v = torch.from_numpy(found)
    return stroke, u, v


@leaf
@no_type_check
def _cross_pixels(lines, size, found):
    """Enters strokes and pixels where there is room for them; how many there are."""
    start, end, margins = lines
    count = 0
    for i in range(len(start)):
        margin = margins[i]
        low, high = min(start[i, 1], end[i, 1]), max(start[i, 1], end[i, 1])
        least, most = min(start[i, 0], end[i, 0]), max(start[i, 0], end[i, 0])
        slope = 0.0
        if end[i, 1] != start[i, 1]:
            slope = (end[i, 0] - start[i, 0]) / (end[i, 1] - start[i, 1])
        top, bottom = _pixels_between(low - margin, high + margin, size[1])
        for v in range(top, bottom):
            left, right = least, most
            if end[i, 1] != start[i, 1]:
                a = min(max(v - (0.5 + margin), low), high)
                b = min(max(v + (0.5 + margin), low), high)
                a = min(max(start[i, 0] + slope * (a - start[i, 1]), least), most)
                b = min(max(start[i, 0] + slope * (b - start[i, 1]), least), most)
                left, right = min(a, b), max(a, b)
            begin, beyond = _pixels_between(left - margin, right + margin, size[0])
            if count + beyond - begin <= found.shape[1]:
                for k in range(begin, beyond):
                    found[0, count + k - begin] = i
                    found[1, count + k - begin] = k
                    found[2, count + k - begin] = v
            count += max(beyond - begin, 0)
    return count


@leaf
@no_type_check
def _pixels_between(low, high, size):
    """The first pixel of a span, and the one beyond its last."""
    first = min(max(np.floor(low + 0.5), 0), size)
    last = min(max(np.floor(high + 0.5), -1), size - 1)
    return int(first), int(last) + 1


@leaf
@no_type_check
def _clip(ends, frames, square, line, corners, behind, points, seen):
    origin, to_u, to_v = frames
    last, fills = -1, False
    x_axis = y_axis = z_axis = gradient = (0.0, 0.0, 0.0)
    size = 1.0
    for i in range(len(square)):
        k = square[i]
        if k != last:
            last = k
            u, v, o = row(to_u, k), row(to_v, k), row(origin, k)
            x_axis, y_axis, z_axis = cross(v, o), cross(o, u), cross(u, v)
            size = dot(u, x_axis)
            fills, gradient = _front(corners[k], u, v, o)
        a, b = ends[line[i], 0], ends[line[i], 1]
        start = (dot(x_axis, a) / size, dot(y_axis, a) / size, dot(z_axis, a) / size)
        end = (dot(x_axis, b) / size, dot(y_axis, b) / size, dot(z_axis, b) / size)
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


@leaf
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


@leaf
@no_type_check
def _front(corners, u, v, o):
    """Whether a face fills a square; 1 / range is x, y and 1 times what comes with it."""
    a, b, c = corners[0], corners[1], corners[2]
    normal = plane(a, b, c)
    offset = dot(normal, a)
    fills = abs(offset) > 0.0
    for first, last in ((a, b), (b, c), (c, a)):
        step = (last[0] - first[0], last[1] - first[1], last[2] - first[2])
        side = cross(first, step)
        middle = dot(side, o) if offset > 0 else -dot(side, o)
        fills &= middle > 0.5 * (abs(dot(side, u)) + abs(dot(side, v)))
    if not fills:
        return False, (0.0, 0.0, 0.0)
    return True, (dot(normal, u) / offset, dot(normal, v) / offset, dot(normal, o) / offset)
