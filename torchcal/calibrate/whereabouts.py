"""First poses of a sensor: what explains a coarse image, about a start or anywhere (3.5).

Anywhere: directions of planes give rotations, correlation of voxels gives the positions for each.
All that is found is judged by predicted images.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.one_view import OneView, as_states
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.ray_fit import RayFit
from torchcal.calibrate.site import Site
from torchcal.geometry import robust, se3
from torchcal.match.directions import Directions, aligning_rotations
from torchcal.match.features import Planes
from torchcal.match.volume import peaks
from torchcal.solve.gauss_newton import GaussNewtonConfig, minimise, shared

DRAWS = (32, 64, 512)
"""Poses drawn from a prior; more where the first do not lead to one that explains the image."""
IMAGE_DIRECTIONS = 6
"""Most directions of planes in the image."""
ROTATIONS = 60
"""Most rotations that are tried."""
PLACES = 12
"""Most positions for each rotation."""
JUDGED = 300
"""Most poses whose images are predicted."""
SHARE, LEAST_FITTED = 12, 4
"""One pose in so many is fitted to the coarse image, and so many at least."""
KEPT = 8
"""Poses that are fitted to the fine one."""
FIRST_TOLERANCE = 0.2
"""m: what ranges may be off by before any fit."""
TOLERANCES = (0.1, 0.03)
"""m: in the fits to the fine image, one after the other."""
LAST_TOLERANCE = 0.003
"""m: where the beam mixes nothing."""
APART = 0.05
"""m and rad: poses that differ by less are one."""
STEPS = GaussNewtonConfig(iterations=6, ripple=0.01, tolerance=0.3, trusted=1.0)
"""Of all fits but the last: with such tolerances their ends need not be exact."""
LAST_STEPS = replace(STEPS, iterations=20)
"""What will end in one place should be there: every pose too many is compared on blocks."""
CLOSE = 1.5
"""Poses whose rays cost more than this many times the least are not followed further."""

UNEXPLAINED = robust.rejected_cost(robust.EFFICIENT)
"""Cost of a pixel that is beyond the cut-off."""
PROMISING = 0.6
"""Share of what poses cost that explain nothing."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Whereabouts:
    """Poses that a coarse image suggests, the best first."""

    Ts_world_sensor: Float[Tensor, "pose 4 4"]
    cost: Float[Tensor, " pose"]
    """Robust cost per measured pixel of the fine rays."""

    @property
    def close(self) -> Float[Tensor, "close 4 4"]:
        """The poses that explain the image nearly as well as the best, and that one first."""
        return self.Ts_world_sensor[self.cost <= CLOSE * self.cost[0]]

    @property
    def promising(self) -> bool:
        """Whether the best pose explains so much that it is worth a look at every pixel."""
        return float(self.cost[0]) < PROMISING * UNEXPLAINED


def poses_anywhere(site: Site, view: OneView, planes: Planes) -> Float[Tensor, "pose 4 4"]:
    """Poses at which many measured points lie on the model, the best first.

    Args:
        site: The model.
        view: The image.
        planes: Planes of the image, in the sensor's frame.
    """
    rotations = aligning_rotations(site.directions, _image_directions(planes), count=ROTATIONS)
    points = view.points.to(rotations)
    if len(points) == 0:
        return rotations.new_zeros(0, 4, 4)
    values, poses = [rotations.new_zeros(0)], [rotations.new_zeros(0, 4, 4)]
    for R in rotations:
        offsets = points @ R.mT
        value, index = peaks(site.volume.scores(offsets), PLACES)
        places = site.volume.places(index.to(offsets), offsets)
        values.append(value.to(places))
        poses.append(se3.from_rotation_translation(R.expand(len(places), 3, 3), places))
    order = torch.cat(values).argsort(descending=True)[:JUDGED]
    return torch.cat(poses)[order]


def judged(
    site: Site, view: OneView, parameters: Parameters, Ts_world_sensor: Float[Tensor, "pose 4 4"]
) -> Whereabouts:
    """Fits the best of some poses to the image, ever finer, and orders them by cost."""
    states = as_states(Ts_world_sensor.double())
    first = RayFit(
        observation=view.coarse,
        surface=site.surface,
        parameters=parameters,
        tolerance=FIRST_TOLERANCE,
    )
    fitted = max(LEAST_FITTED, len(states) // SHARE)
    best = states[first.costs(states).argsort()[:fitted]]
    states = _fitted(first, best, STEPS)
    fine = replace(first, observation=view.fine)
    for tolerance in TOLERANCES:
        fine = replace(fine, tolerance=tolerance)
        states = _fitted(fine, states, STEPS)
    last = replace(fine, observation=view.unmixed, tolerance=LAST_TOLERANCE)
    states = _fitted(last, states, LAST_STEPS)
    costs = fine.costs(states)
    kept = _distinct(states, costs)
    pixels = int(view.fine.measured.sum())
    return Whereabouts(Ts_world_sensor=states[kept, 0], cost=costs[kept] / max(pixels, 1))


def _fitted(fit: RayFit, states: Tensor, config: GaussNewtonConfig) -> Tensor:
    """Where the fits of some states end that do not end in one place."""
    solution = minimise(shared(fit.evaluate), fit.parameters.retract, states, config)
    return solution.state[_distinct(solution.state, solution.equations.cost)]


def _distinct(states: Tensor, costs: Tensor) -> list[int]:
    """The best that are apart from each other, the best first."""
    kept: list[int] = []
    for k in costs.nan_to_num(torch.inf).argsort().tolist():
        if len(kept) < KEPT and all(poses_are_apart(states[k, 0], states[i, 0]) for i in kept):
            kept.append(k)
    return kept


def poses_are_apart(T: Float[Tensor, "4 4"], other: Float[Tensor, "4 4"]) -> bool:
    """Whether two poses are different ones."""
    xi = se3.log(se3.inverse(T) @ other)
    return float(xi[:3].norm()) > APART or float(xi[3:].norm()) > APART


def _image_directions(planes: Planes) -> Directions:
    """By the share of the image that each plane fills."""
    point, normal = planes.elements.point, planes.elements.direction
    distance = point.norm(dim=-1).clamp(min=1e-9)
    solid = planes.area * (point * normal).sum(-1).abs() / distance**3
    return Directions.of(normal, solid, count=IMAGE_DIRECTIONS)
