"""Straight edges between the planes of a mesh (3.1 (2) for a model). Numpy, as the regions."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from torchcal.match.features import LineKind
from torchcal.match.model.regions import Mesh, Regions
from torchcal.match.model.tolerances import Tolerances

LONG = 4.0
"""Square of the length over the area of a long facet: 1 for a square, 2.3 for a triangle."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Segments:
    """Straight edges of a model."""

    ends: Float[ndarray, "line 2 3"]
    """m"""
    is_end: Bool[ndarray, "line 2"]
    kind: Int[ndarray, " line"]
    dihedral: Float[ndarray, " line"]
    """rad; NaN at a border."""
    regions: Int[ndarray, "line 2"]
    """Beside it; -1 at a border."""

    @property
    def direction(self) -> Float[ndarray, "line 3"]:
        """Of unit length."""
        along = self.ends[:, 1] - self.ends[:, 0]
        return along / np.linalg.norm(along, axis=1, keepdims=True)

    @property
    def length(self) -> Float[ndarray, " line"]:
        """From end to end (m)."""
        return np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1)

    def rows(self, rows: ndarray) -> "Segments":
        """Some of them."""
        return Segments(
            ends=self.ends[rows],
            is_end=self.is_end[rows],
            kind=self.kind[rows],
            dihedral=self.dihedral[rows],
            regions=self.regions[rows],
        )

    @staticmethod
    def join(*parts: "Segments") -> "Segments":
        """All of several sets."""
        return Segments(
            ends=np.concatenate([part.ends for part in parts]),
            is_end=np.concatenate([part.is_end for part in parts]),
            kind=np.concatenate([part.kind for part in parts]),
            dihedral=np.concatenate([part.dihedral for part in parts]),
            regions=np.concatenate([part.regions for part in parts]),
        )


def find_creases(mesh: Mesh, regions: Regions, tolerances: Tolerances) -> Segments:
    """Edges at which a plane ends or bends: joined where they go straight on.

    At least one side is a plane; a border counts as JUMP, since nothing continues the surface.
    """
    beside = np.where(mesh.edge_faces >= 0, regions.of_face[mesh.edge_faces], -1)
    is_plane = regions.is_plane[beside] & (beside >= 0)
    sharp = (mesh.bends() >= tolerances.crease) & (beside[:, 0] != beside[:, 1])
    return _joined(mesh, regions, np.flatnonzero(sharp & is_plane.any(1)), beside, tolerances)


def find_limbs(mesh: Mesh, regions: Regions, tolerances: Tolerances) -> Segments:
    """Edges between long facets of curved surfaces: where a sensor may see a pipe end."""
    beside = np.where(mesh.edge_faces >= 0, regions.of_face[mesh.edge_faces], -1)
    bends = mesh.bends()
    smooth = mesh.inner & (bends < tolerances.crease) & (beside[:, 0] != beside[:, 1])
    found = _joined(mesh, regions, np.flatnonzero(smooth), beside, tolerances)
    is_long = (found.length[:, None] ** 2 > LONG * regions.area[found.regions]).all(1)
    kind = np.full(len(found.kind), LineKind.JUMP.value)
    return replace(found, kind=kind).rows(np.flatnonzero(is_long))


def _joined(
    mesh: Mesh, regions: Regions, rows: ndarray, beside: ndarray, tolerances: Tolerances
) -> Segments:
    """Edges of the mesh with the same two regions beside them, joined where they are collinear."""
    swap = beside[rows, 0] < beside[rows, 1]
    pair = np.where(swap[:, None], beside[rows, ::-1], beside[rows])
    group = _collinear(mesh, rows, pair, tolerances)
    count = int(group.max(initial=-1)) + 1
    first = np.full(count, len(rows))
    np.minimum.at(first, group, np.arange(len(rows)))
    ends = _extremes(mesh.vertices[mesh.edges[rows]], group, first)
    pair = pair[first]
    kind, dihedral = _bends_of(mesh, regions, rows, group, pair)
    long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= tolerances.least_length
    found = Segments(
        ends=ends, is_end=np.ones((count, 2), bool), kind=kind, dihedral=dihedral, regions=pair
    )
    return found.rows(long)


def _collinear(
    mesh: Mesh, rows: ndarray, pair: ndarray, tolerances: Tolerances
) -> Int[ndarray, " row"]:
    """Numbers of groups of edges that meet end to end, go straight on and part the same regions."""
    edges = mesh.edges[rows]
    along = mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    owner = np.tile(np.arange(len(rows)), 2)
    keys = np.column_stack([pair[owner], edges.T.ravel()])
    order = np.lexsort(keys.T)
    same = (keys[order][1:] == keys[order][:-1]).all(1)
    one, two = owner[order][:-1][same], owner[order][1:][same]
    sine = np.linalg.norm(np.cross(along[one], along[two]), axis=1)
    straight = sine < np.sin(tolerances.angle)
    links = coo_array(
        (np.ones(straight.sum()), (one[straight], two[straight])), shape=(len(rows), len(rows))
    )
    return connected_components(links, directed=False)[1].astype(np.int64)


def _extremes(ends: ndarray, group: ndarray, first: ndarray) -> Float[ndarray, "line 2 3"]:
    """The two ends of each group that are farthest apart along its first edge."""
    if not len(first):
        return np.zeros((0, 2, 3))
    origin = ends[first, 0][group]
    along = (ends[first, 1] - ends[first, 0])[group]
    points = ends.reshape(-1, 3)
    place = np.einsum("eci,ei->ec", ends - origin[:, None], along).ravel()
    order = np.lexsort((place, np.repeat(group, 2)))
    starts = np.flatnonzero(np.diff(np.repeat(group, 2)[order], prepend=-1))
    lasts = np.r_[starts[1:], len(order)] - 1
    return np.stack([points[order[starts]], points[order[lasts]]], 1)


def _bends_of(
    mesh: Mesh, regions: Regions, rows: ndarray, group: ndarray, pair: ndarray
) -> tuple[ndarray, ndarray]:
    """Kind and dihedral angle of each group, weighted by length."""
    count = len(pair)
    one, two = mesh.edge_faces[rows].T
    length = np.linalg.norm(np.diff(mesh.vertices[mesh.edges[rows]], axis=1)[:, 0], axis=1)
    # The other triangle's centre lies below this one's plane at a convex edge.
    rise = mesh.vertices[mesh.faces[two]].mean(1) - mesh.vertices[mesh.edges[rows, 0]]
    height = np.bincount(group, length * (rise * mesh.normals[one]).sum(1), count)
    kind = np.where(height < 0.0, LineKind.CONVEX.value, LineKind.CONCAVE.value)
    between = np.bincount(group, length * mesh.bends()[rows], count) / np.bincount(
        group, length, count
    )
    border = pair[:, 1] < 0
    a, b = regions.normal[pair[:, 0]], regions.normal[pair[:, 1]]
    exact = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1))
    flat = regions.is_plane[pair].all(1)
    dihedral = np.where(border, np.nan, np.where(flat, exact, between))
    return np.where(border, LineKind.JUMP.value, kind), dihedral
