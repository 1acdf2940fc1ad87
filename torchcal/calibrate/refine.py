"""From a start to the estimate on every pixel: coarse to fine, noise model."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.noise import COEFFICIENTS, NoiseModel, correlation, noise_model
from torchcal.calibrate.observation import Observation, coarser
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.range_fit import RangeFit
from torchcal.calibrate.stages import Tick, quiet
from torchcal.geometry import robust
from torchcal.model.scene import Surface
from torchcal.model.sensor import Drift
from torchcal.solve.field import SPACING
from torchcal.solve.gauss_newton import GaussNewtonConfig, Solution, minimise, shared

FINE_PIXELS = 800_000
"""Pixels of all frames that measured something, together, in the final fit of a sharp sensor; more
are averaged in blocks."""
RIPPLE = 0.005
"""Share of the cost that pixels changing from face to face may add in an accepted step."""
ITERATIONS = 10
"""Most steps of each final fit."""
TOLERANCE = 0.1
"""Shortest step of the final fits, in standard deviations: less cannot be seen in the result."""
WIDE = (1000.0, 60.0)
"""Cut-offs (standard deviations) of first fits: of what stands many pixels elsewhere only the
outline tells where it is, and every pixel there is an outlier to a narrow cut-off."""
LONGEST = 10.0
"""Most that a step is lengthened: real models are themselves noisy, and so are their slopes."""
LARGEST_DRIFT = 0.5
"""Most of the slowly varying error, in the declared sigma of a pixel. What is alike over some
distance beyond that is a wrong model, which a field must not explain away."""
INLIER = 3.0
"""Robust standard deviations within which residuals tell about the noise."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Refined:
    """A state on one resolution and what was learnt there."""

    state: Float[Tensor, "slot 4 4"]
    fit: RangeFit
    """With the noise model that was used."""
    factor: int
    """Block size of the resolution: pixels of the image for one of the fit."""
    solution: Solution


def fine_factor(observation: Observation) -> int:
    """Block size of the final resolution: 1 for wide beams, whose box must be kept exactly."""
    if observation.sensor.beam > 1:
        return 1
    pixels = observation.range[0].numel() * int(observation.measured.flatten(1).any(1).sum())
    return next(f for f in itertools.count(1) if pixels <= FINE_PIXELS * f * f)


def coarse_fit(
    observation: Observation,
    surface: Surface,
    parameters: Parameters,
    states: Float[Tensor, "candidate slot 4 4"],
    tick: Tick = quiet,
) -> tuple[RangeFit, Solution]:
    """First fits of all candidates on coarse images, at one cut-off so that costs compare."""
    fit = RangeFit(
        observation=observation,
        surface=surface,
        parameters=parameters,
        cutoff=robust.EFFICIENT,
        drift=None,
        tick=tick,
    )
    config = GaussNewtonConfig(iterations=6, ripple=RIPPLE)
    solution = None
    for _ in range(2):
        fit = replace(fit, cutoff=min(fit_cutoff(fit, state) for state in states))
        solution = minimise(shared(fit.evaluate), parameters.retract, states, config)
        states = solution.state
    assert solution is not None, "there are two rounds"
    return fit, solution


def widely_fitted(
    fit: RangeFit, states: Float[Tensor, "candidate slot 4 4"], costs: Float[Tensor, " candidate"]
) -> tuple[Float[Tensor, "candidate slot 4 4"], Float[Tensor, " candidate"]]:
    """States after fits with wide cut-offs and then the fit's own, where its cost is lower there.

    Args:
        fit: The images.
        states: Where to start.
        costs: Of the fit there.
    """
    config = GaussNewtonConfig(iterations=ITERATIONS, ripple=RIPPLE, longest=LONGEST)

    def fitted(cutoff: float, starts: Tensor) -> Solution:
        evaluate = replace(fit, cutoff=cutoff).evaluate
        return minimise(shared(evaluate), fit.parameters.retract, starts, config)

    found = states
    for cutoff in WIDE:
        found = fitted(cutoff, found).state
    last = fitted(fit.cutoff, found)
    better = last.equations.cost < costs
    return (
        torch.where(better[:, None, None, None], last.state, states),
        torch.where(better, last.equations.cost, costs),
    )


def fit_cutoff(fit: RangeFit, state: Float[Tensor, "slot 4 4"]) -> float:
    """Eq. 16 over all frames, not below the efficient cut-off."""
    v = [(f.residual / f.sigma)[f.compared] for f in fit.residuals(state)]
    return float(robust.cutoff(torch.cat(v).double()))


