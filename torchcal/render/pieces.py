"""Pieces: the parts of lines in the squares of single pixels."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.render.facets import dot
from torchcal.render.machine_code import machine_code_for
from torchcal.render.silhouette import Strokes, strokes_of
from torchcal.render.soup import Views
from torchcal.render.squares import Squares, spread, square_numbers

MANY = 24
"""Squares with more pieces than this do without those of creases."""
MOST = 64
"""Pieces of silhouettes in a square beyond this many are left out."""
BEHIND = 1e-3
"""Relative: a piece is behind a face where its range is greater by more than this. Where a body
stands on another one its edges count, even if it has sunk in a little."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Lines:
    """Straight lines in space at which the range may jump or bend: borders, then seams."""

    ends: Float[Tensor, "line 2 3"]
    """m, in double precision."""
    view: Int[Tensor, " line"]
    jumps: Bool[Tensor, " line"]
    """Silhouettes."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Pieces:
    """Straight lines in squares, in the order of the squares."""

    square: Int[Tensor, " piece"]
    line: Int[Tensor, " piece"]
    jumps: Bool[Tensor, " piece"]
    """Of silhouettes."""
    low: Float[Tensor, "piece 2"]
    """The end (x, y) with the lesser y."""
    high: Float[Tensor, "piece 2"]
    range: Float[Tensor, "piece 2"]
    """Of both ends, in lengths of the square's rays."""

    def select(self, keep: Tensor) -> "Pieces":
        """The pieces to keep, by a mask or by their places."""
        if keep.dtype == torch.bool:
            if keep.all():
                return self
            keep = torch.nonzero(keep)[:, 0]
        return Pieces(
            square=self.square[keep],
            line=self.line[keep],
            jumps=self.jumps[keep],
            low=self.low[keep],
            high=self.high[keep],
            range=self.range[keep],
        )

    def and_then(self, others: "Pieces") -> "Pieces":
        """These pieces and after them others."""
        return Pieces(
            **{
                each.name: torch.cat([getattr(self, each.name), getattr(others, each.name)])
                for each in fields(self)
            }
        )


def find_pieces(
    lines: Lines, face: Int[Tensor, "view h w"], views: Views
) -> tuple[Squares, Pieces]:
    """The pieces of all lines but for those behind a face that fills their square.

    Args:
        lines: Borders and seams.
        face: The face at the centre of every pixel, of the triangles of all views.
        views: In double precision.
    """
    vertices, surface, projection = views.vertices, views.surface, views.sensor.projection
    strokes = strokes_of(lines.ends, projection)
    number, line = _crossed_squares(strokes, lines.view, projection)
    number, square = torch.unique_consecutive(number, return_inverse=True)
    squares = Squares.of(number, projection)
    central = face[squares.view, squares.v, squares.u]
    corners = vertices[surface.faces[central.clamp(min=0)]] * (central >= 0)[:, None, None]
    pieces = _seen(lines.ends, lines.jumps, squares, square, line, corners)
    count = pieces.square.bincount(minlength=len(number))
    pieces = pieces.select(pieces.jumps | (count[pieces.square] <= MANY))
    count = pieces.square.bincount(minlength=len(number))
    place = torch.arange(len(pieces.square), device=count.device)
    pieces = pieces.select(place - (count.cumsum(0) - count)[pieces.square] < MOST)
    return of_cut_squares(squares, pieces)


def of_cut_squares(squares: Squares, pieces: Pieces) -> tuple[Squares, Pieces]:
    """Without the squares that no piece cuts."""
    kept, square = torch.unique_consecutive(pieces.square, return_inverse=True)
    return squares.select(kept), replace(pieces, square=square)


def with_seams(
    pieces: Pieces,
    squares: Squares,
    square: Int[Tensor, " seam"],
    ends: Float[Tensor, "seam 2 3"],
    seam: int,
) -> tuple[Int[Tensor, " cut"], Squares, Pieces]:
    """Which squares seams cut, these squares, and all pieces in them with those of the seams.

    Args:
        pieces: Known pieces of all squares.
        squares: The pixels.
        square: The squares of the seams, in order.
        ends: Two points (m) of each.
        seam: Number of the first one: that of lines before them.
    """
    order = torch.arange(len(square), device=square.device)
    found = _clipped(ends, order < 0, squares, square, order)
    found = replace(found, line=found.line + seam)
    cut = torch.zeros_like(squares.view, dtype=torch.bool)
    cut[found.square] = True
    own = pieces.select(cut[pieces.square])
    joined = own.and_then(found)
    kept, of_joined = torch.unique(joined.square, return_inverse=True)
    joined = replace(joined, square=of_joined)
    return kept, squares.select(kept), joined.select(torch.sort(of_joined, stable=True).indices)


def _crossed_squares(
    strokes: Strokes, view: Tensor, projection: Projection
) -> tuple[Tensor, Tensor]:
    """Pairs of a pixel's number and a line whose stroke may cross it, each once, in order."""
    module = machine_code_for(strokes.start, "pieces")
    of_strokes = crossed_pixels if module is None else module.crossed_pixels
    stroke, u, v = of_strokes(strokes, projection)
    line = strokes.line[stroke]
    number = square_numbers(view[line], u, v, projection)
    key = torch.unique(number * (len(view) + 1) + line)
    return key // (len(view) + 1), key % (len(view) + 1)


