"""Seams: lines along which faces that share no edge pass through one another in the image."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.model.scene import Surface
from torchcal.render.cells import Cells
from torchcal.render.facets import Facets, dot
from torchcal.render.soup import Views
from torchcal.render.squares import Squares
from torchcal.render.zbuffer import hits_of_points

FLUSH = 1e-6
"""Share of the range: surfaces that are nearer to one another are taken as one."""
INSET = 1e-3
"""Share of the way from a corner to the middle of a cell."""
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
    cells: Cells, face: Int[Tensor, " cell"], squares: Squares, views: Views
) -> tuple[Int[Tensor, " seam"], Float[Tensor, "seam 2 3"]]:
    """Where other faces pass through those seen in cells: squares, in order, and lines.

    Near a corner of the cell another face is in front of the one that is seen in the middle.

    Args:
        cells: Of all squares.
        face: What is seen in them.
        squares: Where they are.
        views: In double precision.
    """
    found = [cells.square.new_zeros(0, 3)]
    for rays in near_corners(cells, squares):
        for other, cell, ranges in hits_of_points(views, squares, cells.square, rays):
            pair, ray = torch.stack([face[cell], other], -1), rays[cell]
            behind = _ranges_behind(pair[:, 0], ray, views)
            meet = (1.0 / ranges - 1.0 / behind) * ranges > FLUSH
            meet &= _strangers(pair, views.surface.faces)
            key = torch.cat([cells.square[cell, None], pair.sort(-1).values], -1)
            found.append(key[meet])
    rows = torch.cat(found).unique(dim=0)
    return rows[:, 0], _ends(rows[:, 1:], views.vertices, views.surface)


def near_corners(cells: Cells, squares: Squares) -> Iterator[Float[Tensor, "cell 3"]]:
    """Rays through places near the corners of all cells."""
    x, y = 0.5 * (cells.left + cells.right).mean(1), cells.y.mean(1)
    for sides in (cells.left, cells.right):
        for end in (0, 1):
            u = torch.lerp(sides[:, end], x, INSET)
            v = torch.lerp(cells.y[:, end], y, INSET)
            yield squares.rays(cells.square, u, v)


def _ranges_behind(face: Tensor, rays: Tensor, views: Views) -> Tensor:
    """Where rays meet single faces; NaN where they do not, or there is no face."""
    corners = views.surface.faces[face.clamp(min=0)]
    plane = Facets.of(views.vertices, corners)
    points = views.vertices[corners].unbind(1)
    meets = face >= 0
    for k in range(3):
        side = torch.linalg.cross(points[k], points[(k + 1) % 3] - points[k])
        meets &= dot(side, rays) * plane.offset[:-1] >= 0
    ranges = plane.offset[:-1] / dot(plane.normal[:-1], rays)
    return torch.where(meets, ranges, torch.nan)


def _strangers(pair: Tensor, faces: Tensor) -> Tensor:
    """Pairs of faces without a common vertex."""
    corners = faces[pair]
    return (corners[:, 0, :, None] != corners[:, 1, None]).flatten(1).all(-1)


def _between(face: Tensor, along_u: bool, views: Views) -> Tensor:
    """Pairs of faces that meet between two neighbouring centres."""
    projection = views.sensor.projection
    du, dv = (1, 0) if along_u else (0, 1)
    height, width = face.shape[1:]
    one, other = face[:, : height - dv, : width - du], face[:, dv:, du:]
    view, v, u = torch.nonzero(one != other, as_tuple=True)
    pair = torch.stack([one[view, v, u], other[view, v, u]], -1)
    may_meet = (pair >= 0).all(-1) & _strangers(pair, views.surface.faces)
    v, u, pair = v[may_meet], u[may_meet], pair[may_meet]
    rays = [projection.rays((u + k * du).double(), (v + k * dv).double()) for k in (0, 1)]
    return pair[_meet(pair, rays, views)].sort(-1).values


def _meet(pair: Tensor, rays: list[Tensor], views: Views) -> Tensor:
    """The rows in which two triangles meet on the way from one ray to the other."""
    faces = views.surface.faces[pair]
    planes = [Facets.of(views.vertices, faces[:, k]) for k in (0, 1)]
    first, last = (
        dot(planes[0].normal[:-1], ray) / planes[0].offset[:-1]
        - dot(planes[1].normal[:-1], ray) / planes[1].offset[:-1]
        for ray in rays
    )
    cross = torch.nonzero(first * last < 0)[:, 0]
    share = (first / (first - last))[cross, None]
    ray = torch.lerp(rays[0][cross], rays[1][cross], share)
    meet = torch.ones_like(cross, dtype=torch.bool)
    for k, plane in enumerate(planes):
        points = views.vertices[faces[cross, k]].unbind(1)
        for j in range(3):
            side = torch.linalg.cross(points[j], points[(j + 1) % 3] - points[j])
            meet &= dot(side, ray) * plane.offset[cross] >= 0
    return cross[meet]


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
