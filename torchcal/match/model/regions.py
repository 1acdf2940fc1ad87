"""Triangles that lie in one plane (3.1 (2) for a model). Numpy: a model is taken apart once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from torchcal.match.model.tolerances import Tolerances

DOMINANT = 4.0
"""A flat part of a curved surface has neighbours that are at least this share of its area."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Mesh:
    """Triangles with what their edges join, in one frame."""

    vertices: Float[ndarray, "vertex 3"]
    faces: Int[ndarray, "face 3"]
    edges: Int[ndarray, "edge 2"]
    edge_faces: Int[ndarray, "edge 2"]
    """-1 at a border."""
    normals: Float[ndarray, "face 3"]
    """Unit length, to the side that the corners run round anticlockwise."""
    areas: Float[ndarray, " face"]
    """m^2"""

    @staticmethod
    def of(
        vertices: Float[ndarray, "vertex 3"],
        faces: Int[ndarray, "face 3"],
        edges: Int[ndarray, "edge 2"],
        edge_faces: Int[ndarray, "edge 2"],
    ) -> "Mesh":
        """With normals and areas of the triangles."""
        corners = vertices[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled = np.linalg.norm(cross, axis=1)
        normals = cross / np.maximum(doubled, np.finfo(float).tiny)[:, None]
        return Mesh(
            vertices=vertices,
            faces=faces,
            edges=edges,
            edge_faces=edge_faces,
            normals=normals,
            areas=0.5 * doubled,
        )

    @property
    def inner(self) -> Bool[ndarray, " edge"]:
        """Edges between two triangles."""
        return self.edge_faces[:, 1] >= 0

    def bends(self) -> Float[ndarray, " edge"]:
        """Angle between the normals beside each edge (rad); pi at a border."""
        one, two = self.normals[self.edge_faces[:, 0]], self.normals[self.edge_faces[:, 1]]
        sine = np.linalg.norm(np.cross(one, two), axis=1)
        bend = np.arctan2(sine, (one * two).sum(1))
        return np.where(self.inner, bend, np.pi)


@dataclass(frozen=True, kw_only=True, slots=True)
class Regions:
    """Connected triangles in one plane each; every triangle is in one."""

    of_face: Int[ndarray, " face"]
    normal: Float[ndarray, "region 3"]
    point: Float[ndarray, "region 3"]
    """The centre of area (m)."""
    area: Float[ndarray, " region"]
    """m^2"""
    is_plane: Bool[ndarray, " region"]
    """Large enough, and no facet of a curved surface."""
    patch: Int[ndarray, " region"]
    """The curved surface that each is part of: regions that meet without a crease."""


def find_regions(mesh: Mesh, tolerances: Tolerances) -> Regions:
    """Merges coplanar connected triangles and tells planes from facets of curved surfaces."""
    bends = mesh.bends()
    label = _connected(mesh, bends < tolerances.angle)
    label = _split_where_curved(mesh, label, bends, tolerances)
    normal, point, area = _fitted(mesh, label)
    is_smooth = bends < tolerances.crease
    is_plane = (area >= tolerances.least_area) & ~_are_facets(mesh, label, area, is_smooth)
    patch = np.zeros(len(area), np.int64)
    patch[label] = _connected(mesh, is_smooth)
    return Regions(
        of_face=label, normal=normal, point=point, area=area, is_plane=is_plane, patch=patch
    )


def _connected(mesh: Mesh, joins: Bool[ndarray, " edge"]) -> Int[ndarray, " face"]:
    one, two = mesh.edge_faces[joins & mesh.inner].T
    count = len(mesh.faces)
    links = coo_array((np.ones(len(one)), (one, two)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)


def _fitted(mesh: Mesh, label: Int[ndarray, " face"]) -> tuple[ndarray, ndarray, ndarray]:
    """Mean normal, centre and area of each region."""
    count = int(label.max()) + 1
    area = np.bincount(label, mesh.areas, count)
    centre = mesh.vertices[mesh.faces].mean(1)

    def mean(values: ndarray) -> ndarray:
        sums = [np.bincount(label, mesh.areas * column, count) for column in values.T]
        return np.stack(sums, 1) / np.maximum(area, np.finfo(float).tiny)[:, None]

    normal = mean(mesh.normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.maximum(length, np.finfo(float).tiny), mean(centre), area


def _split_where_curved(
    mesh: Mesh, label: ndarray, bends: ndarray, tolerances: Tolerances
) -> Int[ndarray, " face"]:
    """Small bends add up: regions that are not flat are grown anew from their largest triangles."""
    normal, point, _ = _fitted(mesh, label)
    height = np.einsum(
        "fci,fi->fc", mesh.vertices[mesh.faces] - point[label][:, None], normal[label]
    )
    cosine = (mesh.normals * normal[label]).sum(1)
    off = (np.abs(height).max(1) > tolerances.distance) | (cosine < np.cos(tolerances.angle))
    curved = np.isin(label, np.unique(label[off]))
    if not curved.any():
        return label
    joins = (bends < tolerances.angle) & mesh.inner
    grown = _grown(mesh, curved, mesh.edge_faces[joins], tolerances)
    grown[~curved] = label[~curved] + grown.max() + 1
    return np.unique(grown, return_inverse=True)[1].astype(np.int64)


def _grown(
    mesh: Mesh, open_faces: Bool[ndarray, " face"], links: ndarray, tolerances: Tolerances
) -> Int[ndarray, " face"]:
    """Regions about seeds, the largest triangle first, of what lies in the seed's plane."""
    neighbours = _neighbours(len(mesh.faces), links)
    corners = mesh.vertices[mesh.faces]
    label = np.where(open_faces, -1, -2)
    number = 0
    for seed in np.argsort(-mesh.areas, kind="stable"):
        if label[seed] != -1:
            continue
        normal, point = mesh.normals[seed], corners[seed, 0]
        layer = np.array([seed])
        while len(layer):
            label[layer] = number
            layer = np.unique(neighbours[layer])
            layer = layer[(layer >= 0) & (label[layer] == -1)]
            height = np.abs((corners[layer] - point) @ normal).max(1, initial=0.0)
            turned = mesh.normals[layer] @ normal < np.cos(tolerances.angle)
            layer = layer[~turned & (height <= tolerances.distance)]
        number += 1
    return label


def _neighbours(count: int, links: ndarray) -> Int[ndarray, "face 3"]:
    """The triangles across each one's sides; -1 where there is none."""
    both = np.concatenate([links, links[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    sizes = np.bincount(both[:, 0], minlength=count)
    place = np.arange(len(both)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    table = np.full((count, 3), -1)
    table[both[:, 0], place] = both[:, 1]
    return table


def _are_facets(
    mesh: Mesh, label: ndarray, area: ndarray, is_smooth: Bool[ndarray, " edge"]
) -> Bool[ndarray, " region"]:
    """Regions that two or more of comparable size continue without a crease.

    The flat side of a rounded box has only narrow strips beside it, a side of a shallow roof only
    one neighbour.
    """
    pairs = label[mesh.edge_faces[is_smooth & mesh.inner]]
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    comparable = area[both[:, 1]] * DOMINANT > area[both[:, 0]]
    return np.bincount(both[comparable, 0], minlength=len(area)) >= 2