def crossed_pixels(strokes: Strokes, projection: Projection) -> tuple[Tensor, Tensor, Tensor]:
    """Strokes and the columns and rows of the pixels that they may cross, row after row."""
    margin = strokes.margin
    delta = strokes.end - strokes.start
    low, high = (pick(strokes.start, strokes.end) for pick in (torch.minimum, torch.maximum))
    first, count = _pixels_between(low[:, 1] - margin, high[:, 1] + margin, projection.height)
    stroke, order = spread(count)
    row = first[stroke] + order
    # Between the borders of its row the stroke spans these columns.
    slope = torch.where(delta[:, 1] == 0, 0.0, delta[:, 0] / delta[:, 1])[stroke]
    reach = (0.5 + margin)[stroke]
    ends = []
    for side in (row - reach, row + reach):
        y = torch.minimum(torch.maximum(side, low[stroke, 1]), high[stroke, 1])
        x = strokes.start[stroke, 0] + slope * (y - strokes.start[stroke, 1])
        ends.append(torch.minimum(torch.maximum(x, low[stroke, 0]), high[stroke, 0]))
    level = (delta[:, 1] == 0)[stroke]
    left = torch.where(level, low[stroke, 0], torch.minimum(*ends)) - margin[stroke]
    right = torch.where(level, high[stroke, 0], torch.maximum(*ends)) + margin[stroke]
    first, count = _pixels_between(left, right, projection.width)
    item, order = spread(count)
    return stroke[item], first[item] + order, row[item]


def _pixels_between(low: Tensor, high: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The first pixel of each span, and how many of an axis there are."""
    first = (low + 0.5).floor().clamp(0, size).long()
    last = (high + 0.5).floor().clamp(-1, size - 1).long()
    return first, (last - first + 1).clamp(min=0)


def _seen(
    ends: Tensor, jumps: Tensor, squares: Squares, square: Tensor, line: Tensor, corners: Tensor
) -> Pieces:
    """Pieces that are not behind the faces, with these corners, that fill their squares.

    On the CPU it is done in machine code where numba is installed, else by tensors.
    """
    module = machine_code_for(ends, "pieces")
    if module is None:
        pieces = _clipped(ends, jumps, squares, square, line)
        return pieces.select(~_hidden(pieces, squares, corners))
    points, seen = module.clipped_and_seen(ends, squares, square, line, corners, BEHIND)
    keep = torch.nonzero(seen)[:, 0]
    points, line = points[keep], line[keep]
    return Pieces(
        square=square[keep],
        line=line,
        jumps=jumps[line],
        low=points[:, 0, :2],
        high=points[:, 1, :2],
        range=points[:, :, 2],
    )


def _clipped(ends: Tensor, jumps: Tensor, squares: Squares, square: Tensor, line: Tensor) -> Pieces:
    """Cuts every edge to the pyramid of its square's rays."""
    axes = torch.stack(
        [
            torch.linalg.cross(squares.along_v, squares.origin),
            torch.linalg.cross(squares.origin, squares.along_u),
            torch.linalg.cross(squares.along_u, squares.along_v),
        ]
    )
    axes = axes / dot(squares.along_u, axes[0])[:, None]
    local = [[dot(axis[square], ends[line, k]) for axis in axes] for k in (0, 1)]
    begin, end = torch.zeros_like(local[0][0]), torch.ones_like(local[0][0])
    for axis in (0, 1):
        for sign in (1.0, -1.0):
            h0, h1 = (0.5 * p[2] + sign * p[axis] for p in local)
            share = h0 / (h0 - h1)
            begin = torch.where(h0 < 0, torch.maximum(begin, share), begin)
            end = torch.where(h1 < 0, torch.minimum(end, share), end)
            end = torch.where((h0 < 0) & (h1 < 0), -1.0, end)
    keep = torch.nonzero(begin < end)[:, 0]
    start = [p[keep] for p in local[0]]
    delta = [b[keep] - a for a, b in zip(start, local[1], strict=True)]
    points = []
    for share in (begin[keep], end[keep]):
        x, y, t = (a + share * d for a, d in zip(start, delta, strict=True))
        points.append(torch.stack([x / t, y / t, t], -1))
    upwards = (points[0][:, 1] <= points[1][:, 1])[:, None]
    low, high = torch.where(upwards, *points), torch.where(upwards, points[1], points[0])
    return Pieces(
        square=square[keep],
        line=line[keep],
        jumps=jumps[line[keep]],
        low=low[:, :2].clamp(-0.5, 0.5),
        high=high[:, :2].clamp(-0.5, 0.5),
        range=torch.stack([low[:, 2], high[:, 2]], -1),
    )


def _hidden(pieces: Pieces, squares: Squares, corners: Tensor) -> Tensor:
    """Pieces behind the face with these corners, where that face fills their square."""
    points = corners.unbind(1)
    normal = torch.linalg.cross(points[1] - points[0], points[2] - points[0])
    offset = dot(normal, points[0])
    fills = offset != 0
    for k in range(3):
        side = torch.linalg.cross(points[k], points[(k + 1) % 3] - points[k])
        middle = dot(side, squares.origin)
        reach = 0.5 * (dot(side, squares.along_u).abs() + dot(side, squares.along_v).abs())
        fills &= middle * offset.sign() > reach
    own = pieces.square
    behind = fills[own]
    for end, distance in zip((pieces.low, pieces.high), pieces.range.unbind(1), strict=True):
        along = dot(normal[own], squares.rays(own, *end.unbind(1)))
        behind &= offset[own] / along < (1.0 - BEHIND) * distance
    return behind
