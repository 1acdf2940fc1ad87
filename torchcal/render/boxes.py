"""Boxes of pixels that faces may cover, and cones about pixels: both only cull."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchcal.geometry.projection import Projection, Spherical
from torchcal.render.squares import Squares, tile_numbers, tiles_of

CLOSE = 1e-6
"""Corners nearer than this (m) to a pinhole's plane do not bound their face in the image."""
MARGIN = 1e-3
"""Pixels by which rounding may move a face in a pinhole's image."""
AROUND = 2e-3
"""rad: cones are taken as wider by this than rounding makes of them."""
SPREAD, SLOPE = 0.3, 4.0
"""Longest side (chord of the unit sphere) and steepest elevation (its tangent) of faces that the
box of their corners bounds in a spherical image."""


def pixel_boxes(
    vertices: Float[Tensor, "view vertex 3"], faces: Int[Tensor, "face 3"], projection: Projection
) -> Int[Tensor, "view face 4"]:
    """Half-open boxes (u0, v0, u1, v1) of pixel centres that each face may cover.

    Args:
        vertices: Points (m) in the sensor's frame of each view.
        faces: Vertices of each triangle.
        projection: The sensor's optics.
    """
    depth = vertices[..., 2:]
    finite = (0.0 * vertices).sum(-1, keepdim=True)  # 0, or NaN
    low, high = _bounds(torch.cat([projection.pixels(vertices), depth, finite], -1), faces)
    hidden = low[..., 3].isnan()
    if isinstance(projection, Spherical):
        corners = vertices[:, faces]
        margin, bounded = _spherical_bounds(corners, projection)
        hidden |= are_beside(corners, projection)
    else:
        margin, bounded = MARGIN, low[..., 2] > CLOSE
        hidden |= high[..., 2] <= 0
    low, high = low[..., :2], high[..., :2]
    size = torch.tensor([projection.width, projection.height], device=vertices.device).to(low)
    low = torch.where(bounded[..., None], (low - margin).ceil(), 0.0)
    high = torch.where(bounded[..., None], (high + margin).floor() + 1, size)
    low = torch.minimum(low.nan_to_num(0.0).clamp(min=0), size).int()
    high = torch.minimum(high.nan_to_num(0.0).clamp(min=0), size).int()
    return torch.cat([low, torch.where(hidden[..., None], low, high)], -1)


def tile_cones(
    low: Int[Tensor, "*batch 2"],
    high: Int[Tensor, "*batch 2"],
    projection: Projection,
    like: Tensor,
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Unit axes and sines of the half-angles of cones that hold the rays of some pixels.

    Args:
        low: The first pixel (u, v) of each tile.
        high: One beyond its last.
        projection: The sensor's optics.
        like: Gives the dtype.
    """
    low, high = low.to(like), high.to(like) - 1
    middle = 0.5 * (low + high)
    axis = normalize(projection.rays(middle[..., 0], middle[..., 1]), dim=-1)
    corners = [(a[..., 0], b[..., 1]) for a in (low, high) for b in (low, high)]
    rays = torch.stack([normalize(projection.rays(u, v), dim=-1) for u, v in corners], -2)
    chord = (rays - axis[..., None, :]).norm(dim=-1).amax(-1)
    return axis, (1.05 * chord).clamp(max=1.0) + 1e-6


def are_beside(
    corners: Float[Tensor, "*batch corner 3"], projection: Spherical
) -> Bool[Tensor, "*batch"]:
    """Whether lines or triangles with these corners (m) are wholly outside a cone about the image.

    The directions in which they are seen lie in a cone, too, that holds those of their corners; of
    those that may be seen over a half of the sphere it is not asked.
    """
    rays = normalize(corners, dim=-1)
    middle = normalize(rays.sum(-2), dim=-1)
    own = _angle(middle[..., None, :], rays).amax(-1)
    axis, reach = image_cone(projection, corners)
    return (own < 0.25 * math.pi) & (_angle(middle, axis) > own + reach + AROUND)


def image_cone(
    projection: Projection, like: Tensor
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """The unit axis and half the angle (rad) of a cone that holds the rays of all pixels."""
    size = torch.tensor([projection.width, projection.height], device=like.device)
    axis, chord = tile_cones(0 * size - 1, size + 1, projection, like)
    return axis, torch.where(chord < 1.0, 2.0 * (0.5 * chord).asin(), math.pi)


def tiles_of_points(
    squares: Squares, square: Int[Tensor, " point"], projection: Projection, views: int
) -> Int[Tensor, "view row column 2"]:
    """The first point in each tile, and how many there are; points come tile after tile."""
    columns, rows = tiles_of(projection)
    tile = tile_numbers(squares.view, squares.u, squares.v, projection)
    count = tile[square].bincount(minlength=views * rows * columns)
    return torch.stack([count.cumsum(0) - count, count], -1).view(views, rows, columns, 2)


def _angle(unit: Tensor, other: Tensor) -> Tensor:
    """Between unit vectors (rad)."""
    return (unit * other).sum(-1).clamp(-1, 1).acos()


def _bounds(of_vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the greatest of what each face's corners have; NaN if one of them is."""
    a, b, c = (of_vertices.index_select(1, corner) for corner in faces.unbind(1))
    return torch.minimum(torch.minimum(a, b), c), torch.maximum(torch.maximum(a, b), c)


def _spherical_bounds(corners: Tensor, projection: Spherical) -> tuple[Tensor, Tensor]:
    """Margin (pixels) by which sides bulge, and whether the box of the corners bounds a face."""
    ray = normalize(corners, dim=-1)
    sides = ray - ray.roll(1, -2)
    spread = sides.norm(dim=-1).amax(-1)
    height = ray[..., 1].abs()
    slope = (height / (1 - height.square()).clamp(min=1e-9).sqrt()).amax(-1)
    step = min(abs(projection.azimuth_step), abs(projection.elevation_step)) or 1.0
    margin = spread.square() * (1 + slope) / step + 0.5
    x, z = corners[..., 0], corners[..., 2]
    over_seam = (z < 0).any(-1) & (x.amin(-1) * x.amax(-1) < 0)
    return margin[..., None], (spread < SPREAD) & (slope < SLOPE) & ~over_seam
