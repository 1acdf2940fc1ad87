"""What images will tell, before they are taken: expected information, and where to look next."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.observation import Observation, coarse_factor, coarser_sensor
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.prediction import predictions
from torchcal.calibrate.range_fit import FILLED, RangeFit, embedded
from torchcal.calibrate.result import NextView
from torchcal.geometry import robust
from torchcal.model.job import Job
from torchcal.model.range_image import RangeImage
from torchcal.model.robot import Robot
from torchcal.model.scene import Scene
from torchcal.model.sensor import Drift, Sensor
from torchcal.solve.gauss_newton import covariance
from torchcal.solve.image_equations import normal_equations

VIEWS = 48
"""Configurations of the joints that are looked at for the next view."""
UNLIMITED = 1e9
"""A cut-off that no residual reaches: at a wrong pose all pixels must count."""
LEAST_GAIN = 0.01
"""Nats: a view that adds less is no better than any other."""


def foreseen_covariance(
    job: Job, scene: Scene, parameters: Parameters, state: Float[Tensor, "slot 4 4"]
) -> Float[Tensor, "parameter parameter"]:
    """P of eq. 3 after images like the job's were taken of nothing but the model.

    The noise is the job's; where its slowly varying part is to be found from residuals, there is
    none to foresee, and the figures are the best that can happen.
    """
    told = parameters.prior_precision.diag()
    for information in foreseen(job, scene, parameters, state):
        told = told + information
    return covariance(told)


def expected_covariance(
    observation: Observation,
    scene: Scene,
    parameters: Parameters,
    state: Float[Tensor, "slot 4 4"],
) -> Float[Tensor, "parameter parameter"]:
    """P of eq. 3 if a state were right and all measured pixels showed the model."""
    if not parameters.names:
        return parameters.prior_sigma.new_zeros(0, 0)
    fit = RangeFit(
        observation=observation,
        surface=scene.surface,
        parameters=parameters,
        cutoff=UNLIMITED,
        drift=None,
    )
    return covariance(fit.evaluate(state[None]).information[0])


def foreseen(
    job: Job, scene: Scene, parameters: Parameters, state: Float[Tensor, "slot 4 4"]
) -> Iterator[Float[Tensor, "parameter parameter"]]:
    """A^T W A of eq. 12 that the image of each frame will have."""
    fit = RangeFit(
        observation=_images(job, scene, parameters, state),
        surface=scene.surface,
        parameters=parameters,
        cutoff=robust.EFFICIENT,
        drift=_drift(job.sensor),
    )
    for frame in fit.residuals(state):
        information, _ = normal_equations(fit.separate(frame), frame.jacobian)
        yield embedded(information, frame.active, len(parameters.names))


def next_view(
    job: Job,
    scene: Scene,
    state: Float[Tensor, "slot 4 4"],
    P: Float[Tensor, "parameter parameter"],
    generator: torch.Generator,
) -> NextView | None:
    """The joint configuration, of some within the limits, whose image would tell most.

    That is the largest gain of information, half the logarithm of det(1 + P A^T W A). None where
    no robot moves the sensor or is seen by it, nothing is unknown, or no image would tell more.

    Args:
        job: Its robot, sensor and unknowns.
        scene: What it sees.
        state: Where everything is believed to be.
        P: How sure that is.
        generator: Draws the configurations; on the CPU.
    """
    if job.robot is None or not job.robot.joint_names or job.frame_poses is not None:
        return None
    known = Parameters.of(job, scene)
    if not known.names or not P.isfinite().all():
        return None
    offsets = dict(zip(known.joint_names, known.joint_offsets(state).tolist(), strict=True))
    values = _configurations(_readable_limits(job.robot, offsets), generator).to(state)
    blank = RangeImage.blank("next", "next", job.sensor)
    blank = replace(blank, range=blank.range.to(state), usable=blank.usable.to(state.device))
    frames = tuple(replace(job.frames[0], image=blank, joints=each) for each in values)
    ahead = replace(job, frames=frames)
    parameters = Parameters.of(ahead, scene)
    informations = list(foreseen(ahead, scene, parameters, state))
    root = _root(P)
    gains = torch.stack([_gain(root, information) for information in informations])
    best = int(gains.argmax())
    if not gains[best] > LEAST_GAIN:
        return None
    after = root @ torch.linalg.solve(_told(root, informations[best]), root.mT)
    return NextView(
        joints=dict(zip(job.robot.joint_names, values[best].tolist(), strict=True)),
        gain=float(gains[best]),
        sigma=dict(zip(parameters.names, after.diagonal().sqrt().tolist(), strict=True)),
    )


def _images(job: Job, scene: Scene, parameters: Parameters, state: Tensor) -> Observation:
    """Coarse images of all frames as the model predicts them, without noise."""
    factor = coarse_factor(job.sensor)
    sensor = coarser_sensor(job.sensor, factor)
    ranges, measured = [], []
    for image in predictions(scene.surface, sensor, parameters, state, dtype=torch.float32):
        inside = (image.range >= sensor.near) & (image.range <= sensor.far)
        measured.append(inside & (image.synthesis.coverage > FILLED))
        ranges.append(torch.where(measured[-1], image.range, 0.0))
    of_all = torch.stack(ranges)
    return Observation(
        sensor=sensor,
        range=of_all,
        measured=torch.stack(measured),
        sigma=sensor.noise.sigma(of_all) / factor,
    )


def _drift(sensor: Sensor) -> Drift | None:
    """The slowly varying noise in pixels of the coarse images, where it is known."""
    known = sensor.noise.drift
    if known is None or known.sigma == 0.0:
        return None
    return replace(known, pixels=known.pixels / coarse_factor(sensor))


def _readable_limits(robot: Robot, offsets: Mapping[str, float]) -> Float[Tensor, "joint 2"]:
    """The limits in values as they are read, which lack the joints' offsets."""
    shift = [offsets.get(name, 0.0) for name in robot.joint_names]
    return robot.joint_limits - robot.joint_limits.new_tensor(shift)[:, None]


def _configurations(limits: Tensor, generator: torch.Generator) -> Float[Tensor, "view joint"]:
    """Values of all joints within their limits; a turn where there are none."""
    low, high = limits.to(torch.float64).unbind(1)
    low = torch.where(low.isfinite(), low, -math.pi)
    high = torch.where(high.isfinite(), high, math.pi)
    share = torch.rand(VIEWS, len(limits), generator=generator, dtype=torch.float64)
    return low + (high - low) * share.to(low)


def _root(P: Tensor) -> Float[Tensor, "parameter direction"]:
    """A square root of P, which there is even where something is known exactly."""
    scale = P.diagonal().clamp(min=0.0).sqrt()
    unit = torch.where(scale > 0.0, scale, 1.0)
    value, vector = torch.linalg.eigh(P / unit[:, None] / unit)
    return scale[:, None] * vector * value.clamp(min=0.0).sqrt()


def _told(root: Tensor, information: Tensor) -> Float[Tensor, "direction direction"]:
    """Information after an image over that before it, along the columns of P's root."""
    eye = torch.eye(len(root), dtype=root.dtype, device=root.device)
    return eye + root.mT @ information @ root


def _gain(root: Tensor, information: Tensor) -> Tensor:
    """Nats."""
    return 0.5 * torch.linalg.slogdet(_told(root, information)).logabsdet
