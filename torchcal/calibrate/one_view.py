"""One range image at several resolutions, and the sensor's pose as the only unknown."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.mechanism import Mechanism
from torchcal.calibrate.observation import (
    Observation,
    coarse_factor,
    coarser,
    near_jumps,
    observed,
)
from torchcal.calibrate.parameters import AXES, Parameters
from torchcal.calibrate.slots import Slots
from torchcal.geometry import se3
from torchcal.geometry.projection import pixel_grid
from torchcal.match.prior_gate import Prior
from torchcal.model.sensor import Sensor
from torchcal.model.tensor_mistakes import check_booleans, check_floats


@dataclass(frozen=True, kw_only=True, slots=True)
class OneView:
    """A measured image, ready for fits."""

    observation: Observation
    """At full resolution, of one frame."""
    fine: Observation
    """One ray for each block of pixels."""
    coarse: Observation
    """One ray for each block of twice the side."""
    unmixed: Observation
    """``fine`` without the blocks near depth jumps, where the beam mixes two surfaces."""
    factor: int
    """Pixels along the side of a block of ``fine``."""

    @staticmethod
    def of(
        range_image: Float[Tensor, "h w"], sensor: Sensor, mask: Bool[Tensor, "h w"] | None
    ) -> "OneView":
        """Takes the pixels within the sensor's limits and the mask; None: all of them.

        Raises:
            TorchcalError: If image or mask are not of the sensor's size.
        """
        size = sensor.projection.height, sensor.projection.width
        check_floats("range_image", range_image, *size)
        if mask is not None:
            check_booleans("mask", mask, *size)
        usable = range_image.isfinite() & (range_image >= sensor.near)
        usable = usable & (range_image <= sensor.far)
        usable = usable if mask is None else usable & mask
        ranges = torch.where(usable, range_image, torch.nan).float()
        observation = observed(ranges[None], usable[None], sensor)
        factor = coarse_factor(sensor)
        fine = _rays(observation, factor)
        return OneView(
            observation=observation,
            fine=fine,
            coarse=_rays(observation, 2 * factor),
            unmixed=fine.without(near_jumps(fine.range, fine.measured, fine.sigma)),
            factor=factor,
        )

    @property
    def points(self) -> Float[Tensor, "point 3"]:
        """Measured points (m) in the sensor's frame, one for each block of pixels."""
        image = self.fine
        u, v = pixel_grid(image.sensor.projection, dtype=torch.float32, device=image.range.device)
        rays = image.sensor.projection.rays(u, v)
        return (image.range[0][..., None] * rays)[image.measured[0]]


def _rays(observation: Observation, factor: int) -> Observation:
    blocks = coarser(observation, factor)
    return replace(blocks, sensor=replace(blocks.sensor, beam=0))


def free_sensor(prior: Prior, Ts_world_body: Float[Tensor, "body 4 4"]) -> Parameters:
    """The sensor's pose as the only unknown, with the prior's variances along its axes."""
    T = prior.T_world_sensor.double()
    eye = torch.eye(12, dtype=T.dtype, device=T.device)
    alone = Mechanism(
        slots=Slots(),
        robot=None,
        joints=eye.new_zeros(1, 0),
        carrier=None,
        standing=False,
        Ts_first_frame=eye[None, :4, :4],
        Ts_world_body=Ts_world_body,
        link=torch.full((len(Ts_world_body),), -1, device=T.device),
        Ts_centre_object=eye.new_zeros(0, 4, 4),
    )
    return Parameters(
        names=tuple(f"sensor.{axis}" for axis in AXES),
        units=("m", "m", "m", "rad", "rad", "rad"),
        prior_sigma=prior.covariance.double().diagonal().sqrt(),
        columns=eye[:, :6],
        nominal=as_states(T),
        mechanism=alone,
    )


def as_states(T_world_sensor: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch slot 4 4"]:
    """States of ``free_sensor``."""
    eye = torch.eye(4).to(T_world_sensor).expand_as(T_world_sensor)
    return torch.stack([T_world_sensor, eye], -3)


def drawn_about(prior: Prior, count: int, generator: torch.Generator) -> Float[Tensor, "count 4 4"]:
    """The prior's pose and draws from it."""
    root, failed = torch.linalg.cholesky_ex(prior.covariance)
    root = torch.where(failed > 0, prior.covariance.diagonal().clamp(min=0.0).sqrt().diag(), root)
    steps = torch.randn(count, 6, generator=generator, dtype=torch.float64).to(root) @ root.mT
    steps[0] = 0.0
    return prior.T_world_sensor @ se3.exp(steps)
