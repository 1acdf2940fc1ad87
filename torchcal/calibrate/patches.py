"""New objects from the patches of their surfaces that single frames saw (section 2.5)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import fast_simplification
import numpy as np
import trimesh
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from torchcal.calibrate.result import AddedObject, Evidence

MOST_FACES = 2000
"""Of one object: enough for its shape in a browser, and a scene of dozens of them stays light."""

SKIRT = 10.0
"""Height of what holds an open mesh's border while it is simplified, in sides of its faces."""

TOUCHING = 0.05
"""Patches that have less of the smaller one's points near the other do not touch."""

ALIKE = 0.7
"""Cosine of the angle (45 degrees) within which faces of two patches may be of one side."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Patch:
    """One connected piece of a new surface, as one frame saw it."""

    frame: str
    mesh: trimesh.Trimesh
    """World frame, metres."""
    tolerance: float
    """How far (m) the same surface may lie from here in another frame."""


def merged_objects(patches: Sequence[Patch]) -> tuple[AddedObject, ...]:
    """One object for each group of patches that touch, named by size from ``added_1`` on.

    Patches touch when points of one lie within both tolerances of the other. Each stays a
    connected piece of the object's mesh.
    """
    groups = _touching(patches)
    groups.sort(key=lambda group: -sum(patch.mesh.area for patch in group))
    return tuple(_object(f"added_{i}", group) for i, group in enumerate(groups, start=1))


def simplified(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with a modest number of faces: flat sides stay flat, and outlines where they are."""
    if len(mesh.faces) == 0 or not mesh.area > 0.0:
        return mesh
    # Decimation takes an open mesh's border for a place without shape and eats it.
    length = SKIRT * math.sqrt(2.0 * mesh.area / len(mesh.faces))
    skirted = _skirted(mesh, length)
    points, faces, *_ = fast_simplification.simplify(
        skirted.vertices, skirted.faces.astype(np.int32), target_reduction=0.5, lossless=True
    )
    if len(faces) > MOST_FACES:
        points, faces, *_ = fast_simplification.simplify(
            points, faces.astype(np.int32), target_count=MOST_FACES
        )
    off, _ = KDTree(mesh.vertices).query(points)
    light = trimesh.Trimesh(points, faces[(off[faces] < length / SKIRT).all(1)], process=False)
    light.remove_unreferenced_vertices()
    return light if len(light.faces) else mesh


def _skirted(mesh: trimesh.Trimesh, length: float) -> trimesh.Trimesh:
    """The mesh with faces across its border that stand up by a length (m)."""
    _, edge, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    a, b = mesh.edges[count[edge.ravel()] == 1].T
    up = len(mesh.vertices)
    skirted = trimesh.Trimesh(
        np.concatenate([mesh.vertices, mesh.vertices + length * mesh.vertex_normals]),
        np.concatenate([mesh.faces, np.stack([b, a, a + up], 1), np.stack([b, a + up, b + up], 1)]),
        process=False,
    )
    skirted.remove_unreferenced_vertices()
    return skirted


def _touching(patches: Sequence[Patch]) -> list[list[Patch]]:
    """Groups of patches that are linked by touching, each in the given order."""
    count = len(patches)
    if count == 0:
        return []
    links = [(i, j) for i in range(count) for j in range(i) if _touch(patches[i], patches[j])]
    rows, columns = np.array(links, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(links)), (rows, columns)), shape=(count, count))
    _, group = connected_components(graph, directed=False)
    members = [np.flatnonzero(group == g).tolist() for g in range(int(group.max()) + 1)]
    return [[patches[i] for i in each] for each in members]


def _touch(one: Patch, other: Patch) -> bool:
    reach = math.hypot(one.tolerance, other.tolerance)
    low = np.maximum(one.mesh.bounds[0], other.mesh.bounds[0])
    high = np.minimum(one.mesh.bounds[1], other.mesh.bounds[1])
    if np.any(low > high + reach):
        return False
    points = sorted((_thinned(p.mesh, 0.5 * reach) for p in (one, other)), key=len)
    distance, _ = KDTree(points[1]).query(points[0], distance_upper_bound=reach)
    return bool(np.isfinite(distance).mean() >= TOUCHING)


def _thinned(mesh: trimesh.Trimesh, cell: float) -> np.ndarray:
    """Evenly spread points of the surface, one for each cube of side ``cell`` (m)."""
    points = np.concatenate([mesh.vertices, mesh.triangles_center])
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def _object(name: str, group: Sequence[Patch]) -> AddedObject:
    frames = tuple(dict.fromkeys(patch.frame for patch in group))
    mesh = simplified(_fused(group))
    pixels = sum(patch.mesh.metadata["pixels"] for patch in group)
    mesh.metadata.update(source="range image", frames=list(frames), pixels=pixels)
    evidence = Evidence(supporting=pixels, contradicting=0, hidden=0)
    return AddedObject(name=name, frames=frames, mesh=mesh, evidence=evidence)


def _fused(group: Sequence[Patch]) -> trimesh.Trimesh:
    """One mesh of several patches: of each side only the patch that shows most of it."""
    first, *others = sorted(group, key=lambda patch: -patch.mesh.area)
    mesh = first.mesh
    for patch in others:
        new = _beside(patch, mesh, math.hypot(patch.tolerance, first.tolerance))
        mesh = trimesh.Trimesh(
            np.concatenate([mesh.vertices, patch.mesh.vertices]),
            np.concatenate([mesh.faces, new + len(mesh.vertices)]),
            process=False,
        )
    mesh.remove_unreferenced_vertices()
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def _beside(patch: Patch, known: trimesh.Trimesh, reach: float) -> Int[np.ndarray, "face 3"]:
    """The faces of a patch that do not lie on a known mesh: near it and turned alike."""
    distance, nearest = KDTree(known.triangles_center).query(
        patch.mesh.triangles_center, distance_upper_bound=reach
    )
    normals = np.concatenate([known.face_normals, np.zeros((1, 3))])[nearest]
    alike = np.einsum("fi,fi->f", normals, patch.mesh.face_normals) > ALIKE
    return patch.mesh.faces[~(np.isfinite(distance) & alike)]
