"""Procedure 3.5 with points: nearest patches of the model, robust fit, new correspondences.

It needs no overlap of the predicted with the measured image and so forgives starts far off.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.observation import Observation
from torchcal.calibrate.parameters import Parameters
from torchcal.geometry import robust, se3
from torchcal.geometry.projection import pixel_grid
from torchcal.match.nearest import Patches
from torchcal.model.scene import Surface
from torchcal.render.facets import Facets
from torchcal.render.synthesis import place_vertices
from torchcal.render.visibility import visible_faces
from torchcal.solve.gauss_newton import NormalEquations

WIDENED = 0.25
"""Share of the image by which the view of the model is widened: a wrong start looks beside it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Part:
    """What one frame sees of bodies that move alike."""

    frame: int
    body: int
    """One of the bodies."""
    patches: Patches
    """In the frame of that body."""


@dataclass(frozen=True, kw_only=True, slots=True)
class NearestFit:
    """The fit of measured points to the nearest patches of the model's visible surface."""

    parameters: Parameters
    points: Float[Tensor, "frame point 3"]
    """Measured points in the sensor's frame (m)."""
    valid: Bool[Tensor, "frame point"]
    sigma: Float[Tensor, "frame point"]
    parts: tuple[_Part, ...]

    @staticmethod
    def of(
        observation: Observation,
        surface: Surface,
        parameters: Parameters,
        state: Float[Tensor, "slot 4 4"],
        *,
        count: int,
        generator: torch.Generator,
    ) -> "NearestFit":
        """Takes ``count`` measured points of each frame and the patches seen from ``state``."""
        points, valid, sigma = _sampled_points(observation, count, generator)
        return NearestFit(
            parameters=parameters,
            points=points.double(),
            valid=valid,
            sigma=sigma.double(),
            parts=_visible_parts(observation, surface, parameters, state),
        )

    def evaluate(self, states: Float[Tensor, "batch slot 4 4"]) -> NormalEquations:
        """Normal equations of every state, with correspondences found anew (3.5 (1) to (4))."""
        error, jacobian = self._correspondences(states)
        v = torch.where(self.valid, error / self.sigma, torch.nan).flatten(1)
        c = robust.cutoff(v)[:, None]
        seen = v.isfinite()
        v = torch.where(seen, v, 0.0)
        weight = torch.where(seen, robust.biweight(v, c), 0.0) / self.sigma.flatten().square()
        H = jacobian.flatten(1, 2)
        HW = H * weight[..., None]
        prior = self.parameters.prior_precision
        offset = self.parameters.difference(states, self.parameters.nominal)
        # Across cut-offs only the scale of the residuals can be compared: c^2 per point.
        cost = torch.where(seen, robust.biweight_cost(v, c), 0.0).sum(1)
        return NormalEquations(
            cost=cost + 0.5 * (prior * offset.square()).sum(-1),
            information=H.mT @ HW + torch.diag(prior),
            gradient=(HW.mT @ error.flatten(1)[..., None])[..., 0] - prior * offset,
        )

    def _correspondences(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (m) along the normals of the nearest patches, and what predicts them."""
        poses = self.parameters.bodies_in_sensor(states)
        motions = list(self.parameters.motions(states, range(len(self.points))))
        shape = (len(states), *self.points.shape[:2])
        best = self.points.new_full(shape, torch.inf)
        error = self.points.new_zeros(shape)
        jacobian = self.points.new_zeros(*shape, len(self.parameters.names))
        for part in self.parts:
            k = part.frame
            T = se3.inverse(poses[:, k, part.body])
            placed = se3.transform(T, self.points[k])
            distance, index = part.patches.nearest(placed)
            normal = part.patches.normals[index] @ T[:, :3, :3]
            along = ((placed - part.patches.points[index]) * part.patches.normals[index]).sum(-1)
            pulled = torch.cat(
                [normal, torch.linalg.cross(self.points[k].expand_as(normal), normal)], -1
            )
            closer = distance < best[:, k]
            best[:, k] = torch.where(closer, distance, best[:, k])
            error[:, k] = torch.where(closer, along, error[:, k])
            row = torch.zeros_like(jacobian[:, k])
            row[..., self.parameters.active(k)] = pulled @ motions[k][:, part.body]
            jacobian[:, k] = torch.where(closer[..., None], row, jacobian[:, k])
        return error, jacobian


def _sampled_points(
    observation: Observation, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Measured points of each frame, drawn without putting any back, and which are valid."""
    u, v = pixel_grid(
        observation.sensor.projection,
        dtype=observation.range.dtype,
        device=observation.range.device,
    )
    rays = observation.sensor.projection.rays(u, v)
    chance = torch.rand(observation.range.shape, generator=generator).to(observation.range)
    chance = torch.where(observation.measured, chance, -1.0).flatten(1)
    order = chance.topk(min(count, chance.shape[1]), dim=1)
    points = (observation.range[..., None] * rays).flatten(1, 2)
    chosen = order.indices
    return (
        points.gather(1, chosen[..., None].expand(-1, -1, 3)),
        order.values >= 0,
        observation.sigma.flatten(1).gather(1, chosen),
    )


def _visible_parts(
    observation: Observation, surface: Surface, parameters: Parameters, state: Tensor
) -> tuple[_Part, ...]:
    """Patches at the pixels of a widened view from the nominal pose, part by part."""
    projection = observation.sensor.projection
    projection = projection.widened(int(WIDENED * max(projection.width, projection.height)))
    Ts_sensor_body = parameters.bodies_in_sensor(state)
    group = parameters.mechanism.moving_alike
    u, v = pixel_grid(projection, dtype=state.dtype, device=state.device)
    rays = projection.rays(u, v)
    parts = []
    for k, poses in enumerate(Ts_sensor_body):
        vertices = place_vertices(surface, poses)
        face = visible_faces(vertices[None].float(), surface.faces, projection)[0]
        facets = Facets.of(vertices, surface.faces)
        ranges = facets.ranges(face, rays)
        seen = (
            (face >= 0) & (ranges >= observation.sensor.near) & (ranges <= observation.sensor.far)
        )
        points, normals = (ranges[..., None] * rays)[seen], facets.normal[face[seen]]
        normals = torch.nn.functional.normalize(normals, dim=-1)
        owner = group[surface.vertex_body[surface.faces[face[seen], 0]]]
        for body in owner.unique().tolist():
            chosen, T = owner == body, se3.inverse(poses[body])
            patches = Patches.of(se3.transform(T, points[chosen]), normals[chosen] @ T[:3, :3].mT)
            parts.append(_Part(frame=k, body=body, patches=patches))
    return tuple(parts)
