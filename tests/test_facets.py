"""Planes of faces: ranges and their derivatives against automatic differentiation."""

import pytest
import torch
from scenes import CAMERA, LIDAR
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.projection import Projection
from torchcal.render.facets import Facets, Hits, Spread

FACES = torch.tensor([[0, 1, 2], [1, 2, 3]])


def corners(rng: torch.Generator) -> torch.Tensor:
    points = torch.randn(4, 3, generator=rng, dtype=torch.float64)
    return points + torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)


def rays(rng: torch.Generator, count: int) -> torch.Tensor:
    directions = 0.2 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return directions + torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def test_the_point_at_the_range_lies_in_the_plane(rng: torch.Generator):
    vertices, ray = corners(rng), rays(rng, 6)
    face = torch.tensor([0, 1, 0, 1, 0, 1])
    points = Facets.of(vertices, FACES).ranges(face, ray)[:, None] * ray
    a, b, c = vertices[FACES[face]].unbind(1)
    volume = torch.linalg.det(torch.stack([b - a, c - a, points - a], 1))
    torch.testing.assert_close(volume, torch.zeros(6, dtype=torch.float64), atol=1e-12, rtol=0)


def test_a_wall_across_the_axis_is_at_its_depth():
    vertices = torch.tensor([[0.0, 0.0, 3.0], [1.0, 0.0, 3.0], [0.0, 1.0, 3.0]])
    ray = torch.tensor([[0.3, -0.2, 1.0], [-2.0, 5.0, 1.0]])
    ranges = Facets.of(vertices, FACES[:1]).ranges(torch.tensor([0, 0]), ray)
    torch.testing.assert_close(ranges, torch.tensor([3.0, 3.0]))


def test_no_face_has_no_range_and_no_derivative(rng: torch.Generator):
    facets, ray, none = Facets.of(corners(rng), FACES), rays(rng, 2), torch.tensor([-1, -1])
    assert (facets.ranges(none, ray) == 0).all()
    assert (facets.at(none, ray).twist_derivatives() == 0).all()


@pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
def test_means_over_pixels_are_those_of_many_rays(projection: Projection, rng: torch.Generator):
    """To the fourth order of a pixel's size; the derivative as well, by differences."""
    vertices = corners(rng)
    u, v = torch.tensor([[13.0, 21.0], [17.0, 9.0]], dtype=torch.float64)
    index = torch.tensor([0, 0])
    to_u, to_v = projection.ray_derivatives(u, v)
    ray, curves = projection.rays(u, v), projection.ray_curvatures(u, v)
    if curves is not None:
        ray = ray + (curves[0] + curves[1]) / 24.0

    def mean(twist: Tensor) -> Hits:
        T = se3.exp(twist)
        facets = Facets.of(vertices @ T[:3, :3].mT + T[:3, 3], FACES)
        return facets.at(index, ray).averaged(Spread.of_square(ray), to_u, to_v)

    facets = Facets.of(vertices, FACES)
    steps = (torch.arange(40, dtype=torch.float64) + 0.5) / 40 - 0.5
    a, b = torch.meshgrid(steps, steps, indexing="ij")
    rays = projection.rays(u[:, None, None] + a, v[:, None, None] + b)
    expected = facets.ranges(index[:, None, None].expand(2, 40, 40), rays).mean((1, 2))
    twist = torch.zeros(6, dtype=torch.float64)
    torch.testing.assert_close(mean(twist).range, expected, rtol=1e-5, atol=0)
    jacobian = torch.autograd.functional.jacobian(lambda x: mean(x).range, twist)
    torch.testing.assert_close(mean(twist).twist_derivatives().mT, jacobian)


def test_twist_derivatives_follow_the_face(rng: torch.Generator):
    vertices, ray, face = corners(rng), rays(rng, 2), torch.tensor([0, 1])

    def moved(twist: torch.Tensor) -> torch.Tensor:
        T = se3.exp(twist)
        return Facets.of(vertices @ T[:3, :3].mT + T[:3, 3], FACES).ranges(face, ray)

    expected = torch.autograd.functional.jacobian(moved, torch.zeros(6, dtype=torch.float64))
    hits = Facets.of(vertices, FACES).at(face, ray)
    torch.testing.assert_close(hits.twist_derivatives().mT, expected)
