"""Which elements of a model a sensor sees from a pose, and as what (3.1 (2)).

The caller casts the rays: an image that says which triangle each pixel's centre meets.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.projection import Projection, pixel_grid
from torchcal.match.features import LineKind, Lines
from torchcal.match.model.features import ModelFeatures
from torchcal.match.model.line_places import BESIDE, Places, places_along

GAP = 4
"""Places in a row that are not seen part a line into pieces."""
INVISIBLE = -1
"""In place of a ``LineKind``: not seen at all."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SeenLines:
    """How a sensor sees lines: some not at all, some in several pieces."""

    pixels: Float[Tensor, " line"]
    """Length in the image of all that is seen of each line."""
    kind: Int[Tensor, " line"]
    """A ``LineKind`` as most of it is seen; -1: not at all."""
    piece_line: Int[Tensor, " piece"]
    """The line that each piece without a gap is of."""
    piece_pixels: Float[Tensor, " piece"]
    piece_kind: Int[Tensor, " piece"]
    piece_ends: Float[Tensor, "piece 2 3"]
    """The first and the last place that is seen (m, world)."""
    piece_is_end: Bool[Tensor, "piece 2"]
    """Whether the line itself ends there."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Seen:
    """What a sensor sees of a model from one pose."""

    lines: SeenLines
    limbs: SeenLines
    plane_area: Float[Tensor, " plane"]
    """m^2 of each plane."""
    plane_pixels: Int[Tensor, " plane"]


def visible(
    model: ModelFeatures,
    T_world_sensor: Float[Tensor, "4 4"],
    projection: Projection,
    face: Int[Tensor, "h w"],
    *,
    jump: float,
) -> Seen:
    """What is seen of each element.

    A line is seen as a crease where the places beside it show both of its surfaces, and as a jump
    where one shows the nearer surface and the other what is farther by ``jump`` or nothing.

    Args:
        model: In the world's frame.
        T_world_sensor: Where the sensor is.
        projection: Its optics.
        face: The triangle that each pixel's centre meets; -1 for none.
        jump: The least step of the range (m).
    """
    T_sensor_world = se3.inverse(T_world_sensor)
    view = _View.of(model, T_sensor_world, projection, face)
    area, pixels = _seen_planes(model, view)
    lines, limbs = (
        places_along(se3.transform(T_sensor_world, part.ends), projection)
        for part in (model.features.lines, model.limbs)
    )
    states = _line_states(lines, model.line_regions, view, jump)
    limb_states = _limb_states(limbs, model, view, jump)
    return Seen(
        lines=_seen_lines(model.features.lines, lines, states, T_world_sensor),
        limbs=_seen_lines(model.limbs, limbs, limb_states, T_world_sensor),
        plane_area=area,
        plane_pixels=pixels,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class _View:
    """Images of what the sensor sees, and where it stands."""

    T_sensor_world: Tensor
    projection: Projection
    face: Tensor
    region: Tensor
    """The region in each pixel; -2 where nothing is."""
    normal: Tensor
    """Of each pixel's plane n p = d, in the sensor's frame."""
    offset: Tensor
    """d (m)"""

    @staticmethod
    def of(
        model: ModelFeatures, T_sensor_world: Tensor, projection: Projection, face: Tensor
    ) -> "_View":
        corners = se3.transform(T_sensor_world, model.triangles)
        one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normal = torch.nn.functional.normalize(torch.linalg.cross(one, two), dim=-1)
        return _View(
            T_sensor_world=T_sensor_world,
            projection=projection,
            face=face,
            region=torch.where(face >= 0, model.face_region[face], -2),
            normal=normal[face],
            offset=(normal * corners[:, 0]).sum(-1)[face],
        )

    def look(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """The region that pixels (u, v) show and its range; -2 and infinite where nothing is."""
        u, v = pixels.unbind(-1)
        column = u.round().long().clamp(0, self.projection.width - 1)
        row = v.round().long().clamp(0, self.projection.height - 1)
        region = self.region[row, column]
        facing = (self.normal[row, column] * self.projection.rays(u, v)).sum(-1)
        range_ = self.offset[row, column] / facing
        nothing = (region < 0) | ~(range_ > 0.0)
        return region, torch.where(nothing, torch.inf, range_)


def _seen_planes(model: ModelFeatures, view: _View) -> tuple[Tensor, Tensor]:
    """Area (m^2) and pixels of each plane: a pixel's is d^2 |r (r_u x r_v)| / |n r|^3."""
    count = model.features.planes.area.shape[0]
    plane = torch.where(view.face >= 0, model.face_plane[view.face], -1)
    u, v = pixel_grid(view.projection, dtype=view.offset.dtype, device=view.offset.device)
    rays = view.projection.rays(u, v)
    along_u, along_v = view.projection.ray_derivatives(u, v)
    solid = (rays * torch.linalg.cross(along_u, along_v)).sum(-1).abs()
    facing = (view.normal * rays).sum(-1).abs()
    area = view.offset.square() * solid / facing**3
    seen = plane >= 0
    total = torch.zeros(count).to(area).index_add(0, plane[seen], area[seen])
    return total, plane[seen].bincount(minlength=count)


