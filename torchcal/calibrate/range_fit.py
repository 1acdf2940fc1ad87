"""The measurement equation on every pixel (eq. 2) as normal equations (eq. 9 to 16)."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.observation import Observation
from torchcal.calibrate.parameters import Parameters
from torchcal.model.scene import Surface
from torchcal.model.sensor import Drift
from torchcal.render.synthesis import synthesise
from torchcal.solve.field import SmoothField
from torchcal.solve.gauss_newton import NormalEquations
from torchcal.solve.image_equations import RobustImage, normal_equations, robust_image

FILLED = 0.75
"""Share of the beam that must meet the model before a pixel is compared."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameResidual:
    """Measured minus predicted of one frame."""

    residual: Float[Tensor, "h w"]
    """m; 0 where not compared."""
    compared: Bool[Tensor, "h w"]
    """Where both measurement and model are there."""
    sigma: Float[Tensor, "h w"]
    jacobian: Float[Tensor, "h w parameter"]
    missed: int
    """Measured pixels where the model is empty."""


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

    def evaluate(self, states: Float[Tensor, "batch 2 4 4"]) -> NormalEquations:
        """Normal equations of every state: all frames and the prior."""
        elements = [self.equations(state, self.residuals(state)) for state in states]
        return NormalEquations(
            cost=torch.cat([e.cost for e in elements]),
            information=torch.cat([e.information for e in elements]),
            gradient=torch.cat([e.gradient for e in elements]),
        )

    def residuals(self, state: Float[Tensor, "2 4 4"]) -> Iterator[FrameResidual]:
        """Residuals frame by frame, so that one frame's derivatives are held at a time."""
        poses = self.parameters.bodies_in_sensor(state).to(self.observation.range)
        motions = self.parameters.motion(state).to(self.observation.range)
        for k in range(len(poses)):
            yield self._frame_residual(k, poses[k], motions[k])

    def _frame_residual(self, k: int, poses: Tensor, motion: Tensor) -> FrameResidual:
        observation = self.observation
        synthesis = synthesise(self.surface, poses, observation.sensor, motion)
        assert synthesis.jacobian is not None, "a motion was given"
        finite = synthesis.range.isfinite() & synthesis.jacobian.isfinite().all(-1)
        compared = observation.measured[k] & (synthesis.coverage > FILLED) & finite
        residual = torch.where(compared, observation.range[k] - synthesis.range, 0.0)
        return FrameResidual(
            residual=residual,
            compared=compared,
            sigma=observation.sigma[k] * self.sigma_scale,
            jacobian=torch.where(compared[..., None], synthesis.jacobian, 0.0),
            missed=int((observation.measured[k] & ~compared).sum()),
        )

    def equations(
        self, state: Float[Tensor, "2 4 4"], frames: Iterable[FrameResidual]
    ) -> NormalEquations:
        """Normal equations, a batch of one, of residuals that ``residuals`` gave for a state."""
        total = self._prior(state)
        for frame in frames:
            image = self.separate(frame)
            information, gradient = normal_equations(image, frame.jacobian)
            # A pixel that the model leaves empty explains no more than one beyond the cut-off.
            missed = frame.missed * self.cutoff**2 / 6.0
            total = NormalEquations(
                cost=total.cost + image.cost + missed,
                information=total.information + information,
                gradient=total.gradient + gradient,
            )
        return total

    def _prior(self, state: Tensor) -> NormalEquations:
        """The prior P of eq. 3 as one more measurement."""
        precision = self.parameters.prior_sigma.double().square().reciprocal()
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
