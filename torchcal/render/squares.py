"""Squares of pixels that borders cross, each with a flat picture of its own.

Within one pixel every ray is taken as ``origin + x along_u + y along_v`` with x and y from -1/2 to
1/2. For a pinhole this is exact, for a spherical sensor to the second order of the pixel's size;
edges are straight in it, and points, edges and planes agree to the last digits of double precision.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection

TILT = 1.2345e-6
"""Slope of the lines of equal y: no edge is parallel to them, upright cameras have level ones."""
TILE = 8
"""Side (pixels) of the tiles by which squares are ordered."""
_GAUSS = 12**-0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class Squares:
    """Pixels of a batch of views, tile after tile, in double precision."""

    view: Int[Tensor, " square"]
    u: Int[Tensor, " square"]
    v: Int[Tensor, " square"]
    origin: Float[Tensor, "square 3"]
    """The ray at the middle, but for what the curvature of the rays takes away from the mean."""
    along_u: Float[Tensor, "square 3"]
    along_v: Float[Tensor, "square 3"]

    @staticmethod
    def of(number: Int[Tensor, " square"], projection: Projection) -> "Squares":
        """Squares of pixels that are counted by ``square_numbers``."""
        columns, rows = tiles_of(projection)
        number, within = number // TILE**2, number % TILE**2
        tile, view = number % (columns * rows), number // (columns * rows)
        u = (tile % columns) * TILE + within % TILE
        v = (tile // columns) * TILE + within // TILE
        middle_u, middle_v = u.double(), v.double()
        low_u, high_u = middle_u - _GAUSS, middle_u + _GAUSS
        low_v, high_v = middle_v - _GAUSS, middle_v + _GAUSS
        a, b = projection.rays(low_u, low_v), projection.rays(high_u, low_v)
        c, d = projection.rays(low_u, high_v), projection.rays(high_u, high_v)
        along_u = (b - a + (d - c)) / (4.0 * _GAUSS)
        along_v = (c - a + (d - b)) / (4.0 * _GAUSS)
        return Squares(
            view=view,
            u=u,
            v=v,
            origin=0.25 * (a + b + (c + d)),
            along_u=along_u - TILT * along_v,
            along_v=along_v,
        )

    def select(self, keep: Tensor) -> "Squares":
        """The squares to keep."""
        return Squares(
            view=self.view[keep],
            u=self.u[keep],
            v=self.v[keep],
            origin=self.origin[keep],
            along_u=self.along_u[keep],
            along_v=self.along_v[keep],
        )

    def rays(
        self, square: Int[Tensor, " point"], x: Float[Tensor, " point"], y: Float[Tensor, " point"]
    ) -> Float[Tensor, "point 3"]:
        """Rays of points in squares."""
        rays = self.origin[square] + x[:, None] * self.along_u[square]
        return rays + y[:, None] * self.along_v[square]


def square_numbers(
    view: Int[Tensor, "*batch"],
    u: Int[Tensor, "*batch"],
    v: Int[Tensor, "*batch"],
    projection: Projection,
) -> Int[Tensor, "*batch"]:
    """Numbers of pixels, counted view after view and tile after tile."""
    tile = tile_numbers(view, u, v, projection)
    return (tile * TILE + v % TILE) * TILE + u % TILE


def tile_numbers(
    view: Int[Tensor, "*batch"],
    u: Int[Tensor, "*batch"],
    v: Int[Tensor, "*batch"],
    projection: Projection,
) -> Int[Tensor, "*batch"]:
    """Numbers of the tiles in which pixels are, counted view after view."""
    columns, rows = tiles_of(projection)
    return (view * rows + v // TILE) * columns + u // TILE


def spread(count: Int[Tensor, " item"]) -> tuple[Int[Tensor, " entry"], Int[Tensor, " entry"]]:
    """Each item as often as it counts, and how often it was there before."""
    item = torch.repeat_interleave(count)
    return item, torch.arange(len(item), device=count.device) - (count.cumsum(0) - count)[item]


def tiles_of(projection: Projection) -> tuple[int, int]:
    """Columns and rows of tiles in an image."""
    return -(-projection.width // TILE), -(-projection.height // TILE)
