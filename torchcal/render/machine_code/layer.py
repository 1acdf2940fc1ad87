"""The hard layer in machine code: that of ``layer.py`` but for rounding, faster.

Neighbours in a row mostly see the same face: what does not change along them is found once.
"""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchcal.render.layer import Layer
from torchcal.render.machine_code.compiled import compiled, in_threads, leaf
from torchcal.render.machine_code.facets import mean_hit
from torchcal.render.machine_code.integrals import motion_of
from torchcal.render.machine_code.vectors import cross, dot, plane, row
from torchcal.render.motion import BodyMotion
from torchcal.render.soup import Views

ROWS = 64
"""Rows that a thread takes at a time."""


def hard_layer(
    face: Int[Tensor, "view h w"],
    frames: tuple[Tensor, Tensor, Tensor],
    views: Views,
    motion: BodyMotion | None,
) -> Layer:
    """As ``layer.plain_hard_layer``."""
    sensor, (count, height, width) = views.sensor, face.shape
    moving, parameters = motion_of(motion, count)
    total, area = views.vertices.new_zeros(2, *face.shape)
    change = views.vertices.new_zeros(count, parameters, height, width)
    images = total.numpy(), area.numpy(), change.numpy()
    mesh = views.vertices.double().contiguous().numpy(), views.surface.faces.numpy()
    of_pixels = tuple(axis.numpy() for axis in frames)
    limits = float(sensor.near), float(sensor.far), 1.0 / 12.0 if sensor.beam > 0 else 0.0

    def fill(task: tuple[int, int]) -> None:
        view, first = task
        rows = view, first, min(first + ROWS, height)
        _fill(rows, face.numpy(), of_pixels, mesh, limits, moving, images)

    in_threads(fill, [(i, first) for i in range(count) for first in range(0, height, ROWS)])
    return Layer(
        total=total,
        area=area,
        total_derivative=change,
        area_derivative=None,
        jump=torch.zeros_like(face, dtype=torch.bool),
    )


@compiled
@no_type_check
def _fill(rows, face, frames, mesh, limits, moving, images):
    """Fills some rows of a view."""
    view, first, last = rows
    vertices, faces = mesh
    kinds, body_kind, face_body = moving
    levers = np.empty((kinds.shape[2], 4))
    for v in range(first, last):
        u = 0
        while u < face.shape[2]:
            f, begin = face[view, v, u], u
            while u < face.shape[2] and face[view, v, u] == f:
                u += 1
            if f < 0:
                continue
            corner = row(vertices, faces[f, 0])
            normal = plane(corner, row(vertices, faces[f, 1]), row(vertices, faces[f, 2]))
            if len(levers):
                _enter_levers(kinds[view, body_kind[face_body[f]]], normal, levers)
            facet = normal, dot(normal, corner)
            _fill_span((view, v, begin, u), facet, frames, limits, levers, images)


@leaf
@no_type_check
def _enter_levers(motion, normal, levers):
    """Enters normal . push and normal x turn: what a face's range changes by is linear in them."""
    for p in range(len(levers)):
        turn = cross(normal, (motion[p, 3], motion[p, 4], motion[p, 5]))
        levers[p, 0] = dot(normal, (motion[p, 0], motion[p, 1], motion[p, 2]))
        levers[p, 1], levers[p, 2], levers[p, 3] = turn


@leaf
@no_type_check
def _fill_span(span, facet, frames, limits, levers, images):
    """Fills neighbouring pixels of a row that see the same face."""
    view, v, begin, end = span
    total, area, change = images
    rays, to_u, to_v = frames
    near, far, spread = limits
    for u in range(begin, end):
        frame = _pixel(rays, v, u), _pixel(to_u, v, u), _pixel(to_v, v, u)
        distance, scale, ray = mean_hit(*facet, frame, (spread, 0.0, spread))
        if near <= distance <= far:
            total[view, v, u], area[view, v, u] = distance, 1.0
            for p in range(len(levers)):
                turn = levers[p, 1] * ray[0] + levers[p, 2] * ray[1] + levers[p, 3] * ray[2]
                change[view, p, v, u] = scale * (levers[p, 0] + distance * turn)


@leaf
@no_type_check
def _pixel(image, v, u):
    return image[v, u, 0], image[v, u, 1], image[v, u, 2]
