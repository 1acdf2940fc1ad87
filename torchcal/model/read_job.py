"""Reading a job file: everything it names is read and checked, in metres and radians."""

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchcal.errors import JobError
from torchcal.model.check_job import check_link, check_tables, check_unknowns, joint_kind
from torchcal.model.job import Frame, Job, PosePrior, RangePrior
from torchcal.model.job_mistakes import checked
from torchcal.model.job_schema import (
    JobTable,
    JointSigmas,
    PoseSigmas,
    PoseTable,
    RangeSigmas,
    WorldTable,
)
from torchcal.model.read_frames import FrameFile, existing_file, find_frames, pose
from torchcal.model.read_sensor import read_sensor, with_preset
from torchcal.model.regular_file import refuse_irregular
from torchcal.model.robot import Robot, load_robot
from torchcal.model.world import World, load_world


def read_job(
    file: Path | str,
    *,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Job:
    """Reads a job file and everything that it names.

    Args:
        file: The TOML file; the paths in it are relative to it.
        dtype: The type of all poses, joint values and images.
        device: Where they lie.

    Returns:
        The job in metres and radians.

    Raises:
        JobError: At the first mistake: the file or one that it names cannot be read, a key is
            unknown, missing, of the wrong type or out of its limits, or a name does not exist.
    """
    recording = read_recording(file, dtype=dtype, device=device)
    frames = tuple(recording.frame(k) for k in range(len(recording.files)))
    return replace(recording.job, frames=frames)


@dataclass(frozen=True, kw_only=True, slots=True)
class Recording:
    """A job whose images are read one by one, when they are asked for."""

    job: Job
    """Without frames."""
    files: tuple[FrameFile, ...]
    dtype: torch.dtype
    device: torch.device

    def frame(self, index: int) -> Frame:
        """Reads one frame.

        Raises:
            JobError: If its image or mask cannot be used.
        """
        return _frame_to(self.files[index].read(), self.dtype, self.device)

    def blank(self, index: int) -> Frame:
        """One frame before its image is taken."""
        return _frame_to(self.files[index].blank(), self.dtype, self.device)

    def planned(self) -> Job:
        """The job before its images are taken: they are blank and need not be there."""
        frames = tuple(self.blank(k) for k in range(len(self.files)))
        return replace(self.job, frames=frames)


def read_recording(
    file: Path | str, *, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
) -> Recording:
    """Reads a job file and everything that it names but the images; as ``read_job``.

    Raises:
        JobError: As ``read_job``.
    """
    file = Path(file)
    table = _read_tables(file)
    check_tables(file, table)
    sensor = read_sensor(file, table.sensor)
    robot = _read_robot(file, table)
    world = _read_world(file, table.world, dtype, device) if table.world else None
    check_unknowns(file, table, robot, world)
    base = table.robot.base if table.robot else PoseTable()
    job = Job(
        file=file,
        world=world,
        robot=robot,
        sensor=sensor,
        link=table.sensor.link,
        T_world_base=pose(base).to(device, dtype),
        T_link_sensor=pose(table.sensor.mount or PoseTable()).to(device, dtype),
        frames=(),
        base=_prior(table.unknown.base, dtype, device),
        mount=_prior(table.unknown.mount, dtype, device),
        joints=_joint_sigmas(table.unknown.joints, robot),
        objects={
            name: prior
            for name, sigmas in table.unknown.object.items()
            if (prior := _prior(sigmas, dtype, device)) is not None
        },
        range=_range_prior(table.unknown.range),
        frame_poses=_prior(table.unknown.frames, dtype, device),
        initial=table.search.initial,
        alpha=table.search.alpha,
    )
    files = find_frames(file, table.frame, sensor, robot)
    return Recording(job=job, files=files, dtype=dtype, device=torch.device(device))


def _read_tables(file: Path) -> JobTable:
    refuse_irregular(file)
    try:
        raw = tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        found = "a folder" if file.is_dir() else f"no readable file ({error.strerror})"
        raise JobError(file, "", found, "a TOML file that describes a job") from error
    except UnicodeDecodeError as error:
        raise JobError(file, "", f"bytes that are not UTF-8 ({error})", "a TOML file") from error
    except RecursionError as error:
        raise JobError(file, "", "tables or lists nested too deeply", "a TOML file") from error
    except ValueError as error:
        raise JobError(file, "", f"text that is not TOML: {error}", "a TOML file") from error
    return checked(file, _with_preset(raw))


def _with_preset(raw: dict[str, Any]) -> dict[str, Any]:
    sensor = raw.get("sensor")
    return {**raw, "sensor": with_preset(sensor)} if isinstance(sensor, dict) else raw


def _read_robot(file: Path, table: JobTable) -> Robot | None:
    if table.robot is None or table.sensor.link is None:
        return None
    robot = load_robot(existing_file(file, "robot.urdf", table.robot.urdf))
    check_link(file, table.sensor.link, robot)
    return robot


def _read_world(
    file: Path, table: WorldTable, dtype: torch.dtype, device: torch.device | str
) -> World:
    return load_world(
        existing_file(file, "world.model", table.model),
        unit=table.unit,
        T_world_file=pose(table.pose).to(device, dtype),
        complete=table.complete,
    )


def _prior(
    table: PoseSigmas | None, dtype: torch.dtype, device: torch.device | str
) -> PosePrior | None:
    if table is None:
        return None
    position = torch.tensor(table.position_sigma, dtype=dtype, device=device)
    rotation = torch.tensor(table.rotation_sigma_deg, dtype=dtype, device=device).deg2rad()
    return PosePrior(sigma=torch.cat([position, rotation]))


def _joint_sigmas(table: JointSigmas | None, robot: Robot | None) -> dict[str, float]:
    if table is None or robot is None:
        return {}
    turning, sliding = math.radians(table.sigma_deg or 0.0), table.sigma or 0.0
    return {
        name: sliding if joint_kind(name, robot) == "prismatic" else turning
        for name in table.names or robot.joint_names
    }


def _range_prior(table: RangeSigmas | None) -> RangePrior | None:
    if table is None:
        return None
    return RangePrior(offset_sigma=table.offset_sigma, scale_sigma=table.scale_sigma)


def _frame_to(frame: Frame, dtype: torch.dtype, device: torch.device | str) -> Frame:
    def moved(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else tensor.to(device, dtype)

    image = replace(
        frame.image,
        range=frame.image.range.to(device, dtype),
        usable=frame.image.usable.to(device),
    )
    return Frame(
        image=image,
        joints=moved(frame.joints),
        T_world_sensor=moved(frame.T_world_sensor),
    )
