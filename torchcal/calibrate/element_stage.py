"""The pose from planes, lines and vertexes about a starting value (3.1 to 3.5)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.element_pose import find_element_poses
from torchcal.calibrate.element_result import ElementPoses
from torchcal.calibrate.element_search import ElementSearch
from torchcal.calibrate.localisation import Matches, StagePose
from torchcal.calibrate.site import Site
from torchcal.geometry import se3
from torchcal.match.characteristics import Candidates, all_elements, find_candidates
from torchcal.match.detection import nearest_candidate
from torchcal.match.features import Features
from torchcal.match.model.expected import expected_features
from torchcal.match.one_place import in_one_place
from torchcal.match.prior_gate import Prior
from torchcal.model.sensor import Sensor

LEAST_PIXELS = 20.0
"""Least length of a line, and side of a plane's square, that an image is expected to show."""
LEAST_JUMP = 0.1
"""m: a smaller step of the range is no line."""
HALVED = 2
"""Visibility is looked up in an image of half the size."""
SEARCH = ElementSearch(restarts=0, enough=0.2, sets=200)
"""Views show much that is no element of the model, and extraction is not perfect."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ElementFit:
    """The pose from elements, if there is one, and what was matched."""

    pose: StagePose | None
    matches: Matches


def element_fit(
    site: Site, sensor: Sensor, measured: Features, start: Prior, generator: torch.Generator
) -> ElementFit:
    """Matches what is expected from a starting value with what was measured, and fits the pose.

    Args:
        site: The model.
        sensor: What measured.
        measured: Elements in the sensor's frame.
        start: The starting value; pairs that it does not expect are no candidates.
        generator: For samples of minimal sets.
    """
    model = _expected(site, sensor, start.T_world_sensor)
    candidates = find_candidates(model, measured, prior=start)
    own, others = all_elements(model), all_elements(measured)
    same = in_one_place(model, measured, start.T_world_sensor, sensor.projection)
    matrix = replace(
        candidates,
        matrix=candidates.matrix & same,
        log_likelihood=candidates.log_likelihood.masked_fill(~same, -torch.inf),
    ).likeliest(1)
    pairs = matrix.nonzero()
    if len(pairs) == 0:
        return ElementFit(
            pose=None, matches=_matches(model, measured, candidates, pairs, pairs[:, 0])
        )
    # Without the elements that have no partner: they would only be taken for each other.
    found = find_element_poses(
        own[pairs[:, 0]],
        others[pairs[:, 1]],
        torch.eye(len(pairs), dtype=torch.bool, device=pairs.device),
        generator=generator,
        search=SEARCH,
        detect=nearest_candidate,
    )
    number = torch.arange(len(pairs), device=pairs.device)
    used = (found.weights > 0).any(-1) & (found.partner == number)
    return ElementFit(pose=_pose(found), matches=_matches(model, measured, candidates, pairs, used))


def _expected(site: Site, sensor: Sensor, T_world_sensor: Float[Tensor, "4 4"]) -> Features:
    halved = replace(sensor, projection=sensor.projection.resized(HALVED))
    seen = site.seen_from(T_world_sensor, halved, jump=LEAST_JUMP)
    return expected_features(site.features, seen, pixels=LEAST_PIXELS / HALVED).features


def _pose(found: ElementPoses) -> StagePose | None:
    """T_world_sensor: a twist on the right of T_sensor_world is one on its inverse's left.

    The covariance is as much larger as the residuals are than the elements' covariances say.
    """
    T_sensor_world = found.T_measured_model
    if not (T_sensor_world.isfinite().all() and found.covariance.isfinite().all()):
        return None
    moved = se3.adjoint(T_sensor_world)
    spare = ((found.weights > 0).sum() - 6).clamp(min=1)
    excess = (2.0 * found.cost / spare).clamp(min=1.0)
    return StagePose(
        T_world_sensor=se3.inverse(T_sensor_world),
        covariance=excess * (moved @ found.covariance @ moved.mT),
    )


def _matches(
    model: Features, measured: Features, candidates: Candidates, pairs: Tensor, used: Tensor
) -> Matches:
    rows, columns = candidates.matrix.shape
    return Matches(
        model=model,
        measured=measured,
        pairs=pairs,
        used=used > 0,
        model_alone=_without(pairs[:, 0], rows),
        measured_alone=_without(pairs[:, 1], columns),
        candidates=int(candidates.matrix.sum()),
    )


def _without(taken: Tensor, count: int) -> Tensor:
    free = torch.ones(count, dtype=torch.bool, device=taken.device)
    free[taken] = False
    return free.nonzero()[:, 0]
