"""The pose of a sensor from one range image, with and without a starting value (3.1, 4.2)."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.element_stage import ElementFit, element_fit
from torchcal.calibrate.localisation import Localisation, Rival, StagePose
from torchcal.calibrate.observability import poses_are_told, unobservable_directions
from torchcal.calibrate.one_view import OneView, as_states, free_sensor
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pixel_stage import PixelFit, block_fit, pixel_fit
from torchcal.calibrate.result import Status
from torchcal.calibrate.site import Site
from torchcal.calibrate.whereabouts import (
    Whereabouts,
    are_apart,
    judged,
    poses_about,
    poses_anywhere,
)
from torchcal.match.features import Features
from torchcal.match.image.features import image_features
from torchcal.match.prior_gate import Prior
from torchcal.model.sensor import Sensor

EXPLAINED = 0.8
"""Share of the measured pixels that must be where the model says."""
FARTHEST = 5.0
"""Prior sigmas: a pose farther from the starting value contradicts it."""
DECISIVE = 50.0
"""Difference of robust costs, of blocks of pixels, that decides between two poses: a likelihood
ratio that noise does not reach."""
RIVAL = 0.01
"""Share of the cost that may be wrong in the same way: poses whose costs differ by less are
rivals."""
CLOSE = 1.5
"""Poses whose rays cost more than this many times the least are no rivals."""
ABOUT = (0.05, 0.02)
"""m and rad: how far off a pose from rays may be, for the matching of elements."""


def localise(
    range_image: Float[Tensor, "h w"],
    site: Site,
    sensor: Sensor,
    *,
    start: Prior | None = None,
    mask: Bool[Tensor, "h w"] | None = None,
    generator: torch.Generator,
) -> Localisation:
    """Finds where a range image was taken.

    Args:
        range_image: Depth or distance (m), as the projection has it; NaN where nothing was
            measured.
        site: The model that the image shows, made ready by ``Site.of``.
        sensor: Optics, limits, beam and noise.
        start: A starting value with its covariance; None: the pose is sought all over the site
            and in all orientations.
        mask: Pixels that may be used; None: all.
        generator: Draws poses and samples; on the CPU.

    Returns:
        The poses of the elements and of all pixels. A wrong pose is not called converged: what
        explains the image no better than another pose is ambiguous, and what explains it badly
        has failed.
    """
    clock = _Clock()
    view = OneView.of(range_image, sensor, mask)
    with clock.measured("elements of the image"):
        measured = image_features(range_image.double(), sensor, mask)
    prior = start or _anywhere(site)
    parameters = free_sensor(prior, site.Ts_world_body)
    with clock.measured("pose from elements"):
        elements = None if start is None else element_fit(site, sensor, measured, start, generator)
    with clock.measured("coarse search"):
        poses = _first_poses(site, view, measured, start, elements, generator)
        found = judged(site, view, parameters, poses) if _is_any(view, poses) else None
    if found is None:
        return _nothing(elements, clock)
    with clock.measured("every pixel"):
        fit = pixel_fit(site, view, parameters, found.Ts_world_sensor[0])
    with clock.measured("rivals"):
        rivals = _rivals(site, view, parameters, found, fit)
    if elements is None:
        with clock.measured("pose from elements"):
            about = _prior(fit.T_world_sensor, *ABOUT)
            elements = element_fit(site, sensor, measured, about, generator)
    return _concluded(parameters, start, elements, fit, found, rivals, clock)


def _anywhere(site: Site) -> Prior:
    """No more than that the sensor is about the site."""
    middle = torch.eye(4).to(site.low)
    middle[:3, 3] = 0.5 * (site.low + site.high)
    return _prior(middle, float((site.high - site.low).norm()), torch.pi)


def _prior(T_world_sensor: Tensor, position: float, rotation: float) -> Prior:
    sigma = torch.tensor([position] * 3 + [rotation] * 3).to(T_world_sensor)
    return Prior(T_world_sensor=T_world_sensor, covariance=torch.diag(sigma.square()))


def _first_poses(
    site: Site,
    view: OneView,
    measured: Features,
    start: Prior | None,
    elements: ElementFit | None,
    generator: torch.Generator,
) -> Float[Tensor, "pose 4 4"]:
    if start is None:
        return poses_anywhere(site, view, measured.planes)
    poses = poses_about(start, generator)
    if elements is None or elements.pose is None:
        return poses
    return torch.cat([elements.pose.T_world_sensor[None], poses])


def _is_any(view: OneView, poses: Tensor) -> bool:
    return len(poses) > 0 and bool(view.fine.measured.any())


def _rivals(
    site: Site, view: OneView, parameters: Parameters, found: Whereabouts, fit: PixelFit
) -> tuple[Rival, ...]:
    """Other poses whose predicted images, with the exact beam, explain the measured one as well."""
    close = found.cost <= CLOSE * found.cost[0]
    close[0] = False
    if not close.any():
        return ()
    blocks = block_fit(site, view, parameters)
    best = float(blocks.evaluate(as_states(fit.T_world_sensor)[None]).cost)
    rivals: list[Rival] = []
    for T in found.Ts_world_sensor[close]:
        other = pixel_fit(site, view, parameters, T)
        cost = float(blocks.evaluate(as_states(other.T_world_sensor)[None]).cost)
        known = [fit.T_world_sensor, *(rival.T_world_sensor for rival in rivals)]
        is_new = all(are_apart(other.T_world_sensor, each) for each in known)
        if is_new and cost - best <= max(DECISIVE, RIVAL * best):
            pixels = max(1, int(blocks.observation.measured.sum()))
            rivals.append(Rival(T_world_sensor=other.T_world_sensor, score=cost / pixels))
    return tuple(rivals)


def _concluded(
    parameters: Parameters,
    start: Prior | None,
    elements: ElementFit,
    fit: PixelFit,
    found: Whereabouts,
    rivals: tuple[Rival, ...],
    clock: "_Clock",
) -> Localisation:
    status = _status(parameters, start, fit, rivals)
    told = fit.covariance.isfinite().all()
    return Localisation(
        status=status,
        message=_message(status, len(rivals)),
        elements=elements.pose,
        pixels=StagePose(T_world_sensor=fit.T_world_sensor, covariance=fit.covariance),
        agreement=fit.agreement,
        score=float(found.cost[0]),
        rivals=rivals,
        unobservable=unobservable_directions(fit.covariance, parameters) if told else (),
        matches=elements.matches,
        seconds=clock.seconds,
    )


def _status(
    parameters: Parameters, start: Prior | None, fit: PixelFit, rivals: tuple[Rival, ...]
) -> Status:
    if not (fit.settled and fit.covariance.isfinite().all() and fit.agreement >= EXPLAINED):
        return Status.FAILED
    state = as_states(fit.T_world_sensor)
    moved = parameters.difference(state, parameters.nominal) / parameters.prior_sigma
    if start is not None and (moved.abs() > FARTHEST).any():
        return Status.FAILED
    if not poses_are_told(fit.covariance, parameters, parameters.pose_jacobians(state)):
        return Status.UNOBSERVABLE
    return Status.AMBIGUOUS if rivals else Status.CONVERGED


def _nothing(elements: ElementFit | None, clock: "_Clock") -> Localisation:
    return Localisation(
        status=Status.FAILED,
        message=_message(Status.FAILED, 0),
        elements=None if elements is None else elements.pose,
        pixels=None,
        agreement=0.0,
        score=float("inf"),
        rivals=(),
        unobservable=(),
        matches=None if elements is None else elements.matches,
        seconds=clock.seconds,
    )


def _message(status: Status, rivals: int) -> str:
    return {
        Status.CONVERGED: "The model explains the image; the pose can be used.",
        Status.AMBIGUOUS: f"{rivals} other poses explain the image as well: do not use this one "
        "without knowing which is right.",
        Status.UNOBSERVABLE: "The image leaves the sensor's pose open in some direction.",
        Status.FAILED: "No pose was found that explains the image.",
    }[status]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Clock:
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def measured(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begin
