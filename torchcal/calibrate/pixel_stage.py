"""The pose from every pixel (eq. 2, 9 to 16), from coarse to fine with the exact beam."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.observation import Observation, coarser, coarser_beam
from torchcal.calibrate.one_view import OneView, as_states
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.range_fit import FrameResidual, RangeFit
from torchcal.calibrate.refine import Refined, with_noise
from torchcal.calibrate.reliability import estimated_covariance
from torchcal.calibrate.site import Site
from torchcal.geometry import robust
from torchcal.solve.gauss_newton import (
    GaussNewtonConfig,
    NormalEquations,
    Solution,
    StopReason,
    covariance,
    minimise,
    shared,
)

CURVATURE = float(robust.relative_curvature(torch.tensor(robust.EFFICIENT, dtype=torch.float64)))
BLOCKS = GaussNewtonConfig(iterations=10, ripple=0.005, curvature=CURVATURE, trusted=60.0)
"""On blocks: a step of so many standard deviations leaves about a tenth of it."""
PIXELS = GaussNewtonConfig(iterations=6, ripple=0.005, curvature=CURVATURE, trusted=20.0)
"""On every pixel: a step of so many standard deviations leaves less than a tenth of one."""
UNKNOWN = replace(PIXELS, longest=1.5, trusted=1.0)
"""Where nobody knows the noise: the derivatives may be noisy, too."""
RIVALS = replace(BLOCKS, iterations=6, trusted=5.0)
"""For costs: what such a step takes off is less than noise may."""
SLOW = 0.5
"""Sigmas of a pixel: what all pixels of a block may be off by together where nobody knows."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PixelFit:
    """A pose on every pixel, and how well it explains the image."""

    T_world_sensor: Float[Tensor, "4 4"]
    covariance: Float[Tensor, "6 6"]
    agreement: float
    """Share of the measured blocks of pixels that are where the model says."""
    settled: bool
    """Whether the last fit ended in a minimum."""


def pixel_fit(
    site: Site, view: OneView, parameters: Parameters, T_world_sensor: Float[Tensor, "4 4"]
) -> PixelFit:
    """Fits the pose with the exact beam to blocks of pixels, then to every pixel.

    Args:
        site: The model.
        view: The image.
        parameters: The sensor's pose and its prior.
        T_world_sensor: Where to start: within about a block of pixels.
    """
    blocks, state = block_fit(site, view, parameters), as_states(T_world_sensor)[None]
    fit, config = replace(blocks, observation=view.observation), PIXELS
    if blocks.observation is not view.observation:
        state = _fitted(blocks, state, BLOCKS).state
    if view.observation.sensor.noise.drift is None:
        fit, config = with_noise(fit, state[0], 1), UNKNOWN
    watched = _Watched(fit=fit)
    solution = minimise(shared(watched.evaluate), parameters.retract, state, config)
    return PixelFit(
        T_world_sensor=solution.state[0, 0],
        covariance=_covariance(fit, solution),
        agreement=_agreement(watched.best, fit.observation, blocks.observation),
        settled=int(solution.stop[0]) != StopReason.INVALID,
    )


def block_fit(site: Site, view: OneView, parameters: Parameters) -> RangeFit:
    """The fit to means over blocks of pixels, at most half as long as those of rays."""
    side = block_side(view.observation.sensor.beam, max(1, view.factor // 2))
    observation = coarser(view.observation, side)
    return RangeFit(
        observation=observation,
        surface=site.surface,
        parameters=parameters,
        cutoff=robust.EFFICIENT,
        drift=None,
    )


def block_side(beam: int, longest: int) -> int:
    """The side of blocks (pixels) whose means a beam of whole blocks predicts best.

    The mean over a block of side f of a beam of side b is as wide as b^2 + f^2 - 1 says, and a beam
    of an odd number n of blocks as (n f)^2.
    """

    def misfit(side: int) -> int:
        return abs((coarser_beam(beam, side) * side) ** 2 - beam**2 - side**2 + 1)

    return min(range(longest, min(longest, 2) - 1, -1), key=misfit)


def compared(fit: RangeFit, states: Float[Tensor, "state slot 4 4"]) -> Solution:
    """Where the states end that start within about a block of pixels of their minima."""
    return _fitted(fit, states, RIVALS)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Watched:
    """A fit of one image that keeps what it saw, so that no state is predicted twice."""

    fit: RangeFit
    seen: list[tuple[float, FrameResidual]] = field(default_factory=list)
    """Costs and residuals."""

    def evaluate(self, states: Float[Tensor, "1 slot 4 4"]) -> NormalEquations:
        """Normal equations of one state."""
        (frame,) = self.fit.residuals(states[0])
        equations = self.fit.equations(states[0], (frame,))
        self.seen.append((float(equations.cost[0]), frame))
        return equations

    @property
    def best(self) -> FrameResidual:
        """Of the least cost."""
        return min(self.seen, key=lambda each: each[0])[1]


def _agreement(frame: FrameResidual, pixels: Observation, blocks: Observation) -> float:
    """Share of the measured blocks of pixels within the noise of what was predicted."""
    side = pixels.range.shape[-1] // blocks.range.shape[-1]
    residual = replace(pixels, range=frame.residual[None], measured=frame.compared[None])
    means = coarser(residual, side)
    agree = (
        (means.range.abs() <= robust.AGREEING * expected_sigma(blocks))
        & means.measured
        & blocks.measured
    )
    return int(agree.sum()) / max(1, int(blocks.measured.sum()))


def expected_sigma(observation: Observation) -> Float[Tensor, "frame h w"]:
    """Standard deviations (m) with what blocks of pixels have in common."""
    noise, sigma = observation.sensor.noise, observation.sigma
    if noise.drift is not None:
        return (sigma.square() + noise.drift.sigma**2).sqrt()
    single = noise.sigma(observation.range)
    return (sigma.square() + (SLOW * single).square()).sqrt()


def _fitted(fit: RangeFit, states: Tensor, config: GaussNewtonConfig) -> Solution:
    return minimise(shared(fit.evaluate), fit.parameters.retract, states, config)


def _covariance(fit: RangeFit, solution: Solution) -> Tensor:
    """P of eq. 3: in closed form where the noise is independent, else from the residuals."""
    known = fit.observation.sensor.noise.drift
    if known is not None and known.sigma == 0.0:
        c = torch.tensor(fit.cutoff, dtype=torch.float64)
        prior = torch.diag(fit.parameters.prior_precision)
        told = solution.equations.information[0] - prior
        return covariance(prior + told / robust.weighted_variance(c))
    refined = Refined(state=solution.state[0], fit=fit, factor=1, solution=solution)
    return estimated_covariance(refined)
