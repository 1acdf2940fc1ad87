"""Checks that concern several tables of a job.

What needs a robot or must do without one, and which names exist.
"""

from pathlib import Path

from torchcal.errors import JobError
from torchcal.model.job import WORLD_LINK
from torchcal.model.job_mistakes import among
from torchcal.model.job_schema import JobTable, JointSigmas
from torchcal.model.robot import Robot
from torchcal.model.world import World

SIGMA_OF = {
    "revolute": ("sigma_deg", "degrees"),
    "continuous": ("sigma_deg", "degrees"),
    "prismatic": ("sigma", "metres"),
}
"""The key of ``unknown.joints`` that is for each kind of joint, and its unit."""


def check_tables(file: Path, table: JobTable) -> None:
    """Checks that each table and key is there where it is needed and nowhere else.

    Raises:
        JobError: At the first key that is missing or means nothing in this job.
    """
    if table.robot is None and table.world is None:
        raise JobError(file, "world", "neither [world] nor [robot]", "one of the two or both")
    if table.robot is None:
        _check_without_robot(file, table)
    else:
        _check_with_robot(file, table)


def _check_without_robot(file: Path, table: JobTable) -> None:
    present = {
        "sensor.link": table.sensor.link,
        "sensor.mount": table.sensor.mount,
        "unknown.mount": table.unknown.mount,
        "unknown.joints": table.unknown.joints,
    }
    present |= {f"frame[{i}].joints": frame.joints for i, frame in enumerate(table.frame, 1)}
    for key, value in present.items():
        if value is not None:
            expected = "no such key, or a [robot] that it belongs to"
            raise JobError(file, key, "a value although the job has no [robot]", expected)
    for i, frame in enumerate(table.frame, 1):
        if frame.pose is None and (table.search.initial == "nominal" or len(table.frame) > 1):
            expected = "the nominal pose of the sensor in the world, for the job has no [robot]"
            raise JobError(file, f"frame[{i}].pose", "nothing", expected)


def _check_with_robot(file: Path, table: JobTable) -> None:
    if table.sensor.link is None:
        expected = f'the URDF link that carries the sensor, or "{WORLD_LINK}" if it stands still'
        raise JobError(file, "sensor.link", "nothing", expected)
    for i, frame in enumerate(table.frame, 1):
        if frame.pose is not None:
            expected = "no pose: with a [robot] it follows from robot.base, joints and sensor.mount"
            raise JobError(file, f"frame[{i}].pose", "a pose", expected)
    if table.unknown.frames is not None:
        expected = "unknown.base, or no [robot]: only then each frame has a pose of its own"
        raise JobError(file, "unknown.frames", "a table although the job has a [robot]", expected)


def check_link(file: Path, link: str, robot: Robot) -> None:
    """Checks that the robot has the link that carries the sensor, or that the sensor stands still.

    Raises:
        JobError: If the robot has no such link.
    """
    names = (*robot.link_names, WORLD_LINK)
    if link not in names:
        raise JobError(file, "sensor.link", f'"{link}"', among(link, names))


def check_joint(file: Path, key: str, name: str, robot: Robot) -> None:
    """Checks that a joint of the robot can be set and estimated.

    Raises:
        JobError: If the robot has no such joint, or it follows another one.
    """
    if name in robot.mimics:
        expected = f'only "{robot.mimics[name]}", the joint that it follows'
        raise JobError(file, key, f'"{name}", a mimic joint', expected)
    if name not in robot.joint_names:
        found = f'"{name}", which the URDF does not have as a moving joint'
        raise JobError(file, key, found, among(name, tuple(robot.joint_names)))


def joint_kind(name: str, robot: Robot) -> str:
    """``revolute``, ``continuous`` or ``prismatic``."""
    return robot.joint_kinds[robot.joint_names.index(name)]


def check_unknowns(file: Path, table: JobTable, robot: Robot | None, world: World | None) -> None:
    """Checks the names in the ``[unknown.*]`` tables.

    Raises:
        JobError: If a joint or an object does not exist or is named twice, or a sigma is missing.
    """
    if table.unknown.joints is not None and robot is not None:
        _check_joint_sigmas(file, table.unknown.joints, robot)
    for name in table.unknown.object:
        _check_object(file, name, world)


def _check_joint_sigmas(file: Path, table: JointSigmas, robot: Robot) -> None:
    for i, name in enumerate(table.names or ()):
        check_joint(file, "unknown.joints.names", name, robot)
        if table.names and name in table.names[:i]:
            raise JobError(file, "unknown.joints.names", f'"{name}" twice', "each joint once")
    chosen = {name: joint_kind(name, robot) for name in table.names or robot.joint_names}
    for name, kind in chosen.items():
        key, unit = SIGMA_OF[kind]
        if getattr(table, key) is None:
            expected = f'a number in {unit} for the {kind} joint "{name}"'
            raise JobError(file, f"unknown.joints.{key}", "nothing", expected)
    needed = {SIGMA_OF[kind][0] for kind in chosen.values()}
    for key in ("sigma", "sigma_deg"):
        if getattr(table, key) is not None and chosen and key not in needed:
            kinds = " or ".join(kind for kind, (own, _) in SIGMA_OF.items() if own == key)
            found = f"a number although no unknown joint is {kinds}"
            raise JobError(file, f"unknown.joints.{key}", found, " and ".join(sorted(needed)))


def _check_object(file: Path, name: str, world: World | None) -> None:
    names = tuple(each.name for each in world.objects) if world else ()
    if name not in names:
        found = "an object that the world does not have"
        raise JobError(file, f"unknown.object.{name}", found, among(name, names))
