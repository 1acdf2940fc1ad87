"""What the range in a pixel's middle leaves out of its mean where the surface is curved or bent.

The mean over a pixel is the range in the middle plus z'' / 24 along rows and along columns, with
z'' the second difference from pixel to pixel. For perspective this is exact to the fourth order; at
an edge between two faces that are both seen it is right in the mean over the places of the edge.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.render.facets import Facets
from torchcal.render.layer import Layer

SMOOTH = 1e-3
"""Share of the range: a smaller second difference is no jump that matters."""
ROUNDING = 1e-6
"""Share of the inverse range by which planes that are one may differ."""


def with_bends(
    layer: Layer,
    hard: Layer,
    face: Int[Tensor, "view h w"],
    facets: Facets,
    projection: Projection,
) -> Layer:
    """Adds what bends of the surface change in the means of pixels.

    Args:
        layer: The layer to add it to.
        hard: The layer of the ranges in the pixels' middles.
        face: The face at the centre of every pixel.
        facets: Planes of the faces.
        projection: The sensor's optics.
    """
    share = [
        _share(hard.total.detach(), face, facets, projection, columns) for columns in (True, False)
    ]
    derivative = layer.total_derivative
    if derivative.shape[1]:
        derivative = derivative + _bend(hard.total_derivative, [each[:, None] for each in share])
    return Layer(
        total=layer.total + _bend(hard.total, share),
        area=layer.area,
        total_derivative=derivative,
        area_derivative=layer.area_derivative,
    )


def _bend(image: Tensor, share: list[Tensor]) -> Tensor:
    """The shares of z'' along rows and along columns; 0 at the border."""
    inner = image[..., 1:-1, 1:-1]
    along_u = (image[..., 1:-1, 2:] + image[..., 1:-1, :-2]).sub(inner, alpha=2.0)
    along_v = (image[..., 2:, 1:-1] + image[..., :-2, 1:-1]).sub(inner, alpha=2.0)
    bend = along_u.mul(share[0]).addcmul(along_v, share[1])
    return torch.nn.functional.pad(bend, (1, 1, 1, 1))


def _share(
    ranges: Tensor, face: Tensor, facets: Facets, projection: Projection, columns: bool
) -> Float[Tensor, "view inner_h inner_w"]:
    """1/24 where pixels and both their neighbours in a row or column show one surface, or 0."""
    low, middle, high = (_shifted(ranges, by, columns) for by in (-1, 0, 1))
    sharp = (low + high).sub(middle, alpha=2.0).abs() > SMOOTH * middle
    share = torch.full_like(middle, 1.0 / 24.0)
    there = [_shifted(face, by, columns) for by in (-1, 0, 1)]
    share = share * (torch.minimum(torch.minimum(*there[:2]), there[2]) >= 0)
    view, v, u = torch.nonzero(sharp, as_tuple=True)
    own = there[1][view, v, u]
    meeting = torch.ones_like(own, dtype=torch.bool)
    for by in (-1, 1):
        beside = (u + 1 + by, v + 1) if columns else (u + 1, v + 1 + by)
        rays = [
            projection.rays(*(x.to(ranges) for x in place)) for place in ((u + 1, v + 1), beside)
        ]
        meeting &= _meet(own, there[1 + by][view, v, u], rays, facets)
    share[view, v, u] *= meeting
    return share


def _shifted(image: Tensor, by: int, columns: bool) -> Tensor:
    """The inner part of the image, moved by some columns or rows."""
    along_v, along_u = (0, by) if columns else (by, 0)
    height, width = image.shape[-2:]
    return image[..., 1 + along_v : height - 1 + along_v, 1 + along_u : width - 1 + along_u]


def _meet(own: Tensor, other: Tensor, rays: list[Tensor], facets: Facets) -> Tensor:
    """Whether two faces' planes meet between the rays through their own pixels' centres."""
    own_ray, other_ray = rays
    inverse = facets.ranges(other, other_ray).reciprocal()
    before = facets.ranges(own, own_ray).reciprocal() - facets.ranges(other, own_ray).reciprocal()
    after = facets.ranges(own, other_ray).reciprocal() - inverse
    together = torch.minimum(before.abs(), after.abs()) < ROUNDING * inverse.abs()
    return together | (before * after <= 0)
