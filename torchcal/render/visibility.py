"""The hard z-buffer: which face every pixel's central ray meets first.

It answers with indices only; ranges and derivatives are then closed forms of the faces' planes
(``facets.py``), so nothing here needs to be differentiable.
"""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection, Spherical
from torchcal.render.facets import Facets

TILE = 16
"""Side (pixels) of the tiles that large faces are culled by."""
DIRECT = 256
"""Faces whose box has at most this many pixels are tested pixel by pixel, without tiles."""
PAIRS = 1 << 22
"""Pairs of a face and a pixel that are tested at a time: it bounds the memory."""
EMPTY = torch.iinfo(torch.int64).max
"""What the z-buffer holds where no face was entered."""
CLOSE = 1e-6
"""Corners nearer than this (m) to a pinhole's plane do not bound their face in the image."""
MARGIN = 1e-3
"""Pixels by which rounding may move a face in a pinhole's image."""
SPREAD, SLOPE = 0.3, 4.0
"""Longest side (chord of the unit sphere) and steepest elevation (its tangent) of faces that the
box of their corners bounds in a spherical image."""


def visible_faces(
    vertices: Float[Tensor, "view vertex 3"], faces: Int[Tensor, "face 3"], projection: Projection
) -> Int[Tensor, "view h w"]:
    """The index of the face that each pixel's central ray meets first; -1 where there is none.

    Args:
        vertices: Points (m) in the sensor's frame of each view.
        faces: Vertices of each triangle; both sides of a face are seen.
        projection: The sensor's optics.
    """
    return torch.stack([_visible_faces_of_view(v, faces, projection) for v in vertices])


