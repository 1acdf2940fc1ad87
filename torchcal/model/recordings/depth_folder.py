"""A folder of depth images with Open3D's intrinsics and a trajectory."""

import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from torchcal.errors import JobError
from torchcal.geometry.projection import Pinhole
from torchcal.model.recordings.cameras import centre_note, pinhole_of
from torchcal.model.recordings.kinds import CAMERA_NOISE, unit_note, unit_of
from torchcal.model.recordings.recorded import Optics, RangePixels, Recorded, Selection, Taken
from torchcal.model.recordings.stillness import evenly
from torchcal.model.recordings.trajectories import Trajectory, read_json, read_trajectory
from torchcal.model.regular_file import refuse_irregular

_TIMES_APART = 0.05
"""s: the farthest that a pose of a trajectory may be from its image."""
_LIKELY_NAMES = ("trajectory", "groundtruth", "poses", "camera_poses")
"""Of files with poses, where there are several; the first one counts."""


def depth_images(source: Path) -> list[Path]:
    """The images of a folder, or of ``depth`` in it, in the order of their names."""
    for folder in (source / "depth", source):
        found = sorted(folder.glob("*.png"))
        depth = [path for path in found if "depth" in path.name]
        if found:
            return depth or found
    return []


def read_depth_folder(source: Path, selection: Selection) -> Recorded:
    """What a folder of depth images holds.

    Args:
        source: The images are in it or in ``depth`` in it, 16-bit PNG; beside them an Open3D
            ``PinholeCameraIntrinsic`` and a trajectory, if any.
        selection: What to take of it; ``use`` names files.

    Raises:
        JobError: If something is missing, broken, or there several times.
    """
    images = depth_images(source)
    selection.refuse_others(source, _texts(source))
    cameras = _cameras(source)
    file = _one(source, "camera intrinsics", list(cameras), selection.use)
    projection = _pinhole(file, cameras[file])
    trajectory = _trajectory(source, cameras, selection.use)
    poses = _paired(source, images, trajectory) if trajectory else dict.fromkeys(range(len(images)))
    known = list(poses)
    taken = [known[k] for k in evenly(len(known), selection.frames)]
    whole = np.dtype(np.uint16)
    notes = [f"{len(taken)} of {len(images)} images were taken, at equal steps"]
    notes += [*centre_note(projection), *unit_note(whole, selection)]
    return Recorded(
        optics=Optics(
            projection=projection, sigma=CAMERA_NOISE, beam=1, depth_unit=unit_of(whole, selection)
        ),
        frames=tuple(Taken(T_world_sensor=poses[k]) for k in taken),
        images=_pixels([images[k] for k in taken], projection),
        notes=tuple(notes),
        to_fill_in={} if trajectory else {"frame.pose": "where the camera was: no trajectory"},
    )


def _cameras(source: Path) -> dict[Path, dict[str, Any]]:
    """The files of a folder that hold intrinsics as Open3D writes them."""
    found = {}
    for file in sorted(source.glob("*.json")):
        refuse_irregular(file)
        content = read_json(file.read_text(encoding="utf-8", errors="replace"))
        first = content.get("parameters") if isinstance(content, dict) else None
        if isinstance(first, list) and first and isinstance(first[0], dict):
            content = first[0].get("intrinsic")
        if isinstance(content, dict) and "intrinsic_matrix" in content:
            found[file] = content
    return found


def _pinhole(file: Path, content: dict[str, Any]) -> Pinhole:
    """The intrinsic matrix is there column by column."""
    try:
        fx, _, _, _, fy, _, cx, cy, _ = (float(value) for value in content["intrinsic_matrix"])
        width, height = float(content["width"]), float(content["height"])
        return pinhole_of(width, height, (fx, fy), (cx, cy))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        expected = "width, height and an intrinsic_matrix of nine numbers"
        raise JobError(file, "", f"intrinsics that cannot be used ({error})", expected) from error


def _one(source: Path, what: str, files: list[Path], use: tuple[str, ...]) -> Path:
    """The file that was chosen, has the likeliest name, or is the only one."""
    if not files:
        expected = "a JSON file with width, height and intrinsic_matrix, as Open3D writes it"
        raise JobError(source, "", f"no file with {what}", expected)
    chosen = [file for file in files if file.name in use]
    likely = [file for name in _LIKELY_NAMES for file in files if file.stem == name]
    if not chosen and not likely and len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise JobError(source, "", f"{len(files)} files with {what}: {names}", "--use FILE")
    return (chosen or likely or files)[0]


def _trajectory(source: Path, cameras: Collection[Path], use: tuple[str, ...]) -> Trajectory | None:
    texts = _texts(source)
    # Where a person said which file has the poses, the others need not be any. One that has
    # intrinsics may have poses too.
    texts = [file for file in texts if file.name in use and file not in cameras] or texts
    found = {file: each for file in texts if (each := read_trajectory(file)) is not None}
    for file in texts:
        said = file.stem in _LIKELY_NAMES or file.name in use
        if said and file not in found and file not in cameras:
            expected = "poses: a .log or .json of Open3D, or a .txt of the TUM benchmark"
            raise JobError(file, "", "no poses that can be read", expected)
    return found[_one(source, "poses", list(found), use)] if found else None


def _texts(source: Path) -> list[Path]:
    """The files of a folder that may hold poses."""
    return [
        path for suffix in ("log", "txt", "json") for path in sorted(source.glob(f"*.{suffix}"))
    ]


def _paired(source: Path, images: list[Path], trajectory: Trajectory) -> dict[int, torch.Tensor]:
    """The poses of images, by their times where the trajectory has any."""
    Ts, times = trajectory.Ts_world_sensor, _times(images)
    if trajectory.times is None or (len(Ts) == len(images) and times.isinf().all()):
        if len(Ts) != len(images):
            expected = "one pose for each image, or a trajectory with times"
            raise JobError(source, "", f"{len(Ts)} poses and {len(images)} images", expected)
        return dict(enumerate(Ts))
    found = {}
    for k, time in enumerate(times):
        away = (trajectory.times - time).abs()
        if away.min() <= _TIMES_APART:
            found[k] = Ts[int(away.argmin())]
    if not found:
        expected = f"images that are named after their times (s), within {_TIMES_APART} s of poses"
        raise JobError(source, "", "poses with times, none of them that of an image", expected)
    return found


def _times(images: list[Path]) -> torch.Tensor:
    """The times (s) after which images are named; infinite for other names."""
    named = (each.stem for each in images)
    seconds = [float(name) if name.replace(".", "", 1).isdecimal() else math.inf for name in named]
    return torch.tensor(seconds, dtype=torch.float64)


def _pixels(files: list[Path], projection: Pinhole) -> Iterator[RangePixels]:
    for file in files:
        refuse_irregular(file)
        try:
            with Image.open(file) as image:
                pixels = np.array(image)
        except (OSError, SyntaxError, ValueError) as error:
            raise JobError(file, "", f"an image that cannot be read ({error})", "a PNG") from error
        whole = np.issubdtype(pixels.dtype, np.integer) and pixels.dtype.itemsize > 1
        if pixels.ndim != 2 or not whole:
            found = f"an image of {pixels.dtype} and shape {pixels.shape}"
            raise JobError(file, "", found, "one channel of 16 bits")
        if pixels.shape != (projection.height, projection.width):
            found = f"{pixels.shape[1]}x{pixels.shape[0]} pixels"
            expected = f"{projection.width}x{projection.height}, as its intrinsics say"
            raise JobError(file, "", found, expected)
        yield pixels.astype(np.uint16)
