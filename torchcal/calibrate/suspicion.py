"""What looks wrong in a job that could be read, before any image is compared with the model."""

import itertools

import torch
import trimesh

from torchcal.geometry import se3
from torchcal.model.job import Job
from torchcal.model.robot import Robot
from torchcal.model.world import World

FAR_APART = 300.0
"""So many times the sensor's reach is more than any place to calibrate in."""
BEYOND = 1e-6
"""rad or m: what rounding may add to a limit."""


def suspicions(job: Job) -> tuple[str, ...]:
    """Warnings about units, joints and images that repeat."""
    repeated = _repeated(job)
    still = () if repeated else _still_joints(job)
    return (*_sizes(job), *_limits(job), *still, *repeated)


def _sizes(job: Job) -> tuple[str, ...]:
    """A model in millimetres, or in kilometres, given as metres."""
    if job.world is None:
        return ()
    size, reach = _extent(job.world), job.sensor.far
    if size > FAR_APART * reach:
        hint = "is world.unit = 0.001?"
    elif size < job.sensor.near / FAR_APART:
        hint = "is world.unit = 1000?"
    else:
        return ()
    return (f"The world is {size:.3g} m wide and the sensor sees {reach:g} m far: {hint}",)


def _extent(world: World) -> float:
    """The longest side (m) of the box around all objects."""
    corners = [
        se3.transform(
            item.T_world_object,
            torch.from_numpy(trimesh.bounds.corners(item.mesh.bounds)).to(item.T_world_object),
        )
        for item in world.objects
    ]
    points = torch.cat(corners)
    return float((points.amax(0) - points.amin(0)).max())


def _limits(job: Job) -> tuple[str, ...]:
    """Joints beyond the URDF's limits: values in degrees, or of another robot."""
    if job.robot is None:
        return ()
    found = []
    for index, name in enumerate(job.robot.joint_names):
        low, high = job.robot.joint_limits[index].tolist()
        values = [float(f.joints[index]) for f in job.frames if f.joints is not None]
        worst = max(values, key=lambda value: max(low - value, value - high), default=low)
        if not low - BEYOND <= worst <= high + BEYOND:
            unit = _unit(job.robot, index)
            found.append(
                f"The joint {name} stands at {worst:g} {unit}, beyond its limits of {low:g} and "
                f"{high:g} {unit}: is it in another unit?"
            )
    return tuple(found)


def _unit(robot: Robot, index: int) -> str:
    return "m" if robot.joint_kinds[index] == "prismatic" else "rad"


def _still_joints(job: Job) -> tuple[str, ...]:
    """Joints that never move in a recording of several images."""
    joints = [frame.joints for frame in job.frames if frame.joints is not None]
    if len(joints) < 2 or joints[0].numel() == 0:
        return ()
    if any(not torch.equal(each, joints[0]) for each in joints):
        return ()
    return (f"The joints are the same in all {len(joints)} frames: were they recorded?",)


def _repeated(job: Job) -> tuple[str, ...]:
    """Frames whose image is that of the frame before."""
    images = [frame.image for frame in job.frames]
    return tuple(
        f"The images of the frames {one.name} and {other.name} are the same, pixel by pixel."
        for one, other in itertools.pairwise(images)
        if one.range.shape == other.range.shape
        and torch.equal(one.range.nan_to_num(), other.range.nan_to_num())
    )
