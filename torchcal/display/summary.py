"""The answer as rows that a person reads: corrections, how sure they are, settings of the job."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.observability import LEFT
from torchcal.calibrate.result import Calibration, NextView
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Job, PosePrior, RangePrior
from torchcal.model.sensor import Noise, Sensor
from torchcal.model.write_job import key

AXES = ("x", "y", "z", "rx", "ry", "rz")

MILLI = 1000.0

SHOWN_UNITS = {"m": (MILLI, "mm"), "rad": (math.degrees(1.0), "°"), "1": (100.0, "%")}
"""Factor and name of the unit that a person reads."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AxisCorrection:
    """One axis of a corrected pose, or one number; in ``unit``."""

    axis: str
    unit: str
    change: float
    sigma: float
    """0 where the axis was held."""
    prior: float
    """What the job thought possible, one standard deviation; 0 where the axis was held."""

    @property
    def from_prior(self) -> bool:
        """Whether the images said next to nothing about it."""
        return self.sigma > LEFT * self.prior

    @property
    def held(self) -> bool:
        """Whether the job took this axis for certain."""
        return self.prior == 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Correction:
    """A part of the model that was unknown: what was believed, what was found."""

    title: str
    axes: tuple[AxisCorrection, ...]
    notes: tuple[str, ...]


def axis_sigmas(
    names: tuple[str, ...], covariance: Float[Tensor, "parameter parameter"], group: str
) -> list[float]:
    """Standard deviations (m, m, m, rad, rad, rad) of a pose's block; 0 for held axes."""
    sigmas = covariance.diagonal().clamp(min=0.0).sqrt().tolist()
    known = dict(zip(names, sigmas, strict=True))
    return [known.get(f"{group}.{axis}", 0.0) for axis in AXES]


def corrections(calibration: Calibration) -> tuple[Correction, ...]:
    """What was corrected, in the order in which the job lists its unknowns."""
    job, estimate = calibration.job, calibration.estimate
    found = []
    if (prior := _base_prior(job)) is not None:
        title, nominal, estimated = _base_poses(calibration)
        sigmas = _base_sigmas(calibration)
        found.append(_correction(title, nominal, estimated, sigmas, prior))
    if job.joints:
        found.append(_joint_correction(calibration))
    if job.mount is not None:
        sigmas = axis_sigmas(estimate.names, estimate.covariance, "mount")
        poses = job.T_link_sensor, estimate.T_link_sensor
        title = f"Sensor on {job.link}" if job.link else "Sensor mount"
        found.append(_correction(title, *poses, sigmas, job.mount))
    nominal = {item.name: item.T_world_object for item in job.world.objects} if job.world else {}
    for name, prior in job.objects.items():
        sigmas = axis_sigmas(estimate.names, estimate.covariance, f"objects.{name}")
        poses = nominal[name], estimate.Ts_world_object[name]
        found.append(_correction(f"Object {name} in the world", *poses, sigmas, prior))
    if job.range is not None:
        found.append(_range_correction(calibration, job.range))
    return tuple(found)


def _joint_correction(calibration: Calibration) -> Correction:
    """The zero positions of all joints that were unknown."""
    job, offsets = calibration.job, calibration.estimate.joint_offsets
    assert job.robot is not None, "only robots have joints"
    rows = (
        _number(
            calibration, f"joints.{name}", name, job.robot.joint_unit(name), offsets[name], prior
        )
        for name, prior in job.joints.items()
    )
    notes = ("What must be added to the values that the joints report.",)
    return Correction(title="Zero positions of the joints", axes=tuple(rows), notes=notes)


def _range_correction(calibration: Calibration, prior: RangePrior) -> Correction:
    """The sensor's own error."""
    estimate = calibration.estimate
    rows = (
        _number(
            calibration, "range.offset", "offset", "m", estimate.range_offset, prior.offset_sigma
        ),
        _number(calibration, "range.scale", "scale", "1", estimate.range_scale, prior.scale_sigma),
    )
    notes = ("The sensor measures offset + (1 + scale) times the true range.",)
    return Correction(title="The sensor's range", axes=rows, notes=notes)


