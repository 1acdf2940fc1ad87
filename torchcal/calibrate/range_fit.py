"""The measurement equation on every pixel (eq. 2) as normal equations (eq. 9 to 16)."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.calibrate.observation import Observation
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.prediction import Prediction, predictions
from torchcal.calibrate.stages import Tick, quiet
from torchcal.geometry import robust
from torchcal.model.scene import Surface
from torchcal.model.sensor import Drift, Sensor
from torchcal.solve.field import SmoothField
from torchcal.solve.gauss_newton import NormalEquations
from torchcal.solve.image_equations import RobustImage, normal_equations, robust_image

FILLED = 0.75
"""Share of the beam that must meet the model before a pixel is compared."""
INSIDE = 3.0
"""Standard deviations of a pixel's noise that its range must lie within the sensor's limits: nearer
to them the noise decides what is measured, and what is measured is not the range on average."""
UNDECIDED = 0.5
"""Cost of a pixel nearer to the limits: that of one which agrees, on average."""


def within_limits(ranges: Float[Tensor, "h w"], sensor: Sensor) -> Bool[Tensor, "h w"]:
    """Which predicted ranges (m) lie ``INSIDE`` the sensor's limits."""
    margin = INSIDE * sensor.noise.sigma(ranges)
    return (ranges > sensor.near + margin) & (ranges < sensor.far - margin)


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameResidual:
    """Measured minus predicted of one frame."""

    residual: Float[Tensor, "h w"]
    """m; 0 where not compared."""
    compared: Bool[Tensor, "h w"]
    """Where both measurement and model are there."""
    sigma: Float[Tensor, "h w"]
    jacobian: Float[Tensor, "h w active"]
    """Derivative of what is predicted."""
    active: Int[Tensor, " active"]
    """The parameters of ``jacobian``; the image does not depend on others."""
    uncompared: Float[Tensor, "h w"]
    """Cost of what is measured and not compared; 0 elsewhere."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RangeFit:
    """The robust fit of predicted to measured images, at one resolution and cut-off."""

    observation: Observation
    surface: Surface
    parameters: Parameters
    cutoff: float
    """c of eq. 16, in standard deviations."""
    drift: Drift | None
    """The slowly varying part of the noise; its length in this resolution's pixels."""
    sigma_scale: float = 1.0
    """Independent noise over the sensor's sigma."""
    tick: Tick = quiet
    """Called with each image that was predicted."""

    def evaluate(self, states: Float[Tensor, "batch slot 4 4"]) -> NormalEquations:
        """Normal equations of every state: all frames and the prior."""
        elements = [self.equations(state, self.residuals(state)) for state in states]
        return NormalEquations(
            cost=torch.cat([e.cost for e in elements]),
            information=torch.cat([e.information for e in elements]),
            gradient=torch.cat([e.gradient for e in elements]),
        )

    def residuals(self, state: Float[Tensor, "slot 4 4"]) -> Iterator[FrameResidual]:
        """Residuals frame by frame, so that one frame's derivatives are held at a time."""
        sensor, like = self.observation.sensor, self.observation.range
        measured = self.observation.measured.flatten(1).any(1).tolist()
        frames = [k for k, any_pixel in enumerate(measured) if any_pixel]
        predicted = predictions(
            self.surface, sensor, self.parameters, state, dtype=like.dtype, frames=frames
        )
        for k, any_pixel in enumerate(measured):
            yield self._frame_residual(k, next(predicted)) if any_pixel else self._nothing(k)
            self.tick()

    def _frame_residual(self, k: int, prediction: Prediction) -> FrameResidual:
        observation, sensor = self.observation, self.observation.sensor
        finite = prediction.range.isfinite() & prediction.jacobian.isfinite().all(-1)
        modelled = finite & (prediction.synthesis.coverage > FILLED)
        compared = observation.measured[k] & modelled & within_limits(prediction.range, sensor)
        # A pixel that the model leaves empty explains no more than one beyond the cut-off.
        empty = robust.rejected_cost(self.cutoff)
        cost = empty + (UNDECIDED - empty) * modelled.double()
        return FrameResidual(
            residual=torch.where(compared, observation.range[k] - prediction.range, 0.0),
            compared=compared,
            sigma=observation.sigma[k] * self.sigma_scale,
            jacobian=torch.where(compared[..., None], prediction.jacobian, 0.0),
            active=prediction.active,
            uncompared=torch.where(observation.measured[k] & ~compared, cost, 0.0),
        )

    def _nothing(self, k: int) -> FrameResidual:
        """Of a frame in which nothing was measured: nothing needs to be predicted."""
        none = torch.zeros_like(self.observation.range[k])
        active = self.parameters.active(k)
        return FrameResidual(
            residual=none,
            compared=self.observation.measured[k],
            sigma=self.observation.sigma[k] * self.sigma_scale,
            jacobian=none[..., None].expand(*none.shape, len(active)),
            active=active,
            uncompared=none.double(),
        )

    def equations(
        self, state: Float[Tensor, "slot 4 4"], frames: Iterable[FrameResidual]
    ) -> NormalEquations:
        """Normal equations, a batch of one, of residuals that ``residuals`` gave for a state."""
        total = self._prior(state)
        for frame in frames:
            image = self.separate(frame)
            information, gradient = normal_equations(image, frame.jacobian)
            count = len(self.parameters.names)
            total = NormalEquations(
                cost=total.cost + image.cost + frame.uncompared.sum(),
                information=total.information + embedded(information, frame.active, count),
                gradient=total.gradient.index_add(1, frame.active, gradient[None]),
            )
        return total

    def _prior(self, state: Tensor) -> NormalEquations:
        """The prior P of eq. 3 as one more measurement."""
        precision = self.parameters.prior_precision
        error = self.parameters.difference(state, self.parameters.nominal).double()
        return NormalEquations(
            cost=0.5 * (precision * error.square()).sum()[None],
            information=torch.diag(precision)[None],
            gradient=(-precision * error)[None],
        )

    def separate(self, frame: FrameResidual) -> RobustImage:
        """One frame's residuals as slowly varying part, independent noise and outliers."""
        field = None
        if self.drift is not None and self.drift.sigma > 0:
            field = SmoothField.of(
                *frame.residual.shape,
                sigma=self.drift.sigma,
                pixels=self.drift.pixels,
                like=frame.residual.double(),
            )
        return robust_image(
            frame.residual, frame.sigma, frame.compared, cutoff=self.cutoff, field=field
        )


def embedded(
    matrix: Float[Tensor, "active active"], active: Int[Tensor, " active"], count: int
) -> Float[Tensor, "parameter parameter"]:
    """A frame's matrix among all ``count`` parameters; 0 for those that it does not depend on."""
    whole = matrix.new_zeros(count, count)
    whole[active[:, None], active] = matrix
    return whole
