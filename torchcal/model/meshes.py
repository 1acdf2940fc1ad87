"""Triangle meshes from files and primitives, cleaned, coloured and merged.

Everything here is numpy and trimesh: meshes are read once, on the host, before tensors are made of
them in ``torchcal.model.scene``.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from trimesh.resolvers import FilePathResolver
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.color import to_rgba, uv_to_color

from torchcal.errors import JobError
from torchcal.model.paint import (
    KEPT,
    NEUTRAL_GREY,
    base_colour,
    joined,
    material_image,
    paint_of,
)
from torchcal.model.regular_file import irregular

FARTHEST = 1e6
"""m: no place or size of a robot's surroundings is beyond it; it was given in another unit."""

WELD_TOLERANCE = 1e-7
"""Vertices closer than this share of the mesh's size are one vertex; STL files hold 24 bits."""


def read_scene(file: Path, key: str = "", named_in: Path | None = None) -> trimesh.Scene:
    """Any file that trimesh reads, as it stands there: no axis turned, nothing fetched or merged.

    Args:
        file: The file with the geometry.
        key: The key that names ``file``, for errors.
        named_in: The file in which that key stands; None: ``file`` itself.

    Raises:
        JobError: If the file is missing, of a kind that trimesh does not read, or broken.
    """
    where = named_in or file
    if not file.is_file():
        found = f"{file.name}, {irregular(file)}" if irregular(file) else f"no file {file}"
        raise JobError(where, key, found, "a file with triangles")
    options: dict[str, Any] = {"split_objects": True} if file.suffix.lower() == ".obj" else {}
    try:
        return trimesh.load_scene(
            str(file), resolver=_RegularFiles(str(file)), process=False, **options
        )
    except Exception as error:  # each of trimesh's loaders raises errors of its own
        raise JobError(
            where, key, f"{file.name}, which cannot be read ({error})", "a file with triangles"
        ) from error


class _RegularFiles(FilePathResolver):
    """What a file with geometry names beside itself; a pipe among it would never be read whole."""

    def absolute(self, name: str) -> Path:
        path = super().absolute(name)
        found = irregular(path)
        if found:
            raise ValueError(f"{name} is {found}")
        return path


def reach(mesh: trimesh.Trimesh, T: NDArray[np.float64]) -> float:
    """The largest coordinate of a mesh under any 4x4 matrix; NaN or infinite for broken ones."""
    with np.errstate(over="ignore", invalid="ignore"):
        corners = np.asarray(trimesh.bounds.corners(mesh.bounds)) @ T[:3, :3].T + T[:3, 3]
    return float(np.abs(corners).max())


def triangles(geometry: object) -> trimesh.Trimesh | None:
    """The geometry as a clean mesh of its own; None for points, lines and empty meshes."""
    if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
        return None
    mesh = _copied(geometry)
    mesh.update_faces(sound_faces(mesh))
    mesh.remove_unreferenced_vertices()
    return mesh if len(mesh.faces) else None


