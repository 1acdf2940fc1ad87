"""Many poses of a sensor against one coarse image: one ray for each pixel, all poses at once."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.observation import Observation
from torchcal.calibrate.parameters import Parameters
from torchcal.geometry import robust
from torchcal.model.scene import Surface
from torchcal.render.synthesis import synthesise
from torchcal.solve.gauss_newton import NormalEquations


@dataclass(frozen=True, kw_only=True, slots=True)
class RayFit:
    """The robust fit of predicted to measured ranges of one image, for a batch of poses."""

    observation: Observation
    """Of one frame; its sensor has a beam of 0."""
    surface: Surface
    parameters: Parameters
    tolerance: float
    """m: what a range may be off by beside its noise, far from the solution."""

    def costs(self, states: Float[Tensor, "batch slot 4 4"]) -> Float[Tensor, " batch"]:
        """The robust cost of every state, without derivatives."""
        poses = self.parameters.bodies_in_sensor(states)[:, 0].to(self.observation.range)
        synthesis = synthesise(self.surface, poses, self.observation.sensor)
        return self._cost(*self._whitened(synthesis.range))

    def evaluate(self, states: Float[Tensor, "batch slot 4 4"]) -> NormalEquations:
        """Normal equations of every state: the image and the prior."""
        like = self.observation.range
        poses = self.parameters.bodies_in_sensor(states)[:, 0].to(like)
        motion = self.parameters.motion(states, 0).to(like)
        synthesis = synthesise(self.surface, poses, self.observation.sensor, motion)
        assert synthesis.jacobian is not None, "a motion was given"
        v, sigma = self._whitened(synthesis.range)
        A = (synthesis.jacobian / sigma[..., None]).flatten(1, 2)
        w = robust.biweight(v.nan_to_num(torch.inf), robust.EFFICIENT).flatten(1)
        WA = A * w[..., None]
        precision = self.parameters.prior_precision
        offset = self.parameters.difference(states, self.parameters.nominal).double()
        error = v.nan_to_num(0.0).flatten(1)[..., None]
        return NormalEquations(
            cost=self._cost(v, sigma) + 0.5 * (precision * offset.square()).sum(-1),
            information=(WA.mT @ A).double() + torch.diag(precision),
            gradient=(WA.mT @ error)[..., 0].double() - precision * offset,
        )

    def _whitened(self, predicted: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals in standard deviations, NaN where one side is missing; these deviations."""
        observation = self.observation
        sigma = (observation.sigma[0].square() + self.tolerance**2).sqrt()
        v = torch.where(observation.measured[0], observation.range[0] - predicted, torch.nan)
        return v / sigma, sigma

    def _cost(self, v: Tensor, sigma: Tensor) -> Tensor:
        """A measured pixel that the model leaves empty counts as one beyond the cut-off."""
        rho = robust.biweight_cost(v.nan_to_num(torch.inf), robust.EFFICIENT)
        return torch.where(self.observation.measured[0], rho, 0.0).flatten(1).double().sum(1)
