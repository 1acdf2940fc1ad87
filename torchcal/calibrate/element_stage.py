"""The pose from planes, lines and vertexes about a starting value (3.1 to 3.5)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.calibrate.element_fit import (
    Correspondences,
    ElementProblem,
    correspondences,
    procedure_3_5,
)
from torchcal.calibrate.localisation import Matches, StagePose
from torchcal.calibrate.site import Site
from torchcal.geometry import robust, se3
from torchcal.match.characteristics import all_elements, candidate_pairs, within
from torchcal.match.detection import every_candidate
from torchcal.match.elements import Elements
from torchcal.match.features import Features, LineKind
from torchcal.match.invariants import GAMMA
from torchcal.match.joint import joint_hypotheses
from torchcal.match.minimal_sets import Hypotheses
from torchcal.match.model.expected import expected_features
from torchcal.match.prior_gate import Expectation, Prior
from torchcal.model.sensor import Sensor
from torchcal.solve.gauss_newton import covariance

LEAST_PIXELS = 20.0
"""Least length of a line, and side of a plane's square, that an image is expected to show."""
LEAST_JUMP = 0.1
"""m: a smaller step of the range is no line."""
HALVED = 2
"""Visibility is looked up in an image of half the size."""
ROUNDS = 4
"""Most times that elements are matched anew about the pose that the last matches led to."""
SETTLED = 0.1
"""Standard deviations by which the pose must move for the matches to be sought once more."""
ABOUT = (0.01, 0.005)
"""m and rad: how far off such a pose may be in every direction, besides its covariance."""