def _seen_lines(
    lines: Lines, places: Places, states: tuple[Tensor, Tensor], T_world_sensor: Tensor
) -> SeenLines:
    crease, edge = states
    count = len(lines.kind)
    pixels, is_jump = _lengths(places, crease, edge, places.line, count)
    kind = torch.where(is_jump, LineKind.JUMP.value, lines.kind)
    piece = _pieces(places, crease | edge)
    first, last = _borders(piece)
    of = places.line[first]
    piece_pixels, piece_is_jump = _lengths(places, crease, edge, piece, len(first))
    steps = places.line.bincount(minlength=count)[of].clamp(min=1)
    reach = GAP / steps
    ends = se3.transform(T_world_sensor, places.point[torch.stack([first, last], 1)])
    is_end = torch.stack([places.share[first] < reach, places.share[last] > 1.0 - reach], 1)
    return SeenLines(
        pixels=pixels,
        kind=torch.where(pixels > 0.0, kind, INVISIBLE),
        piece_line=of,
        piece_pixels=piece_pixels,
        piece_kind=torch.where(piece_is_jump, LineKind.JUMP.value, lines.kind[of]),
        piece_ends=ends,
        piece_is_end=is_end & lines.is_end[of],
    )


def _lengths(
    places: Places, crease: Tensor, edge: Tensor, group: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """Pixels that are seen of each group of places (-1: of none), and whether mostly as a jump."""
    rows = group >= 0
    as_crease, as_jump = (
        torch.zeros(count).to(places.step).index_add(0, group[rows], (places.step * state)[rows])
        for state in (crease, edge)
    )
    return as_crease + as_jump, as_jump > as_crease


def _pieces(places: Places, seen: Tensor) -> Tensor:
    """The number of the piece that each place is in; -1 where it is not seen."""
    rows = seen.nonzero()[:, 0]
    begins = torch.ones_like(rows, dtype=torch.bool)
    begins[1:] = (rows.diff() > GAP) | (places.line[rows].diff() != 0)
    return torch.full_like(places.line, -1).index_put((rows,), begins.cumsum(0) - 1)


def _borders(piece: Tensor) -> tuple[Tensor, Tensor]:
    """The first and the last place of each piece."""
    rows = (piece >= 0).nonzero()[:, 0]
    begins = torch.ones_like(rows, dtype=torch.bool)
    begins[1:] = piece[rows].diff() != 0
    ends = torch.ones_like(begins)
    ends[:-1] = begins[1:]
    return rows[begins], rows[ends]


def _line_states(
    places: Places, regions: Tensor, view: _View, jump: float
) -> tuple[Tensor, Tensor]:
    """Where lines are seen as creases, and where as jumps."""
    own = regions[places.line]
    (left, left_range), (right, right_range) = _beside(places, view)
    inside = places.step > 0.0
    left_is, right_is = left[:, None] == own, right[:, None] == own
    crease = (left_is & right_is.flip(1)).any(1)
    edge = _jumps(left_is.any(1), right_is.any(1), right_range - left_range, jump)
    return crease & inside, edge & inside


def _limb_states(
    places: Places, model: ModelFeatures, view: _View, jump: float
) -> tuple[Tensor, Tensor]:
    """Nowhere, and where curved surfaces turn away: the next facet faces the other way."""
    regions = model.limb_regions[places.line]
    normal = model.region_normal[regions] @ view.T_sensor_world[:3, :3].mT
    facing = (normal * places.point[:, None]).sum(-1) < 0.0
    (left, left_range), (right, right_range) = _beside(places, view)
    patch = torch.cat([model.region_patch, model.region_patch.new_tensor([-1, -1])])
    own = patch[regions[:, 0]]
    edge = _jumps(patch[left] == own, patch[right] == own, right_range - left_range, jump)
    turns = facing[:, 0] != facing[:, 1]
    return torch.zeros_like(edge), edge & turns & (places.step > 0.0)


def _beside(places: Places, view: _View) -> list[tuple[Tensor, Tensor]]:
    """Regions and ranges on both sides."""
    return [view.look(places.pixel + side * BESIDE * places.across) for side in (1.0, -1.0)]


def _jumps(left_own: Tensor, right_own: Tensor, deeper: Tensor, jump: float) -> Tensor:
    """Where one side is the line's own surface and the other, the farther one, is not."""
    return (left_own & ~right_own & (deeper > jump)) | (right_own & ~left_own & (-deeper > jump))
