"""Frames that come one by one from a sensor: what of them can be used."""

from dataclasses import replace

import torch

from torchcal.model.job import Frame, Job
from torchcal.model.range_image import RangeImage


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
    image, projection = frame.image, job.sensor.projection
    expected = projection.height, projection.width
    if tuple(image.range.shape) != expected:
        return f"Found an image of shape {tuple(image.range.shape)}; expected {expected}."
    if job.robot is not None:
        joints, count = frame.joints, len(job.robot.joint_names)
        if joints is None or tuple(joints.shape) != (count,) or not joints.isfinite().all():
            return f"Found joint values {joints}; expected {count} finite numbers."
    elif frame.T_world_sensor is not None and not frame.T_world_sensor.isfinite().all():
        return "Found a nominal pose that is not finite; expected finite numbers."
    inside = (image.range >= job.sensor.near) & (image.range <= job.sensor.far)
    if not (image.usable & inside).any():
        return "The image holds no measured pixel that may be used."
    ranges = torch.where(inside, image.range, torch.nan)
    return replace(frame, image=replace(image, range=ranges))