def _number(
    calibration: Calibration, name: str, axis: str, unit: str, value: float, prior: float
) -> AxisCorrection:
    """A row of one number."""
    estimate, (scale, shown) = calibration.estimate, SHOWN_UNITS[unit]
    variances = dict(zip(estimate.names, estimate.covariance.diagonal().tolist(), strict=True))
    sigma = max(variances.get(name, 0.0), 0.0) ** 0.5
    return AxisCorrection(
        axis=axis, unit=shown, change=scale * value, sigma=scale * sigma, prior=scale * prior
    )


def _base_prior(job: Job) -> PosePrior | None:
    """Of the base; of a hand-held sensor's first pose its own error and that of all frames."""
    priors = [each.sigma for each in (job.base, job.frame_poses) if each is not None]
    return PosePrior(sigma=torch.stack(priors).norm(dim=0)) if priors else None


def _base_poses(calibration: Calibration) -> tuple[str, Tensor, Tensor]:
    """Title, nominal and estimated pose of the base, or of the first frame's hand-held sensor."""
    job, estimate = calibration.job, calibration.estimate
    nominal = job.frames[0].T_world_sensor
    if job.robot is not None or nominal is None:
        return "Robot base in the world", job.T_world_base, estimate.T_world_base
    return "Sensor in the world (first frame)", nominal, estimate.Ts_world_sensor[0]


def _base_sigmas(calibration: Calibration) -> list[float]:
    """One standard deviation on each axis of the pose that ``unknown.base`` stands for."""
    estimate = calibration.estimate
    if calibration.job.robot is not None:
        return axis_sigmas(estimate.names, estimate.covariance, "base")
    return estimate.pose_covariances[0].diagonal().clamp(min=0.0).sqrt().tolist()


def _correction(
    title: str, nominal: Tensor, estimated: Tensor, sigmas: list[float], prior: PosePrior
) -> Correction:
    """The rows of one pose."""
    twist = se3.log(se3.inverse(nominal) @ estimated.to(nominal)).tolist()
    believed = prior.sigma.tolist()
    scales = [SHOWN_UNITS["m"]] * 3 + [SHOWN_UNITS["rad"]] * 3
    axes = tuple(
        AxisCorrection(
            axis=axis,
            unit=unit,
            change=scale * twist[i],
            sigma=scale * sigmas[i],
            prior=scale * believed[i],
        )
        for i, (axis, (scale, unit)) in enumerate(zip(AXES, scales, strict=True))
    )
    notes = (
        f"Nominal: {pose_words(nominal)}",
        f"Estimated: {pose_words(estimated)}",
        "Corrections are along and about the axes of the nominal pose.",
    )
    return Correction(title=title, axes=axes, notes=notes)


def pose_words(T: Float[Tensor, "4 4"]) -> str:
    """A pose as xyz in metres and roll, pitch, yaw in degrees."""
    xyz, rpy = se3.to_xyz_rpy(T)
    place = ", ".join(f"{value + 0.0:.4f}" for value in xyz.tolist())
    turn = ", ".join(f"{value + 0.0:.3f}" for value in torch.rad2deg(rpy).tolist())
    return f"xyz ({place}) m, roll pitch yaw ({turn})°"


def distance_words(one: Float[Tensor, "4 4"], other: Float[Tensor, "4 4"]) -> str:
    """How far one pose is from another, in mm and degrees."""
    twist = se3.log(se3.inverse(one) @ other.to(one))
    moved, turned = MILLI * float(twist[:3].norm()), math.degrees(float(twist[3:].norm()))
    return f"{moved:.1f} mm and {turned:.2f}° away"


def next_view_words(view: NextView | None) -> str:
    """Where to look next, as a job file has it (rad, m); empty where nobody knows."""
    if view is None:
        return ""
    joints = ", ".join(f"{key(name)} = {value:.3f}" for name, value in view.joints.items())
    return f"joints = {{ {joints} }}"


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
    rows["Prior of the base"] = _prior_words(job.base)
    rows["Prior of the mount"] = _prior_words(job.mount)
    if job.joints:
        rows["Unknown joints"] = ", ".join(job.joints)
    if job.objects:
        rows["Unknown objects"] = ", ".join(job.objects)
    if job.range is not None:
        rows["Prior of the sensor's range"] = (
            f"{MILLI * job.range.offset_sigma:g} mm, {100.0 * job.range.scale_sigma:g} %"
        )
    if job.frame_poses is not None:
        rows["Prior of each frame's pose"] = _prior_words(job.frame_poses)
    rows["Alpha"] = f"{job.alpha:g} standard deviations (eq. 5)"
    return rows


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
