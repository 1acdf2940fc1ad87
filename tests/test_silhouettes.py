"""Silhouettes: where they are found, and that they share pixels by their exact area."""

import math

import pytest
import torch
import trimesh
from scenes import (
    at_rest,
    ball,
    box,
    sensor_of,
    sheet,
    surface_of,
    wall,
)
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.scene import Surface
from torchcal.render.synthesis import synthesise

SQUARE = Pinhole(width=24, height=24, fx=30.0, fy=30.0, cx=11.5, cy=11.5)
NEAR, FAR = 2.0, 5.0


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


@pytest.mark.parametrize("angle_deg", [7.0, 23.0, -38.0, 44.0, 155.0])
def test_every_pixel_of_a_slanted_edge_has_the_exact_area(angle_deg: float):
    """A beam of one pixel: the length of each line within the pixel, summed over 2000 lines."""
    angle, offset = math.radians(angle_deg), 0.31
    lines = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000 - 0.5
    v = torch.arange(24, dtype=torch.float64)[:, None] - 11.5 + lines
    edge = (offset - math.sin(angle) * v) / math.cos(angle) + 11.5
    left = torch.arange(24, dtype=torch.float64)[:, None, None] - 0.5
    inside = (edge - left).clamp(0, 1).mean(-1).mT
    expected = inside if math.cos(angle) > 0 else 1.0 - inside
    share = share_of_near(half_plane(angle, offset))
    torch.testing.assert_close(share, expected, atol=2e-6, rtol=0)


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


def test_the_area_of_a_small_square_is_exact(rng: torch.Generator):
    side = 7.3
    for x, y, turn in torch.rand(10, 3, generator=rng, dtype=torch.float64).tolist():
        scale, half = NEAR / SQUARE.fx, side / 2
        cos, sin = math.cos(turn), math.sin(turn)
        corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
        placed = [(cos * a - sin * b + x, sin * a + cos * b + y) for a, b in corners]
        near = sheet(*[(scale * a, scale * b, NEAR) for a, b in placed])
        share = share_of_near(surface_of(near, wall(FAR)))
        assert abs(share.sum() - side**2) < 1e-4  # of 53 pixels: squares are sheared by 1e-6


def test_a_bar_between_two_centres_is_seen():
    """From u = 11.6 to 11.9: no centre of a pixel is on it."""
    left, right = ((u - SQUARE.cx) / SQUARE.fx * NEAR for u in (11.6, 11.9))
    bar = sheet((left, -9.0, NEAR), (right, -9.0, NEAR), (right, 9.0, NEAR), (left, 9.0, NEAR))
    share = share_of_near(surface_of(bar, wall(FAR)))
    expected = torch.zeros(24, 24, dtype=torch.float64)
    expected[:, 12] = 0.3
    torch.testing.assert_close(share, expected, atol=1e-6, rtol=0)


def test_a_gap_between_two_centres_is_seen_through():
    """From u = 11.6 to 11.9, between two sheets."""
    left, right = ((u - SQUARE.cx) / SQUARE.fx * NEAR for u in (11.6, 11.9))
    sheets = [
        sheet((a, -9.0, NEAR), (b, -9.0, NEAR), (b, 9.0, NEAR), (a, 9.0, NEAR))
        for a, b in ((-9.0, left), (right, 9.0))
    ]
    share = share_of_near(surface_of(*sheets, wall(FAR)))
    expected = torch.ones(24, 24, dtype=torch.float64)
    expected[:, 12] = 0.7
    torch.testing.assert_close(share, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("turn", [0.0, 0.37])
def test_edges_of_touching_boxes_count_once(turn: float):
    """Two boxes side by side, flush at the front, are one box; so is the derivative."""
    one = [box((0.8, 0.5, 0.3), (0.0, 0.0, 2.3))]
    two = [box((0.3, 0.5, 0.3), (-0.25, 0.0, 2.3)), box((0.5, 0.5, 0.3), (0.15, 0.0, 2.3))]
    about = [se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.3, 0.2, turn], dtype=torch.float64))]
    found = []
    for boxes in (one, two):
        surface = surface_of(*boxes, wall(FAR))
        poses = at_rest(surface)
        poses[:-1] = about[0]
        motion = torch.eye(6, dtype=torch.float64).expand(len(poses), 6, 6)
        found.append(synthesise(surface, poses, sensor_of(SQUARE, 1), motion))
    torch.testing.assert_close(found[0].range, found[1].range, atol=1e-5, rtol=0)
    torch.testing.assert_close(found[0].jacobian, found[1].jacobian, atol=1e-3, rtol=0)


def test_faces_that_pass_through_one_another_divide_pixels():
    """A sheet pierces another one: the picture is that of the sheets cut at their meeting."""

    def ranges(*sheets: trimesh.Trimesh) -> Tensor:
        surface = surface_of(*sheets)
        return synthesise(surface, at_rest(surface), sensor_of(SQUARE, 1)).range

    x = 0.0137
    front = sheet((-9.0, -9.0, 2.0), (9.0, -9.0, 2.0), (9.0, 9.0, 2.0), (-9.0, 9.0, 2.0))
    slope = 0.5 / 0.7

    def leaning(a: float, b: float) -> trimesh.Trimesh:
        (p, q) = (2.0 + slope * (at - x) for at in (a, b))
        return sheet((a, -9.0, p), (b, -9.0, q), (b, 9.0, q), (a, 9.0, p))

    whole = ranges(front, leaning(x - 0.7, x + 0.7))
    cut = ranges(front, leaning(x - 0.7, x), leaning(x, x + 0.7))
    torch.testing.assert_close(whole, cut, atol=1e-6, rtol=0)


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


