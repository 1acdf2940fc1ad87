"""Regions: what each face fills of a square; and the rims along which regions meet at a jump."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor
from torchcal.render.cells import Cells
from torchcal.render.facets import Facets, Hits, RayTurns, Spread, dot
from torchcal.render.pieces import Pieces
from torchcal.render.silhouette import Borders
from torchcal.render.squares import Squares

SHARES = (0.5 - 12**-0.5, 0.5 + 12**-0.5)
"""Gauss's points of a span from 0 to 1, each of weight 1/2: exact to the third order."""


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
    spread: Spread


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


def shows_several(
    cells: Cells, face: Int[Tensor, " cell"], squares: int
) -> Bool[Tensor, " square"]:
    """The squares in which more than one face is seen."""
    other = (face[1:] != face[:-1]) & (cells.square[1:] == cells.square[:-1])
    several = torch.zeros(squares, dtype=torch.bool, device=face.device)
    several[cells.square[1:][other]] = True
    return several


def regions_of(cells: Cells, face: Int[Tensor, " cell"]) -> Regions:
    """Joins neighbouring cells that show the same face."""
    begins = torch.ones_like(face, dtype=torch.bool)
    begins[1:] = (cells.square[1:] != cells.square[:-1]) | (face[1:] != face[:-1])
    first, region = torch.nonzero(begins)[:, 0], begins.cumsum(0) - 1
    moments = torch.stack(_moments(cells), -1)
    moments = moments.new_zeros(len(first), 6).index_add(0, region, moments)
    area, x, y, xx, xy, yy = moments.unbind(-1)
    filled = area > 0
    safe = torch.where(filled, area, 1.0)
    x, y, xx, xy, yy = (each / safe for each in (x, y, xx, xy, yy))
    return Regions(
        square=cells.square[first],
        face=face[first].where(filled, -1),
        area=area,
        centroid=torch.stack([x, y], -1),
        spread=Spread(uu=(xx - x * x)[:, None], uv=(xy - x * y)[:, None], vv=(yy - y * y)[:, None]),
    )


def range_of_regions(
    regions: Regions,
    squares: Squares,
    vertices: Float[Tensor, "vertex 3"],
    surface: Surface,
    projection: Projection,
) -> Hits:
    """The mean ranges of regions, and their derivatives."""
    u = (squares.u[regions.square] + regions.centroid[:, 0]).to(vertices)
    v = (squares.v[regions.square] + regions.centroid[:, 1]).to(vertices)
    spread = Spread(
        uu=regions.spread.uu.to(u), uv=regions.spread.uv.to(u), vv=regions.spread.vv.to(u)
    )
    facets = Facets.of(vertices, surface.faces[regions.face.clamp(min=0)])
    index = torch.arange(len(u), device=u.device).where(regions.face >= 0, -1)
    to_u, to_v = projection.ray_derivatives(u, v)
    turns = RayTurns(to_u=to_u, to_v=to_v, curved=projection.ray_curvatures(u, v))
    return facets.at(index, projection.rays(u, v)).averaged(spread, turns)


def rims_of(
    cells: Cells,
    face: Int[Tensor, " cell"],
    pieces: Pieces,
    squares: Squares,
    vertices: Float[Tensor, "vertex 3"],
    surface: Surface,
    borders: Borders,
    sensor: Sensor,
) -> Rims:
    """The rims between cells of different faces.

    Args:
        cells: All cells.
        face: What is seen in them.
        pieces: Their sides.
        squares: Where they are.
        vertices: Points (m) in the sensor's frame of their view.
        surface: The triangles of all views.
        borders: The lines that they are parts of; all others are seams.
        sensor: Its optics, and its limits beyond which there is no return.
    """
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
    projection, limits = sensor.projection, (sensor.near, sensor.far)
    to_u, to_v = dot(m, squares.along_u[square]), dot(m, squares.along_v[square])
    # How far the left cell's area reaches beyond the line when m . ray rises by 1.
    rate = -delta.square().sum(-1) / (to_u * delta[:, 1] - to_v * delta[:, 0])
    total, area = torch.zeros_like(m), torch.zeros_like(m)
    planes = [Facets.of(vertices, surface.faces[face[k].clamp(min=0)]) for k in (left, left + 1)]
    own = torch.arange(len(left), device=left.device)
    own = [own.where(face[k] >= 0, -1) for k in (left, left + 1)]
    u, v = squares.u[square], squares.v[square]
    for share in SHARES:
        x, y = (start + share * delta).unbind(-1)
        true_rays, rays = projection.rays(u + x, v + y), squares.rays(square, x, y)
        hits = [
            plane.at(k, true_rays).between(*limits) for plane, k in zip(planes, own, strict=True)
        ]
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
