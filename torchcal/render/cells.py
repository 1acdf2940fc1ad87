"""Cells: each square cut into trapezoids within which one face is seen.

Lines of equal y through the ends and the meetings of all pieces cut a square into slabs; the pieces
that pass through a slab cut it into cells. Whatever is seen, the cells fill the square.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.render.pieces import Pieces
from torchcal.render.squares import Squares

AT_ONCE = 1 << 21
"""Places for cells, most of them empty, that tensors have at a time: it bounds the memory."""
THIN = 1e-11
"""Lower slabs (pixels) are left out."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Cells:
    """Trapezoids in the order of their squares, in each slab from left to right."""

    square: Int[Tensor, " cell"]
    y: Float[Tensor, "cell 2"]
    """Of the lower and the upper side."""
    left: Float[Tensor, "cell 2"]
    """x of the left ends of the lower and the upper side."""
    right: Float[Tensor, "cell 2"]
    piece: Int[Tensor, " cell"]
    """The piece at the right, beyond which the next cell is; -1 at the square's border."""
    ray: Float[Tensor, "cell 3"]
    """Through a point inside the cell: its centroid, but for rounding."""

    @staticmethod
    def of(
        square: Tensor, y: Tensor, left: Tensor, right: Tensor, piece: Tensor, squares: Squares
    ) -> "Cells":
        """Cells with their rays."""
        a, b = (right - left).unbind(1)
        # The narrower of both sides counts half as much as the wider one, where it is a point.
        share = torch.where(a + b > 0, (a + 2.0 * b) / (3.0 * (a + b)), 0.5)
        (low, high), (start, end) = (0.5 * (left + right)).unbind(1), y.unbind(1)
        ray = squares.rays(square, low + share * (high - low), start + share * (end - start))
        return Cells(square=square, y=y, left=left, right=right, piece=piece, ray=ray)


def cells_of(pieces: Pieces, squares: Squares) -> Cells:
    """Cuts all squares that have a piece at least."""
    count = pieces.square.bincount(minlength=len(squares.view))
    start = count.cumsum(0) - count
    width = 2 ** (count - 1).clamp(min=0).double().log2().floor().long().add(1)
    width = torch.where(count <= 1, count, width)
    empty = pieces.low.new_zeros(0, 2)
    groups = [(count[:0], empty, empty, empty, count[:0])]
    groups += [
        _cells_of_group(pieces, part, start, count, k)
        for k in torch.unique(width).tolist()
        if k
        for part in torch.nonzero(width == k)[:, 0].split(max(1, AT_ONCE // k**3))
    ]
    square, y, left, right, piece = (torch.cat(part) for part in zip(*groups, strict=True))
    order = torch.sort(square, stable=True).indices
    return Cells.of(*(each[order] for each in (square, y, left, right, piece)), squares=squares)


def _cells_of_group(
    pieces: Pieces, square: Tensor, start: Tensor, count: Tensor, width: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The cells of squares with at most ``width`` pieces each."""
    place = torch.arange(width, device=square.device)
    there = place < count[square, None]
    piece = torch.where(there, start[square, None] + place, 0)
    x, y = pieces.low[piece].unbind(-1)
    high_x, high_y = pieces.high[piece].unbind(-1)
    y, high_y = y.masked_fill(~there, 0.5), high_y.masked_fill(~there, 0.5)
    slope = ((high_x - x) / (high_y - y)).masked_fill(high_y - y < THIN, 0.0)
    lines = (x, y, high_y, slope)
    border = torch.full_like(y[:, :1], 0.5)
    cuts = torch.cat([-border, border, y, high_y, _meetings(lines)], 1).sort(1).values
    low, high = cuts[:, :-1, None], cuts[:, 1:, None]
    x, y, high_y, slope = (each[:, None] for each in lines)
    passes = (y <= low) & (high_y >= high) & (high - low > THIN)
    middle = (x + slope * (0.5 * (low + high) - y)).masked_fill(~passes, torch.inf)
    order = middle.sort(dim=-1, stable=True).indices
    passes = passes.gather(-1, order)
    ends = [
        (x + slope * (end - y)).gather(-1, order).clamp(-0.5, 0.5).masked_fill(~passes, 0.5)
        for end in (low, high)
    ]
    sides = torch.stack(ends, -1)
    border = torch.full_like(sides[:, :, :1], 0.5)
    left, right = torch.cat([-border, sides], 2), torch.cat([sides, border], 2)
    beyond = torch.where(passes, piece[:, None].expand_as(order).gather(-1, order), -1)
    beyond = torch.cat([beyond, torch.full_like(beyond[..., :1], -1)], -1)
    valid = torch.cat([high - low > THIN, passes], -1)
    row, slab, cell = torch.nonzero(valid, as_tuple=True)
    left, right = left[row, slab, cell], right[row, slab, cell]
    y = torch.stack([cuts[row, slab], cuts[row, slab + 1]], -1)
    return square[row], y, left, torch.maximum(left, right), beyond[row, slab, cell]


def _meetings(lines: tuple[Tensor, Tensor, Tensor, Tensor]) -> Tensor:
    """Y of the points where two pieces of a square cross; 1/2 where they do not."""
    x, y, high_y, slope = lines
    i, j = torch.triu_indices(x.shape[1], x.shape[1], 1, device=x.device)
    low = torch.maximum(y[:, i], y[:, j])
    high = torch.minimum(high_y[:, i], high_y[:, j])
    begin, end = (
        x[:, i] + slope[:, i] * (at - y[:, i]) - (x[:, j] + slope[:, j] * (at - y[:, j]))
        for at in (low, high)
    )
    meets = (low < high) & (begin * end < 0)
    return torch.where(meets, low + (high - low) * (begin / (begin - end)), 0.5)
