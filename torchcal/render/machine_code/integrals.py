"""Integrals over squares in machine code: those of ``integrals.py`` but for rounding, faster."""

from typing import no_type_check

import numpy as np
import torch

from torchcal.render.layer import Sums
from torchcal.render.machine_code.cells import frames_of, ray_of
from torchcal.render.machine_code.compiled import compiled, in_threads, leaf, parts_of
from torchcal.render.machine_code.facets import mean_hit
from torchcal.render.machine_code.vectors import cross, dot, plane, row
from torchcal.render.motion import BodyMotion
from torchcal.render.regions import Divided
from torchcal.render.silhouette import Borders
from torchcal.render.soup import Views


def sums_of(divided: Divided, borders: Borders, views: Views, motion: BodyMotion | None) -> Sums:
    """As ``integrals.sums_of``."""
    squares, own, rims = divided.squares, divided.regions, divided.rims
    count = len(squares.view)
    regions = tuple(
        each.numpy() for each in (own.square, own.face, own.area, own.centroid, own.spread)
    )
    frames = frames_of(squares)
    levers = rims.total_lever.numpy(), rims.area_lever.numpy()
    edges = views.surface.edges[borders.edge]
    bodies = views.surface.vertex_body[edges[:, 0]]
    of_rims = rims.square.numpy(), rims.border.numpy(), levers, edges.numpy(), bodies.numpy()
    moving, parameters = motion_of(motion, views.count)
    moving = (*moving, squares.view.numpy())
    mesh = views.vertices.contiguous().numpy(), views.surface.faces.numpy()
    limits = float(views.sensor.near), float(views.sensor.far)
    sums = np.zeros((count, 2 + 2 * parameters))

    def add(part: tuple[int, int]) -> None:
        span, of_span = (np.searchsorted(square, part) for square in (regions[0], of_rims[0]))
        _add_regions((span[0], span[1]), regions, frames, mesh, limits, moving, sums)
        if parameters:
            _add_rims((of_span[0], of_span[1]), of_rims, mesh, moving, sums)

    in_threads(add, parts_of(count))
    return Sums.split(torch.from_numpy(sums))


def motion_of(motion: BodyMotion | None, views: int) -> tuple[tuple[np.ndarray, ...], int]:
    """Motion of each kind of body, the kinds of bodies, the bodies of faces; parameters."""
    if motion is None:
        none = np.zeros(0, np.int64)
        return (np.zeros((views, 1, 0, 6)), none, none), 0
    kinds = motion.kinds.double().contiguous().numpy()
    return (kinds, motion.body_kind.numpy(), motion.face_body.numpy()), kinds.shape[2]


@compiled
@no_type_check
def _add_regions(span, regions, frames, mesh, limits, moving, sums):
    square, face, area, centroid, spread = regions
    kinds, body_kind, face_body, view = moving
    twist = np.empty(6)
    for i in range(span[0], span[1]):
        if face[i] < 0:
            continue
        k, motion = square[i], kinds[0, 0]
        if kinds.shape[2]:
            motion = kinds[view[k], body_kind[face_body[face[i]]]]
        frame = row(frames[0], k), row(frames[1], k), row(frames[2], k)
        region = face[i], area[i], (centroid[i, 0], centroid[i, 1]), row(spread, i)
        _add_region(region, frame, mesh, limits, motion, twist, sums[k])


@compiled
@no_type_check
def _add_rims(span, rims, mesh, moving, sums):
    """Adds what the motion of borders changes: see ``regions.Rims``."""
    square, border, levers, edges, bodies = rims
    kinds, body_kind, _, view = moving
    twist = np.empty(6)
    for i in range(span[0], span[1]):
        k = square[i]
        first, last = row(mesh[0], edges[border[i], 0]), row(mesh[0], edges[border[i], 1])
        along = (last[0] - first[0], last[1] - first[1], last[2] - first[2])
        normal = cross(first, along)
        motion = kinds[view[k], body_kind[bodies[border[i]]]]
        for kind in range(2):
            lever = row(levers[kind], i)
            turn, push = cross(along, lever), cross(normal, lever)
            for j in range(3):
                twist[j], twist[3 + j] = turn[j], push[j]
            _add_twist(motion, twist, 2 + kind * len(motion), sums[k])


@leaf
@no_type_check
def _add_region(region, frame, mesh, limits, motion, twist, sums):
    """Adds the integral of a region's range, and its derivative: see ``mean_hit``."""
    vertices, faces = mesh
    _, to_u, to_v = frame
    face, area, centroid, spread = region
    ray = ray_of(frame, centroid)
    corner = vertices[faces[face, 0]]
    normal = plane(corner, vertices[faces[face, 1]], vertices[faces[face, 2]])
    distance, scale, ray = mean_hit(normal, dot(normal, corner), (ray, to_u, to_v), spread)
    if not limits[0] <= distance <= limits[1]:
        return
    sums[0] += distance * area
    sums[1] += area
    if not len(motion):
        return
    push, size = scale * area, distance * area * scale
    lever = cross(ray, normal)
    for j in range(3):
        twist[j], twist[3 + j] = push * normal[j], size * lever[j]
    _add_twist(motion, twist, 2, sums)


@leaf
@no_type_check
def _add_twist(motion, twist, at, sums):
    """Adds the derivatives to the parameters from ``at`` on."""
    for p in range(len(motion)):
        for j in range(6):
            sums[at + p] += motion[p, j] * twist[j]