def fine_fit(
    observation: Observation,
    surface: Surface,
    parameters: Parameters,
    state: Float[Tensor, "slot 4 4"],
    *,
    factor: int,
    tick: Tick = quiet,
) -> Refined:
    """The fit with the noise model of the sensor, or of the residuals themselves.

    Args:
        observation: The measured images.
        surface: The scene's triangles.
        parameters: What is unknown.
        state: Where to start.
        factor: Side of the blocks of pixels that are averaged.
        tick: Called with each image that was predicted, also by what is asked of the fit later.
    """
    observation = coarser(observation, factor)
    fit = RangeFit(
        observation=observation,
        surface=surface,
        parameters=parameters,
        cutoff=2.0 * robust.EFFICIENT,
        drift=None,
        tick=tick,
    )
    fit = with_noise(fit, state, factor)
    config = GaussNewtonConfig(
        iterations=ITERATIONS, ripple=RIPPLE, longest=LONGEST, tolerance=TOLERANCE
    )
    solution = minimise(shared(fit.evaluate), parameters.retract, state[None], config)
    fit = with_noise(fit, solution.state[0], factor)
    solution = minimise(shared(fit.evaluate), parameters.retract, solution.state, config)
    return Refined(state=solution.state[0], fit=fit, factor=factor, solution=solution)


def with_noise(
    fit: RangeFit,
    state: Float[Tensor, "slot 4 4"],
    factor: int,
    *,
    largest: float = LARGEST_DRIFT,
    shortest: float = 0.0,
) -> RangeFit:
    """The fit with the efficient cut-off and the noise that its own residuals show.

    Args:
        fit: Of blocks of pixels.
        state: Where its residuals are looked at.
        factor: Side of a block (pixels).
        largest: Most of the slowly varying error, in the declared sigma of a pixel.
        shortest: Least length (pixels) over which that is alike.
    """
    known = fit.observation.sensor.noise.drift
    if known is not None:
        drift = Drift(sigma=known.sigma, pixels=known.pixels / factor)
        fit = replace(fit, drift=drift, cutoff=robust.EFFICIENT)
        return replace(fit, sigma_scale=max(1.0, _independent_scale(fit, state)))
    model = _noise_of_residuals(fit, state, largest=largest * factor)
    pixels = max(model.drift.pixels, shortest / factor)
    drift = replace(model.drift, pixels=pixels) if model.drift.sigma > 0 else None
    return replace(fit, drift=drift, sigma_scale=model.sigma_scale, cutoff=robust.EFFICIENT)


def _independent_scale(fit: RangeFit, state: Tensor) -> float:
    """Robust standard deviation of the whitened residuals without their slowly varying part."""
    plain = replace(fit, sigma_scale=1.0)
    v = []
    for frame in plain.residuals(state):
        image = plain.separate(frame)
        v.append((image.error / frame.sigma)[frame.compared])
    return robust.robust_scale(torch.cat(v))


def fitted_drift(refined: Refined) -> Drift:
    """The slowly varying noise that the fit used, in pixels of the images."""
    drift = refined.fit.drift or Drift(sigma=0.0, pixels=1.0)
    return replace(drift, pixels=drift.pixels * refined.factor)


def slow_error(refined: Refined) -> Drift:
    """What the comparison must expect to vary slowly, in pixels of the images.

    It is the whole of it, not only the part that the fit takes for noise: the operator is not to be
    told of objects where camera and model merely differ.
    """
    known = refined.fit.observation.sensor.noise.drift
    if known is not None:
        return known
    drift = _noise_of_residuals(refined.fit, refined.state, largest=math.inf).drift
    return replace(drift, pixels=drift.pixels * refined.factor)


def _noise_of_residuals(fit: RangeFit, state: Tensor, *, largest: float) -> NoiseModel:
    """Noise model of the residuals; ``largest`` slowly varying part in sigmas of the pixels."""
    if not fit.observation.measured.any():
        return NoiseModel(sigma_scale=1.0, drift=Drift(sigma=0.0, pixels=1.0))
    sigma = float(fit.observation.sigma[fit.observation.measured].median())
    filled = float(fit.observation.measured.flatten(1).double().sum(1).max())
    return noise_model(
        correlation(_inliers(fit, state)),
        sigma,
        largest=largest * sigma,
        shortest=(filled / COEFFICIENTS) ** 0.5 / SPACING,
    )


def _inliers(fit: RangeFit, state: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Residuals (m) of each frame, and which of them are no outliers among all."""
    # The derivatives are not kept: of a long recording they would fill the memory.
    frames = [(f.residual, f.sigma, f.compared) for f in fit.residuals(state)]
    v = torch.cat([(residual / sigma)[compared] for residual, sigma, compared in frames])
    limit = INLIER * robust.robust_scale(v)
    for residual, sigma, compared in frames:
        yield residual, compared & (residual.abs() < limit * sigma)
