"""Random elements, their motion and their noise, for tests of matching."""

import torch
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.elements import Elements, Kind
from torchcal.match.minimal_sets import Hypotheses, minimal_hypotheses
from torchcal.match.pairs import Pairs
from torchcal.match.residuals import PairResiduals, Whitening

KINDS = {"P": Kind.POINT, "L": Kind.LINE, "E": Kind.PLANE}
"""A letter for each kind: sets of elements are written as words."""
OBLIQUE = torch.tensor([[1.0, 0.4, 0.3], [0.3, 1.0, 0.2], [0.4, 0.3, 1.0]], dtype=torch.float64)
"""Directions at 50 to 60 degrees to one another."""
CORNERS = torch.tensor([[0.1, -0.4, 0.2], [0.7, 0.3, -0.2], [-0.3, 0.6, 0.5]], dtype=torch.float64)
"""A triangle with long sides."""


def normal(*shape: int, rng: torch.Generator) -> Tensor:
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def units(*shape: int, rng: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(normal(*shape, 3, rng=rng), dim=-1)


def poses(count: int, *, rng: torch.Generator, size: float = 1.0) -> Tensor:
    return se3.exp(size * normal(count, 6, rng=rng))


def elements(
    word: str, point: Tensor, direction: Tensor, covariance: Tensor | None = None
) -> Elements:
    """Elements of the kinds that the letters name; directions of any length."""
    kind = torch.tensor([KINDS[letter].value for letter in word], dtype=torch.int64)
    kind = kind.expand(point.shape[:-1])
    unit = torch.nn.functional.normalize(direction, dim=-1)
    if covariance is None:
        covariance = point.new_zeros(*point.shape[:-1], 6, 6)
    return Elements(
        kind=kind,
        point=point,
        direction=torch.where((kind == Kind.POINT)[..., None], 0.0, unit),
        covariance=covariance,
    )


def well_placed(word: str, members: int, *, rng: torch.Generator) -> Elements:
    """Up to three elements for each member, in random places but far from degenerate."""
    count = len(word)
    point = CORNERS[:count] + 0.05 * normal(members, count, 3, rng=rng)
    direction = OBLIQUE[:count] + 0.05 * normal(members, count, 3, rng=rng)
    return elements(word, point, direction)


def covariances(*shape: int, rng: torch.Generator, sigma: float = 0.01) -> Tensor:
    """Random, of all six axes together, with standard deviations about sigma."""
    root = normal(*shape, 6, 6, rng=rng) / 6**0.5
    return sigma**2 * (root @ root.mT + 0.1 * torch.eye(6, dtype=torch.float64))


def with_covariance(exact: Elements, covariance: Tensor) -> Elements:
    return Elements(
        kind=exact.kind,
        point=exact.point,
        direction=exact.direction,
        covariance=covariance.expand(*exact.kind.shape, 6, 6),
    )


def moved(T_a_b: Tensor, own: Elements) -> Elements:
    """Elements of frame b in frame a, with the noise turned along."""
    R = T_a_b[..., None, :3, :3]
    turn = torch.zeros(*R.shape[:-2], 6, 6, dtype=R.dtype)
    turn[..., :3, :3] = turn[..., 3:, 3:] = R
    return Elements(
        kind=own.kind,
        point=se3.transform(T_a_b, own.point),
        direction=own.direction @ T_a_b[..., :3, :3].mT,
        covariance=turn @ own.covariance @ turn.mT,
    )


def noisy(exact: Elements, *, rng: torch.Generator) -> Elements:
    """Elements as they are measured: with errors drawn from their covariance."""
    root, _ = torch.linalg.cholesky_ex(exact.covariance)
    error = (root @ normal(*exact.kind.shape, 6, 1, rng=rng))[..., 0]
    direction = torch.nn.functional.normalize(exact.direction + error[..., 3:], dim=-1)
    return Elements(
        kind=exact.kind,
        point=exact.point + error[..., :3],
        direction=torch.where((exact.kind == Kind.POINT)[..., None], 0.0, direction),
        covariance=exact.covariance,
    )


def single(own: Elements) -> Elements:
    """In float32."""
    return Elements(
        kind=own.kind,
        point=own.point.float(),
        direction=own.direction.float(),
        covariance=own.covariance.float(),
    )


def one_to_one(members: int, count: int) -> Tensor:
    """The matrices C (eq. 6) in which every element has its own number for a partner."""
    return torch.eye(count, dtype=torch.bool).expand(members, count, count)


def residuals_of(model: Elements, measured: Elements, candidates: Tensor) -> PairResiduals:
    """Of all candidates, a problem for each member."""
    every = torch.arange(len(candidates))
    return PairResiduals.of(
        model, measured, Whitening.of(measured), every, Pairs.of(candidates.contiguous())
    )


def retract(T: Tensor, step: Tensor) -> Tensor:
    return T @ se3.exp(step)


def hypotheses(
    model: Elements,
    measured: Elements,
    candidates: torch.Tensor,
    limit: int = 10_000,
    seed: int = 0,
) -> Hypotheses:
    generator = torch.Generator().manual_seed(seed)
    return minimal_hypotheses(model, measured, candidates, limit=limit, generator=generator)
