"""The straight edges that a pinhole sensor sees of known meshes, worked out with the ray caster.

Nothing here knows of torchcal's own extraction: it is what extracted lines are judged by.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from torchcal.demo import raycast
from torchcal.geometry.projection import Projection

FLAT = 0.02
"""rad. Faces that meet at less lie on one plane."""
SAME_LINE = 2e-3
"""m and rad. Mesh edges that lie nearer together are pieces of one line."""
BESIDE = 0.5
"""Pixels from an edge at which the surfaces on both of its sides are looked up."""
ON_SURFACE = 3e-3
"""m. An edge is seen where the nearer surface beside it is this near to it."""
TOUCHING = 0.03
"""m. Surfaces beside an edge whose ranges differ by less meet there; others are a jump."""
GAP = 10.0
"""Pixels. Visible pieces of one line with no more between them are one edge."""
NEAREST = 0.05
"""m. Edges are cut where they come nearer to the sensor's plane."""


@dataclass(frozen=True, kw_only=True, slots=True)
class VisibleEdges:
    """Visible pieces of straight edges, in the sensor's frame."""

    pixels: Float[ndarray, "edge 2 2"]
    """Both ends in the image."""
    ends: Float[ndarray, "edge 2 3"]
    """m"""
    strong: Float[ndarray, " edge"]
    """Pixels of its length where faces meet at more than the smallest dihedral angle, or the
    range jumps by more than the smallest jump."""
    weak: Float[ndarray, " edge"]
    """Pixels of its length where there is anything at all to be seen."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Samples:
    line: Int[ndarray, " sample"]
    pixel: Float[ndarray, "sample 2"]
    point: Float[ndarray, "sample 3"]
    across: Float[ndarray, "sample 2"]
    """Unit vector in the image, perpendicular to the edge."""


def visible_edges(
    meshes: Sequence[trimesh.Trimesh],
    T_world_sensor: Float[ndarray, "4 4"],
    projection: Projection,
    *,
    dihedral: float,
    jump: float,
) -> VisibleEdges:
    """The visible pieces of all edges of meshes (m, world frame).

    Args:
        meshes: What there is to be seen.
        T_world_sensor: Where the sensor stands; its optics are those of a pinhole.
        projection: Its optics.
        dihedral: The smallest angle (rad) between faces that both are seen, of a strong edge.
        jump: The smallest difference (m) of the ranges, of a strong edge with one face in view.
    """
    scene = raycast.view(meshes, T_world_sensor)
    samples = _samples(_mesh_edges(meshes, T_world_sensor), projection)
    angle, step = _beside(scene, samples, projection)
    crease = step < TOUCHING
    weak = np.where(crease, angle > FLAT, np.isfinite(step))
    strong = np.where(crease, angle > dihedral, step > jump)
    return _pieces(samples, weak, strong)


def _mesh_edges(
    meshes: Sequence[trimesh.Trimesh], T_world_sensor: Float[ndarray, "4 4"]
) -> Float[ndarray, "edge 2 3"]:
    corners = np.concatenate(
        [
            mesh.vertices[mesh.face_adjacency_edges[mesh.face_adjacency_angles > FLAT]]
            for mesh in meshes
        ]
    )
    return (corners - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3]


def _lines(edges: Float[ndarray, "edge 2 3"]) -> Int[ndarray, " edge"]:
    """The same number for edges that lie on one straight line."""
    direction = edges[:, 1] - edges[:, 0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    foot = edges[:, 0] - (edges[:, 0] * direction).sum(1, keepdims=True) * direction
    near = [
        KDTree(np.hstack([foot, direction])).query_ball_tree(
            KDTree(np.hstack([foot, sign * direction])), SAME_LINE
        )
        for sign in (1.0, -1.0)
    ]
    pairs = np.array([(a, b) for found in near for a, bs in enumerate(found) for b in bs])
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(edges), len(edges)))
    return connected_components(graph, directed=False)[1]


def _samples(edges: Float[ndarray, "edge 2 3"], projection: Projection) -> _Samples:
    """Points on the edges, one for each pixel of their way through the image."""
    parts = list(_edge_samples(edges, _lines(edges), projection))
    return _Samples(
        line=np.concatenate([part.line for part in parts]),
        pixel=np.concatenate([part.pixel for part in parts]),
        point=np.concatenate([part.point for part in parts]),
        across=np.concatenate([part.across for part in parts]),
    )


def _edge_samples(
    edges: Float[ndarray, "edge 2 3"], lines: Int[ndarray, " edge"], projection: Projection
) -> Iterator[_Samples]:
    size = np.array([projection.width - 1.0, projection.height - 1.0])
    for edge, line in zip(edges, lines, strict=True):
        front = _in_front(edge)
        if front is None:
            continue
        ends = projection.pixels(torch.from_numpy(front)).numpy()
        length = np.linalg.norm(ends[1] - ends[0])
        share = (np.arange(int(np.clip(length, 1, 20000))) + 0.5) / max(int(length), 1)
        pixel = ends[0] + share[:, None] * (ends[1] - ends[0])
        seen = ((pixel >= 0) & (pixel <= size)).all(1)
        inverse = (1 - share) / front[0, 2] + share / front[1, 2]
        rays = projection.rays(*torch.from_numpy(pixel[seen]).unbind(-1)).numpy()
        along = (ends[1] - ends[0]) / max(length, 1e-9)
        yield _Samples(
            line=np.full(seen.sum(), line),
            pixel=pixel[seen],
            point=rays / inverse[seen, None],
            across=np.broadcast_to([-along[1], along[0]], (seen.sum(), 2)),
        )


def _in_front(edge: Float[ndarray, "2 3"]) -> Float[ndarray, "2 3"] | None:
    """The part before the sensor; None where there is none."""
    depth = edge[:, 2]
    if (depth < NEAREST).all():
        return None
    share = (NEAREST - depth[0]) / (depth[1] - depth[0] if depth[1] != depth[0] else 1.0)
    cut = edge[0] + share * (edge[1] - edge[0])
    return np.where((depth < NEAREST)[:, None], cut, edge)


def _beside(
    scene: raycast.View, samples: _Samples, projection: Projection
) -> tuple[Float[ndarray, " sample"], Float[ndarray, " sample"]]:
    """Angle (rad) and step of range (m) between the surfaces beside; NaN where it is hidden."""
    own = projection.rays(*torch.from_numpy(samples.pixel).unbind(-1)).numpy()
    faces, ranges = [], []
    for side in (-BESIDE, BESIDE):
        shifted = torch.from_numpy(samples.pixel + side * samples.across)
        _, face = raycast.cast(scene, projection.rays(*shifted.unbind(-1)).numpy())
        faces.append(face)
        ranges.append(raycast.plane_ranges(scene, face, own))
    normals = [scene.normals[face] for face in faces]
    normals = [normal / np.linalg.norm(normal, axis=1, keepdims=True) for normal in normals]
    angle = np.arccos(np.clip((normals[0] * normals[1]).sum(1), -1.0, 1.0))
    depth = samples.point[:, 2]
    off = np.minimum(np.abs(ranges[0] - depth), np.abs(ranges[1] - depth))
    seen = (off < ON_SURFACE) & (np.minimum(*ranges) > depth - TOUCHING)
    seen &= (faces[0] >= 0) & (faces[1] >= 0)
    step = np.abs(ranges[0] - ranges[1])
    return np.where(seen, angle, np.nan), np.where(seen, step, np.nan)


def _pieces(
    samples: _Samples, weak: Bool[ndarray, " sample"], strong: Bool[ndarray, " sample"]
) -> VisibleEdges:
    found = []
    for line in np.unique(samples.line[weak]):
        (members,) = np.nonzero((samples.line == line) & weak)
        pixel = samples.pixel[members]
        along = np.array([samples.across[members[0], 1], -samples.across[members[0], 0]])
        place = pixel @ along
        order = np.argsort(place)
        breaks = np.nonzero(np.diff(place[order]) > GAP)[0] + 1
        for run in np.split(order, breaks):
            bins = np.floor(place[run])
            found.append(
                (
                    members[run[[0, -1]]],
                    len(np.unique(bins[strong[members[run]]])),
                    len(np.unique(bins)),
                )
            )
    ends = np.array([each[0] for each in found], dtype=int).reshape(-1, 2)
    return VisibleEdges(
        pixels=samples.pixel[ends],
        ends=samples.point[ends],
        strong=np.array([each[1] for each in found], dtype=float),
        weak=np.array([each[2] for each in found], dtype=float),
    )
