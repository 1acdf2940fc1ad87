"""PLY and PCD files: one cloud, or a folder of them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from torchcal.errors import JobError
from torchcal.model.meshes import read_scene
from torchcal.model.recordings.cloud_images import cloud_images
from torchcal.model.recordings.layout import Points, sound
from torchcal.model.recordings.pcd import CloudFile, read_pcd
from torchcal.model.recordings.recorded import Recorded, Selection, Taken
from torchcal.model.recordings.stillness import evenly

_SUFFIXES = (".pcd", ".ply")


def cloud_paths(source: Path) -> list[Path]:
    """The clouds of a file or a folder, in the order of their names."""
    files = [source] if source.is_file() else sorted(source.glob("*"))
    return [file for file in files if file.suffix.lower() in _SUFFIXES]


def read_clouds(source: Path, selection: Selection) -> Recorded:
    """What PLY and PCD files hold, one image for each.

    Args:
        source: A file or a folder of them, of which ``Selection.use`` may name some.
        selection: With ``position`` the points are in the axes of the world, and the sensor stood
            there. Else they are in the sensor's own axes, and the VIEWPOINT of a PCD file says
            where it stood; a PLY file does not.

    Raises:
        JobError: If a file cannot be read, holds no points, or is named and not there.
    """
    files = cloud_paths(source)
    selection.refuse_others(source, files)
    files = [file for file in files if file.name in selection.use] or files
    taken = [files[k] for k in evenly(len(files), selection.frames)]
    try:
        images = cloud_images(lambda: _clouds(taken, selection.position), selection.resolution_deg)
    except ValueError as error:
        raise JobError(source, "", f"clouds with {error}", "points around a sensor") from error
    T_cloud_sensor = images.layout.T_cloud_sensor
    known = selection.position is not None or all(file.suffix.lower() == ".pcd" for file in taken)
    frames = (
        Taken(T_world_sensor=_cloud(file, selection.position).T_world_sensor @ T_cloud_sensor)
        for file in taken
    )
    return Recorded(
        optics=images.optics,
        frames=tuple(frames),
        images=(images.image(points) for points in _clouds(taken, selection.position)),
        notes=(f"{len(taken)} of {len(files)} clouds were taken", images.note),
        to_fill_in={} if known else {"frame.pose": _POSE},
    )


_POSE = "where the sensor stood: PLY files do not say, or import again with --position"


def _clouds(files: list[Path], position: tuple[float, float, float] | None) -> Iterator[Points]:
    for file in files:
        yield _cloud(file, position).points


def _cloud(file: Path, position: tuple[float, float, float] | None) -> CloudFile:
    """The points of a file in the axes of a sensor, and where that stands."""
    read = read_pcd(file) if file.suffix.lower() == ".pcd" else _read_ply(file)
    if position is None:
        return read
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return CloudFile(points=read.points - np.array(position), T_world_sensor=T)


def _read_ply(file: Path) -> CloudFile:
    scene = read_scene(file)
    parts = [
        np.asarray(each.vertices, np.float64)
        for each in scene.geometry.values()
        if isinstance(each, trimesh.PointCloud | trimesh.Trimesh)
    ]
    if not parts:
        raise JobError(file, "", "no points", "a PLY file with vertices")
    eye: Float[Tensor, "4 4"] = torch.eye(4, dtype=torch.float64)
    return CloudFile(points=sound(np.concatenate(parts)[None]), T_world_sensor=eye)
