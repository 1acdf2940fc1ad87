"""Meshes of regions: the right size and place, turned to the sensor, no bridges over jumps."""

import numpy as np
import pytest
import torch
from wall_comparison import BOX, NOISY, PINHOLE, SHAPE, scene, white

from torchcal.calibrate.reconstruct import (
    mesh_of_region,
    slopes,
    smoothing_side,
    unmixed,
)
from torchcal.geometry import se3
from torchcal.geometry.projection import Projection, Spherical

EYE = torch.eye(4, dtype=torch.float64)
MILLIMETRE = 1e-3


def pose(xyz, rpy):
    return se3.from_xyz_rpy(
        torch.tensor(xyz, dtype=torch.float64), torch.tensor(rpy, dtype=torch.float64)
    )


def box_mask():
    mask = torch.zeros(SHAPE, dtype=torch.bool)
    mask[BOX] = True
    return mask


def mesh_of(
    ranges,
    mask=None,
    T=EYE,
    *,
    sigma=MILLIMETRE,
    beam=1,
    behind=None,
    projection: Projection = PINHOLE,
):
    mask = box_mask() if mask is None else mask
    far = None if behind is None else torch.from_numpy(behind)
    return mesh_of_region(
        torch.from_numpy(ranges), mask, projection, T, sigma=sigma, beam=beam, behind=far
    )


def test_a_flat_front_has_the_extents_of_its_pixels():
    mesh = mesh_of(scene(2.7))
    # The centres of the outermost of 60 pixels are 59 pixels apart.
    np.testing.assert_allclose(mesh.extents, [59 * 2.7 / 549, 59 * 2.7 / 549, 0.0], atol=1e-9)
    np.testing.assert_allclose(mesh.vertices[:, 2], 2.7, rtol=1e-12)


@pytest.mark.parametrize(("share", "pixels"), [(0.2, 60), (0.8, 62)])
def test_the_outline_is_where_the_object_fills_half_of_a_pixel(share, pixels):
    rim = (slice(BOX[0].start - 1, BOX[0].stop + 1), slice(BOX[1].start - 1, BOX[1].stop + 1))
    ranges, behind = scene(2.7), scene()
    mixed = np.zeros(SHAPE, bool)
    mixed[rim], mixed[BOX] = True, False
    ranges[mixed] = share * 2.7 + (1.0 - share) * behind[mixed]
    mask = torch.from_numpy(mixed) | box_mask()
    mesh = mesh_of(ranges, mask, behind=behind)
    side = (pixels - 1) * 2.7 / 549
    np.testing.assert_allclose(mesh.extents, [side, side, 0.0], atol=1e-9)


def test_the_rim_of_a_dome_carries_on_its_slope():
    v, u = np.indices(SHAPE) - 85.0
    dome = 2.7 + 4e-5 * (u**2 + v**2)  # 2.4 mm a pixel at the rim
    ranges = scene()
    ranges[BOX] = dome[BOX]
    mesh = mesh_of(ranges, behind=scene(), sigma=1e-5)
    pixels = mesh.vertices[:, :2] / mesh.vertices[:, 2:] * 549.0 + [99.5, 79.5] - 85.0
    expected = 2.7 + 4e-5 * (pixels**2).sum(1)
    assert len(mesh.vertices) == 60 * 60
    np.testing.assert_allclose(mesh.vertices[:, 2], expected, atol=5e-4)


def test_the_mesh_stands_in_the_world_where_the_sensor_saw_it():
    T = pose([1.0, -2.0, 0.5], [0.3, -0.2, 1.1])
    here, there = mesh_of(scene(2.7)), mesh_of(scene(2.7), T=T)
    moved = here.copy().apply_transform(T.numpy())
    np.testing.assert_allclose(there.bounds, moved.bounds, atol=1e-9)


@pytest.mark.parametrize("elevation", [(-0.2, 0.2), (0.2, -0.2)])
@pytest.mark.parametrize("azimuth", [(-0.3, 0.3), (0.3, -0.3)])
def test_faces_are_turned_to_the_sensor_whichever_way_it_scans(azimuth, elevation):
    scanner = Spherical(width=200, height=160, azimuth=azimuth, elevation=elevation)
    T = pose([1.0, 2.0, 3.0], [0.4, 0.5, 0.6])
    mesh = mesh_of(scene(2.7), T=T, projection=scanner)
    facing = np.einsum("fi,fi->f", mesh.face_normals, T[:3, 3].numpy() - mesh.triangles_center)
    assert (facing > 0.0).all()


def test_no_triangle_crosses_a_jump():
    ranges = scene(2.7)
    ranges[:, 100:] += 0.3
    pieces = mesh_of(ranges).split(only_watertight=False)
    assert len(pieces) == 2
    assert all(np.ptp(piece.vertices[:, 2]) < 1e-9 for piece in pieces)


def test_a_slanted_surface_is_not_torn():
    ranges = scene(2.7) + 0.01 * np.arange(SHAPE[1])  # 1 cm a pixel of 5 mm: 64 degrees
    assert len(mesh_of(ranges).split(only_watertight=False)) == 1


@pytest.mark.parametrize("seed", range(10))
def test_extents_are_right_in_strong_noise_behind_a_wide_beam(seed):
    mesh = mesh_of(scene(2.7, beam=21) + white(seed), sigma=0.05, beam=21)
    assert mesh.extents[:2] == pytest.approx([0.29, 0.29], abs=0.02)
    # Averages of 11 x 11 pixels leave 5 mm, carried on over half a beam 8 mm: thousands of pixels
    # span about eight of these.
    assert mesh.extents[2] < 0.08
    assert mesh.centroid == pytest.approx([0.0, 0.0, 2.7], abs=0.01)


def test_slopes_are_those_of_a_plane_also_beside_its_border():
    v, u = np.indices(SHAPE, dtype=float)
    mask = np.zeros(SHAPE, bool)
    mask[40:80, 60:100] = True
    plane = np.where(mask, 2.0 + 0.03 * v - 0.02 * u, np.nan)
    slope_v, slope_u = slopes(plane, mask, side=21)
    # The square pixel that is added to the variances, 21^2 / 12, takes 3 % off in the middle.
    assert slope_v[60, 80] == pytest.approx(0.03, rel=0.03)
    assert slope_u[60, 80] == pytest.approx(-0.02, rel=0.03)
    assert slope_v[40, 60] == pytest.approx(0.03, rel=0.1)


def test_regions_without_a_triangle_give_an_empty_mesh():
    line = torch.zeros(SHAPE, dtype=torch.bool)
    line[10, 10:60] = True
    assert len(mesh_of(scene(2.7), line).faces) == 0
    assert len(mesh_of(scene(2.7), torch.zeros_like(line)).faces) == 0
    assert len(mesh_of(np.full(SHAPE, np.nan)).faces) == 0


def test_the_average_makes_noise_as_small_as_a_pixel():
    assert smoothing_side(0.05, 0.005) == 11
    assert smoothing_side(0.001, 0.005) == 1
    assert smoothing_side(1.0, 0.001) == 21


def test_pixels_within_half_a_beam_of_the_edge_are_mixed_but_not_those_at_the_image_border():
    inside = np.zeros((40, 60), bool)
    inside[:30, :30] = True
    pure = unmixed(inside, beam=7)
    assert pure[:27, :27].all()
    assert pure.sum() == 27 * 27


def test_a_thin_region_keeps_its_pixels():
    inside = np.zeros((40, 60), bool)
    inside[10:13, 5:50] = True
    np.testing.assert_array_equal(unmixed(inside, beam=NOISY.beam), inside)
