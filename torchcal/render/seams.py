"""Seams: lines along which faces that share no edge pass through one another in the image."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.model.scene import Surface
from torchcal.render.cells import Cells
from torchcal.render.facets import Facets, dot
from torchcal.render.soup import Views
from torchcal.render.squares import spread

CLOSE = 1e-6
"""Pixels. A shorter line between two faces is none."""
LENGTH = 1e3
"""m. Lines that meet in a pixel are followed as far as this: beyond their faces they do nothing."""


def seams_of(
    face: Int[Tensor, "view h w"], views: Views
) -> tuple[Float[Tensor, "seam 2 3"], Int[Tensor, " seam"]]:
    """The seams that somewhere pass between the centres of neighbouring pixels, and their views.

    Args:
        face: The face at the centre of every pixel, of the triangles of all views.
        views: In double precision.
    """
    found = [_between(face, along_u, views) for along_u in (True, False)]
    pairs = torch.unique(torch.cat(found), dim=0)
    ends = _ends(pairs, views.vertices, views.surface)
    return _within(ends, pairs, views.vertices, views.surface), pairs[:, 0] // len(views.own_faces)


def _within(ends: Tensor, pairs: Tensor, vertices: Tensor, surface: Surface) -> Tensor:
    """The parts of lines that lie in both triangles."""
    start, delta = ends[:, 0], ends[:, 1] - ends[:, 0]
    low, high = torch.zeros_like(start[:, 0]), torch.ones_like(start[:, 0])
    for face in pairs.unbind(1):
        normal = Facets.of(vertices, surface.faces[face]).normal[:-1]
        points = vertices[surface.faces[face]].unbind(1)
        for k in range(3):
            inwards = torch.linalg.cross(normal, points[(k + 1) % 3] - points[k])
            rise, at_start = dot(inwards, delta), dot(inwards, start - points[k])
            share = -at_start / rise
            low = torch.where(rise > 0, torch.maximum(low, share), low)
            high = torch.where(rise < 0, torch.minimum(high, share), high)
    high = torch.maximum(low, high)
    return torch.stack([start + low[:, None] * delta, start + high[:, None] * delta], 1)


def seams_missed(
    cells: Cells,
    face: Int[Tensor, " cell"],
    vertices: Float[Tensor, "vertex 3"],
    surface: Surface,
) -> tuple[Int[Tensor, " seam"], Float[Tensor, "seam 2 3"]]:
    """Where cells that lie one upon the other show faces that share no edge: squares and lines."""
    if not len(face):
        return face, vertices.new_zeros(0, 2, 3)
    starts = torch.cat([cells.y[1:, 0] != cells.y[:-1, 0], cells.piece.new_ones(1).bool()])
    starts[:-1] |= cells.square[1:] != cells.square[:-1]
    last = torch.nonzero(starts)[:, 0]
    count = torch.diff(last, prepend=last.new_full((1,), -1))
    slab = torch.repeat_interleave(count)
    first = last - count + 1
    followed = torch.cat([cells.square[first[1:]] == cells.square[first[:-1]], starts[:0]])
    followed = torch.cat([followed, followed.new_zeros(len(count) - len(followed))])
    number = torch.cat([count[1:], count[:1]]) * followed
    lower, order = spread(number[slab])
    upper = last[slab[lower]] + 1 + order
    pair = torch.stack([face[lower], face[upper]], -1)
    left = torch.maximum(cells.left[lower, 1], cells.left[upper, 0])
    right = torch.minimum(cells.right[lower, 1], cells.right[upper, 0])
    differ = (pair[:, 0] != pair[:, 1]) & (pair >= 0).all(-1) & (right - left > CLOSE)
    lower, pair = lower[differ], pair[differ].sort(-1).values
    strangers = _strangers(pair, surface.faces)
    found = torch.cat([cells.square[lower, None], pair], -1)[strangers].unique(dim=0)
    return found[:, 0], _ends(found[:, 1:], vertices, surface)


def _strangers(pair: Tensor, faces: Tensor) -> Tensor:
    """Pairs of faces without a common vertex."""
    corners = faces[pair]
    return (corners[:, 0, :, None] != corners[:, 1, None]).flatten(1).all(-1)


def _between(face: Tensor, along_u: bool, views: Views) -> Tensor:
    """Pairs of faces that meet between two neighbouring centres."""
    vertices, surface, projection = views.vertices, views.surface, views.sensor.projection
    du, dv = (1, 0) if along_u else (0, 1)
    height, width = face.shape[1:]
    one, other = face[:, : height - dv, : width - du], face[:, dv:, du:]
    view, v, u = torch.nonzero((one != other) & (one >= 0) & (other >= 0), as_tuple=True)
    pair = torch.stack([one[view, v, u], other[view, v, u]], -1)
    strangers = _strangers(pair, surface.faces)
    view, v, u, pair = view[strangers], v[strangers], u[strangers], pair[strangers]
    rays = [projection.rays((u + k * du).double(), (v + k * dv).double()) for k in (0, 1)]
    meet = torch.nonzero(_meet(pair, rays, vertices, surface))[:, 0]
    return pair[meet].sort(-1).values


def _meet(pair: Tensor, rays: list[Tensor], vertices: Tensor, surface: Surface) -> Tensor:
    """Whether two triangles meet on the way from one ray to the other."""
    facets = [Facets.of(vertices, surface.faces[face]) for face in pair.unbind(1)]
    first, last = (
        dot(facets[0].normal[:-1], ray) / facets[0].offset[:-1]
        - dot(facets[1].normal[:-1], ray) / facets[1].offset[:-1]
        for ray in rays
    )
    share = (first / (first - last)).nan_to_num(-1.0)
    ray = rays[0] + share[:, None] * (rays[1] - rays[0])
    meet = (share > 0) & (share < 1)
    for face, plane in zip(pair.unbind(1), facets, strict=True):
        points = vertices[surface.faces[face]].unbind(1)
        for k in range(3):
            side = torch.linalg.cross(points[k], points[(k + 1) % 3] - points[k])
            meet &= dot(side, ray) * plane.offset[:-1] >= 0
    return meet


def _ends(pairs: Tensor, vertices: Tensor, surface: Surface) -> Tensor:
    """Two points of the line in which the planes of two faces meet."""
    (n, d), (m, e) = (
        (facets.normal[:-1], facets.offset[:-1, None])
        for facets in (Facets.of(vertices, surface.faces[face]) for face in pairs.unbind(1))
    )
    along = torch.linalg.cross(n, m)
    size = dot(along, along)[:, None]
    nearest = (d * torch.linalg.cross(m, along) + e * torch.linalg.cross(along, n)) / size
    reach = LENGTH * along / size.sqrt()
    return torch.stack([nearest - reach, nearest + reach], 1)
