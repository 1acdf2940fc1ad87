"""Making the folder of a job out of a recording."""

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from torchcal.errors import JobError
from torchcal.model.recordings.bag import bag_files
from torchcal.model.recordings.bag_recording import read_bag
from torchcal.model.recordings.cloud_files import cloud_paths, read_clouds
from torchcal.model.recordings.depth_folder import depth_images, read_depth_folder
from torchcal.model.recordings.job_files import write_files
from torchcal.model.recordings.job_tables import job_tables, remarks_of, with_tables_of
from torchcal.model.recordings.recorded import Recorded, Selection
from torchcal.model.regular_file import refuse_irregular
from torchcal.model.write_job import write_job

JOB = "job.toml"
_NO_PACKAGES: Mapping[str, Path] = MappingProxyType({})
_NO_WORLD = {"world": '[world] model = "cell.glb": the CAD model of the surroundings'}


@dataclass(frozen=True, kw_only=True, slots=True)
class Imported:
    """A job that was made of a recording."""

    job: Path
    """The job file."""
    frames: int
    notes: tuple[str, ...]
    """How the recording was read; what begins with WARNING wants a look."""
    to_fill_in: Mapping[str, str]
    """Keys of the job that a person has to fill in, each with what belongs there."""


def import_recording(
    source: Path | str,
    folder: Path | str,
    *,
    selection: Selection | None = None,
    packages: Mapping[str, Path] = _NO_PACKAGES,
    world: Path | None = None,
    like: Path | None = None,
) -> Imported:
    """Writes a job with everything that a recording knows: images, joints or poses, and the robot.

    Args:
        source: A bag of ROS 1 or ROS 2, an MCAP file, a folder of depth images with Open3D's
            intrinsics and a trajectory, or PLY or PCD clouds.
        folder: Must be there; files of the same names are replaced.
        selection: What to take of it, where there is a choice.
        packages: Where the packages are that ``package://`` means in the URDF, by name.
        world: The CAD model of the surroundings.
        like: A job of the same cell: what the recording cannot know is taken over from it.

    Raises:
        TorchcalError: If a library that reads the recording is not installed.
        JobError: If the recording cannot be read, or lacks something that only a person knows.
    """
    source, folder, selection = Path(source), Path(folder), selection or Selection()
    other = _tables(like)
    model = world or _named_in(like, other, "world", "model")
    recorded = _read(source, _with_spares(selection, like, other))
    written = write_files(source, recorded, folder, packages, model)
    to_fill_in = {**recorded.to_fill_in, **({} if model else _NO_WORLD)}
    remarks = remarks_of(to_fill_in, other)
    missing = {key: words for key, words in to_fill_in.items() if key in remarks}
    tables = with_tables_of(job_tables(recorded, written), other)
    notes = recorded.notes
    blank = written.images.count(None)
    if blank:
        notes = (*notes, f"WARNING: {blank} images hold no measurement and were left out")
    heading = _heading(source, notes, missing)
    write_job(folder / JOB, tables, heading=heading, remarks=remarks)
    return Imported(
        job=folder / JOB,
        frames=len(recorded.frames) - blank,
        notes=notes,
        to_fill_in=missing,
    )


def _with_spares(selection: Selection, like: Path | None, other: Mapping[str, Any]) -> Selection:
    """What another job says of the robot and the images, where the recording does not."""
    urdf = _named_in(like, other, "robot", "urdf")
    unit = other.get("sensor", {}).get("depth_unit")
    unit = float(unit) if isinstance(unit, int | float) and unit > 0 else None
    return replace(
        selection,
        spare_urdf=selection.spare_urdf or urdf,
        spare_unit=selection.spare_unit or unit,
    )


def _read(source: Path, selection: Selection) -> Recorded:
    if selection.frames < 1:
        raise JobError(source, "--frames", f"{selection.frames}", "1 or more")
    if not source.exists():
        raise JobError(source, "", "no such file or folder", _RECORDINGS)
    refuse_irregular(source)
    if bag_files(source):
        return read_bag(source, selection)
    images, clouds = len(depth_images(source)), len(cloud_paths(source))
    if images > clouds:
        return read_depth_folder(source, selection)
    if clouds:
        return read_clouds(source, selection)
    raise JobError(source, "", "nothing that can be imported", _RECORDINGS)


_RECORDINGS = (
    "a bag of ROS 1 or ROS 2, an MCAP file, a folder of depth PNGs with Open3D's intrinsics, or "
    "PLY or PCD clouds"
)


def _heading(source: Path, notes: Iterable[str], missing: Mapping[str, str]) -> list[str]:
    """What stands at the top of the job file."""
    lines = [f"Imported from {source.name}."]
    lines += [f"- {words}" for words in notes]
    if missing:
        lines += ["", "To be filled in:"]
        lines += [f"- {key}: {words}" for key, words in missing.items()]
    return lines


def _tables(like: Path | None) -> dict[str, Any]:
    """The tables of another job; none if there is no file."""
    if like is None:
        return {}
    refuse_irregular(like)
    try:
        tables = tomllib.loads(like.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise JobError(like, "", f"a job that cannot be read ({error})", "a job file") from error
    return {name: table for name, table in tables.items() if isinstance(table, dict)}


def _named_in(like: Path | None, tables: Mapping[str, Any], table: str, key: str) -> Path | None:
    """A file that another job names."""
    named = tables.get(table, {}).get(key)
    return like.parent / named if like is not None and isinstance(named, str) else None
