"""What can be said of a job before anything is estimated."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.anywhere import without_prior
from torchcal.calibrate.check_result import (
    Foresight,
    FrameCheck,
    JobCheck,
    ParameterCheck,
)
from torchcal.calibrate.foresight import expected_covariance, foreseen_covariance, next_view
from torchcal.calibrate.observability import unobservable_directions
from torchcal.calibrate.observation import coarse_factor, coarser, observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene, predict
from torchcal.calibrate.readings import misreadings
from torchcal.calibrate.suspicion import suspicions
from torchcal.model.job import Frame, Job, check_frames
from torchcal.model.precision import job_in_double

FEW = 0.05
"""A smaller share of measured pixels, or of the model in them, is worth a warning."""
UNITS = 3.0
"""Ranges that differ from the model's by more than this factor look like a wrong unit."""


def check(job: Job) -> JobCheck:
    """What a job holds and what its images can tell of the unknowns, at the nominal pose.

    Raises:
        TorchcalError: As ``calibrate``.
    """
    check_frames(job)
    job = without_prior(job_in_double(job))
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    predictions = predict(job)
    frames = tuple(
        _check_frame(frame, prediction)
        for frame, prediction in zip(job.frames, predictions, strict=True)
    )
    images = coarser(observe(job), coarse_factor(job.sensor))
    P = expected_covariance(images, scene, parameters, parameters.nominal)
    return JobCheck(
        frames=frames,
        parameters=_parameter_checks(parameters, P),
        unobservable=unobservable_directions(P, parameters),
        warnings=(
            *(() if parameters.names else ("The job declares nothing unknown.",)),
            *suspicions(job),
            *misreadings(job, scene, parameters, parameters.nominal),
        ),
    )


def foresee(job: Job, *, generator: torch.Generator) -> Foresight:
    """What images like the job's will tell, at the nominal state; they need not be there yet.

    Args:
        job: Its images are not looked at.
        generator: Draws configurations for the next view; on the CPU.
    """
    job = without_prior(job_in_double(job))
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    P = foreseen_covariance(job, scene, parameters, parameters.nominal)
    return Foresight(
        parameters=_parameter_checks(parameters, P),
        unobservable=unobservable_directions(P, parameters),
        next_view=next_view(job, scene, parameters.nominal, P, generator),
    )


def _parameter_checks(
    parameters: Parameters, P: Float[Tensor, "parameter parameter"]
) -> tuple[ParameterCheck, ...]:
    """What is believed of every parameter before, and what P leaves of it."""
    return tuple(
        ParameterCheck(name=name, unit=unit, prior_sigma=prior, expected_sigma=expected)
        for name, unit, prior, expected in zip(
            parameters.names,
            parameters.units,
            parameters.prior_sigma.tolist(),
            P.diagonal().sqrt().tolist(),
            strict=True,
        )
    )


def _check_frame(frame: Frame, prediction: Float[Tensor, "h w"]) -> FrameCheck:
    ranges = frame.image.range
    measured, modelled = ranges.isfinite(), prediction.isfinite()
    usable = measured & frame.image.usable
    both = usable & modelled
    median, predicted = (_median(x) for x in (ranges[usable], prediction[both]))
    shares = tuple(float(x.double().mean()) for x in (measured, usable))
    model_share = float(both.sum()) / max(int(usable.sum()), 1)
    return FrameCheck(
        name=frame.image.name,
        measured_fraction=shares[0],
        usable_fraction=shares[1],
        model_fraction=model_share,
        median_range_m=median,
        predicted_median_range_m=predicted,
        warnings=tuple(_warnings(shares[1], model_share, median / predicted)),
    )


def _median(values: Tensor) -> float:
    return float(values.median()) if values.numel() else float("nan")


def _warnings(usable_share: float, model_share: float, ratio: float) -> list[str]:
    warnings = []
    if usable_share < FEW:
        warnings.append(f"only {usable_share:.1%} of the pixels were measured and may be used")
    if model_share < FEW:
        warnings.append(
            f"the model fills only {model_share:.1%} of the measured pixels at the nominal pose"
        )
    if ratio > UNITS or ratio < 1.0 / UNITS:
        warnings.append(
            f"the measured ranges are {ratio:.3g} times the model's: check depth_unit and unit"
        )
    return warnings
