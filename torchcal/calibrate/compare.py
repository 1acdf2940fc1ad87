"""Measured against predicted, pixel by pixel (section 2.3 and 2.4, eq. 1, 4 and 5)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float16, Int32, UInt8
from torch import Tensor

from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.prediction import Prediction, predictions
from torchcal.calibrate.range_fit import FILLED, INSIDE, within_limits
from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.calibrate.spread import Drawn, drawn_steps, moves_far
from torchcal.calibrate.stages import Tick, quiet
from torchcal.geometry import gaussian, robust
from torchcal.model.job import Frame, Job
from torchcal.model.scene import Scene
from torchcal.model.sensor import Sensor
from torchcal.render.appearance import appearance

EMPTY = 0.01
"""Share of the beam that may meet the model where a measurement still counts as unmodelled."""
RESIDUALS = 1 << 21
"""So many tell the noise's scale: of more pixels one in so many is taken."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Belief:
    """Where everything is believed to be and how sure that is."""

    state: Float[Tensor, "slot 4 4"]
    covariance: Float[Tensor, "parameter parameter"]
    """P of eq. 3."""
    drift_sigma: float
    """The slowly varying range error (m)."""
    drift_pixels: float
    """Its correlation length (pixels); 0 without one."""
    sigma_scale: float = 1.0
    """How much larger the residuals are than the sensor's sigma says."""
    used_pixels: int = 0
    """Those that the fit went by; 0 before one."""
    independent_pixels: float = 0.0
    """So many with errors of their own would have told as much."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Shown:
    """What the model says of one frame."""

    range: Float[Tensor, "h w"]
    """m; NaN where the model is empty."""
    mixed: Bool[Tensor, "h w"]
    """Where the beam meets the model with a part that is too small to compare, yet not empty, or so
    near to the sensor's limits that its noise decides whether anything is measured."""
    spread: Float[Tensor, "h w"]
    """sqrt(H P H^T), what the uncertain parameters add (m)."""
    colour: UInt8[Tensor, "h w 3"]
    normal: Float16[Tensor, "h w 3"]
    body: Int32[Tensor, "h w"]


def compare(
    job: Job, scene: Scene, parameters: Parameters, belief: Belief, tick: Tick = quiet
) -> tuple[Belief, tuple[FrameComparison, ...]]:
    """Compares every frame with the prediction by eq. 5.

    Args:
        job: The recording.
        scene: Its model.
        parameters: What is unknown.
        belief: What is known of it.
        tick: Called with each image that was predicted.

    Returns:
        The belief with the noise's sigma enlarged where the residuals are larger than it says, and
        the comparisons made with it.
    """
    shown = []
    for frame in _shown_frames(job, scene, parameters, belief):
        shown.append(frame)
        tick()
    scale = belief.sigma_scale * _residual_scale(job, shown, belief)
    belief = replace(belief, sigma_scale=scale)
    return belief, _compare_frames(job, shown, belief)


def compare_as_believed(
    job: Job, scene: Scene, parameters: Parameters, belief: Belief
) -> tuple[FrameComparison, ...]:
    """The same with the noise as it is believed to be."""
    return _compare_frames(job, list(_shown_frames(job, scene, parameters, belief)), belief)


def reclassified(comparison: FrameComparison, alpha: float) -> FrameComparison:
    """The same comparison judged with another alpha of eq. 5.

    What was not compared, such as a beam that is half beside the model, depends on no alpha.

    Raises:
        ValueError: If ``alpha`` is not positive.
    """
    if not alpha > 0.0:
        raise ValueError(f"found alpha {alpha}; expected more than 0")
    compared = comparison.label != PixelClass.NOT_COMPARED
    label = classify(comparison.measured, comparison.predicted, comparison.sigma, compared, alpha)
    return replace(comparison, label=label)


def without_range_error(
    comparison: FrameComparison, offset: float, scale: float
) -> FrameComparison:
    """The same comparison in true ranges: z_measured = offset + (1 + scale) z."""
    if offset == scale == 0.0:
        return comparison
    return replace(
        comparison,
        measured=(comparison.measured - offset) / (1.0 + scale),
        predicted=(comparison.predicted - offset) / (1.0 + scale),
        sigma=comparison.sigma / (1.0 + scale),
    )


def _shown_frames(
    job: Job, scene: Scene, parameters: Parameters, belief: Belief
) -> Iterator[_Shown]:
    reaching = _reaching(job.sensor)
    frames = predictions(scene.surface, reaching, parameters, belief.state, dtype=torch.float32)
    for k, frame in enumerate(frames):
        yield _shown(scene, parameters, belief, job.sensor, k, frame)


def _reaching(sensor: Sensor) -> Sensor:
    """The sensor with limits as wide as its noise may bring something within its own."""
    near, far = torch.tensor([sensor.near, sensor.far], dtype=torch.float64)
    near_sigma, far_sigma = (float(sensor.noise.sigma(limit)) for limit in (near, far))
    return replace(
        sensor,
        near=max(0.0, sensor.near - INSIDE * near_sigma),
        far=sensor.far + INSIDE * far_sigma,
    )


