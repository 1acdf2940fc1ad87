"""The hard z-buffer by tensor operations, on any device; machine code is checked against it.

The views of a batch are one soup: face ``f`` of view ``k`` is face ``k * faces + f`` of the soup,
and so are the vertices and the pixels.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.render.boxes import pixel_boxes, tile_cones, tiles_of_points
from torchcal.render.facets import Facets
from torchcal.render.soup import Views
from torchcal.render.squares import TILE, Squares, spread

DIRECT = 256
"""Faces whose box has at most this many pixels are tested pixel by pixel, without tiles."""
PAIRS = 1 << 20
"""Pairs of a face and a pixel, and faces, that are handled at a time: it bounds the memory."""
EMPTY = torch.iinfo(torch.int64).max
"""What the z-buffer holds where no face was entered."""


def visible_faces(
    vertices: Float[Tensor, "view vertex 3"], faces: Int[Tensor, "face 3"], projection: Projection
) -> Int[Tensor, "view h w"]:
    """As ``visibility.visible_faces``."""
    views = max(1, PAIRS // max(len(faces), 1))
    parts = [_seen(part, faces, projection) for part in vertices.split(views)]
    return torch.cat(parts) if parts else faces.new_zeros(0, projection.height, projection.width)


def _seen(vertices: Tensor, faces: Tensor, projection: Projection) -> Tensor:
    box = pixel_boxes(vertices, faces, projection).long().flatten(0, 1)
    area = (box[:, 2:] - box[:, :2]).clamp(min=0).prod(-1)
    test = _FaceTest.of(vertices, faces, projection)
    shape = (len(vertices), projection.height, projection.width)
    buffer = torch.full(shape, EMPTY, dtype=torch.int64, device=vertices.device)
    small = torch.nonzero((area > 0) & (area <= DIRECT))[:, 0]
    large = torch.nonzero(area > DIRECT)[:, 0]
    _fill(buffer, test, small, box[small])
    for tiles in _tiles_of_boxes(large, box[large], test).split(PAIRS // TILE**2):
        _fill(buffer, test, tiles[:, 0], tiles[:, 1:])
    return torch.where(buffer == EMPTY, -1, (buffer & 0xFFFFFFFF) % max(len(faces), 1))


def faces_at_points(
    views: Views,
    squares: Squares,
    square: Int[Tensor, " point"],
    rays: Float[Tensor, "point 3"],
) -> Int[Tensor, " point"]:
    """The face, of the triangles of all views, that the ray of each point meets first.

    Args:
        views: In double precision.
        squares: Pixels in which the points are.
        square: The square of each point, in their order.
        rays: The points' rays.
    """
    projection, faces = views.sensor.projection, views.own_faces
    vertices = views.vertices.view(views.count, -1, 3)
    points = tiles_of_points(squares, square, projection, views.count)
    buffer = torch.full(square.shape, EMPTY, dtype=torch.int64, device=rays.device)
    box = pixel_boxes(vertices, faces, projection).long().flatten(0, 1)
    # Points are off the centres of their pixels.
    box = torch.cat([box[:, :2] - 1, box[:, 2:] + 1], -1)
    test = _FaceTest.of(vertices, faces, projection)
    for item, u, v in _tiles_of_faces(box, projection):
        view = item // test.faces_of_view
        axis, sine = _wide_cones(u, v, test)
        first, count = points[view, v, u, 0], points[view, v, u, 1]
        near = torch.nonzero((count > 0) & test.may_touch(item, axis, sine))[:, 0]
        for part in _parts(count[near]):
            pair = near[part]
            entry, order = spread(count[pair])
            point = first[pair][entry] + order
            _enter(buffer, test, item[pair][entry], point, rays[point])
    face = (buffer & 0xFFFFFFFF) % max(len(faces), 1) + len(faces) * squares.view[square]
    return torch.where(buffer == EMPTY, -1, face)


@dataclass(frozen=True, kw_only=True, slots=True)
class _FaceTest:
    """Ray against triangle by homogeneous edge functions; faces may pass behind the sensor."""

    projection: Projection
    facets: Facets
    edge: Float[Tensor, "face 3 3"]
    """Normals of the planes through the sensor and each side, towards the inside of the face."""
    faces_of_view: int

    @staticmethod
    def of(vertices: Tensor, faces: Tensor, projection: Projection) -> "_FaceTest":
        soup = vertices.flatten(0, 1)
        views = torch.arange(len(vertices), device=faces.device)
        corners = (faces + views[:, None, None] * vertices.shape[1]).flatten(0, 1)
        facets = Facets.of(soup, corners)
        start, end = corners, corners.roll(-1, 1)
        # Both faces of an edge take its vertices in the same order, so no ray slips between them.
        first, last = soup[torch.minimum(start, end)], soup[torch.maximum(start, end)]
        edge = torch.linalg.cross(first, last - first)
        flip = torch.where(start < end, 1.0, -1.0).to(soup) * facets.offset[:-1].sign()[:, None]
        return _FaceTest(
            projection=projection,
            facets=facets,
            edge=edge * flip[..., None],
            faces_of_view=max(len(faces), 1),
        )

    def ranges(self, face: Tensor, rays: Tensor) -> Tensor:
        """Range (m) at which each ray meets its face; infinite where it does not."""
        inside = ((self.edge[face] * rays[:, None]).sum(-1) >= 0).all(-1)
        t = self.facets.offset[face] / (self.facets.normal[face] * rays).sum(-1)
        return torch.where(inside & (t > 0), t, torch.inf)

    def may_touch(self, face: Tensor, axis: Tensor, sine: Tensor) -> Tensor:
        """Whether a face may reach into a cone about a unit axis with this sine of half-angle."""
        edge = self.edge[face]
        reach = (edge * axis[:, None]).sum(-1) + edge.norm(dim=-1) * sine[:, None]
        return (reach >= 0).all(-1)


def _tiles_of_boxes(face: Tensor, box: Tensor, test: _FaceTest) -> Tensor:
    """Rows (face, u0, v0, u1, v1): the tiles of each box into which its face may reach."""
    first, last = box[:, :2] // TILE, (box[:, 2:] + TILE - 1) // TILE
    item, u, v = _cells(first, last)
    low = torch.stack([u, v], -1) * TILE
    high = torch.minimum(low + TILE, box[item, 2:])
    low = torch.maximum(low, box[item, :2])
    axis, sine = tile_cones(low, high, test.projection, test.edge)
    keep = test.may_touch(face[item], axis, sine)
    return torch.cat([face[item, None], low, high], -1)[keep]


def _tiles_of_faces(box: Tensor, projection: Projection) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """All pairs of a face and a tile (item, column, row) that its box touches, part by part."""
    size = torch.tensor([projection.width, projection.height], device=box.device)
    tiles = (size + TILE - 1) // TILE
    first = (box[:, :2].clamp(min=0) // TILE).minimum(tiles)
    last = ((box[:, 2:] + TILE - 1) // TILE).minimum(tiles).maximum(first)
    for part in _parts((last - first).prod(-1)):
        item, u, v = _cells(first[part], last[part])
        yield item + part.start, u, v


def _wide_cones(u: Tensor, v: Tensor, test: _FaceTest) -> tuple[Tensor, Tensor]:
    """The cones about all points of tiles, up to the borders of their pixels."""
    low = torch.stack([u, v], -1) * TILE
    return tile_cones(low - 1, low + TILE + 1, test.projection, test.edge)


def _fill(buffer: Tensor, test: _FaceTest, face: Tensor, box: Tensor) -> None:
    """Enters the faces into the z-buffer at all pixels of their boxes."""
    for part in _parts((box[:, 2:] - box[:, :2]).prod(-1)):
        item, u, v = _cells(box[part, :2], box[part, 2:])
        index = face[part][item]
        rays = test.projection.rays(u.to(test.edge), v.to(test.edge))
        row = (index // test.faces_of_view) * test.projection.height + v
        _enter(buffer.view(-1), test, index, row * test.projection.width + u, rays)


def _enter(buffer: Tensor, test: _FaceTest, face: Tensor, place: Tensor, rays: Tensor) -> None:
    """Enters faces into the z-buffer at single places."""
    t = test.ranges(face, rays)
    met = t.isfinite()
    # Positive floats sort like their bits: one number holds the range and, for ties, the face.
    key = (t[met].float().view(torch.int32).long() << 32) | face[met]
    buffer.scatter_reduce_(0, place[met], key, "amin")


def _cells(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """All cells (item, column, row) of boxes from ``first`` to before ``last``."""
    extent = last - first
    count = extent.prod(-1)
    item, order = spread(count)
    columns = extent[item, 0]
    return item, first[item, 0] + order % columns, first[item, 1] + order // columns


def _parts(count: Tensor) -> Iterator[slice]:
    """Slices of the items that hold about ``PAIRS`` pairs each."""
    group = count.cumsum(0) // PAIRS
    sizes = torch.unique_consecutive(group, return_counts=True)[1].tolist()
    ends = itertools.accumulate(sizes)
    return (slice(end - size, end) for size, end in zip(sizes, ends, strict=True))
