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

    A face in a cell whose plane is in front in a corner of it meets what is seen.

    Args:
        cells: Of all squares.
        face: What is seen in them.
        squares: Where they are.
        views: In double precision.
    """
    found = [cells.square.new_zeros(0, 3)]
    for rays in _probes(cells, squares):
        for other, point, _ in hits_of_points(views, squares, cells.square, rays):
            pair = torch.stack([face[point], other], -1)
            differ = torch.nonzero((pair[:, 0] >= 0) & (pair[:, 0] != other))[:, 0]
            differ = differ[_strangers(pair[differ], views.surface.faces)]
            pair, cell = pair[differ], point[differ]
            meet = _is_in_front_in_a_corner(pair, cells, cell, squares, views)
            key = torch.cat([cells.square[cell, None], pair.sort(-1).values], -1)
            found.append(key[meet])
    rows = torch.cat(found).unique(dim=0)
    return rows[:, 0], _ends(rows[:, 1:], views.vertices, views.surface)


def _probes(cells: Cells, squares: Squares) -> Iterator[Float[Tensor, "cell 3"]]:
    """Rays through the middle of all cells and through places near their corners."""
    yield cells.ray
    x, y = 0.5 * (cells.left + cells.right).mean(1), cells.y.mean(1)
    for sides in (cells.left, cells.right):
        for end in (0, 1):
            u = torch.lerp(sides[:, end], x, INSET)
            v = torch.lerp(cells.y[:, end], y, INSET)
            yield squares.rays(cells.square, u, v)


def _is_in_front_in_a_corner(
    pair: Tensor, cells: Cells, cell: Tensor, squares: Squares, views: Views
) -> Tensor:
    """Whether the second face's plane is nearer than the first one's in a corner of the cell."""
    planes = [Facets.of(views.vertices, views.surface.faces[face]) for face in pair.unbind(1)]
    front = torch.zeros_like(cell, dtype=torch.bool)
    own = cells.square[cell]

    def inverses(rays: Tensor) -> list[Tensor]:
        return [dot(plane.normal[:-1], rays) / plane.offset[:-1] for plane in planes]

    least = FLUSH * inverses(squares.origin[own])[0]
    for sides in (cells.left, cells.right):
        for end in (0, 1):
            x, y = sides[cell, end], cells.y[cell, end]
            seen, other = inverses(squares.rays(own, x, y))
            front |= other - seen > least
    return front


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
    view, v, u = torch.nonzero((one != other) & (one >= 0) & (other >= 0), as_tuple=True)
    pair = torch.stack([one[view, v, u], other[view, v, u]], -1)
    strangers = _strangers(pair, views.surface.faces)
    view, v, u, pair = view[strangers], v[strangers], u[strangers], pair[strangers]
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
