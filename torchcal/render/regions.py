"""Regions: what each face fills of a square; and the rims along which regions meet at a jump."""

from dataclasses import dataclass, fields
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.render.cells import Cells, cells_of
from torchcal.render.facets import Facets, dot
from torchcal.render.machine_code import machine_code_for
from torchcal.render.pieces import BEHIND, Pieces, of_cut_squares, with_seams
from torchcal.render.seams import seams_missed
from torchcal.render.silhouette import Borders
from torchcal.render.soup import Views
from torchcal.render.squares import Squares
from torchcal.render.zbuffer import faces_at_points

SHARES = (0.5 - 12**-0.5, 0.5 + 12**-0.5)
"""Gauss's points of a span from 0 to 1, each of weight 1/2: exact to the third order."""
CROWDED = 6
"""Squares with more pieces than this do without those that are covered at all ``PROBES``."""
PROBES = (0.01, 0.5, 0.99)
"""Shares of a piece's length."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Regions:
    """Parts of squares that are filled by one face each."""

    square: Int[Tensor, " region"]
    face: Int[Tensor, " region"]
    """-1 where the model is empty."""
    area: Float[Tensor, " region"]
    """Pixels."""
    centroid: Float[Tensor, "region 2"]
    """(x, y) from the middle of the pixel."""
    spread: Float[Tensor, "region 3"]
    """Second moments (xx, xy, yy) about the centroid, over the area (pixels^2)."""

    @staticmethod
    def of(square: Tensor, face: Tensor, moments: Float[Tensor, "region 6"]) -> "Regions":
        """From the integrals of 1, x, y, x^2, x y and y^2."""
        area, x, y, xx, xy, yy = moments.unbind(-1)
        filled = area > 0
        safe = torch.where(filled, area, 1.0)
        x, y, xx, xy, yy = (each / safe for each in (x, y, xx, xy, yy))
        return Regions(
            square=square,
            face=face.where(filled, -1),
            area=area,
            centroid=torch.stack([x, y], -1),
            spread=torch.stack([xx - x * x, xy - x * y, yy - y * y], -1),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Rims:
    """Pieces along which the range jumps.

    Motion of an edge whose plane through the sensor has the normal m changes the integrals over the
    square by (change of m) . lever.
    """

    square: Int[Tensor, " rim"]
    border: Int[Tensor, " rim"]
    total_lever: Float[Tensor, "rim 3"]
    area_lever: Float[Tensor, "rim 3"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Divided:
    """Squares and what they are divided into."""

    squares: Squares
    regions: Regions
    """In the order of the squares."""
    rims: Rims
    """In the order of the squares."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Shown:
    """Squares, the cells that they are cut into, and the face that is seen in each cell."""

    squares: Squares
    pieces: Pieces
    """The sides of the cells."""
    cells: Cells
    face: Int[Tensor, " cell"]
    """-1 where the model is empty."""


Part = TypeVar("Part", Regions, Rims)


def divide(squares: Squares, pieces: Pieces, borders: Borders, views: Views) -> Divided:
    """Divides squares among the faces that are seen in them.

    On the CPU it is done in machine code where numba is installed, else by tensors.

    Args:
        squares: The pixels that lines cross.
        pieces: The lines' parts in them.
        borders: What the first lines are; all others are seams.
        views: Not traced, in double precision.
    """
    module = machine_code_for(views.vertices, "regions")
    divided_by = plain_divide if module is None else module.divide
    return divided_by(squares, pieces, borders, views)


def plain_divide(squares: Squares, pieces: Pieces, borders: Borders, views: Views) -> Divided:
    """The same by tensor operations, on any device."""
    pieces = pieces.select(~_are_covered(pieces, squares, views))
    squares, pieces = of_cut_squares(squares, pieces)
    shown = _shown(squares, pieces, views)
    regions, rims = regions_of(shown), rims_of(shown, borders, views)
    square, ends = seams_missed(shown.cells, shown.face, views.vertices, views.surface)
    if len(square):
        first_seam = int(pieces.line.max()) + 1 + len(borders.edge)
        cut, *parts = with_seams(pieces, squares, square, ends, first_seam)
        again = _shown(*parts, views)
        whole = torch.ones_like(squares.view, dtype=torch.bool)
        whole[cut] = False
        regions = _replaced(regions, whole, regions_of(again), cut)
        rims = _replaced(rims, whole, rims_of(again, borders, views), cut)
    return Divided(squares=squares, regions=regions, rims=rims)


def _are_covered(pieces: Pieces, squares: Squares, views: Views) -> Bool[Tensor, " piece"]:
    """Pieces of crowded squares that are behind a face at both ends and in the middle."""
    own = pieces.square
    crowded = torch.nonzero(own.bincount(minlength=len(squares.view))[own] > CROWDED)[:, 0]
    own, low, high = own[crowded], pieces.low[crowded], pieces.high[crowded]
    inverse = pieces.range[crowded].reciprocal()
    hidden = torch.ones_like(own, dtype=torch.bool)
    for share in PROBES:
        rays = squares.rays(own, *(low + share * (high - low)).unbind(1))
        face = faces_at_points(views, squares, own, rays)
        planes = Facets.of(views.vertices, views.surface.faces[face.clamp(min=0)])
        order = torch.arange(len(face), device=face.device)
        nearest = planes.ranges(order, rays).where(face >= 0, torch.inf)
        hidden &= nearest * torch.lerp(*inverse.unbind(1), share) < 1.0 - BEHIND
    covered = torch.zeros_like(pieces.jumps)
    covered[crowded] = hidden
    return covered


