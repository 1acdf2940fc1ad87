"""What looks wrong in a job that could be read, before any image is compared with the model."""

import torch
import trimesh

from torchcal.calibrate.repeats import is_same_place, repeats, same_images
from torchcal.geometry import se3
from torchcal.model.job import Job
from torchcal.model.robot import Robot
from torchcal.model.world import World

FAR_APART = 300.0
"""So many times the sensor's reach is more than any place to calibrate in."""
NAMED = 4
"""Frames with the same image that are named; of more, only the number is."""
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
    """Frames with the same image."""
    again = set(repeats(job))
    return tuple(_repeated_words(job, group, again) for group in same_images(job))


def _repeated_words(job: Job, group: tuple[int, ...], again: set[int]) -> str:
    names = [job.frames[k].image.name for k in group]
    told = ", ".join(names[:NAMED]) if len(names) > NAMED + 1 else ", ".join(names[:-1])
    last = f"{len(names) - NAMED} others" if len(names) > NAMED + 1 else names[-1]
    same = f"The images of the frames {told} and {last} are the same, pixel by pixel"
    first = job.frames[group[0]]
    if not all(is_same_place(first, job.frames[k]) for k in group):
        return f"{same}, and not the places where they were taken: were they mixed up?"
    if again.issuperset(group[1:]):
        return f"{same}: only the first of them counts."
    return f"{same}, and each counts: sigmas of what they share are too small by that."
