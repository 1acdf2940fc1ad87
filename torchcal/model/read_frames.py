"""From a job's ``[[frame]]`` tables to frames: images, masks, joint values and poses."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.errors import JobError
from torchcal.geometry import se3
from torchcal.model.check_job import check_joint, joint_kind
from torchcal.model.job import Frame
from torchcal.model.job_schema import FrameTable, PoseTable
from torchcal.model.range_image import RangeImage, read_mask, read_range
from torchcal.model.regular_file import irregular
from torchcal.model.robot import Robot
from torchcal.model.sensor import Sensor

_MOST_TURNS = 2.0
"""A revolute joint beyond this many turns was given in degrees."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameFile:
    """A frame whose image is still in its file."""

    file: Path
    """The job's."""
    key: str
    """Of its table in the job file."""
    name: str
    table: FrameTable
    sensor: Sensor
    joints: Float[Tensor, " joint"] | None
    T_world_sensor: Float[Tensor, "4 4"] | None

    def read(self) -> Frame:
        """Reads the image, in float64 on the CPU.

        Raises:
            JobError: If image or mask cannot be used.
        """
        image = _read_image(self.file, self.key, self.name, self.table, self.sensor)
        return Frame(image=image, joints=self.joints, T_world_sensor=self.T_world_sensor)

    def blank(self) -> Frame:
        """The frame before its image is taken."""
        image = RangeImage.blank(self.name, self.table.depth, self.sensor)
        return Frame(image=image, joints=self.joints, T_world_sensor=self.T_world_sensor)


def find_frames(
    file: Path, tables: list[FrameTable], sensor: Sensor, robot: Robot | None
) -> tuple[FrameFile, ...]:
    """The frames of a job without their images, in float64 on the CPU.

    Args:
        file: The job's.
        tables: As the job has them.
        sensor: What takes the images.
        robot: What carries it, if any.

    Raises:
        JobError: If a joint does not exist or its value is in degrees.
    """
    names = _unique([Path(table.depth).stem for table in tables])
    return tuple(
        FrameFile(
            file=file,
            key=f"frame[{i}]",
            name=name,
            table=table,
            sensor=sensor,
            joints=_joint_values(file, f"frame[{i}]", table.joints or {}, robot) if robot else None,
            T_world_sensor=None if robot else pose(table.pose or PoseTable()),
        )
        for i, (name, table) in enumerate(zip(names, tables, strict=True), 1)
    )


def pose(table: PoseTable) -> Float[Tensor, "4 4"]:
    """The 4x4 matrix of a pose table (m)."""
    xyz = torch.tensor(table.xyz, dtype=torch.float64)
    return se3.from_xyz_rpy(xyz, torch.tensor(table.rpy_deg, dtype=torch.float64).deg2rad())


def existing_file(file: Path, key: str, named: str) -> Path:
    """The path of a file that a job names.

    Raises:
        JobError: If there is no such file, or it is a pipe or a device.
    """
    path = file.parent / named
    # Unlike the methods of Path these do not raise on a name that no file can have.
    if os.path.isfile(path):
        return path
    if odd := irregular(path):
        raise JobError(file, key, f'"{named}", {odd}', "a regular file")
    folder = os.path.isdir(path)
    siblings = os.listdir(path.parent) if os.path.isdir(path.parent) and not folder else []
    close = get_close_matches(path.name, siblings, n=1)
    hint = f'; did you mean "{close[0]}"?' if close else ""
    what = "a folder" if folder else "a file that does not exist"
    raise JobError(file, key, f'"{named}", {what}', f"a file at {path}{hint}")


@contextmanager
def _blamed_on(file: Path, key: str) -> Iterator[None]:
    """Mistakes of a file become mistakes of the key that names it."""
    try:
        yield
    except JobError as error:
        found = f'"{error.file.name}" with {error.found}'
        raise JobError(file, key, found, error.expected) from error


def _read_image(file: Path, key: str, name: str, table: FrameTable, sensor: Sensor) -> RangeImage:
    path = existing_file(file, f"{key}.depth", table.depth)
    with _blamed_on(file, f"{key}.depth"):
        ranges = read_range(path, sensor)
    usable = torch.ones_like(ranges, dtype=torch.bool)
    if table.mask is not None:
        usable = _read_usable(file, f"{key}.mask", table.mask, sensor)
        if not (usable & ranges.isfinite()).any():
            found = f'"{table.mask}", in which no usable pixel was measured'
            raise JobError(file, f"{key}.mask", found, f'some measured pixels of "{table.depth}"')
    return RangeImage(name=name, file=table.depth, range=ranges, usable=usable)


def _read_usable(file: Path, key: str, named: str, sensor: Sensor) -> Tensor:
    path = existing_file(file, key, named)
    with _blamed_on(file, key):
        return read_mask(path, sensor)


def _joint_values(
    file: Path, key: str, values: dict[str, float], robot: Robot
) -> Float[Tensor, " joint"]:
    for name, value in values.items():
        check_joint(file, f"{key}.joints.{name}", name, robot)
        if joint_kind(name, robot) == "revolute" and abs(value) > _MOST_TURNS * 2 * math.pi:
            expected = f"radians; as degrees it would be {math.radians(value):.6g} rad"
            raise JobError(file, f"{key}.joints.{name}", f"{value:g}", expected)
    ordered = [values.get(name, 0.0) for name in robot.joint_names]
    return torch.tensor(ordered, dtype=torch.float64)


def _unique(names: list[str]) -> list[str]:
    """The names, numbered where they repeat: what is written for each frame bears its name."""
    taken: list[str] = []
    for name in names:
        candidates = (name if i == 1 else f"{name}-{i}" for i in range(1, len(names) + 2))
        taken.append(next(each for each in candidates if each not in taken))
    return taken