def _shown(squares: Squares, pieces: Pieces, views: Views) -> Shown:
    cells = cells_of(pieces, squares)
    face = faces_at_points(views, squares, cells.square, cells.ray)
    return Shown(squares=squares, pieces=pieces, cells=cells, face=face)


def _replaced(
    old: Part, whole: Bool[Tensor, " square"], new: Part, cut: Int[Tensor, " cut"]
) -> Part:
    """Those of whole squares, and others in the squares that were cut again; in order."""
    keep = whole[old.square]
    square = torch.cat([old.square[keep], cut[new.square]])
    order = torch.sort(square, stable=True).indices

    def joined(name: str) -> Tensor:
        return torch.cat([getattr(old, name)[keep], getattr(new, name)])[order]

    names = [each.name for each in fields(old) if each.name != "square"]
    return type(old)(square=square[order], **{name: joined(name) for name in names})


def regions_of(shown: Shown) -> Regions:
    """Joins the cells of a square that show the same face."""
    cells = shown.cells
    pair = torch.stack([cells.square, shown.face], -1)
    pair, region = torch.unique(pair, dim=0, return_inverse=True)
    moments = torch.stack(_moments(cells), -1)
    moments = moments.new_zeros(len(pair), 6).index_add(0, region, moments)
    return Regions.of(pair[:, 0], pair[:, 1], moments)


def rims_of(shown: Shown, borders: Borders, views: Views) -> Rims:
    """The rims between cells of different faces.

    Args:
        shown: The cells, and what is seen in them.
        borders: The lines that they are parts of; all others are seams.
        views: The sensor has limits beyond which there is no return.
    """
    squares, pieces, cells, face = shown.squares, shown.pieces, shown.cells, shown.face
    vertices, surface = views.vertices, views.surface
    left = torch.nonzero((cells.piece >= 0) & (face != face.roll(-1)))[:, 0]
    # Seams move with two bodies, but the range does not jump there.
    left = left[pieces.line[cells.piece[left]] < len(borders.edge)]
    # Nor does it at an edge both of whose faces are seen.
    own = surface.edge_faces[borders.edge[pieces.line[cells.piece[left]]]]
    pair = torch.stack([face[left], face[left + 1]], -1)
    left = left[(pair != own).any(-1) & (pair != own.flip(1)).any(-1)]
    piece, square = cells.piece[left], cells.square[left]
    low, high = cells.right[left], cells.y[left]
    start, end = (torch.stack([low[:, k], high[:, k]], -1) for k in (0, 1))
    delta = end - start
    first, last = vertices[surface.edges[borders.edge[pieces.line[piece]]]].unbind(1)
    m = torch.linalg.cross(first, last - first)
    limits = (views.sensor.near, views.sensor.far)
    to_u, to_v = dot(m, squares.along_u[square]), dot(m, squares.along_v[square])
    # How far the left cell's area reaches beyond the line when m . ray rises by 1.
    rate = -delta.square().sum(-1) / (to_u * delta[:, 1] - to_v * delta[:, 0])
    total, area = torch.zeros_like(m), torch.zeros_like(m)
    planes = [Facets.of(vertices, surface.faces[face[k].clamp(min=0)]) for k in (left, left + 1)]
    own = torch.arange(len(left), device=left.device)
    own = [own.where(face[k] >= 0, -1) for k in (left, left + 1)]
    for share in SHARES:
        rays = squares.rays(square, *(start + share * delta).unbind(-1))
        hits = [plane.at(k, rays).between(*limits) for plane, k in zip(planes, own, strict=True)]
        jump = hits[0].range - hits[1].range
        gained = (hits[0].scale != 0).to(m) - (hits[1].scale != 0).to(m)
        total = total + (0.5 * rate * jump)[:, None] * rays
        area = area + (0.5 * rate * gained)[:, None] * rays
    rim, index = torch.unique(piece, return_inverse=True)
    levers = torch.cat([total, area], -1)
    levers = levers.new_zeros(len(rim), 6).index_add(0, index, levers)
    # Of the cells at a piece any one knows its square.
    squares_of_rims = torch.empty_like(rim).index_put((index,), square)
    return Rims(
        square=squares_of_rims,
        border=pieces.line[rim],
        total_lever=levers[:, :3],
        area_lever=levers[:, 3:],
    )


def _moments(cells: Cells) -> tuple[Tensor, ...]:
    """Integrals over each cell of 1, x, y, x^2, x y and y^2."""
    start, end = cells.y.unbind(1)
    height = end - start
    sums: list[Tensor] = []
    for share in SHARES:
        y = start + share * height
        left = cells.left[:, 0] + share * (cells.left[:, 1] - cells.left[:, 0])
        right = cells.right[:, 0] + share * (cells.right[:, 1] - cells.right[:, 0])
        width, middle = right - left, 0.5 * (left + right)
        weight = 0.5 * height * width
        square = middle * middle + width * width / 12.0
        terms = [weight, weight * middle, weight * y, weight * square]
        terms += [weight * middle * y, weight * y * y]
        sums = [a + b for a, b in zip(sums, terms, strict=True)] if sums else terms
    return tuple(sums)