def _compare_frames(job: Job, shown: list[_Shown], belief: Belief) -> tuple[FrameComparison, ...]:
    return tuple(
        _compare_frame(job, frame, prediction, belief)
        for frame, prediction in zip(job.frames, shown, strict=True)
    )


def _shown(
    scene: Scene,
    parameters: Parameters,
    belief: Belief,
    sensor: Sensor,
    k: int,
    prediction: Prediction,
) -> _Shown:
    synthesis = prediction.synthesis
    modelled = (synthesis.coverage > FILLED) & prediction.range.isfinite()
    poses = parameters.bodies_in_sensor(belief.state)[k].float()
    shown = appearance(scene, poses, sensor, synthesis.face)
    return _Shown(
        range=torch.where(modelled, prediction.range, torch.nan),
        mixed=torch.where(
            modelled, ~within_limits(prediction.range, sensor), synthesis.coverage > EMPTY
        ),
        spread=_spread(scene, parameters, belief, sensor, k, prediction, shown.body),
        colour=(255.0 * shown.colour).round().byte(),
        normal=shown.normal.half(),
        body=shown.body.int(),
    )


def _spread(
    scene: Scene,
    parameters: Parameters,
    belief: Belief,
    sensor: Sensor,
    k: int,
    prediction: Prediction,
    body: Tensor,
) -> Float[Tensor, "h w"]:
    """What the uncertain parameters add to sigma' of eq. 4 (m)."""
    active, ranges = prediction.active, prediction.synthesis.range
    P = belief.covariance[active[:, None], active].to(prediction.jacobian)
    tangent = gaussian.predicted_sigma(prediction.jacobian, P, torch.zeros_like(ranges))
    motion = parameters.motion(belief.state, k).to(ranges)
    if not moves_far(ranges, body, motion, P, sensor):
        return tangent
    steps = drawn_steps(belief.covariance)
    states = belief.state.expand(len(steps), *belief.state.shape)
    poses = parameters.bodies_in_sensor(parameters.retract(states, steps))[:, k]
    drawn = Drawn.of(scene.surface, poses, sensor)
    slopes = prediction.synthesis.jacobian
    assert slopes is not None, "predictions come with their derivative"
    sigma = torch.hypot(tangent, sensor.noise.sigma(ranges))
    beyond = drawn.beyond_tangent(ranges, slopes, steps[:, active], sigma)
    return torch.hypot(tangent, beyond)


def _sigma(prediction: _Shown, sensor: Sensor, belief: Belief) -> Tensor:
    """Sigma' of eq. 4 with both parts of the noise."""
    noise = sensor.noise.sigma(prediction.range) * belief.sigma_scale
    drift = torch.full_like(noise, belief.drift_sigma)
    return torch.hypot(prediction.spread, torch.hypot(noise, drift))


def _residual_scale(job: Job, predictions: list[_Shown], belief: Belief) -> float:
    """Robust standard deviation of measured minus predicted in units of sigma', at least 1.

    What shows something new is not counted: it would enlarge the noise of everything else.
    """
    v, every = [], len(predictions) * predictions[0].range.numel() // RESIDUALS + 1
    for frame, prediction in zip(job.frames, predictions, strict=True):
        residual = frame.image.range.to(prediction.range) - prediction.range
        d = residual / _sigma(prediction, job.sensor, belief)
        v.append(d[frame.image.usable & d.isfinite()][::every])
    return max(1.0, robust.inlier_scale(torch.cat(v)))


def _compare_frame(job: Job, frame: Frame, prediction: _Shown, belief: Belief) -> FrameComparison:
    sigma = _sigma(prediction, job.sensor, belief)
    measured = frame.image.range.to(prediction.range)
    return FrameComparison(
        name=frame.image.name,
        measured=measured,
        predicted=prediction.range,
        sigma=sigma,
        label=classify(
            measured, prediction.range, sigma, frame.image.usable & ~prediction.mixed, job.alpha
        ),
        body=prediction.body,
        colour=prediction.colour,
        normal=prediction.normal,
        usable=frame.image.usable,
    )


def classify(
    measured: Float[Tensor, "h w"],
    predicted: Float[Tensor, "h w"],
    sigma: Float[Tensor, "h w"],
    usable: Tensor,
    alpha: float,
) -> UInt8[Tensor, "h w"]:
    """One ``PixelClass`` per pixel by eq. 5: |measured - predicted| > alpha sigma'."""
    is_measured, is_modelled = measured.isfinite(), predicted.isfinite()
    d = (measured - predicted) / sigma
    label = torch.full_like(measured, PixelClass.NOT_COMPARED, dtype=torch.uint8)
    label = label.masked_fill(is_measured & is_modelled, PixelClass.AGREES)
    label = label.masked_fill(d < -alpha, PixelClass.NEARER)
    label = label.masked_fill(d > alpha, PixelClass.FARTHER)
    label = label.masked_fill(~is_measured & is_modelled, PixelClass.MISSING)
    label = label.masked_fill(is_measured & ~is_modelled, PixelClass.UNMODELLED)
    return label.masked_fill(~usable, PixelClass.NOT_COMPARED)
