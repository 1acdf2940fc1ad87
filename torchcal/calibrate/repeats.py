"""Frames of a recording with the same image: one measurement, however often it is there."""

import hashlib

import torch

from torchcal.model.job import Frame, Job


def same_images(job: Job) -> tuple[tuple[int, ...], ...]:
    """Groups of frames whose images are the same, pixel by pixel."""
    groups: dict[str, list[int]] = {}
    for index, frame in enumerate(job.frames):
        groups.setdefault(_digest(frame), []).append(index)
    return tuple(tuple(group) for group in groups.values() if len(group) > 1)


def repeats(job: Job) -> tuple[int, ...]:
    """Frames that say what an earlier one says: the same image, taken from the same place.

    There are none where the pose of every frame is its own unknown: its image tells it.
    """
    if job.frame_poses is not None:
        return ()
    return tuple(
        later
        for group in same_images(job)
        for place, later in enumerate(group)
        if any(is_same_place(job.frames[k], job.frames[later]) for k in group[:place])
    )


def is_same_place(one: Frame, other: Frame) -> bool:
    """Whether two frames were taken at the same joints, and from the same nominal pose."""
    pairs = ((one.joints, other.joints), (one.T_world_sensor, other.T_world_sensor))
    return all(a is b or (a is not None and b is not None and torch.equal(a, b)) for a, b in pairs)


def _digest(frame: Frame) -> str:
    """The same of two images if all their pixels are."""
    ranges, usable = frame.image.range, frame.image.usable
    digest = hashlib.blake2b(repr((ranges.dtype, tuple(ranges.shape))).encode())
    for pixels in (ranges.nan_to_num(), usable):
        digest.update(pixels.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
