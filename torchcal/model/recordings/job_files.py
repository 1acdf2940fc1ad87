"""Writing what a job names: range images, the robot and the model of the world."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from torchcal.errors import JobError
from torchcal.model.mesh_copy import MeshFolder
from torchcal.model.recordings.job_tables import Written
from torchcal.model.recordings.recorded import RangePixels, Recorded
from torchcal.model.recordings.robot_files import copy_robot
from torchcal.model.regular_file import irregular

_SATURATED = 65535
"""Cameras that cannot say "not measured" by 0 say it by the largest number."""


def write_files(
    source: Path,
    recorded: Recorded,
    folder: Path,
    packages: Mapping[str, Path],
    world: Path | None,
) -> Written:
    """Writes everything that a job names into its folder.

    Args:
        source: Where the recording is, for errors.
        recorded: The recording; its images are read.
        folder: Of the job.
        packages: Where the packages are that ``package://`` means in the URDF, by name.
        world: The CAD model of the surroundings; None: nobody has named one.

    Raises:
        JobError: If an image cannot be read or none holds a measurement, or if the model or a mesh
            of the robot is missing.
    """
    urdf = None
    if recorded.carrier is not None:
        urdf = copy_robot(recorded.carrier.robot, folder / "robot", packages)
    if world is not None and not world.is_file():
        raise JobError(
            world, "", irregular(world) or "no such file", "a file that trimesh reads as a scene"
        )
    model = None if world is None else f"world/{MeshFolder(folder / 'world').add(world)}"
    (folder / "depth").mkdir(parents=True, exist_ok=True)
    images = _write_images(source, recorded, folder)
    return replace(images, urdf=urdf and str(urdf.relative_to(folder)), world=model)


def _write_images(source: Path, recorded: Recorded, folder: Path) -> Written:
    names: list[str | None] = []
    near, far, whole = math.inf, 0.0, False
    for number, pixels in enumerate(recorded.images, start=1):
        whole = pixels.dtype.kind == "u"
        ranges = _ranges(pixels, recorded.optics.depth_unit if whole else 1.0)
        if ranges.size == 0:
            names.append(None)
            continue
        name = f"depth/{number:04d}" + (".png" if whole else ".npy")
        _write_image(folder / name, pixels)
        names.append(name)
        near, far = float(ranges.min(initial=near)), float(ranges.max(initial=far))
    if far == 0.0:
        raise JobError(source, "", "images in which nothing was measured", "some ranges")
    limits = math.floor(near * 100.0) / 100.0, math.ceil(far * 10.0 + 1e-9) / 10.0
    return Written(images=tuple(names), limits=limits, whole=whole, urdf=None, world=None)


def _write_image(file: Path, pixels: RangePixels) -> None:
    if pixels.dtype.kind == "u":
        Image.fromarray(pixels).save(file)
    else:
        np.save(file, pixels)


def _ranges(pixels: RangePixels, unit: float) -> NDArray[np.float64]:
    """What was measured (m)."""
    sound = np.isfinite(pixels) & (pixels > 0)
    if pixels.dtype.kind == "u":
        sound &= pixels != _SATURATED
    return pixels[sound].astype(np.float64) * unit
