"""Planes of faces: the range along a ray and its derivative, both closed forms."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Spread:
    """Second moments of regions about their centroids, over their areas (pixels^2)."""

    uu: Float[Tensor, "*#batch 1"]
    uv: Float[Tensor, "*#batch 1"]
    vv: Float[Tensor, "*#batch 1"]

    @staticmethod
    def of_square(like: Tensor) -> "Spread":
        """Of a whole pixel."""
        third = like.new_full((1,), 1.0 / 12.0)
        return Spread(uu=third, uv=torch.zeros_like(third), vv=third)


@dataclass(frozen=True, kw_only=True, slots=True)
class Hits:
    """Where rays meet the planes of faces."""

    rays: Float[Tensor, "*#batch 3"]
    """``range * rays`` is the point (m) that moves with the face."""
    normal: Float[Tensor, "*batch 3"]
    """Not normalised; 0 where there is no face."""
    scale: Float[Tensor, "*batch"]
    """1 / (normal . ray): times ``normal``, the derivative of the range to the face's motion (m);
    0 where nothing is met."""
    range: Float[Tensor, "*batch"]
    """m; 0 where nothing is met."""

    def between(self, near: float, far: float) -> "Hits":
        """Those with ranges (m) within limits; at the others nothing is met."""
        outside = (self.range.detach() < near) | (self.range.detach() > far)
        return replace(
            self,
            scale=self.scale.masked_fill(outside, 0.0),
            range=self.range.masked_fill(outside, 0.0),
        )

    def averaged(
        self, spread: Spread, to_u: Float[Tensor, "*#batch 3"], to_v: Float[Tensor, "*#batch 3"]
    ) -> "Hits":
        """The mean ranges over regions whose centroids the rays see, and their derivatives.

        With w = n . ray and the range 1 / w but for a factor, it is the second order of the mean.

        Args:
            spread: Of the regions.
            to_u: How rays turn from column to column.
            to_v: And from row to row.
        """
        scale = self.scale[..., None]
        normal = self.normal * scale
        slope_u, slope_v = dot(normal, to_u)[..., None], dot(normal, to_v)[..., None]
        across_u = spread.uu * slope_u + spread.uv * slope_v
        across_v = spread.uv * slope_u + spread.vv * slope_v
        twice = 2.0 * (across_u * to_u + across_v * to_v)
        excess = across_u * slope_u + across_v * slope_v
        gain = 1.0 + excess
        return replace(
            self,
            rays=((gain + 2.0 * excess) * self.rays - twice) / gain.square(),
            scale=self.scale * gain[..., 0],
            range=self.range * gain[..., 0],
        )

    def twist_derivatives(self) -> Float[Tensor, "6 ..."]:
        """Derivative of the range to the motion of the face: dz/dp = n / (n . ray).

        The motion is a twist on the left, in the sensor's frame (m, rad); 0 where nothing is met.
        """
        x, y, z = (self.normal * self.scale[..., None]).unbind(-1)
        u, v, w = (self.rays * self.range[..., None]).unbind(-1)
        return torch.stack([x, y, z, v * z - w * y, w * x - u * z, u * y - v * x])


@dataclass(frozen=True, kw_only=True, slots=True)
class Facets:
    """The planes ``normal . p = offset`` of all faces in the sensor's frame."""

    normal: Float[Tensor, "plane 3"]
    """Not normalised; the last one, of 0, stands for no face."""
    offset: Float[Tensor, " plane"]

    @staticmethod
    def of(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> "Facets":
        """The planes of triangles whose corners are in the sensor's frame (m)."""
        v0, v1, v2 = (vertices.index_select(0, corner) for corner in faces.unbind(1))
        normal = torch.linalg.cross(v1 - v0, v2 - v0)
        offset = dot(normal, v0)
        return Facets(
            normal=torch.cat([normal, normal.new_zeros(1, 3)]),
            offset=torch.cat([offset, offset.new_zeros(1)]),
        )

    def at(self, face: Int[Tensor, "*batch"], rays: Float[Tensor, "*#batch 3"]) -> Hits:
        """Where rays meet the planes of their faces; nothing where ``face`` is -1."""
        none = face < 0
        index = face.masked_fill(none, len(self.offset) - 1).flatten()
        normal = self.normal.index_select(0, index).view(*face.shape, 3)
        along = dot(normal, rays).masked_fill(none, 1.0)
        offset = self.offset.index_select(0, index).view(face.shape)
        scale = along.reciprocal().masked_fill(none, 0.0)
        return Hits(rays=rays, normal=normal, scale=scale, range=offset / along)

    def ranges(
        self, face: Int[Tensor, "*batch"], rays: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Range (m) at which rays meet the planes; 0 where ``face`` is -1."""
        return self.at(face, rays).range


def dot(a: Float[Tensor, "*#batch 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch"]:
    """Scalar products, added up in the same order whatever the batch is."""
    (x, y, z), (u, v, w) = a.unbind(-1), b.unbind(-1)
    return x * u + y * v + z * w
