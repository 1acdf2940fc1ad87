"""What is believed after the fits of a recording (section 3), and what to say of it."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.stats import chi2
from torch import Tensor

from torchcal.calibrate.compare import Belief
from torchcal.calibrate.fits import EXPLAINED, Choice
from torchcal.calibrate.observability import LEFT, poses_are_told, unobservable_directions
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.readings import EXPLAINED as WELL_EXPLAINED
from torchcal.calibrate.refine import Refined
from torchcal.calibrate.reliability import reliability
from torchcal.calibrate.result import (
    Alternative,
    Estimate,
    FrameComparison,
    Status,
    rivals_words,
)
from torchcal.calibrate.slots import BASE, MOUNT
from torchcal.geometry import gaussian, robust
from torchcal.model.job import Job
from torchcal.model.sensor import Drift, Sensor

CHANCE = 1e-4
"""An object moved if chance alone would put its estimate so far off less often than this."""
SHARPEST = 1e-9
"""Least share of the prior's sigma that an estimate can leave."""
NOTHING_TOLD = (
    "No measured pixel could be compared with the model, and everything that is given comes from "
    "the prior: is the nominal pose right, and is the model where the sensor looks?"
)
OWN_ERRORS = 0.8
"""With more independent pixels than this share of all, nobody needs to be told of them."""


def nominal_belief(job: Job, parameters: Parameters) -> Belief:
    """What is believed before any image is looked at: the nominal state with P = prior."""
    drift = job.sensor.noise.drift
    return Belief(
        state=parameters.nominal,
        covariance=torch.diag(parameters.prior_sigma.square()),
        drift_sigma=0.0 if drift is None else drift.sigma,
        drift_pixels=0.0 if drift is None else drift.pixels,
    )


def belief_after(refined: Refined, slow: Drift) -> Belief:
    """What is believed after a fit, with the slowly varying error (pixels of the images)."""
    told = reliability(refined)
    return Belief(
        state=refined.state,
        covariance=told.covariance,
        drift_sigma=slow.sigma,
        drift_pixels=slow.pixels if slow.sigma > 0 else 0.0,
        used_pixels=told.used_pixels,
        independent_pixels=told.independent_pixels,
    )


def estimate_of(
    sensor: Sensor,
    parameters: Parameters,
    belief: Belief,
    choice: Choice | None,
    comparisons: Sequence[FrameComparison],
) -> Estimate:
    """Puts a belief into words and figures; without a choice nothing was estimated."""
    jacobians = parameters.pose_jacobians(belief.state)
    rivals = choice.rivals if choice else ()
    offsets = parameters.joint_offsets(belief.state).tolist()
    objects = parameters.object_poses(belief.state)
    range_offset, range_scale = parameters.range_error(belief.state).tolist()
    if choice is None:
        status, message = _status_of_nominal(parameters, belief, comparisons)
    else:
        agreement = declared_agreement(sensor, belief, comparisons)
        status = _status(parameters, belief, choice, agreement, jacobians)
        message = _message(status, len(rivals), belief, agreement)
    return Estimate(
        status=status,
        message=message,
        names=parameters.names,
        covariance=belief.covariance,
        state=belief.state,
        T_world_base=belief.state[BASE],
        T_link_sensor=belief.state[MOUNT],
        Ts_world_sensor=parameters.sensor_poses(belief.state),
        pose_covariances=gaussian.moved_covariance(belief.covariance, jacobians),
        joint_offsets=dict(zip(parameters.joint_names, offsets, strict=True)),
        Ts_world_object=dict(zip(parameters.object_names, objects, strict=True)),
        range_offset=range_offset,
        range_scale=range_scale,
        moved=moved_objects(parameters, belief) if choice else (),
        sigma_scale=belief.sigma_scale,
        drift_sigma=belief.drift_sigma,
        drift_pixels=belief.drift_pixels,
        estimated=choice is not None,
        used_pixels=belief.used_pixels,
        independent_pixels=belief.independent_pixels,
        score=choice.score if choice else 0.0,
        unobservable=unobservable_directions(belief.covariance, parameters) if choice else (),
        alternatives=tuple(
            Alternative(Ts_world_sensor=parameters.sensor_poses(state), score=score)
            for state, score in rivals
        ),
    )


def moved_objects(parameters: Parameters, belief: Belief) -> tuple[str, ...]:
    """The unknown objects that are not where the model has them, by a chi-square test.

    It asks for the directions that the images tell: in others the prior is all that is known.
    """
    step = parameters.difference(belief.state, parameters.nominal)
    moved = []
    for name, rows in zip(parameters.object_names, parameters.object_jacobians, strict=True):
        own = rows.any(0)
        sigma = parameters.prior_sigma[own]
        left, direction = gaussian.left_over(belief.covariance[own][:, own], sigma)
        told = left <= LEFT  # none where the covariance is not finite
        if not told.any():
            continue
        off = (direction[:, told].mT @ (step[own] / sigma)) / left[told].clamp(min=SHARPEST)
        if chi2.sf(float(off.square().sum()), int(told.sum())) < CHANCE:
            moved.append(name)
    return tuple(moved)


