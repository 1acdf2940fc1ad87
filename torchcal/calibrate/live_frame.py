"""Frames that come one by one from a sensor: what of them can be used."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.model.job import Frame, Job
from torchcal.model.range_image import RangeImage

LOOSE = 1e-3
"""Nominal poses may be rounded by so much and still be rigid motions."""


def only_frame(job: Job) -> Job:
    """The job with one frame without an image, at its first nominal pose and joint values of 0."""
    given = job.frames[0].T_world_sensor if job.frames else None
    shape = job.sensor.projection.height, job.sensor.projection.width
    count, device = len(job.robot.joint_names) if job.robot else 0, job.T_world_base.device
    blank = torch.full(shape, torch.nan, device=device)
    usable = torch.zeros(shape, dtype=torch.bool, device=device)
    joints = torch.zeros(count, dtype=torch.float64, device=device)
    frame = Frame(
        image=RangeImage(name="", file="", range=blank, usable=usable),
        joints=None if job.robot is None else joints,
        T_world_sensor=job.T_world_base if given is None and job.robot is None else given,
    )
    return replace(job, frames=(frame,))


def usable_frame(frame: Frame, job: Job) -> Frame | str:
    """The frame without what its sensor cannot have measured, or a sentence that says why not."""
    frame = _detached(frame)
    image, projection = frame.image, job.sensor.projection
    expected = projection.height, projection.width
    if tuple(image.range.shape) != expected:
        return f"Found an image of shape {tuple(image.range.shape)}; expected {expected}."
    if job.robot is not None:
        joints, count = frame.joints, len(job.robot.joint_names)
        if joints is None or tuple(joints.shape) != (count,) or not joints.isfinite().all():
            return f"Found joint values {joints}; expected {count} finite numbers."
    elif frame.T_world_sensor is not None and not _is_rigid(frame.T_world_sensor):
        return (
            f"Found a nominal pose {frame.T_world_sensor.tolist()}; expected a rigid motion, a "
            "rotation and a shift."
        )
    inside = (image.range >= job.sensor.near) & (image.range <= job.sensor.far)
    if not (image.usable & inside).any():
        return "The image holds no measured pixel that may be used."
    ranges = torch.where(inside, image.range, torch.nan)
    return replace(frame, image=replace(image, range=ranges))


def is_repeated(frame: Frame, before: Frame) -> bool:
    """Whether two frames are the same in every pixel, for the noise of a new image is its own.

    The same image with other joints or from another place is none: it contradicts one of the two.
    """
    pairs = (
        (frame.image.range.nan_to_num(0.0), before.image.range.nan_to_num(0.0)),
        (frame.image.usable, before.image.usable),
        (frame.joints, before.joints),
        (frame.T_world_sensor, before.T_world_sensor),
    )
    return all(
        a is b if a is None or b is None else torch.equal(a, b)  # None: of no robot, of no odometry
        for a, b in pairs
    )


def _detached(frame: Frame) -> Frame:
    """The frame outside of its caller's derivatives."""
    pose, joints = frame.T_world_sensor, frame.joints
    return replace(
        frame,
        image=replace(frame.image, range=frame.image.range.detach()),
        joints=None if joints is None else joints.detach(),
        T_world_sensor=None if pose is None else pose.detach(),
    )


def _is_rigid(T: Float[Tensor, "4 4"]) -> bool:
    R, last = T[:3, :3], T.new_tensor([0.0, 0.0, 0.0, 1.0])
    if not T.isfinite().all() or torch.linalg.det(R) <= 0.0:
        return False
    stretched = (R @ R.mT - torch.eye(3).to(R)).abs().max()
    return bool(torch.maximum(stretched, (T[3] - last).abs().max()) < LOOSE)
