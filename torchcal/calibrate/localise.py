"""The pose of a sensor from one range image, with and without a starting value (3.1, 4.2)."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.clock import Clock
from torchcal.calibrate.element_stage import element_fit
from torchcal.calibrate.localisation import Localisation, Rival, StagePose
from torchcal.calibrate.observability import poses_are_told, unobservable_directions
from torchcal.calibrate.one_view import OneView, as_states, drawn_about, free_sensor
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pixel_stage import PixelFit, block_fit, pixel_fit, refined
from torchcal.calibrate.result import Status
from torchcal.calibrate.site import Site
from torchcal.calibrate.whereabouts import (
    DRAWS,
    Whereabouts,
    are_apart,
    judged,
    poses_anywhere,
)
from torchcal.geometry import se3
from torchcal.match.features import Planes
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
    """
    clock = Clock()
    with clock.measured("elements of the image"):
        measured = image_features(range_image.double(), sensor, mask)
    view = OneView.of(range_image, sensor, mask)
    found = _found(view, site, measured.planes, start, generator, clock)
    if found.pixels is None:
        return found
    with clock.measured("pose from elements"):
        about = Prior(T_world_sensor=found.pixels.T_world_sensor, covariance=_about(site))
        elements = element_fit(site, sensor, measured, about)
    return replace(
        found, elements=elements.pose, matches=elements.matches, seconds=dict(clock.seconds)
    )


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
    view = OneView.of(range_image, sensor, mask)
    return _found(view, site, None, start, generator, Clock())


def _found(
    view: OneView,
    site: Site,
    planes: Planes | None,
    start: Prior | None,
    generator: torch.Generator,
    clock: Clock,
) -> Localisation:
    """The pose from every pixel, its rivals and its status."""
    parameters = free_sensor(start or site.middle, site.Ts_world_body)
    best = None
    for poses in _first_poses(site, view, planes, start, generator):
        with clock.measured("coarse search"):
            found = judged(site, view, parameters, poses)
        with clock.measured("every pixel"):
            fit = pixel_fit(site, view, parameters, found.Ts_world_sensor[0])
        if best is None or fit.agreement > best[1].agreement:
            best = found, fit
        if fit.agreement >= EXPLAINED:
            break
    if best is None:
        return _nothing(clock)
    with clock.measured("rivals"):
        rivals = _rivals(site, view, parameters, *best)
    return _concluded(parameters, start, *best, rivals, clock)


def _about(site: Site) -> Float[Tensor, "6 6"]:
    position, rotation = ABOUT
    return torch.diag(torch.tensor([position] * 3 + [rotation] * 3).to(site.low).square())


def _first_poses(
    site: Site,
    view: OneView,
    planes: Planes | None,
    start: Prior | None,
    generator: torch.Generator,
) -> Iterator[Float[Tensor, "pose 4 4"]]:
    """About the start first, then, as the last resort with a start, all that planes suggest."""
    if not view.coarse.measured.any():
        return
    if start is not None:
        for count in DRAWS:
            yield drawn_about(start, count, generator)
    poses = site.Ts_world_body[:0] if planes is None else poses_anywhere(site, view, planes)
    if start is not None:
        poses = poses[_is_near(poses, start)]
    if len(poses):
        yield poses


def _is_near(poses: Float[Tensor, "pose 4 4"], start: Prior) -> Bool[Tensor, " pose"]:
    """Which poses do not contradict a starting value."""
    xi = se3.log(se3.inverse(start.T_world_sensor) @ poses)
    return (xi.abs() <= FARTHEST * start.covariance.diagonal().sqrt()).all(-1)


def _rivals(
    site: Site, view: OneView, parameters: Parameters, found: Whereabouts, fit: PixelFit
) -> tuple[Rival, ...]:
    """Other poses whose predicted images, with the exact beam, explain the measured one as well."""
    close = found.cost <= CLOSE * found.cost[0]
    close[0] = False
    if not close.any():
        return ()
    poses = torch.cat([fit.T_world_sensor[None], found.Ts_world_sensor[close]])
    solution = refined(block_fit(site, view, parameters), as_states(poses))
    cost, state = solution.equations.cost, solution.state[:, 0]
    allowed = cost[0] + max(DECISIVE, RIVAL * float(cost[0]))
    known, rivals = [state[0]], []
    for T, other in zip(state[1:], cost[1:], strict=True):
        if other <= allowed and all(are_apart(T, each) for each in known):
            known.append(T)
            rivals.append(Rival(T_world_sensor=T, score=float(other / cost[0] * found.cost[0])))
    return tuple(rivals)


def _concluded(
    parameters: Parameters,
    start: Prior | None,
    found: Whereabouts,
    fit: PixelFit,
    rivals: tuple[Rival, ...],
    clock: Clock,
) -> Localisation:
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
    moved = parameters.difference(state, parameters.nominal) / parameters.prior_sigma
    if start is not None and (moved.abs() > FARTHEST).any():
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
        Status.AMBIGUOUS: f"{rivals} other poses explain the image as well: do not use this one "
        "without knowing which is right.",
        Status.UNOBSERVABLE: "The image leaves the sensor's pose open in some direction.",
        Status.FAILED: "No pose was found that explains the image.",
    }[status]