def doubted(estimate: Estimate, mistakes: Sequence[str]) -> Estimate:
    """The estimate after a look for mistakes: an answer cannot be used if one was found.

    Args:
        estimate: What was found.
        mistakes: From ``misreadings``: sentences.
    """
    if not mistakes or estimate.status == Status.FAILED:
        return estimate
    message = f"A pose was found, but {mistakes[0][0].lower()}{mistakes[0][1:]}"
    return replace(estimate, status=Status.FAILED, message=message)


def _status(
    parameters: Parameters, belief: Belief, choice: Choice, agreement: float, jacobians: Tensor
) -> Status:
    if not belief.covariance.isfinite().all() or agreement < choice.least_agreement:
        return Status.FAILED
    if parameters.contradicts_prior(belief.state):
        return Status.FAILED
    poses = torch.cat([jacobians, parameters.object_jacobians])
    if not poses_are_told(belief.covariance, parameters, poses):
        return Status.UNOBSERVABLE
    return Status.AMBIGUOUS if choice.rivals else Status.CONVERGED


def declared_agreement(
    sensor: Sensor, belief: Belief, comparisons: Sequence[FrameComparison]
) -> float:
    """Share of the compared pixels, in the worst frame, that agree within the declared noise.

    What varies slowly adds to that. What P adds would excuse everything where nothing is told.
    """
    slow = belief.drift_sigma / belief.sigma_scale
    noise = [
        torch.hypot(sensor.noise.sigma(c.predicted), torch.full_like(c.predicted, slow))
        for c in comparisons
    ]
    return worst_agreement(comparisons, noise)


def agreement_with(comparisons: Sequence[FrameComparison], belief: Belief) -> float:
    """Share of the compared pixels that agree with a belief, in the worst frame.

    The comparison's own sigma' would not do: it is enlarged until it fits the residuals.
    """
    return worst_agreement(comparisons, [c.sigma / belief.sigma_scale for c in comparisons])


def worst_agreement(
    comparisons: Sequence[FrameComparison], sigmas: Sequence[Float[Tensor, "h w"]]
) -> float:
    """Share of the compared pixels that agree within so much (m), in the worst frame."""
    shares = []
    for c, sigma in zip(comparisons, sigmas, strict=True):
        d = ((c.measured - c.predicted) / sigma)[c.usable]
        d = d[d.isfinite()]
        if d.numel():
            shares.append(float((d.abs() <= robust.AGREEING).double().mean()))
    return min(shares, default=0.0)


def _status_of_nominal(
    parameters: Parameters, belief: Belief, comparisons: Sequence[FrameComparison]
) -> tuple[Status, str]:
    if agreement_with(comparisons, belief) < EXPLAINED:
        return Status.FAILED, "Nothing was estimated; the nominal pose does not explain the images."
    why = "Nothing was estimated" if parameters.names else "The job declares nothing unknown"
    return Status.CONVERGED, f"{why}: the images were compared at the nominal pose."


def _message(status: Status, rivals: int, belief: Belief, agreement: float) -> str:
    if belief.used_pixels == 0 and status != Status.CONVERGED:
        return NOTHING_TOLD
    images = "the images"
    if agreement < WELL_EXPLAINED:
        images = f"at least {int(100.0 * agreement)} % of what was measured in each image,"
    return {
        Status.CONVERGED: f"The model explains {images} and the estimated pose can be used"
        f"{worth_words(belief)}.",
        Status.AMBIGUOUS: f"{rivals_words(rivals, 'the images')}: do not use this one "
        "without knowing which is right.",
        Status.UNOBSERVABLE: "The images leave a pose open in some direction, and what is given "
        f"there comes from the prior{worth_words(belief)}.",
        Status.FAILED: "No pose near the nominal one explains all images.",
    }[status]


def worth_words(belief: Belief) -> str:
    """How many independent pixels the images were worth, as the end of a sentence."""
    used, independent = belief.used_pixels, belief.independent_pixels
    if independent <= 0.0:
        return ""
    if independent > OWN_ERRORS * used:
        return f"; the {used:,} pixels that were used err independently of each other"
    return (
        f"; neighbouring pixels err alike, so that the {used:,} that were used count as about "
        f"{float(f'{independent:.2g}'):,.0f} independent ones"
    )
