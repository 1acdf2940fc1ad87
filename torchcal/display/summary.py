"""The answer as rows that a person reads: corrections and how sure they are."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.observability import LEFT
from torchcal.calibrate.result import Calibration, NextView
from torchcal.geometry import se3
from torchcal.model.job import Job, PosePrior, RangePrior
from torchcal.model.write_job import key

AXES = ("x", "y", "z", "rx", "ry", "rz")

MILLI = 1000.0

SHOWN_UNITS = {"m": (MILLI, "mm"), "rad": (math.degrees(1.0), "°"), "1": (100.0, "%")}
"""Factor and name of the unit that a person reads."""


OWN_AXES = (
    "Shifts along and turns about its own axes in the nominal pose, "
    "not the axes in which both poses are given."
)
"""What a person must know to read the rows of a pose."""


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
    found: list[Correction] = []
    found += (
        _sensor_corrections(calibration) if job.robot is None else _base_corrections(calibration)
    )
    if job.joints:
        found.append(_joint_correction(calibration))
    if job.mount is not None:
        sigmas = axis_sigmas(estimate.names, estimate.covariance, "mount")
        poses = job.T_link_sensor, estimate.T_link_sensor
        title = f"Sensor on {job.link}" if job.link else "Sensor mount"
        found.append(_correction(title, *poses, sigmas, job.mount))
    objects = {item.name: item for item in job.world.objects} if job.world else {}
    for name, prior in job.objects.items():
        sigmas = axis_sigmas(estimate.names, estimate.covariance, f"objects.{name}")
        item = objects[name]
        at = centre_pose(item.mesh).to(item.T_world_object)
        before, now = item.T_world_object @ at, estimate.Ts_world_object[name].to(at) @ at
        found.append(
            _correction(f"Object {name} in the world (its centre)", before, now, sigmas, prior)
        )
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


def _base_corrections(calibration: Calibration) -> list[Correction]:
    """The robot's base, where it was unknown."""
    job, estimate = calibration.job, calibration.estimate
    if job.base is None:
        return []
    sigmas = axis_sigmas(estimate.names, estimate.covariance, "base")
    poses = job.T_world_base, estimate.T_world_base
    return [_correction("Robot base in the world", *poses, sigmas, job.base)]


def _sensor_corrections(calibration: Calibration) -> list[Correction]:
    """The poses of a hand-held sensor: all if each has its own error, else the first."""
    job, estimate = calibration.job, calibration.estimate
    priors = [each.sigma for each in (job.base, job.frame_poses) if each is not None]
    if not priors:
        return []
    prior = PosePrior(sigma=torch.stack(priors).norm(dim=0))
    shown = len(job.frames) if job.frame_poses is not None else 1
    found = []
    for frame, T, P in zip(
        job.frames[:shown], estimate.Ts_world_sensor, estimate.pose_covariances, strict=False
    ):
        assert frame.T_world_sensor is not None, "without a robot every frame has a pose"
        title = _sensor_title(job, frame.image.name)
        sigmas = P.diagonal().clamp(min=0.0).sqrt().tolist()
        found.append(_correction(title, frame.T_world_sensor, T, sigmas, prior))
    return found


def _sensor_title(job: Job, name: str) -> str:
    """Of the pose that a hand-held sensor had in a frame."""
    if len(job.frames) == 1:
        return "Sensor in the world"
    if job.frame_poses is not None:
        return f"Sensor in the world, frame {name}"
    return "Sensor in the world (first frame; the others move with it)"


def _correction(
    title: str, nominal: Tensor, estimated: Tensor, sigmas: list[float], prior: PosePrior
) -> Correction:
    """The rows of one pose: how far it is from where it was believed, and how far it is turned."""
    relative = se3.inverse(nominal) @ estimated.to(nominal)
    change = [*relative[:3, 3].tolist(), *se3.log(relative)[3:].tolist()]
    believed = prior.sigma.tolist()
    scales = [SHOWN_UNITS["m"]] * 3 + [SHOWN_UNITS["rad"]] * 3
    axes = tuple(
        AxisCorrection(
            axis=axis,
            unit=unit,
            change=scale * change[i],
            sigma=scale * sigmas[i],
            prior=scale * believed[i],
        )
        for i, (axis, (scale, unit)) in enumerate(zip(AXES, scales, strict=True))
    )
    notes = (
        f"Nominal: {pose_words(nominal)}",
        f"Estimated: {pose_words(estimated)}",
        OWN_AXES,
    )
    return Correction(title=title, axes=axes, notes=notes)


def centre_pose(mesh: trimesh.Trimesh) -> Float[Tensor, "4 4"]:
    """``T_object_centre`` of a mesh: where the sigmas of an object's pose are, too."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.from_numpy(mesh.bounds.mean(axis=0))
    return T


def pose_words(T: Float[Tensor, "4 4"]) -> str:
    """A pose as xyz in metres and roll, pitch, yaw in degrees."""
    xyz, rpy = se3.to_xyz_rpy(T)
    place = ", ".join(f"{value + 0.0:.4f}" for value in xyz.tolist())
    turn = ", ".join(f"{value + 0.0:.3f}" for value in torch.rad2deg(rpy).tolist())
    return f"xyz ({place}) m, roll pitch yaw ({turn})°"


def distance_words(one: Float[Tensor, "4 4"], other: Float[Tensor, "4 4"]) -> str:
    """How far one pose is from another, in mm and degrees."""
    relative = se3.inverse(one) @ other.to(one)
    moved = MILLI * float(relative[:3, 3].norm())
    turned = math.degrees(float(se3.log(relative)[3:].norm()))
    return f"{moved:.1f} mm and {turned:.2f}° away"


def decimals(sigma: float) -> int:
    """So many that a standard deviation shows two digits: what it is of deserves no more."""
    return min(9, max(0, 1 - math.floor(math.log10(sigma)))) if sigma > 0.0 else 3


def size_words(extents: Iterable[float]) -> str:
    """The sides of a box in metres, with two digits of the smallest down to a tenth of a mm."""
    sides = list(extents)
    digits = min(4, max(3, decimals(min(sides))))
    return " × ".join(f"{side:.{digits}f}" for side in sides) + " m"


def next_view_words(view: NextView | None) -> str:
    """Where to look next, as a job file has it (rad, m); empty where nobody knows."""
    if view is None:
        return ""
    joints = ", ".join(f"{key(name)} = {value:.3f}" for name, value in view.joints.items())
    return f"joints = {{ {joints} }}"
