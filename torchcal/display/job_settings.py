"""What a job says, as rows that a person reads."""

import torch
from torch import Tensor

from torchcal.calibrate.parameters import parameter_unit
from torchcal.display.summary import MILLI, SHOWN_UNITS
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Job, PosePrior
from torchcal.model.sensor import Noise, Sensor


def settings(job: Job) -> dict[str, str]:
    """What the job says, in words with units."""
    rows = {
        "Job file": job.file.name,
        "Frames": str(len(job.frames)),
        "World": f"{len(job.world.objects)} objects" if job.world else "none: only the robot",
        "Robot": job.robot.name if job.robot else "none: hand-held sensor",
    }
    if job.link is not None:
        rows["Sensor on"] = job.link
    rows |= _sensor_settings(job.sensor)
    if job.robot is None:
        rows["Prior of the sensor's pose"] = _prior_words(job.base)
    else:
        rows["Prior of the base"] = _prior_words(job.base)
        rows["Prior of the mount"] = _prior_words(job.mount)
    if job.joints:
        rows["Priors of the joints"] = _joint_priors(job)
    for name, prior in job.objects.items():
        rows[f"Prior of the object {name}"] = _prior_words(prior)
    if job.range is not None:
        rows["Prior of the sensor's range"] = (
            f"{MILLI * job.range.offset_sigma:g} mm, {100.0 * job.range.scale_sigma:g} %"
        )
    if job.frame_poses is not None:
        rows["Prior of each frame's own error"] = _prior_words(job.frame_poses)
    rows["Search starts"] = "at the nominal pose" if job.initial == "nominal" else "anywhere"
    rows["Alpha"] = f"{job.alpha:g} standard deviations (eq. 5)"
    return rows


def _joint_priors(job: Job) -> str:
    """One standard deviation of every joint's zero position."""
    words = []
    for name, sigma in job.joints.items():
        scale, unit = SHOWN_UNITS[parameter_unit(f"joints.{name}", job)]
        words.append(f"{name} {scale * sigma:.4g}{'' if unit == '°' else ' '}{unit}")
    return ", ".join(words)


def _sensor_settings(sensor: Sensor) -> dict[str, str]:
    """The sensor's part of the settings."""
    lens = sensor.projection
    kind = "pinhole, depth along z" if isinstance(lens, Pinhole) else "spherical, distance"
    return {
        "Sensor": f"{kind}, {lens.width} × {lens.height} pixels",
        "Limits": f"{sensor.near:g} to {sensor.far:g} m",
        "Noise of a pixel": _noise_words(sensor.noise),
        "Beam": f"{sensor.beam} × {sensor.beam} pixels" if sensor.beam else "an ideal ray",
    }


def _noise_words(noise: Noise) -> str:
    """Standard deviation of a pixel as the job gives it."""
    words = f"{MILLI * noise.a:g} mm"
    if noise.b or noise.c:
        words = f"{noise.a:g} + {noise.b:g} z + {noise.c:g} z² (m)"
    if noise.drift is None:
        return f"{words}; slow drift estimated"
    if noise.drift.sigma == 0.0:
        return f"{words}; no slow drift"
    drift = noise.drift
    return f"{words}; slow drift {MILLI * drift.sigma:g} mm over {drift.pixels:g} pixels"


def _prior_words(prior: PosePrior | None) -> str:
    """One standard deviation of a prior; one number where its axes are alike."""
    if prior is None:
        return "known exactly"
    metres, radians = prior.sigma[:3], prior.sigma[3:]
    return f"{_numbers(MILLI * metres)} mm, {_numbers(torch.rad2deg(radians))}°"


def _numbers(values: Tensor) -> str:
    """The values, once if all are the same."""
    words = [f"{value:.4g}" for value in values.tolist()]
    return words[0] if len(set(words)) == 1 else ", ".join(words)