def _visible_faces_of_view(vertices: Tensor, faces: Tensor, projection: Projection) -> Tensor:
    box = _pixel_boxes(vertices[faces], projection)
    area = (box[:, 2:] - box[:, :2]).clamp(min=0).prod(-1)
    test = _FaceTest.of(vertices, faces, projection)
    size = projection.height * projection.width
    buffer = torch.full((size,), EMPTY, dtype=torch.int64, device=vertices.device)
    small = torch.nonzero((area > 0) & (area <= DIRECT))[:, 0]
    large = torch.nonzero(area > DIRECT)[:, 0]
    _fill(buffer, test, small, box[small])
    for tiles in _tiles_of_boxes(large, box[large], test).split(PAIRS // TILE**2):
        _fill(buffer, test, tiles[:, 0], tiles[:, 1:])
    face = torch.where(buffer == EMPTY, -1, buffer & 0xFFFFFFFF)
    return face.view(projection.height, projection.width)


@dataclass(frozen=True, kw_only=True, slots=True)
class _FaceTest:
    """Ray against triangle by homogeneous edge functions; faces may pass behind the sensor."""

    projection: Projection
    facets: Facets
    edge: Float[Tensor, "face 3 3"]
    """Normals of the planes through the sensor and each side, towards the inside of the face."""

    @staticmethod
    def of(vertices: Tensor, faces: Tensor, projection: Projection) -> "_FaceTest":
        facets = Facets.of(vertices, faces)
        start, end = faces, faces.roll(-1, 1)
        # Both faces of an edge take its vertices in the same order, so no ray slips between them.
        first, last = vertices[torch.minimum(start, end)], vertices[torch.maximum(start, end)]
        edge = torch.linalg.cross(first, last - first)
        flip = torch.where(start < end, 1.0, -1.0).to(vertices) * facets.offset.sign()[:, None]
        return _FaceTest(projection=projection, facets=facets, edge=edge * flip[..., None])

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


def _pixel_boxes(corners: Tensor, projection: Projection) -> Tensor:
    """Half-open boxes (u0, v0, u1, v1) of pixel centres that each face may cover."""
    pixels = projection.pixels(corners)
    if isinstance(projection, Spherical):
        margin, bounded = _spherical_bounds(corners, projection)
        hidden = torch.zeros_like(bounded)
    else:
        margin, bounded = MARGIN, (corners[..., 2] > CLOSE).all(-1)
        hidden = (corners[..., 2] <= 0).all(-1)
    hidden = hidden | ~corners.isfinite().flatten(1).all(-1)
    size = torch.tensor([projection.width, projection.height], device=corners.device).to(pixels)
    low = torch.where(bounded[:, None], (pixels.amin(1) - margin).ceil(), 0.0)
    high = torch.where(bounded[:, None], (pixels.amax(1) + margin).floor() + 1, size)
    low = torch.minimum(low.nan_to_num(0.0).clamp(min=0), size).long()
    high = torch.minimum(high.nan_to_num(0.0).clamp(min=0), size).long()
    return torch.cat([low, torch.where(hidden[:, None], low, high)], -1)


def _spherical_bounds(corners: Tensor, projection: Spherical) -> tuple[Tensor, Tensor]:
    """Margin (pixels) by which sides bulge, and whether the box of the corners bounds a face."""
    ray = torch.nn.functional.normalize(corners, dim=-1)
    sides = ray - ray.roll(1, 1)
    spread = sides.norm(dim=-1).amax(-1)
    height = ray[..., 1].abs()
    slope = (height / (1 - height.square()).clamp(min=1e-9).sqrt()).amax(-1)
    step = min(abs(projection.azimuth_step), abs(projection.elevation_step)) or 1.0
    margin = spread.square() * (1 + slope) / step + 0.5
    x, z = corners[..., 0], corners[..., 2]
    over_seam = (z < 0).any(-1) & (x.amin(-1) * x.amax(-1) < 0)
    return margin[:, None], (spread < SPREAD) & (slope < SLOPE) & ~over_seam


def _tiles_of_boxes(face: Tensor, box: Tensor, test: _FaceTest) -> Tensor:
    """Rows (face, u0, v0, u1, v1): the tiles of each box into which its face may reach."""
    first, last = box[:, :2] // TILE, (box[:, 2:] + TILE - 1) // TILE
    item, u, v = _cells(first, last)
    low = torch.stack([u, v], -1) * TILE
    high = torch.minimum(low + TILE, box[item, 2:])
    low = torch.maximum(low, box[item, :2])
    axis, sine = _cones(low, high, test)
    keep = test.may_touch(face[item], axis, sine)
    return torch.cat([face[item, None], low, high], -1)[keep]


def _cones(low: Tensor, high: Tensor, test: _FaceTest) -> tuple[Tensor, Tensor]:
    """Unit axes and sines of the half-angles of the cones about the centres of some pixels."""
    normalize = torch.nn.functional.normalize
    low, high = low.to(test.edge), high.to(test.edge) - 1
    middle = 0.5 * (low + high)
    axis = normalize(test.projection.rays(middle[:, 0], middle[:, 1]), dim=-1)
    corners = [(a[:, 0], b[:, 1]) for a in (low, high) for b in (low, high)]
    rays = torch.stack([normalize(test.projection.rays(u, v), dim=-1) for u, v in corners], 1)
    chord = (rays - axis[:, None]).norm(dim=-1).amax(-1)
    return axis, (1.05 * chord).clamp(max=1.0) + 1e-6


def _fill(buffer: Tensor, test: _FaceTest, face: Tensor, box: Tensor) -> None:
    """Enters the faces into the z-buffer at all pixels of their boxes."""
    count = (box[:, 2:] - box[:, :2]).prod(-1)
    for part in _parts(count):
        item, u, v = _cells(box[part, :2], box[part, 2:])
        index = face[part][item]
        rays = test.projection.rays(u.to(test.edge), v.to(test.edge))
        t = test.ranges(index, rays)
        met = t.isfinite()
        # Positive floats sort like their bits: one number holds the range and, for ties, the face.
        key = (t[met].float().view(torch.int32).long() << 32) | index[met]
        pixel = (v * test.projection.width + u)[met]
        buffer.scatter_reduce_(0, pixel, key, "amin")


def _cells(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """All cells (item, column, row) of boxes from ``first`` to before ``last``."""
    extent = last - first
    count = extent.prod(-1)
    item = torch.repeat_interleave(count)
    order = torch.arange(len(item), device=count.device) - (count.cumsum(0) - count)[item]
    columns = extent[item, 0]
    return item, first[item, 0] + order % columns, first[item, 1] + order // columns


def _parts(count: Tensor) -> list[slice]:
    """Slices of the items that hold about ``PAIRS`` pairs each."""
    group = count.cumsum(0) // PAIRS
    sizes = torch.unique_consecutive(group, return_counts=True)[1].tolist()
    ends = list(itertools.accumulate(sizes))
    return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
