"""What one frame says of the parameters: quick fits of rays, then the exact image once."""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.observation import (
    Observation,
    coarser,
    grown,
    near_jumps,
    observe,
    sharpened,
)
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pixel_stage import block_side, expected_sigma
from torchcal.calibrate.range_fit import FrameResidual, RangeFit, embedded
from torchcal.calibrate.refine import Refined, with_noise
from torchcal.calibrate.reliability import reliable_share
from torchcal.geometry import robust
from torchcal.model.job import Job
from torchcal.model.scene import Scene
from torchcal.model.sensor import Drift
from torchcal.solve.gauss_newton import (
    GaussNewtonConfig,
    NormalEquations,
    Solution,
    minimise,
    shared,
)
from torchcal.solve.image_equations import normal_equations

WIDTH = 128
"""Images are averaged to about so many pixels along their longer side."""
LEAST_WHOLE = 0.5
"""Share of the blocks that must be whole before those with missing pixels are left out."""
CLOSE = 0.5
"""A step that changes the blocks by less than this part of their sigma (rms) is the last."""
STEPS = 6
"""Most for each cut-off."""
CUTOFFS = (60.0, robust.EFFICIENT)
"""Standard deviations of a block, after a first fit of what fits best: walls tell the turn, and
only then are the other surfaces near enough to tell the shift along the walls."""
APART = 5.0
"""Standard deviations beyond which a block shows something else than the model."""
LOOKS = 4
"""Most exact images for one frame."""
SLOW_PIXELS = 30.0
"""Over about so many pixels the range errors of real cameras are alike. The residuals of a single
frame show less, because its own fit takes up what varies most slowly."""
LARGEST_SLOW = 2.0
"""Most of that error, in the declared sigma of a pixel: a single frame must not be believed more
than it deserves, and no comparison is made with it that a wrong model could hide from."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Trust:
    """How much of what a frame seems to tell can be relied on."""

    sigma_scale: float = 1.0
    """Residuals over the sensor's sigma."""
    drift: Drift | None = None
    """What varies slowly over the image; its length in blocks of pixels."""
    share: float = 1.0
    """Of the information, where neighbouring errors are alike beyond that."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Told:
    """What a frame tells, near a state, without any prior."""

    state: Float[Tensor, "slot 4 4"]
    information: Float[Tensor, "parameter parameter"]
    gradient: Float[Tensor, " parameter"]
    """Information times the step to where the frame alone would have the parameters."""
    agreement: float
    """Share of the measured blocks of pixels that are where the model says."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameFit:
    """A frame's images and what is expected of it: nominal state and prior of ``parameters``."""

    fit: RangeFit
    """Of blocks of pixels."""
    coarse: Observation
    """Of blocks twice as long that show one surface, compared with the rays in their middles."""
    side: int
    """Of a block (pixels)."""

    @staticmethod
    def of(job: Job, scene: Scene, parameters: Parameters, trust: Trust) -> "FrameFit":
        """Averages the only frame of a job."""
        observation = observe(job)
        projection, beam = job.sensor.projection, job.sensor.beam
        side = max(1, round(max(projection.width, projection.height) / WIDTH))
        side = block_side(beam, side) if beam > 1 else side
        side = min(side, projection.width, projection.height)
        whole = coarser(observation, side, least=1.0)
        blocks = coarser(observation, side)
        if whole.measured.sum() >= LEAST_WHOLE * blocks.measured.sum():
            blocks = whole
        fit = RangeFit(
            observation=blocks,
            surface=scene.surface,
            parameters=parameters,
            cutoff=robust.EFFICIENT,
            drift=trust.drift,
            sigma_scale=trust.sigma_scale,
        )
        coarse = sharpened(coarser(blocks, min(2, *blocks.range.shape[1:])))
        jumps = near_jumps(coarse.range, coarse.measured, coarse.sigma)
        return FrameFit(fit=fit, coarse=coarse.without(jumps), side=side)

    @property
    def measured(self) -> bool:
        """Whether there is anything to compare."""
        return bool(self.coarse.measured.any())

    def near(self, state: Float[Tensor, "slot 4 4"]) -> Float[Tensor, "slot 4 4"]:
        """Where rays lead from a state within a few pixels of the coarse image."""
        rays = _Rays(fit=replace(self.fit, observation=self.coarse, drift=None))
        config = self._steps(self.coarse)
        # Each fit need only lead to where the next begins; after the last is the exact image.
        for cutoff, following in pairwise((rays.cutoff(state), *CUTOFFS, CUTOFFS[-1])):
            near = config.tolerance * following / CUTOFFS[-1]
            state = rays.fitted(state, cutoff, replace(config, tolerance=near, trusted=near))
        return state

    def told(self, state: Float[Tensor, "slot 4 4"], share: float) -> Told:
        """What the exact image says near a state, after steps to where the frame is explained.

        Args:
            state: Within about a pixel of where the frame is explained best.
            share: Of the information that can be relied on.
        """
        parameters = self.fit.parameters
        wide = torch.diag(parameters.prior_precision)
        told, frame = self._look(state, share)
        for _ in range(LOOKS - 1):
            offset = parameters.difference(state, parameters.nominal)
            step = torch.linalg.solve(told.information + wide, told.gradient - wide @ offset)
            change = (frame.jacobian.double() @ step[frame.active] / frame.sigma)[frame.compared]
            if not change.square().mean() > CLOSE**2:
                break
            state = parameters.retract(state, step)
            told, frame = self._look(state, share)
        return told

    def trust(self, state: Float[Tensor, "slot 4 4"]) -> Trust:
        """What the residuals at a fitted state say of the noise."""
        fit = self._with_noise(self.fit, state)
        known, share = fit.observation.sensor.noise.drift, 1.0
        if known is None or known.sigma > 0.0:
            solution = self._fitted(fit, state)
            fit = self._with_noise(fit, solution.state[0])
            refined = Refined(state=solution.state[0], fit=fit, factor=self.side, solution=solution)
            share = reliable_share(refined)
        return Trust(sigma_scale=fit.sigma_scale, drift=fit.drift, share=share)

    def _with_noise(self, fit: RangeFit, state: Tensor) -> RangeFit:
        return with_noise(fit, state, self.side, largest=LARGEST_SLOW, shortest=SLOW_PIXELS)

    def trusting(self, trust: Trust) -> "FrameFit":
        """The same with another noise."""
        fit = replace(self.fit, sigma_scale=trust.sigma_scale, drift=trust.drift)
        return replace(self, fit=fit)

    def _fitted(self, fit: RangeFit, state: Tensor) -> Solution:
        config = self._steps(fit.observation)
        return minimise(shared(fit.evaluate), fit.parameters.retract, state[None], config)

    def _steps(self, observation: Observation) -> GaussNewtonConfig:
        close = CLOSE * float(observation.measured.sum()) ** 0.5
        return GaussNewtonConfig(iterations=STEPS, ripple=0.005, tolerance=close, longest=1.5)

    def _look(self, state: Tensor, share: float) -> tuple[Told, FrameResidual]:
        fit = self.fit
        whole = next(fit.residuals(state))
        frame = self._explainable(whole)
        information, gradient = normal_equations(fit.separate(frame), frame.jacobian)
        # The weights of the biweight hold more than it tells, and its cost is flatter (3.3).
        c = gradient.new_tensor(fit.cutoff)
        relied = share / robust.weighted_variance(c)
        count = len(fit.parameters.names)
        pull = gradient.new_zeros(count).index_add(0, frame.active, gradient)
        told = Told(
            state=state,
            information=relied * embedded(information, frame.active, count),
            gradient=relied / robust.relative_curvature(c) * pull,
            agreement=self._agreement(whole),
        )
        return told, frame

    def _explainable(self, frame: FrameResidual) -> FrameResidual:
        """Without the blocks that show something else, and those whose beams may hold a part of it.

        These differ too little for the biweight, and all to one side.
        """
        sigma = torch.hypot(expected_sigma(self.fit.observation)[0], frame.sigma)
        apart = (frame.residual.abs() > APART * sigma) & frame.compared
        reach = max(1, self.fit.observation.sensor.beam)
        return replace(frame, compared=frame.compared & ~grown(apart[None], reach)[0])

    def _agreement(self, frame: FrameResidual) -> float:
        observation = self.fit.observation
        agrees = frame.residual.abs() <= robust.AGREEING * expected_sigma(observation)[0]
        return int((agrees & frame.compared).sum()) / max(1, int(observation.measured.sum()))


