"""The shapes of a URDF's links as triangle meshes in the link's frame, metres."""

import math
import os
from pathlib import Path
from urllib.parse import unquote, urlparse

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from torchcal.errors import JobError
from torchcal.geometry import se3
from torchcal.model.meshes import merged, painted, read_scene, transformed, triangles
from torchcal.model.regular_file import irregular
from torchcal.model.urdf_tree import Link, Origin, Shape

MESH_FORMATS = (".dae", ".obj", ".stl")

SECTIONS = 128
"""Around a cylinder: a chord leaves a radius of one metre by 0.3 mm."""

SUBDIVISIONS = 4
"""Of the icosahedron that stands for a sphere."""


def link_mesh(urdf: Path, link: Link) -> trimesh.Trimesh | None:
    """All shapes of a link in one mesh; None for a link that shows nothing.

    Raises:
        JobError: If a mesh file is missing, of another format than ``MESH_FORMATS``, or broken.
    """
    if not link.shapes:
        return None
    return merged([_shape_mesh(urdf, shape) for shape in link.shapes])


def origin_matrix(origin: Origin) -> torch.Tensor:
    """The 4x4 pose of a URDF origin, float64."""
    xyz, rpy = (torch.tensor(part, dtype=torch.float64) for part in (origin.xyz, origin.rpy))
    return se3.from_xyz_rpy(xyz, rpy)


def resolve(urdf: Path, filename: str, key: str) -> Path:
    """The file that a name in a URDF means: relative to it, ``file://`` or ``package://``.

    Raises:
        JobError: If there is no such file, or if the name is of another scheme.
    """
    parts, key = urlparse(filename), f"{key}.filename"
    if parts.scheme == "package":
        candidates = _in_packages(urdf, parts.netloc, unquote(parts.path).lstrip("/"))
    elif parts.scheme == "file":
        candidates = [urdf.parent / unquote(parts.netloc + parts.path)]
    elif "://" in filename:
        expected = "a path, file:// or package://; nothing is fetched"
        raise JobError(urdf, key, filename, expected)
    else:
        candidates = [urdf.parent / filename]
    found = next((path for path in candidates if path.is_file()), None)
    if found is None:
        tried = (
            " or ".join(map(str, candidates)) or f"a package folder {parts.netloc} near the URDF"
        )
        odd = next((f", {each}" for path in candidates if (each := irregular(path))), "")
        raise JobError(urdf, key, f"{filename}{odd}", f"an existing file: {tried}")
    return found


def _in_packages(urdf: Path, package: str, rest: str) -> list[Path]:
    """Where a package may be: around the URDF first, then on ROS_PACKAGE_PATH."""
    above = urdf.resolve().parents
    listed = [Path(entry) for entry in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)]
    roots = [folder for folder in (*above, *listed) if folder.name == package]
    roots += [folder / package for folder in (*above, *listed) if (folder / package).is_dir()]
    return [root / rest for root in roots]


def _shape_mesh(urdf: Path, shape: Shape) -> trimesh.Trimesh:
    makers = {"box": _box, "cylinder": _cylinder, "sphere": _sphere}
    make = makers.get(shape.kind)
    mesh = _mesh_file(urdf, shape) if make is None else make(shape)
    if shape.colour is not None:
        mesh = painted(mesh, np.round(255 * np.clip(shape.colour, 0, 1)).astype(np.uint8))
    return transformed(mesh, _placement(shape))


def _placement(shape: Shape) -> NDArray[np.float64]:
    """Origin after scale."""
    scale = shape.size if shape.kind == "mesh" else (1.0, 1.0, 1.0)
    return origin_matrix(shape.origin).numpy() @ np.diag([*scale, 1.0])


def _box(shape: Shape) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=shape.size)


def _cylinder(shape: Shape) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(*shape.size, sections=SECTIONS)


def _sphere(shape: Shape) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=SUBDIVISIONS, radius=shape.size[0])


def _mesh_file(urdf: Path, shape: Shape) -> trimesh.Trimesh:
    file, key = resolve(urdf, shape.filename, shape.key), f"{shape.key}.filename"
    if file.suffix.lower() not in MESH_FORMATS:
        raise JobError(urdf, key, shape.filename, f"a mesh file: {', '.join(MESH_FORMATS)}")
    if file.suffix.lower() == ".dae" and b"<!DOCTYPE" in file.read_bytes():
        raise JobError(urdf, key, f"{shape.filename}, which has a DOCTYPE", "COLLADA without one")
    scene = read_scene(file, key, urdf)
    parts = [triangles(part) for part in scene.dump()]
    solid = [part for part in parts if part is not None]
    if not solid:
        raise JobError(urdf, key, f"{shape.filename} without triangles", "a mesh with triangles")
    return transformed(merged(solid), np.diag([*[_metres(file, scene)] * 3, 1.0]))


def _metres(file: Path, scene: trimesh.Scene) -> float:
    """Metres of one unit: COLLADA states its unit, as ROS's viewers read it; others do not."""
    if file.suffix.lower() != ".dae" or not scene.units:
        return 1.0
    factor = trimesh.units.unit_conversion(scene.units, "meters")
    return factor if math.isfinite(factor) and factor > 0 else 1.0
