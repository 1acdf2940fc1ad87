"""The synthesis of eq. 17 and 18 against Embree, and its derivative against differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scenes import (
    CAMERA,
    LIDAR,
    at_rest,
    ball,
    box,
    cell,
    oracle_of,
    sensor_of,
    sheet,
    surface_of,
    wall,
)
from torch import Tensor

from torchcal.demo import raycast
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole, Projection, Spherical
from torchcal.model.scene import Surface
from torchcal.render.synthesis import Synthesis, place_vertices, synthesise

PROJECTIONS = pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
BEAMS = pytest.mark.parametrize("beam", [1, 5])
FLIPS = 0.02
"""Share of the pixels in which another face comes into view within a step of the difference."""


def rendered(surface: Surface, projection: Projection, beam: int) -> Synthesis:
    return synthesise(surface, at_rest(surface), sensor_of(projection, beam))


def moved_poses(surface: Surface, motion: Tensor, q: Tensor) -> Tensor:
    return se3.exp(motion @ q) @ at_rest(surface)


def motion_of(surface: Surface, rng: torch.Generator, parameters: int = 6) -> Tensor:
    """The first body stands still, all others move in their own ways."""
    bodies = int(surface.vertex_body.max()) + 1
    motion = torch.randn(bodies, 6, parameters, generator=rng, dtype=torch.float64)
    motion[0] = 0.0
    return motion


@PROJECTIONS
def test_an_ideal_ray_measures_what_embree_measures(projection: Projection):
    ranges = rendered(surface_of(*cell()), projection, 0).range.numpy()
    expected = raycast.predict(oracle_of(*cell()), projection, 0)
    assert (np.abs(ranges - expected) > 1e-6).mean() <= 0.002  # rays on edges


@pytest.mark.parametrize(
    ("beam", "rms", "bias"), [(1, 0.05, 2e-3), (5, 0.01, 2e-3), (21, 4e-3, 2e-3)]
)
@PROJECTIONS
def test_the_beam_measures_what_many_rays_measure(
    projection: Projection, beam: int, rms: float, bias: float
):
    """The bounds are some of the jumps of metres in a scene of 40 x 32 pixels."""
    ranges = rendered(surface_of(*cell()), projection, beam).range.numpy()
    error = ranges - raycast.predict(oracle_of(*cell()), projection, beam)
    assert np.sqrt(np.square(error).mean()) < rms
    assert abs(error.mean()) < bias


def test_silhouettes_at_the_border_of_the_image_share_its_pixels():
    camera = Pinhole(width=9, height=9, fx=10.0, fy=10.0, cx=4.0, cy=4.0)
    edge = 2.0 * (8.3 - 4.0) / 10.0  # at u = 8.3, beyond the last centre
    near = sheet((-9.0, -9.0, 2.0), (edge, -9.0, 2.0), (edge, 9.0, 2.0), (-9.0, 9.0, 2.0))
    ranges = rendered(surface_of(near, wall(5.0)), camera, 1).range
    torch.testing.assert_close(ranges[:, -1], torch.full((9,), 0.8 * 2.0 + 0.2 * 5.0).double())
    torch.testing.assert_close(ranges[:, :-1], torch.full((9, 8), 2.0).double())


def test_a_bar_that_is_thinner_than_a_pixel_is_seen_in_the_mean():
    width, shares = 0.3, []
    for u in np.linspace(15.0, 17.0, 41)[:-1] + 0.013:
        left, right = (2.0 * (u + d - CAMERA.cx) / CAMERA.fx for d in (-width / 2, width / 2))
        bar = sheet((left, -9.0, 2.0), (right, -9.0, 2.0), (right, 9.0, 2.0), (left, 9.0, 2.0))
        ranges = rendered(surface_of(bar, wall(5.0)), CAMERA, 1).range
        shares.append(((5.0 - ranges) / 3.0).sum(1).mean())
    torch.testing.assert_close(torch.stack(shares), torch.full((40,), width).double())


def test_several_edges_within_one_strip_count_once():
    """A body that juts out a little behind another one has its silhouette in the same pixels."""
    camera = replace(CAMERA, width=24, height=24)
    panel = box((0.5, 0.8, 0.02), (0.0, 0.0, 2.0))
    frame = box((0.504, 0.804, 0.3), (0.0, 0.0, 2.18))
    bodies = (wall(5.0), panel, frame)
    error = rendered(surface_of(*bodies), camera, 1).range.numpy()
    error = error - raycast.predict(oracle_of(*bodies), camera, 1)
    assert abs(error.mean()) < 2e-3
    assert np.sqrt(np.square(error).mean()) < 0.03


def test_a_face_that_is_seen_edge_on_does_not_fill_its_pixel_with_its_plane():
    """The flank of a tube of 32 facets: the outermost is thinner than a pixel."""
    tube = trimesh.creation.cylinder(0.38, height=4.0, sections=32)
    errors = []
    for x in np.linspace(-0.6, 0.6, 12):
        turned = tube.copy().apply_transform(trimesh.transformations.euler_matrix(1.5, 0.0, 0.1))
        bodies = (wall(5.0), turned.apply_translation((x, 0.0, 2.5)))
        ranges = rendered(surface_of(*bodies), CAMERA, 1).range.numpy()
        errors.append(ranges - raycast.predict(oracle_of(*bodies), CAMERA, 1))
    assert np.abs(errors).max() < 0.2
    assert abs(np.mean(errors)) < 1e-3


@PROJECTIONS
@BEAMS
def test_autograd_through_the_poses_gives_the_jacobian(
    projection: Projection, beam: int, rng: torch.Generator
):
    surface = surface_of(*cell())
    motion, weight = (
        motion_of(surface, rng),
        torch.randn(32, 40, generator=rng, dtype=torch.float64),
    )
    q = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    sensor = sensor_of(projection, beam)
    synthesis = synthesise(surface, moved_poses(surface, motion, q), sensor, motion)
    (gradient,) = torch.autograd.grad((weight * synthesis.range).sum(), q)
    assert synthesis.jacobian is not None
    by_hand = (weight[..., None] * synthesis.jacobian).sum((0, 1)).detach()
    torch.testing.assert_close(by_hand, gradient, rtol=1e-8, atol=1e-8)


@PROJECTIONS
@BEAMS
def test_differences_of_images_give_the_jacobian(
    projection: Projection, beam: int, rng: torch.Generator
):
    surface, step = surface_of(*cell()), 1e-6
    motion, sensor = motion_of(surface, rng), sensor_of(projection, beam)
    jacobian = synthesise(surface, at_rest(surface), sensor, motion).jacobian
    assert jacobian is not None
    for i, unit in enumerate(torch.eye(6, dtype=torch.float64)):
        ahead, behind = (
            synthesise(surface, moved_poses(surface, motion, s * step * unit), sensor).range
            for s in (1.0, -1.0)
        )
        difference = (ahead - behind) / (2 * step)
        # Pixels of 0.03 rad are flat to 1e-4 only, in a spherical sensor.
        off = (difference - jacobian[..., i]).abs() > 5e-4 * (1.0 + difference.abs())
        assert off.double().mean() <= FLIPS * beam**2  # one flip is in beam x beam pixels


@PROJECTIONS
def test_views_of_a_batch_are_rendered_as_if_each_were_alone(
    projection: Projection, rng: torch.Generator
):
    surface, sensor = surface_of(*cell()), sensor_of(projection, 5)
    motion = torch.stack([motion_of(surface, rng) for _ in range(6)]).view(2, 3, 4, 6, 6)
    q = 0.02 * torch.randn(2, 3, 6, generator=rng, dtype=torch.float64)
    poses = se3.exp((motion @ q[..., None, :, None])[..., 0]) @ at_rest(surface)
    together = synthesise(surface, poses, sensor, motion)
    assert together.range.shape == (2, 3, 32, 40)
    for index in np.ndindex(2, 3):
        alone = synthesise(surface, poses[index], sensor, motion[index])
        assert torch.equal(alone.range, together.range[index])
        assert together.jacobian is not None
        assert alone.jacobian is not None
        assert torch.equal(alone.jacobian, together.jacobian[index])


@PROJECTIONS
def test_a_nan_pose_empties_its_own_view_only(projection: Projection):
    surface = surface_of(*cell(), ball(0.2, (0.0, 0.0, 1.5)), wall(2.9, 0.5))
    poses = at_rest(surface).expand(3, -1, 4, 4).clone()
    poses[1] = torch.nan
    motion = torch.eye(6, dtype=torch.float64).expand(3, poses.shape[1], 6, 6)
    synthesis = synthesise(surface, poses, sensor_of(projection, 3), motion)
    assert synthesis.range[1].isnan().all()
    assert (synthesis.coverage[1] == 0).all()
    assert synthesis.jacobian is not None
    assert (synthesis.jacobian[1] == 0).all()
    alone = synthesise(surface, at_rest(surface), sensor_of(projection, 3))
    for view in (0, 2):
        assert torch.equal(synthesis.range[view], alone.range)


@PROJECTIONS
def test_single_precision_gives_the_same_image(projection: Projection):
    surface = surface_of(*cell())
    exact = rendered(surface, projection, 5).range
    single = replace(surface, vertices=surface.vertices.float())
    ranges = synthesise(single, at_rest(surface).float(), sensor_of(projection, 5)).range
    assert ranges.dtype == torch.float32
    error = (ranges.double() - exact).abs()
    assert (error > 1e-4).double().mean() <= FLIPS * 25
    assert error.median() < 1e-6


def test_what_is_nearer_or_farther_than_the_limits_gives_no_return():
    surface = surface_of(wall(2.0, 0.4), wall(6.0))
    for near, far, seen in (
        (0.5, 9.0, {0, 1, 2, 3}),
        (3.0, 9.0, {-1, 2, 3}),
        (0.5, 4.0, {-1, 0, 1}),
    ):
        sensor = sensor_of(CAMERA, 1, near=near, far=far)
        synthesis = synthesise(surface, at_rest(surface), sensor)
        assert set(synthesis.face.unique().tolist()) == seen
        empty = synthesis.coverage == 0
        assert torch.equal(synthesis.range.isnan(), empty)


def test_a_view_of_nothing_is_empty():
    surface = surface_of(ball(0.5, (0.0, 0.0, -3.0)))
    motion = torch.eye(6, dtype=torch.float64)[None]
    for beam in (0, 1, 21):
        synthesis = synthesise(surface, at_rest(surface), sensor_of(CAMERA, beam), motion)
        assert synthesis.range.isnan().all()
        assert (synthesis.coverage == 0).all()
        assert synthesis.jacobian is not None
        assert (synthesis.jacobian == 0).all()


def test_the_beam_is_the_mean_over_its_clipped_box():
    surface = surface_of(*cell())
    own = rendered(surface, CAMERA, 1).range
    wide = rendered(surface, CAMERA, 5).range
    for v, u in ((0, 0), (3, 1), (16, 20), (31, 39)):
        rows, columns = slice(max(v - 2, 0), v + 3), slice(max(u - 2, 0), u + 3)
        torch.testing.assert_close(wide[v, u], own[rows, columns].mean())


def test_bodies_are_placed_by_their_own_poses(rng: torch.Generator):
    surface = surface_of(*cell())
    poses = se3.exp(torch.randn(5, 4, 6, generator=rng, dtype=torch.float64))
    placed = place_vertices(surface, poses)
    for k in range(0, len(surface.vertices), 17):
        T = poses[2, surface.vertex_body[k]]
        torch.testing.assert_close(placed[2, k], T[:3, :3] @ surface.vertices[k] + T[:3, 3])


def test_a_whole_turn_is_rendered_without_a_gap():
    around = Spherical(
        width=90, height=30, azimuth=(-np.pi, np.pi * 88 / 90), elevation=(1.0, -1.0)
    )
    error = rendered(surface_of(*cell()), around, 1).range.numpy()
    error = error - raycast.predict(oracle_of(*cell()), around, 1)
    assert np.isfinite(error).all()
    assert abs(error.mean()) < 2e-3