def sound_faces(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """Which faces are finite, have an area and are no copy of an earlier face."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    finite = np.all(np.isfinite(vertices), axis=1)
    sound = np.all(finite[faces], axis=1)
    ids = weld(np.where(finite[:, None], vertices, 0.0))[faces]
    sound &= np.all(ids != np.roll(ids, 1, axis=1), axis=1)
    sound[sound] = _has_area(vertices[faces[sound]])
    kept = np.flatnonzero(sound)
    copies = np.ones(len(faces), dtype=bool)
    copies[kept[_first_rows(np.sort(ids[kept], axis=1))]] = False
    return ~copies


def _has_area(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.square(sides).sum(2).max(1)
    doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return doubled > 1e-12 * longest


def _first_rows(rows: NDArray[np.integer]) -> NDArray[np.integer]:
    """Where each distinct row occurs first."""
    order = np.lexsort(rows.T)
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(1)
    return order[new]


def weld(points: NDArray[np.float64], tolerance: float | None = None) -> NDArray[np.int64]:
    """An id for every point, the same for points closer than the tolerance.

    Args:
        points: Finite points, one a row.
        tolerance: In the points' unit; None: ``WELD_TOLERANCE`` times the size of the whole.

    Returns:
        Ids from 0 without gaps, in the order in which they first occur.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    distinct, ids = _exactly_equal(points)
    reach = WELD_TOLERANCE * float(np.ptp(points, axis=0).max()) if tolerance is None else tolerance
    pairs = KDTree(distinct).query_pairs(reach, output_type="ndarray")
    if len(pairs) == 0:
        return ids
    size = len(distinct)
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    return connected_components(links, directed=False)[1].astype(np.int64)[ids]


def _exactly_equal(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The distinct points, in the order in which they first occur, and each point's index there."""
    points = points + 0.0  # -0.0 becomes 0.0
    order = np.lexsort(points.T)
    new = np.ones(len(points), dtype=bool)
    new[1:] = (points[order[1:]] != points[order[:-1]]).any(1)
    first = order[new]  # lexsort is stable: the first of each group of equal points
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    ids = np.empty(len(points), dtype=np.int64)
    ids[order] = rank[np.cumsum(new) - 1]
    return points[np.sort(first)], ids


def face_colours(mesh: trimesh.Trimesh) -> NDArray[np.uint8]:
    """RGBA of every face: its own colour, its vertices' mean or its texture's middle."""
    visual = mesh.visual
    if isinstance(visual, TextureVisuals):
        return _material_colours(mesh.faces, visual)
    if not isinstance(visual, ColorVisuals) or visual.kind is None:
        return np.tile(np.array(NEUTRAL_GREY, dtype=np.uint8), (len(mesh.faces), 1))
    return np.asarray(visual.face_colors)


def _material_colours(faces: NDArray[np.int64], visual: TextureVisuals) -> NDArray[np.uint8]:
    colours = _texture_colours(faces, visual) * (base_colour(visual.material) / 255.0)
    vertex = visual.vertex_attributes.get("color")
    if vertex is not None and len(vertex) > faces.max():
        colours = colours * (to_rgba(vertex)[faces].mean(1) / 255.0)
    return np.round(colours).astype(np.uint8)


def _texture_colours(faces: NDArray[np.int64], visual: TextureVisuals) -> NDArray[np.float64]:
    image, uv = material_image(visual.material), visual.uv
    if image is None or uv is None or len(uv) <= faces.max():
        return np.full((len(faces), 4), 255.0)
    return uv_to_color(np.asarray(uv)[faces].mean(1), image).astype(np.float64)


def painted(mesh: trimesh.Trimesh, colours: NDArray[np.uint8]) -> trimesh.Trimesh:
    """The bare mesh with these RGBA face colours, one for each face or one for all."""
    rgba = np.broadcast_to(colours, (len(mesh.faces), 4)).copy()
    return trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=rgba, process=False)


def merged(parts: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of several, with the mean colours of their faces and their whole look as paint."""
    if len(parts) == 1:
        return parts[0]
    counts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return trimesh.Trimesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, counts, strict=True)]),
        face_colors=np.concatenate([face_colours(part) for part in parts]),
        metadata={KEPT: joined([paint_of(part) for part in parts])},
        process=False,
    )


def transformed(mesh: trimesh.Trimesh, T: NDArray[np.float64]) -> trimesh.Trimesh:
    """The mesh under any 4x4 matrix; a mirror turns the faces so that they still look outwards."""
    copy = _copied(mesh)
    copy.apply_transform(T)
    if KEPT in copy.metadata and np.linalg.det(T[:3, :3]) < 0:
        copy.metadata[KEPT] = copy.metadata[KEPT].turned()
    return copy


def _copied(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A copy with the colours of vertices that trimesh leaves behind beside a material."""
    copy = mesh.copy()
    if isinstance(mesh.visual, TextureVisuals) and isinstance(copy.visual, TextureVisuals):
        copy.visual.vertex_attributes.update(dict(mesh.visual.vertex_attributes.items()))
    return copy
