import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from torchcal.geometry.projection import Pinhole, Projection, Spherical, pixel_grid

PINHOLE = Pinhole(width=8, height=6, fx=9.0, fy=10.0, cx=3.2, cy=2.7)
LIDAR = Spherical(width=8, height=6, azimuth=(-2.5, 2.5), elevation=(0.7, -0.9))
BEHIND = Spherical(width=8, height=6, azimuth=(2.0, 4.5), elevation=(-0.3, 0.4))
EVERY = pytest.mark.parametrize(
    "optics", [PINHOLE, LIDAR, BEHIND], ids=["pinhole", "lidar", "rear"]
)
SHAPES = pytest.mark.parametrize("shape", [(), (3,), (2, 3)], ids=str)

ATOL = 1e-12  # closed forms in float64


def pixels_of(optics: Projection, shape: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    u, v = torch.rand(2, *shape, generator=generator, dtype=torch.float64).unbind(0)
    return u * (optics.width - 1), v * (optics.height - 1)


@EVERY
def test_optics_are_projections(optics):
    assert isinstance(optics, Projection)


@SHAPES
@EVERY
def test_a_point_on_a_ray_falls_on_its_pixel_at_its_range(optics, shape):
    u, v = pixels_of(optics, shape)
    points = 2.5 * optics.rays(u, v)
    assert points.shape == (*shape, 3)
    assert_close(optics.pixels(points), torch.stack([u, v], -1), rtol=0, atol=ATOL)
    assert_close(optics.ranges(points), torch.full_like(u, 2.5), rtol=0, atol=ATOL)


@SHAPES
@EVERY
def test_ray_derivatives_are_those_of_autograd(optics, shape):
    u, v = (pixel.requires_grad_() for pixel in pixels_of(optics, shape))
    to_u, to_v = optics.ray_derivatives(u, v)
    rays = optics.rays(u, v)
    for axis in range(3):
        grad = torch.autograd.grad(
            rays[..., axis].sum(), (u, v), retain_graph=True, materialize_grads=True
        )
        assert_close(to_u[..., axis].detach(), grad[0], rtol=0, atol=ATOL)
        assert_close(to_v[..., axis].detach(), grad[1], rtol=0, atol=ATOL)


@EVERY
@pytest.mark.parametrize("factor", [2, 3])
def test_a_resized_pixel_is_centred_on_the_pixels_that_it_covers(optics, factor):
    small = optics.resized(factor)
    assert (small.width, small.height) == (8 // factor, 6 // factor)
    u, v = pixel_grid(small, dtype=torch.float64, device=torch.device("cpu"))
    shift = (factor - 1) / 2
    rays = optics.rays(factor * u + shift, factor * v + shift)
    assert_close(small.rays(u, v), rays, rtol=0, atol=ATOL)


@EVERY
@pytest.mark.parametrize("parts", [1, 3, 5])
def test_divided_pixels_put_together_again_are_the_same_optics(optics, parts):
    fine = optics.divided(parts)
    assert (fine.width, fine.height) == (8 * parts, 6 * parts)
    u, v = pixel_grid(optics, dtype=torch.float64, device=torch.device("cpu"))
    shift = (parts - 1) / 2
    assert_close(
        fine.rays(parts * u + shift, parts * v + shift), optics.rays(u, v), rtol=0, atol=ATOL
    )
    assert_close(fine.resized(parts).rays(u, v), optics.rays(u, v), rtol=0, atol=ATOL)


def test_pinhole_looks_along_z_at_its_centre():
    ray = PINHOLE.rays(torch.tensor(3.2), torch.tensor(2.7))
    assert_close(ray, torch.tensor([0.0, 0.0, 1.0]))


def test_pinhole_sees_right_and_down():
    ray = PINHOLE.rays(torch.tensor(12.2), torch.tensor(12.7))
    assert_close(ray, torch.tensor([1.0, 1.0, 1.0]))


def test_spherical_corners_are_at_the_given_angles():
    ray = LIDAR.rays(torch.tensor([0.0, 7.0]).double(), torch.tensor([0.0, 5.0]).double())
    expected = [
        [math.sin(az) * math.cos(el), -math.sin(el), math.cos(az) * math.cos(el)]
        for az, el in ((-2.5, 0.7), (2.5, -0.9))
    ]
    assert_close(ray, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=ATOL)


@given(
    st.floats(min_value=-2 * math.pi, max_value=0),
    st.floats(min_value=0.1, max_value=math.pi * 1.9),
)
def test_azimuths_are_found_on_either_side_of_the_seam(first, span):
    optics = Spherical(width=5, height=3, azimuth=(first, first + span), elevation=(0.2, -0.2))
    u = torch.arange(5, dtype=torch.float64)
    found = optics.pixels(optics.rays(u, torch.ones_like(u)))[..., 0]
    assert_close(found, u, rtol=0, atol=1e-11)  # a step of 0.025 rad magnifies rounding by 40


def test_a_single_row_is_as_high_as_a_column_is_wide():
    row = Spherical(width=3, height=1, azimuth=(-0.2, 0.2), elevation=(0.1, 0.1))
    assert_close(row.elevation_step, -0.2)
    column = Spherical(width=1, height=3, azimuth=(0.1, 0.1), elevation=(0.2, -0.2))
    assert_close(column.azimuth_step, 0.2)
    below = row.rays(torch.tensor(1.0).double(), torch.tensor(0.5).double())
    assert_close(row.pixels(below), torch.tensor([1.0, 0.5], dtype=torch.float64))


def test_grid_counts_columns_and_rows_from_zero():
    u, v = pixel_grid(PINHOLE, dtype=torch.float32, device=torch.device("cpu"))
    assert u.shape == v.shape == (6, 8)
    assert u.dtype == torch.float32
    assert (u[0].tolist(), v[:, 0].tolist()) == ([0, 1, 2, 3, 4, 5, 6, 7], [0, 1, 2, 3, 4, 5])


@EVERY
def test_single_precision_stays_single(optics):
    u, v = (pixel.float() for pixel in pixels_of(optics, (4,)))
    rays = optics.rays(u, v)
    tensors = (rays, *optics.ray_derivatives(u, v), optics.pixels(rays), optics.ranges(rays))
    assert {tensor.dtype for tensor in tensors} == {torch.float32}
    assert_close(optics.pixels(rays), torch.stack([u, v], -1), rtol=0, atol=1e-5)
