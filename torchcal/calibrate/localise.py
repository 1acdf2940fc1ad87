"""The pose of a sensor from one range image, with and without a starting value (3.1, 4.2)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.clock import Clock
from torchcal.calibrate.element_stage import fit_elements
from torchcal.calibrate.localisation import Localisation, Rival, StagePose
from torchcal.calibrate.observability import poses_are_told, unobservable_directions
from torchcal.calibrate.one_view import OneView, as_states, drawn_about, free_sensor
from torchcal.calibrate.parameters import FARTHEST, Parameters
from torchcal.calibrate.pixel_stage import PixelFit, block_fit, compared, pixel_fit
from torchcal.calibrate.result import Status, rivals_words
from torchcal.calibrate.site import Site
from torchcal.calibrate.whereabouts import (
    DRAWS,
    Whereabouts,
    judged,
    poses_anywhere,
    poses_are_apart,
)
from torchcal.geometry import se3
from torchcal.match.features import Planes
from torchcal.match.image.features import image_features
from torchcal.match.prior_gate import Prior
from torchcal.model.sensor import Sensor

EXPLAINED = 0.8
"""Share of the measured pixels that must be where the model says."""
DECISIVE = 50.0
"""Difference of robust costs, of blocks of pixels, that decides between two poses: a likelihood
ratio that noise does not reach."""
RIVAL = 0.01
"""Share of the cost that may be wrong in the same way: poses whose costs differ by less are
rivals."""
ABOUT = (0.03, 0.01)
"""m and rad: twice what first poses are off by; pairs of elements are gated by it."""


def localise(
    range_image: Float[Tensor, "h w"],
    site: Site,
    sensor: Sensor,
    *,
    start: Prior | None = None,
    mask: Bool[Tensor, "h w"] | None = None,
    generator: torch.Generator,
) -> Localisation:
    """Finds where a range image was taken, from its elements and from every pixel.

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
        The poses of both stages and what they rest on. A wrong pose is not called converged: what
        explains the image no better than another pose is ambiguous, and what explains it badly
        has failed.

    Raises:
        TorchcalError: If image or mask are not of the sensor's size.
    """
    view, clock = OneView.of(range_image, sensor, mask), Clock()
    with clock.measured("elements of the image"):
        measured = image_features(range_image.double(), sensor, mask)
    attempt = _attempted(view, site, measured.planes, start, generator, clock)
    if attempt is None:
        return _nothing(clock)
    with clock.measured("pose from elements"):
        elements = fit_elements(site, sensor, measured, _about(attempt.found))
    found = _concluded(site, view, start, attempt, clock)
    return replace(found, elements=elements.pose, matches=elements.matches)


def localise_pixels(
    range_image: Float[Tensor, "h w"],
    site: Site,
    sensor: Sensor,
    *,
    start: Prior,
    mask: Bool[Tensor, "h w"] | None = None,
    generator: torch.Generator,
) -> Localisation:
    """The same from a starting value and without elements, in a fraction of the time.

    The arguments are those of ``localise``.
    """
    view, clock = OneView.of(range_image, sensor, mask), Clock()
    attempt = _attempted(view, site, None, start, generator, clock)
    return _nothing(clock) if attempt is None else _concluded(site, view, start, attempt, clock)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Attempt:
    """First poses, and what the best of them becomes on every pixel."""

    found: Whereabouts
    fit: PixelFit


def _attempted(
    view: OneView,
    site: Site,
    planes: Planes | None,
    start: Prior | None,
    generator: torch.Generator,
    clock: Clock,
) -> _Attempt | None:
    """The first attempt that explains the image, or the best; None without anything to try."""
    parameters, best = _unknown(site, start), None
    for found in _searched(view, site, planes, start, generator, clock):
        with clock.measured("every pixel"):
            fit = pixel_fit(site, view, parameters, found.Ts_world_sensor[0])
        if best is None or fit.agreement > best.fit.agreement:
            best = _Attempt(found=found, fit=fit)
        if fit.agreement >= EXPLAINED:
            break
    return best


def _searched(
    view: OneView,
    site: Site,
    planes: Planes | None,
    start: Prior | None,
    generator: torch.Generator,
    clock: Clock,
) -> Iterator[Whereabouts]:
    """What explains the coarse image as it is found, and last the best of all that does not."""
    if not view.coarse.measured.any():
        return
    parameters, others = _unknown(site, start), []
    for draw in _first_poses(view, site, planes, start, generator):
        with clock.measured("coarse search"):
            poses = draw()
            found = judged(site, view, parameters, poses) if len(poses) else None
        if found is not None and found.promising:
            yield found
        elif found is not None:
            others.append(found)
    if others:
        yield min(others, key=lambda found: float(found.cost[0]))


def _first_poses(
    view: OneView,
    site: Site,
    planes: Planes | None,
    start: Prior | None,
    generator: torch.Generator,
) -> Iterator[Callable[[], Float[Tensor, "pose 4 4"]]]:
    """About the start first, then, as the last resort with a start, all that planes suggest."""
    if start is not None:
        yield from (partial(drawn_about, start, count, generator) for count in DRAWS)
    if planes is not None:
        yield partial(_anywhere, view, site, planes, start)


def _anywhere(
    view: OneView, site: Site, planes: Planes, start: Prior | None
) -> Float[Tensor, "pose 4 4"]:
    poses = poses_anywhere(site, view, planes)
    return poses if start is None else poses[_is_near(poses, start)]


def _unknown(site: Site, start: Prior | None) -> Parameters:
    return free_sensor(start or site.middle, site.Ts_world_body)


def _about(found: Whereabouts) -> Prior:
    """The first pose as a starting value for elements."""
    position, rotation = ABOUT
    T = found.Ts_world_sensor[0]
    sigma = torch.tensor([position] * 3 + [rotation] * 3).to(T)
    return Prior(T_world_sensor=T, covariance=torch.diag(sigma.square()))


def _is_near(poses: Float[Tensor, "pose 4 4"], start: Prior) -> Bool[Tensor, " pose"]:
    """Which poses do not contradict a starting value."""
    xi = se3.log(se3.inverse(start.T_world_sensor) @ poses)
    return (xi.abs() <= FARTHEST * start.covariance.diagonal().sqrt()).all(-1)


def _rivals(
    site: Site, view: OneView, parameters: Parameters, found: Whereabouts, fit: PixelFit
) -> tuple[Rival, ...]:
    """Other poses whose predicted images, with the exact beam, explain the measured one as well."""
    others = found.close[1:]
    if len(others) == 0:
        return ()
    poses = torch.cat([fit.T_world_sensor[None], others])
    solution = compared(block_fit(site, view, parameters), as_states(poses))
    cost, state = solution.equations.cost, solution.state[:, 0]
    allowed = cost[0] + max(DECISIVE, RIVAL * float(cost[0]))
    known, rivals = [state[0]], []
    for T, other in zip(state[1:], cost[1:], strict=True):
        if other <= allowed and all(poses_are_apart(T, each) for each in known):
            known.append(T)
            rivals.append(Rival(T_world_sensor=T, score=float(other / cost[0] * found.cost[0])))
    return tuple(rivals)


def _concluded(
    site: Site, view: OneView, start: Prior | None, attempt: _Attempt, clock: Clock
) -> Localisation:
    """What is said of an attempt, after its rivals were looked at."""
    parameters, fit, found = _unknown(site, start), attempt.fit, attempt.found
    with clock.measured("rivals"):
        rivals = _rivals(site, view, parameters, found, fit)
    status = _status(parameters, start, fit, rivals)
    told = fit.covariance.isfinite().all()
    return Localisation(
        status=status,
        message=_message(status, len(rivals)),
        elements=None,
        pixels=StagePose(T_world_sensor=fit.T_world_sensor, covariance=fit.covariance),
        agreement=fit.agreement,
        score=float(found.cost[0]),
        rivals=rivals,
        unobservable=unobservable_directions(fit.covariance, parameters) if told else (),
        matches=None,
        seconds=clock.seconds,
    )


def _status(
    parameters: Parameters, start: Prior | None, fit: PixelFit, rivals: tuple[Rival, ...]
) -> Status:
    if not (fit.settled and fit.covariance.isfinite().all() and fit.agreement >= EXPLAINED):
        return Status.FAILED
    state = as_states(fit.T_world_sensor)
    if start is not None and parameters.contradicts_prior(state):
        return Status.FAILED
    if not poses_are_told(fit.covariance, parameters, parameters.pose_jacobians(state)):
        return Status.UNOBSERVABLE
    return Status.AMBIGUOUS if rivals else Status.CONVERGED


def _nothing(clock: Clock) -> Localisation:
    return Localisation(
        status=Status.FAILED,
        message=_message(Status.FAILED, 0),
        elements=None,
        pixels=None,
        agreement=0.0,
        score=float("inf"),
        rivals=(),
        unobservable=(),
        matches=None,
        seconds=clock.seconds,
    )


def _message(status: Status, rivals: int) -> str:
    return {
        Status.CONVERGED: "The model explains the image; the pose can be used.",
        Status.AMBIGUOUS: f"{rivals_words(rivals, 'the image')}: do not use this one "
        "without knowing which is right.",
        Status.UNOBSERVABLE: "The image leaves the sensor's pose open in some direction.",
        Status.FAILED: "No pose was found that explains the image.",
    }[status]
