"""Vertexes, lines and planes of a model with their characteristic values (3.1, 3.2)."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from torchcal.match.elements import Elements
from torchcal.match.features import Features, Lines, Planes, Vertices
from torchcal.match.model.contacts import find_contacts, without_buried
from torchcal.match.model.corners import Corners, find_corners, with_ends_at
from torchcal.match.model.edges import Segments, find_creases, find_limbs
from torchcal.match.model.outlines import Borders, find_borders, outline
from torchcal.match.model.regions import Mesh, Regions, find_regions
from torchcal.match.model.tolerances import Tolerances
from torchcal.model.scene import Surface

APART = 0.25
"""Of the least length: how far from one another surfaces meet, and lines end in one corner."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelFeatures:
    """The elements of a model whose bodies stand in given places, all in one frame."""

    features: Features
    plane_body: Int[Tensor, " plane"]
    """The body of each element."""
    line_body: Int[Tensor, "line 2"]
    """Of both sides: they differ where two bodies meet. A border has its own twice."""
    vertex_body: Int[Tensor, "vertex 3"]
    """Of each of its lines: the first side's."""
    limbs: Lines
    """Long edges in curved surfaces, of kind JUMP: they show only where the surface turns away."""
    limb_body: Int[Tensor, "limb 2"]
    face_plane: Int[Tensor, " face"]
    """The plane that each triangle is part of; -1: curved or too small."""
    face_region: Int[Tensor, " face"]
    """The flat region of each triangle: planes, and facets of curved surfaces."""
    region_normal: Float[Tensor, "region 3"]
    region_patch: Int[Tensor, " region"]
    """The surface without a crease that each region is part of."""
    line_regions: Int[Tensor, "line 2"]
    """The regions beside each line; -1 at a border."""
    limb_regions: Int[Tensor, "limb 2"]
    triangles: Float[Tensor, "face 3 3"]
    """Corners (m)."""


def find_model_features(
    surface: Surface,
    Ts_world_body: Float[Tensor, "body 4 4"],
    tolerances: Tolerances | None = None,
) -> ModelFeatures:
    """Finds the elements of a scene in the world's frame.

    Coplanar connected triangles of a body are one plane, collinear edges between two planes one
    line; where planes meet that share no edge there is a concave line. Facets of curved surfaces
    and what is smaller than the tolerances are no elements. Normals point to the side that the
    triangles' corners run round anticlockwise, and kinds follow from them.

    Args:
        surface: Triangles on bodies.
        Ts_world_body: Where the bodies stand; identities for the elements of one body in its frame.
        tolerances: None: those of a clean model of this size.
    """
    mesh, body = _mesh_in_world(surface, Ts_world_body)
    tolerances = tolerances or Tolerances.of_size(float(np.ptp(mesh.vertices, axis=0).max()))
    regions = find_regions(mesh, tolerances)
    borders = find_borders(mesh, regions)
    reach = APART * tolerances.least_length
    creases = find_creases(mesh, regions, tolerances)
    contacts = find_contacts(regions, borders, creases.regions, tolerances, reach)
    lines = Segments.join(without_buried(creases, contacts, reach), contacts)
    limbs = find_limbs(mesh, regions, tolerances)
    corners = find_corners(lines, reach, math.sin(tolerances.crease) ** 2)
    lines = with_ends_at(lines, corners)
    region_body = np.zeros(len(regions.area), np.int64)
    region_body[regions.of_face] = body[mesh.faces[:, 0]]
    return _as_tensors(
        mesh, regions, borders, lines, limbs, corners, region_body, like=surface.vertices
    )


def _as_tensors(
    mesh: Mesh,
    regions: Regions,
    borders: Borders,
    lines: Segments,
    limbs: Segments,
    corners: Corners,
    region_body: ndarray,
    *,
    like: Tensor,
) -> ModelFeatures:
    rows = np.flatnonzero(regions.is_plane)
    number = np.full(len(regions.area) + 1, -1)
    number[rows] = np.arange(len(rows))
    line_body = _bodies(lines, region_body)
    return ModelFeatures(
        features=Features(
            planes=_planes(regions, borders, rows, like),
            lines=_lines(lines, number, like),
            vertices=_vertices(corners, like),
        ),
        plane_body=_index(region_body[rows], like),
        line_body=_index(line_body, like),
        vertex_body=_index(line_body[corners.lines, 0], like),
        limbs=_lines(limbs, number, like),
        limb_body=_index(_bodies(limbs, region_body), like),
        face_plane=_index(number[regions.of_face], like),
        face_region=_index(regions.of_face, like),
        region_normal=_values(regions.normal, like),
        region_patch=_index(regions.patch, like),
        line_regions=_index(lines.regions, like),
        limb_regions=_index(limbs.regions, like),
        triangles=_values(mesh.vertices[mesh.faces], like),
    )


def _mesh_in_world(surface: Surface, Ts_world_body: Tensor) -> tuple[Mesh, ndarray]:
    body = surface.vertex_body.cpu().numpy()
    T = Ts_world_body.detach().double().cpu().numpy()[body]
    own = surface.vertices.detach().double().cpu().numpy()
    vertices = np.einsum("vij,vj->vi", T[:, :3, :3], own) + T[:, :3, 3]
    faces, edges, edge_faces = (
        table.cpu().numpy() for table in (surface.faces, surface.edges, surface.edge_faces)
    )
    return Mesh.of(vertices, faces, edges, edge_faces), body


def _planes(regions: Regions, borders: Borders, rows: ndarray, like: Tensor) -> Planes:
    area = _values(regions.area[rows], like)
    point, normal = (_values(table[rows], like) for table in (regions.point, regions.normal))
    outlines = (outline(borders[region], regions.normal[region]) for region in rows)
    return Planes(
        elements=Elements.planes(point, normal),
        area=area,
        area_sigma=torch.zeros_like(area),
        outline=tuple(_values(corners, like) for corners in outlines),
    )


def _lines(found: Segments, number: ndarray, like: Tensor) -> Lines:
    ends = _values(found.ends, like)
    length = (ends[:, 1] - ends[:, 0]).norm(dim=-1)
    return Lines(
        elements=Elements.lines(ends.mean(1), _values(found.direction, like)),
        ends=ends,
        is_end=torch.as_tensor(found.is_end, device=like.device),
        length_sigma=torch.zeros_like(length),
        kind=_index(found.kind, like),
        dihedral=_values(found.dihedral, like),
        dihedral_sigma=torch.zeros_like(length),
        planes=_index(number[found.regions], like),
    )


def _vertices(corners: Corners, like: Tensor) -> Vertices:
    angles = _values(corners.angles, like)
    return Vertices(
        elements=Elements.points(_values(corners.points, like)),
        lines=_index(corners.lines, like),
        angles=angles,
        angles_sigma=torch.zeros_like(angles),
    )


def _bodies(found: Segments, region_body: ndarray) -> ndarray:
    first, second = found.regions.T
    return region_body[np.stack([first, np.where(second < 0, first, second)], 1)]


def _values(values: ndarray, like: Tensor) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(values)).to(like)


def _index(values: ndarray, like: Tensor) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(values, np.int64), device=like.device)
