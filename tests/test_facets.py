"""Planes of faces: ranges and their derivatives against automatic differentiation."""

import torch

from torchcal.geometry import se3
from torchcal.render.facets import Facets

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
    assert (facets.at(none, ray).slopes(ray.flip(0)) == 0).all()
    assert (facets.at(none, ray).twist_derivatives() == 0).all()


def test_slopes_follow_the_rays(rng: torch.Generator):
    facets, ray, step = Facets.of(corners(rng), FACES), rays(rng, 2), rays(rng, 2)
    face = torch.tensor([0, 1])
    jacobian = torch.autograd.functional.jacobian(lambda r: facets.ranges(face, r), ray)
    expected = (jacobian * step).sum((-2, -1))
    torch.testing.assert_close(facets.at(face, ray).slopes(step), expected)


def test_twist_derivatives_follow_the_face(rng: torch.Generator):
    vertices, ray, face = corners(rng), rays(rng, 2), torch.tensor([0, 1])

    def moved(twist: torch.Tensor) -> torch.Tensor:
        T = se3.exp(twist)
        return Facets.of(vertices @ T[:3, :3].mT + T[:3, 3], FACES).ranges(face, ray)

    expected = torch.autograd.functional.jacobian(moved, torch.zeros(6, dtype=torch.float64))
    hits = Facets.of(vertices, FACES).at(face, ray)
    torch.testing.assert_close(hits.twist_derivatives().mT, expected)
