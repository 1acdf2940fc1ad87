"""Planes of faces: the range along a ray and its derivative, both closed forms."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Facets:
    """The planes ``normal . p = offset`` of all faces in the sensor's frame of one view."""

    normal: Float[Tensor, "face 3"]
    """Not normalised."""
    offset: Float[Tensor, " face"]

    @staticmethod
    def of(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> "Facets":
        """The planes of triangles whose corners are in the sensor's frame (m)."""
        v0, v1, v2 = vertices[faces].unbind(1)
        normal = torch.linalg.cross(v1 - v0, v2 - v0)
        return Facets(normal=normal, offset=(normal * v0).sum(-1))

    def ranges(
        self, face: Int[Tensor, "*batch"], rays: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Range (m) at which rays meet the planes; 0 where ``face`` is -1."""
        met = face >= 0
        index = face.clamp(min=0)
        t = self.offset[index] / (self.normal[index] * rays).sum(-1)
        return torch.where(met, t, torch.zeros_like(t))

    def slopes(
        self,
        face: Int[Tensor, "*batch"],
        rays: Float[Tensor, "*batch 3"],
        rays_step: Float[Tensor, "*batch 3"],
    ) -> Float[Tensor, "*batch"]:
        """Derivative of ``ranges`` when the rays move by ``rays_step``; 0 where ``face`` is -1."""
        normal = self.normal[face.clamp(min=0)]
        return -self.ranges(face, rays) * (normal * rays_step).sum(-1) / (normal * rays).sum(-1)

    def twist_derivatives(
        self, face: Int[Tensor, "*batch"], rays: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 6"]:
        """Derivative of ``ranges`` to the motion of the face: dz/dp = n / (n . ray).

        The motion is a twist on the left, in the sensor's frame (m, rad); 0 where ``face`` is -1.
        """
        normal = self.normal[face.clamp(min=0)]
        per_metre = normal / (normal * rays).sum(-1, keepdim=True)
        points = self.ranges(face, rays)[..., None] * rays
        derivative = torch.cat([per_metre, torch.linalg.cross(points, per_metre)], -1)
        return torch.where((face >= 0)[..., None], derivative, torch.zeros_like(derivative))
