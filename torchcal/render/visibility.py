"""The hard z-buffer: which face every pixel's central ray meets first.

It answers with indices only; depths and derivatives are then closed forms of the faces' planes
(``faces.py``), so nothing here needs to be differentiable.
"""

import itertools

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection, Spherical

TILE = 16
"""Side (pixels) of the tiles that large faces are culled by."""
DIRECT = 256
"""Faces whose box has at most this many pixels are tested pixel by pixel, without tiles."""
PAIRS = 1 << 22
"""Pairs of a face and a pixel that are tested at a time: it bounds the memory."""
EMPTY = torch.iinfo(torch.int64).max


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


def _visible_faces_of_view(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], projection: Projection
) -> Int[Tensor, "h w"]:
    corners = vertices[faces]
    box = _pixel_boxes(corners, projection)
    extent = (box[:, 2:] - box[:, :2]).clamp(min=0)
    area = extent.prod(-1)
    test = _FaceTest(vertices, faces, projection)
    buffer = torch.full(
        (projection.height * projection.width,), EMPTY, dtype=torch.int64, device=vertices.device
    )
    small = torch.nonzero((area > 0) & (area <= DIRECT))[:, 0]
    large = torch.nonzero(area > DIRECT)[:, 0]
    _fill(buffer, test, small, box[small])
    for tiles in _chunks(_tiles_of_boxes(large, box[large], test), PAIRS // TILE**2):
        _fill(buffer, test, tiles[:, 0], tiles[:, 1:])
    face = torch.where(buffer == EMPTY, -1, buffer & 0xFFFFFFFF)
    return face.view(projection.height, projection.width)


class _FaceTest:
    """Ray against triangle by homogeneous edge functions: also right behind the sensor."""

    def __init__(self, vertices: Tensor, faces: Tensor, projection: Projection):
        self.projection = projection
        self.corners = vertices[faces]
        v0, v1, v2 = self.corners.unbind(1)
        self.normal = torch.linalg.cross(v1 - v0, v2 - v0)
        self.offset = (self.normal * v0).sum(-1)
        start, end = faces, faces.roll(-1, 1)
        # Both faces of an edge take its vertices in the same order, so no ray slips between them.
        first, last = vertices[torch.minimum(start, end)], vertices[torch.maximum(start, end)]
        edge = torch.linalg.cross(first, last - first)
        flip = torch.where(start < end, 1.0, -1.0).to(vertices) * self.offset.sign()[:, None]
        self.edge = edge * flip[..., None]

    def ranges(self, face: Tensor, rays: Tensor) -> Tensor:
        """Range (m) at which each ray meets its face; infinite where it does not."""
        inside = ((self.edge[face] * rays[:, None]).sum(-1) >= 0).all(-1)
        t = self.offset[face] / (self.normal[face] * rays).sum(-1)
        return torch.where(inside & (t > 0), t, torch.inf)

    def may_touch(self, face: Tensor, axis: Tensor, sine: Tensor) -> Tensor:
        """Whether a face may reach into a cone about a unit axis with this sine of half-angle."""
        edge = self.edge[face]
        reach = (edge * axis[:, None]).sum(-1) + edge.norm(dim=-1) * sine[:, None]
        return (reach >= 0).all(-1)


def _pixel_boxes(corners: Tensor, projection: Projection) -> Tensor:
    """Half-open boxes (u0, v0, u1, v1) of pixel centres that each face may cover."""
    pixels = projection.pixels(corners)
    margin, regular, empty = _regularity(corners, projection)
    full = torch.tensor([[projection.width, projection.height]], device=corners.device)
    low = torch.where(regular[:, None], (pixels.amin(1) - margin).ceil(), 0.0)
    high = torch.where(regular[:, None], (pixels.amax(1) + margin).floor() + 1, full.to(low))
    low = torch.minimum(low.nan_to_num(0.0).clamp(min=0), full.to(low)).long()
    high = torch.minimum(high.nan_to_num(0.0).clamp(min=0), full.to(high)).long()
    return torch.cat([low, torch.where(empty[:, None], low, high)], -1)


def _regularity(corners: Tensor, projection: Projection) -> tuple[Tensor, Tensor, Tensor]:
    """Margin (pixels) of a face's box, whether the box of its corners bounds it, whether it is unseen."""
    bad = ~corners.isfinite().all(-1).all(-1)
    if isinstance(projection, Spherical):
        ray = torch.nn.functional.normalize(corners, dim=-1)
        spread = torch.stack([(ray[:, i] - ray[:, i - 1]).norm(dim=-1) for i in range(3)]).amax(0)
        slope = ray[..., 1].abs().amax(-1) / (1 - ray[..., 1].square()).clamp(min=1e-9).sqrt().amin(-1)
        step = min(abs(projection.azimuth_step), abs(projection.elevation_step)) or 1.0
        margin = spread.square() * (1 + slope) / step + 0.5
        seam = (corners[..., 2] < 0).any(-1) & (corners[..., 0].amin(-1) * corners[..., 0].amax(-1) < 0)
        return margin[:, None], (spread < 0.3) & (slope < 4.0) & ~seam, bad
    z = corners[..., 2]
    margin = torch.full_like(z[:, :1], 1e-3)
    return margin, (z > 1e-6).all(-1), bad | (z <= 0).all(-1)


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
    item = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    order = torch.arange(len(item), device=count.device) - (count.cumsum(0) - count)[item]
    columns = extent[item, 0]
    return item, first[item, 0] + order % columns, first[item, 1] + order // columns


def _parts(count: Tensor) -> list[slice]:
    """Slices of the items that hold about ``PAIRS`` pairs each."""
    group = count.cumsum(0) // PAIRS
    sizes = torch.unique_consecutive(group, return_counts=True)[1].tolist()
    ends = list(itertools.accumulate(sizes))
    return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]


def _chunks(rows: Tensor, size: int) -> tuple[Tensor, ...]:
    return rows.split(max(size, 1)) if len(rows) else ()