@dataclass(frozen=True, kw_only=True, slots=True)
class _Rays:
    """Fits of one frame with several cut-offs that predict no state twice."""

    fit: RangeFit
    seen: list[tuple[Tensor, FrameResidual]] = field(default_factory=list)
    """States with their residuals."""

    def cutoff(self, state: Float[Tensor, "slot 4 4"]) -> float:
        """Eq. 16, not below the efficient cut-off."""
        frame = self._residual(state)
        v = (frame.residual / frame.sigma)[frame.compared]
        return float(robust.cutoff(v.double()))

    def fitted(
        self, state: Float[Tensor, "slot 4 4"], cutoff: float, config: GaussNewtonConfig
    ) -> Float[Tensor, "slot 4 4"]:
        """Where steps lead from a state."""
        fit = replace(self.fit, cutoff=cutoff)

        def evaluate(states: Tensor) -> NormalEquations:
            return fit.equations(states[0], (self._residual(states[0]),))

        return minimise(shared(evaluate), fit.parameters.retract, state[None], config).state[0]

    def _residual(self, state: Tensor) -> FrameResidual:
        for known, frame in self.seen:
            if torch.equal(known, state):
                return frame
        (frame,) = self.fit.residuals(state)
        self.seen.append((state, frame))
        return frame
