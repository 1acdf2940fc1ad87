"""The numerical experiment of 4.1: the pose of a brick from vertexes with wrong correspondences."""

import itertools
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.elements import Elements

SIZE = (3.0, 4.0, 5.0)
"""Width, depth and height (m)."""
SIGMA = 0.01
"""Standard deviation of each component of a measured vertex (m)."""
EXTENT = 10.0
"""Side of the cube that the positions are drawn from (m)."""
SUCCESS = 0.1
"""Largest error of a success (m and rad)."""

Protocol: TypeAlias = Literal["all-pairs", "one-to-one", "nearest"]
"""Which correspondences a trial is given.

``all-pairs`` and ``nearest``: each of the 64 C_ij is 1 with probability 1/2. ``one-to-one``: every
measured vertex has one candidate, the true one with probability 1/2.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class BrickTrials:
    """Trials with their truth."""

    T_measured_brick: Float[Tensor, "trial 4 4"]
    measured: Elements
    """The eight vertexes, in the model's order."""
    candidates: Bool[Tensor, "trial model measured"]
    """C of eq. 6."""


def brick_model() -> Elements:
    """The exact vertexes of the brick about its centre (m)."""
    corners = list(itertools.product(*[(-0.5 * side, 0.5 * side) for side in SIZE]))
    return Elements.points(torch.tensor(corners, dtype=torch.float64))


def draw_trials(trials: int, protocol: Protocol, *, generator: torch.Generator) -> BrickTrials:
    """Draws poses, noise and candidates."""
    model = brick_model()
    R = se3.random_rotations(trials, generator=generator)
    t = EXTENT * (torch.rand(trials, 3, dtype=torch.float64, generator=generator) - 0.5)
    T = se3.from_rotation_translation(R, t)
    exact = se3.transform(T, model.point)
    noise = SIGMA * torch.randn(exact.shape, dtype=torch.float64, generator=generator)
    covariance = SIGMA**2 * torch.eye(3, dtype=torch.float64)
    return BrickTrials(
        T_measured_brick=T,
        measured=Elements.points(exact + noise, covariance.expand(*exact.shape, 3)),
        candidates=_draw_candidates(trials, model.count, protocol, generator),
    )


def _draw_candidates(
    trials: int, count: int, protocol: Protocol, generator: torch.Generator
) -> Bool[Tensor, "trial model measured"]:
    if protocol != "one-to-one":
        return torch.rand(trials, count, count, generator=generator) < 0.5
    true = torch.arange(count).expand(trials, count)
    wrong = (true + torch.randint(1, count, (trials, count), generator=generator)) % count
    is_true = torch.rand(trials, count, generator=generator) < 0.5
    partner = torch.where(is_true, true, wrong)
    return torch.zeros(trials, count, count).scatter(1, partner[:, None], 1.0).bool()


def symmetries() -> Float[Tensor, "symmetry 4 4"]:
    """The four rotations that map the brick onto itself; the first is none."""
    turns = [(1, 1, 1, 1), (1, -1, -1, 1), (-1, 1, -1, 1), (-1, -1, 1, 1)]
    return torch.diag_embed(torch.tensor(turns, dtype=torch.float64))


def errors(
    T_measured_brick: Float[Tensor, "*batch 4 4"], truth: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch symmetry 6"]:
    """Twists (m, rad) from estimates to the truth and to its symmetric poses."""
    T_brick_true = se3.inverse(T_measured_brick) @ truth
    return se3.log(T_brick_true[..., None, :, :] @ symmetries().to(truth))


def are_successes(twists: Float[Tensor, "*batch 6"]) -> Bool[Tensor, "*batch"]:
    """Whether errors are within 0.1 m and 0.1 rad; never where they are NaN."""
    return (twists[..., :3].norm(dim=-1) < SUCCESS) & (twists[..., 3:].norm(dim=-1) < SUCCESS)


def cramer_rao() -> Float[Tensor, "6 6"]:
    """The least covariance of a twist on the right of the pose, from all eight vertexes."""
    p = brick_model().point
    eye = torch.eye(3, dtype=p.dtype).expand(len(p), 3, 3)
    A = torch.cat([eye, -se3.hat(p)], -1).flatten(0, 1)
    return SIGMA**2 * torch.linalg.inv(A.mT @ A)


@dataclass(frozen=True, kw_only=True, slots=True)
class BrickOracle:
    """What could be known from C alone, trial by trial; a tie of k poses counts 1/k."""

    modulo_symmetry: Float[Tensor, " trial"]
    """The share of right poses, symmetric ones too, among those that C supports most."""
    absolute: Float[Tensor, " trial"]
    """The share of the true pose among the symmetric ones that C supports most."""


def oracle(candidates: Bool[Tensor, "trial model measured"]) -> BrickOracle:
    """Counts what C says for every motion that maps three or more vertexes onto vertexes."""
    coincidences = _coincidences()
    support = candidates.double().flatten(1) @ coincidences.double().flatten(1).mT
    is_right = coincidences.sum((1, 2)) == len(coincidences[0])
    best = support == support.amax(1, keepdim=True)
    right = support[:, is_right]
    best_right = right == right.amax(1, keepdim=True)
    is_true = coincidences[is_right].diagonal(dim1=1, dim2=2).all(1)
    return BrickOracle(
        modulo_symmetry=(best & is_right).sum(1) / best.sum(1),
        absolute=(best_right & is_true).sum(1) / best_right.sum(1),
    )


def _coincidences() -> Bool[Tensor, "motion model measured"]:
    """Which vertexes coincide after each of the motions that map three onto three others."""
    p = brick_model().point
    triples = torch.tensor(list(itertools.permutations(range(len(p)), 3)))
    increasing = triples[(triples.diff(dim=1) > 0).all(1)]
    sides = torch.cdist(p, p)

    def lengths(triple: Tensor) -> Tensor:
        return sides[triple, triple.roll(1, -1)]

    same = (lengths(increasing)[:, None] - lengths(triples)).abs().amax(-1) < 1e-9
    own, other = same.nonzero(as_tuple=True)
    a, b = p[increasing[own]], p[triples[other]]
    R = _frames(b) @ torch.linalg.inv(_frames(a))
    moved = (p - a[:, :1]) @ R.mT + b[:, :1]
    return torch.unique(torch.cdist(moved, p) < 1e-6, dim=0)


def _frames(triangle: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Two sides and the normal of triangles, as columns."""
    one, two = triangle[..., 1, :] - triangle[..., 0, :], triangle[..., 2, :] - triangle[..., 0, :]
    return torch.stack([one, two, torch.linalg.cross(one, two)], -1)
