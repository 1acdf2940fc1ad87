"""Silhouettes: where they are found, and that they share pixels by their exact area."""

import math

import pytest
import torch
from scenes import (
    CAMERA,
    LIDAR,
    at_rest,
    ball,
    box,
    sensor_of,
    sheet,
    surface_of,
    wall,
)
from torch import Tensor

from torchcal.geometry.projection import Pinhole, Projection
from torchcal.model.scene import Surface
from torchcal.render.crossings import Crossings, find_crossings
from torchcal.render.facets import Facets
from torchcal.render.synthesis import synthesise
from torchcal.render.visibility import visible_faces

SQUARE = Pinhole(width=24, height=24, fx=30.0, fy=30.0, cx=11.5, cy=11.5)
NEAR, FAR = 2.0, 5.0


def crossings_of(surface: Surface, projection: Projection) -> Crossings:
    face = visible_faces(surface.vertices[None], surface.faces, projection)
    facets = Facets.of(surface.vertices, surface.faces)
    return find_crossings(surface.vertices, surface, facets, face, projection)


def half_plane(angle: float, offset: float) -> Surface:
    """Covers the pixels with cos(angle) u + sin(angle) v < offset, from the image's middle."""
    cos, sin = math.cos(angle), math.sin(angle)
    scale = NEAR / SQUARE.fx
    along, across = torch.tensor([(-sin, cos), (cos, sin)], dtype=torch.float64)
    corners = [(offset, -90.0), (offset, 90.0), (-90.0, 90.0), (-90.0, -90.0)]
    points = [scale * (a * across + b * along) for a, b in corners]
    near = sheet(*[(float(p[0]), float(p[1]), NEAR) for p in points])
    return surface_of(near, wall(FAR))


def share_of_near(surface: Surface) -> Tensor:
    ranges = synthesise(surface, at_rest(surface), sensor_of(SQUARE, 1)).range
    return (FAR - ranges) / (FAR - NEAR)


def covered_rows(angle: float, offset: float) -> Tensor:
    """Exact length of each row of pixel centres, within the image, that a half plane covers."""
    middle = 11.5
    v = torch.arange(24, dtype=torch.float64) - middle
    edge = (offset - math.sin(angle) * v) / math.cos(angle)
    left = (edge + middle + 0.5).clamp(0, 24)
    return left if math.cos(angle) > 0 else 24 - left


@pytest.mark.parametrize("angle_deg", [0.0, 7.0, 23.0, -38.0, 44.0, 155.0, 171.0])
@pytest.mark.parametrize("offset", [-3.37, 0.0, 0.18, 0.5, 2.91])
def test_every_row_of_a_steep_edge_has_the_exact_area(angle_deg: float, offset: float):
    angle = math.radians(angle_deg)
    rows = share_of_near(half_plane(angle, offset)).sum(1)
    inner = slice(1, -1)  # near the border of rows an edge may leave the image sideways
    expected = covered_rows(angle, offset)
    crosses = (expected > 1) & (expected < 23)
    assert crosses[inner].sum() > 5
    torch.testing.assert_close(rows[crosses], expected[crosses], atol=1e-6, rtol=0)


@pytest.mark.parametrize("offset", [-3.37, 0.0, 2.91])
def test_every_column_of_a_flat_edge_has_the_exact_area(offset: float):
    columns = share_of_near(half_plane(math.radians(70.0), offset)).sum(0)
    turned_rows = covered_rows(math.radians(20.0), offset)
    torch.testing.assert_close(columns, turned_rows, atol=1e-6, rtol=0)


def test_an_upright_edge_shares_the_pixel_that_it_cuts():
    share = share_of_near(half_plane(0.0, 0.2))
    row = torch.tensor([1.0] * 12 + [0.2] + [0.0] * 11, dtype=torch.float64)
    torch.testing.assert_close(share, row.expand(24, 24), atol=1e-9, rtol=0)


def test_edges_at_random_places_are_not_biased(rng: torch.Generator):
    count, errors = 60, []
    for turn, shift in torch.rand(count, 2, generator=rng, dtype=torch.float64).tolist():
        angle, offset = math.radians(88.0 * turn - 44.0), 6.0 * shift - 3.0
        share = share_of_near(half_plane(angle, offset))[6:18]
        errors.append(share.sum() - covered_rows(angle, offset)[6:18].sum())
    assert abs(torch.stack(errors).mean()) < 1e-6  # pixels of area: exact but for rounding


def test_the_area_of_a_small_square_is_right_in_the_mean(rng: torch.Generator):
    errors, side = [], 7.3
    for x, y, turn in torch.rand(40, 3, generator=rng, dtype=torch.float64).tolist():
        scale, half = NEAR / SQUARE.fx, side / 2
        cos, sin = math.cos(turn), math.sin(turn)
        corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
        placed = [(cos * a - sin * b + x, sin * a + cos * b + y) for a, b in corners]
        near = sheet(*[(scale * a, scale * b, NEAR) for a, b in placed])
        errors.append(share_of_near(surface_of(near, wall(FAR))).sum() - side**2)
    errors = torch.stack(errors)
    # Corners are off by some hundredths of a pixel each, with either sign.
    assert errors.abs().max() < 1.0
    assert abs(errors.mean()) < 4.0 * errors.std() / len(errors) ** 0.5 + 0.02


def test_the_border_of_an_open_mesh_before_nothing_shares_the_area():
    surface = surface_of(
        sheet((-1.0, -2.0, NEAR), (0.017, -2.0, NEAR), (0.017, 2.0, NEAR), (-1.0, 2.0, NEAR))
    )
    synthesis = synthesise(surface, at_rest(surface), sensor_of(SQUARE, 1))
    edge = 0.017 / NEAR * SQUARE.fx + 12.0  # from the left border of the image
    expected = (edge - torch.arange(24, dtype=torch.float64)).clamp(0, 1).expand(24, 24)
    torch.testing.assert_close(synthesis.coverage, expected, atol=1e-9, rtol=0)
    met = synthesis.range.isfinite()
    assert torch.equal(met, expected > 0)
    assert (synthesis.range[met] - NEAR).abs().max() < 1e-9


@pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
def test_a_flat_face_of_many_triangles_has_no_crossings(projection: Projection):
    tiled = box((6.0, 6.0, 6.0), (0.0, 0.0, 0.0)).subdivide().subdivide()
    assert len(crossings_of(surface_of(tiled), projection).gap) == 0


def test_silhouettes_behind_another_surface_are_not_seen():
    surface = surface_of(wall(1.5), ball(0.5, (0.0, 0.0, 3.0)))
    assert len(crossings_of(surface, CAMERA).gap) == 0


@pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
def test_gaps_are_within_half_a_pixel_and_steps_are_of_one(projection: Projection):
    found = crossings_of(surface_of(wall(5.0), ball(0.6, (0.1, 0.0, 3.0))), projection)
    assert len(found.gap) > 20
    assert (found.gap >= 0).all()
    assert (found.gap <= 0.5).all()
    assert (found.step.abs().sum(-1) == 1).all()
    assert (found.body == 1).all()


def test_two_bodies_that_end_together_count_once():
    """A second sheet a little behind the first one has its silhouette in the same strip."""
    edge = 0.013
    first, second = (
        sheet((-3.0, -3.0, z), (x, -3.0, z), (x, 3.0, z), (-3.0, 3.0, z))
        for z, x in ((NEAR, edge), (1.01 * NEAR, 1.01 * edge - 0.001))
    )
    one, both = (share_of_near(surface_of(*near, wall(FAR))) for near in ([first], [first, second]))
    torch.testing.assert_close(both, one)
