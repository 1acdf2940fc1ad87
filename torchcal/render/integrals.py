"""Integrals over squares: of the planes of their regions, and what their rims change.

A region's integral moves with its face, and with the lines that bound it: where the range jumps
there, the jump times the area that a line sweeps is what its motion changes.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.render.facets import Facets, Hits, Spread, dot
from torchcal.render.layer import Sums
from torchcal.render.machine_code import is_traced, machine_code_for
from torchcal.render.motion import BodyMotion
from torchcal.render.regions import Divided, Regions, Rims
from torchcal.render.silhouette import Borders
from torchcal.render.soup import Views
from torchcal.render.squares import Squares


@dataclass(frozen=True, kw_only=True, slots=True)
class BorderPlanes:
    """The planes through the sensor that hold the borders."""

    normal: Float[Tensor, "border 3"]
    """first x last: not normalised."""
    along: Float[Tensor, "border 3"]
    """From the first end to the last one (m)."""
    body: Int[Tensor, " border"]

    @staticmethod
    def of(borders: Borders, views: Views) -> "BorderPlanes":
        """The planes of all borders."""
        edges = views.surface.edges[borders.edge]
        first, last = views.vertices[edges].unbind(1)
        return BorderPlanes(
            normal=torch.linalg.cross(first, last - first),
            along=last - first,
            body=views.surface.vertex_body[edges[:, 0]],
        )

    def values(self, rims: Rims, lever: Float[Tensor, "rim 3"]) -> Float[Tensor, " rim"]:
        """Normal . lever: 0, but its derivative is not."""
        return dot(self.normal[rims.border], lever)

    def twist_derivatives(
        self, rims: Rims, lever: Float[Tensor, "rim 3"]
    ) -> Float[Tensor, "rim 6"]:
        """Derivative of ``values`` to the motion of the border, a twist in the sensor's frame."""
        along, normal = self.along[rims.border], self.normal[rims.border]
        return torch.cat([torch.linalg.cross(along, lever), torch.linalg.cross(normal, lever)], -1)


def sums_of(divided: Divided, borders: Borders, views: Views, motion: BodyMotion | None) -> Sums:
    """The integrals of range and area over squares, and their derivatives.

    On the CPU it is done in machine code where numba is installed, else, and if gradients are to
    be traced, by tensors.

    Args:
        divided: The squares.
        borders: The lines that move their rims.
        views: In double precision.
        motion: How bodies move with the parameters.
    """
    module = None if is_traced(views.vertices) else machine_code_for(views.vertices, "integrals")
    of_squares = plain_sums_of if module is None else module.sums_of
    return of_squares(divided, borders, views, motion)


def plain_sums_of(
    divided: Divided, borders: Borders, views: Views, motion: BodyMotion | None
) -> Sums:
    """The same by tensor operations, on any device."""
    squares, regions, rims = divided.squares, divided.regions, divided.rims
    hits = mean_hits(regions, squares, views)
    met = (hits.scale != 0).to(regions.area) * regions.area
    planes = BorderPlanes.of(borders, views)

    def summed(of_regions: Tensor, of_rims: Tensor) -> Tensor:
        zeros = of_regions.new_zeros(len(squares.view), *of_regions.shape[1:])
        return zeros.index_add(0, regions.square, of_regions).index_add(0, rims.square, of_rims)

    total = summed(hits.range * regions.area, planes.values(rims, rims.total_lever))
    area = summed(met, planes.values(rims, rims.area_lever))
    inner, changes = total.new_zeros(len(met), 0), [total.new_zeros(len(rims.square), 0)] * 2
    if motion is not None:
        twists = hits.twist_derivatives().mT * regions.area[:, None]
        inner = motion.of_faces(twists, regions.face, squares.view[regions.square])
        changes = [
            motion.of_bodies(
                planes.twist_derivatives(rims, lever),
                planes.body[rims.border],
                squares.view[rims.square],
            )
            for lever in (rims.total_lever, rims.area_lever)
        ]
    return Sums(
        total=total,
        area=area,
        total_derivative=summed(inner, changes[0]),
        area_derivative=summed(torch.zeros_like(inner), changes[1]),
    )


def mean_hits(regions: Regions, squares: Squares, views: Views) -> Hits:
    """The mean ranges of regions, and their derivatives."""
    faces = views.surface.faces[regions.face.clamp(min=0)]
    index = torch.arange(len(faces), device=faces.device).where(regions.face >= 0, -1)
    own = regions.square
    rays = squares.rays(own, *regions.centroid.unbind(1))
    hits = Facets.of(views.vertices, faces).at(index, rays)
    uu, uv, vv = regions.spread[:, :, None].unbind(1)
    spread = Spread(uu=uu, uv=uv, vv=vv)
    hits = hits.averaged(spread, squares.along_u[own], squares.along_v[own])
    return hits.between(views.sensor.near, views.sensor.far)