def test_two_bodies_that_end_together_count_once():
    """A second sheet a little behind the first one has its silhouette in the same strip."""
    edge = 0.013
    first, second = (
        sheet((-3.0, -3.0, z), (x, -3.0, z), (x, 3.0, z), (-3.0, 3.0, z))
        for z, x in ((NEAR, edge), (1.01 * NEAR, 1.01 * edge - 0.001))
    )
    one, both = (share_of_near(surface_of(*near, wall(FAR))) for near in ([first], [first, second]))
    torch.testing.assert_close(both, one)


@pytest.mark.parametrize("angle_deg", [0.0, 7.0, -38.0, 81.0])
@pytest.mark.parametrize("slope", [0.8, -0.5])
def test_a_fold_has_the_mean_of_both_its_planes_in_every_pixel(angle_deg: float, slope: float):
    """Ridges and valleys; the mean of 80 x 80 rays in each pixel."""
    angle, side = math.radians(angle_deg), 2.5
    across, along = (math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))
    corners = [
        (0.013 + a * across[0] + b * along[0], a * across[1] + b * along[1], NEAR + slope * abs(a))
        for a in (-side, 0.0, side)
        for b in (-9.0, 9.0)
    ]
    faces = [[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]]
    fold = surface_of(trimesh.Trimesh(vertices=corners, faces=faces, process=False))
    ranges = synthesise(fold, at_rest(fold), sensor_of(SQUARE, 1)).range
    steps = (torch.arange(80, dtype=torch.float64) + 0.5) / 80 - 0.5
    place = (torch.arange(24, dtype=torch.float64)[:, None] + steps).flatten()
    v, u = torch.meshgrid(place, place, indexing="ij")
    points = fold.vertices[fold.faces[[0, 2]]]
    planes = torch.linalg.solve(points, torch.ones(2, 3, 1, dtype=torch.float64))[..., 0]
    inverse = SQUARE.rays(u, v) @ planes.mT  # of both planes' ranges
    inverse = inverse.amin(-1) if slope > 0 else inverse.amax(-1)
    expected = (1.0 / inverse).unflatten(0, (24, 80)).unflatten(2, (24, 80)).mean((1, 3))
    torch.testing.assert_close(ranges, expected, atol=3e-6, rtol=0)


def jumps_of(step: float, beam: int) -> Tensor:
    """Columns in which a sheet that ends at u = 14.3 is seen before a wall behind it."""
    edge = (14.3 - SQUARE.cx) / SQUARE.fx * NEAR
    near = sheet((-9.0, -9.0, NEAR), (edge, -9.0, NEAR), (edge, 9.0, NEAR), (-9.0, 9.0, NEAR))
    surface = surface_of(near, wall(NEAR + step))
    jump = synthesise(surface, at_rest(surface), sensor_of(SQUARE, beam)).jump
    assert (jump == jump[:1]).all()
    return jump[0].nonzero()[:, 0]


def test_beams_that_hold_a_depth_jump_are_told():
    assert jumps_of(1.0, 1).tolist() == [14]
    assert jumps_of(1.0, 5).tolist() == [12, 13, 14, 15, 16]
    assert jumps_of(0.05, 1).tolist() == [14]


def test_small_steps_creases_and_ideal_rays_are_no_jumps():
    assert len(jumps_of(0.03, 1)) == 0  # of 2 m: less than 2 %
    assert len(jumps_of(1.0, 0)) == 0
    roof = surface_of(
        sheet((0.0, -9.0, NEAR), (9.0, -9.0, 9.0), (9.0, 9.0, 9.0), (0.0, 9.0, NEAR)),
        sheet((-9.0, -9.0, 9.0), (0.0, -9.0, NEAR), (0.0, 9.0, NEAR), (-9.0, 9.0, 9.0)),
    )
    assert not synthesise(roof, at_rest(roof), sensor_of(SQUARE, 1)).jump.any()


@pytest.mark.parametrize("subdivisions", [4, 5])
def test_a_ball_of_thousands_of_faces_in_a_few_pixels_has_its_area(subdivisions: int):
    """More faces than pixels by far: the ball is 4.2 pixels wide."""
    radius = 2.1 / SQUARE.fx * FAR
    surface = surface_of(ball(radius, (0.013, -0.021, FAR), subdivisions))
    coverage = synthesise(surface, at_rest(surface), sensor_of(SQUARE, 1)).coverage
    sine = radius / FAR  # the picture is bounded by the cone that touches the ball
    expected = math.pi * (SQUARE.fx * sine) ** 2 / (1.0 - sine**2)
    assert abs(coverage.sum() / expected - 1.0) < 2e-3