EXCESS = 1.5
"""How many times larger errors of elements are than the noise alone makes them: the blur joins
neighbours. Measured in images of known scenes: the median of right planes' and creases' residuals
is 1.0 standard deviations where noise would give 0.67."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MatchedPose:
    """The pose from elements, if there is one, and what was matched."""

    pose: StagePose | None
    matches: Matches


def fit_elements(site: Site, sensor: Sensor, measured: Features, start: Prior) -> MatchedPose:
    """Matches what is expected from a starting value with what was measured, and fits the pose.

    Args:
        site: The model.
        sensor: What measured.
        measured: Elements in the sensor's frame.
        start: The starting value; pairs that it does not expect are no candidates.
    """
    measured = _trusted(measured)
    found = _matched(site, sensor, measured, start)
    for _ in range(ROUNDS - 1):
        if found.pose is None:
            break
        before, found = found.pose, _matched(site, sensor, measured, _about(found.pose))
        if found.pose is not None and _moved(before, found.pose) < SETTLED:
            break
    return found


def _trusted(measured: Features) -> Features:
    """The same elements with covariances as large as their errors."""

    def trusted(elements: Elements) -> Elements:
        return replace(elements, covariance=EXCESS**2 * elements.covariance)

    planes, lines, vertices = measured.planes, measured.lines, measured.vertices
    return Features(
        planes=replace(planes, elements=trusted(planes.elements)),
        lines=replace(lines, elements=trusted(lines.elements)),
        vertices=replace(vertices, elements=trusted(vertices.elements)),
    )


def _about(pose: StagePose) -> Prior:
    position, rotation = ABOUT
    slack = torch.tensor([position] * 3 + [rotation] * 3).to(pose.covariance).square().diag()
    return Prior(T_world_sensor=pose.T_world_sensor, covariance=pose.covariance + slack)


def _moved(before: StagePose, after: StagePose) -> float:
    """Standard deviations."""
    xi = se3.log(se3.inverse(before.T_world_sensor) @ after.T_world_sensor)
    return float(xi @ torch.linalg.solve(after.covariance, xi)) ** 0.5


def _matched(site: Site, sensor: Sensor, measured: Features, start: Prior) -> MatchedPose:
    """Elements are matched about a starting value, and the pose is fitted to the matches."""
    model = _expected(site, sensor, start.T_world_sensor)
    candidates = candidate_pairs(model, measured)
    near = within(candidates, model, measured, start).matrix
    joint = joint_hypotheses(
        Expectation.of(model, measured),
        replace(candidates, matrix=near),
        start,
        _order(measured),
        gamma=GAMMA,
    )
    partner = joint.partner[0]
    other = (partner >= 0).nonzero()[:, 0]
    pairs = torch.stack([partner[other], other], 1)
    if len(pairs) == 0:
        return MatchedPose(pose=None, matches=_matches(model, measured, near, pairs, other > 0))
    rests_on, T_sensor_world = _fitted(model, measured, pairs, joint.T_sensor_world[:1])
    return MatchedPose(
        pose=_pose(T_sensor_world, rests_on, joint.spread()),
        matches=_matches(model, measured, near, pairs, rests_on.explained[0]),
    )


def _order(measured: Features) -> Int[Tensor, " element"]:
    """What tells the most first: large planes, then long creases, long jumps, and vertexes."""
    planes, lines = len(measured.planes.area), len(measured.lines.kind)
    is_jump = measured.lines.kind == LineKind.JUMP
    straight = torch.where(is_jump, -1.0 / measured.lines.length, measured.lines.length)
    return torch.cat(
        [
            measured.planes.area.argsort(descending=True),
            planes + straight.argsort(descending=True),
            planes + lines + torch.arange(measured.vertices.elements.count).to(is_jump.device),
        ]
    )


def _fitted(
    model: Features, measured: Features, pairs: Tensor, T_sensor_world: Float[Tensor, "1 4 4"]
) -> tuple[Correspondences, Float[Tensor, "4 4"]]:
    """Procedure 3.5 on the matches alone: others would only be taken for each other."""
    alone = torch.eye(len(pairs), dtype=torch.bool, device=pairs.device)[None]
    own, others = all_elements(model)[pairs[:, 0]], all_elements(measured)[pairs[:, 1]]
    problem = ElementProblem.of(own.expand(1), others.expand(1), alone)
    start = Hypotheses(batch=pairs.new_zeros(1), T=T_sensor_world)
    first = torch.full_like(T_sensor_world[:, 0, 0], robust.ZETA * robust.EFFICIENT)
    fit = procedure_3_5(problem, start, first, detect=every_candidate)
    return correspondences(problem, fit, every_candidate), fit.poses.T[0]


def _expected(site: Site, sensor: Sensor, T_world_sensor: Float[Tensor, "4 4"]) -> Features:
    halved = replace(sensor, projection=sensor.projection.resized(HALVED))
    seen = site.seen_from(T_world_sensor, halved, jump=LEAST_JUMP)
    return expected_features(site.features, seen, pixels=LEAST_PIXELS / HALVED).features


def _pose(
    T_sensor_world: Float[Tensor, "4 4"], rests_on: Correspondences, spread: Float[Tensor, "6 6"]
) -> StagePose | None:
    """T_world_sensor: a twist on the right of T_sensor_world is one on its inverse's left.

    The covariance is as much larger as the residuals are than the elements' covariances say, and
    by what other matches would change.
    """
    own = covariance(rests_on.information)[0]
    if not (T_sensor_world.isfinite().all() and own.isfinite().all()):
        return None
    moved = se3.adjoint(T_sensor_world)
    spare = ((rests_on.weights > 0).sum() - 6).clamp(min=1)
    excess = (2.0 * rests_on.cost[0] / spare).clamp(min=1.0)
    return StagePose(
        T_world_sensor=se3.inverse(T_sensor_world),
        covariance=moved @ (excess * own + spread) @ moved.mT,
    )


def _matches(
    model: Features,
    measured: Features,
    candidates: Bool[Tensor, "model measured"],
    pairs: Int[Tensor, "pair 2"],
    used: Bool[Tensor, " pair"],
) -> Matches:
    rows, columns = candidates.shape
    return Matches(
        model=model,
        measured=measured,
        pairs=pairs,
        used=used,
        model_alone=_without(pairs[:, 0], rows),
        measured_alone=_without(pairs[:, 1], columns),
        candidates=int(candidates.sum()),
    )


def _without(taken: Tensor, count: int) -> Tensor:
    free = torch.ones(count, dtype=torch.bool, device=taken.device)
    free[taken] = False
    return free.nonzero()[:, 0]
