"""Hypotheses of a pose from the fewest pairs of elements that determine it (3.2).

Three pairs of points, two pairs of lines, three pairs of planes, and mixtures: every set whose
lengths and angles agree, or a sample of them, solved in closed form.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.alignment import rotation_from_directions, solve_3x3
from torchcal.match.elements import Elements, Kind
from torchcal.match.invariants import PARALLEL, Invariants
from torchcal.match.pairs import Pairs, place_in_group

P, L, E = Kind.POINT.value, Kind.LINE.value, Kind.PLANE.value
TWO = ((P, L), (L, L), (L, E))
"""Kinds, in ascending order, of which two pairs determine a pose; without lines three do."""
AGREEMENT = 0.1
"""Most that the cosine between the two directions of a hypothesis may differ (lines only agree up
to their sign before)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Hypotheses:
    """Poses, each for one member of a batch, in ascending order of the members."""

    batch: Int[Tensor, " hypothesis"]
    T: Float[Tensor, "hypothesis 4 4"]
    """Carries the model's elements onto the measured ones."""

    def __getitem__(self, chosen: Tensor) -> "Hypotheses":
        """Some of the hypotheses."""
        return Hypotheses(batch=self.batch[chosen], T=self.T[chosen])

    @staticmethod
    def join(*parts: "Hypotheses") -> "Hypotheses":
        """All hypotheses of several sets, in ascending order of the batch."""
        batch = torch.cat([part.batch for part in parts])
        order = batch.argsort(stable=True)
        return Hypotheses(batch=batch[order], T=torch.cat([part.T for part in parts])[order])


def minimal_hypotheses(
    model: Elements,
    measured: Elements,
    candidates: Bool[Tensor, "batch model measured"],
    *,
    limit: int,
    generator: torch.Generator,
) -> Hypotheses:
    """The poses of all minimal sets of candidates whose lengths and angles agree.

    Args:
        model: Elements of each member of the batch.
        measured: Elements of each member of the batch.
        candidates: The matrix C of eq. 6; elements of different kinds are never paired.
        limit: Most sets of each size for a member of the batch; more are sampled.
        generator: For the sample.
    """
    same = model.kind[:, :, None] == measured.kind[:, None, :]
    pairs = Pairs.of(candidates & same)
    if model.directed:
        pairs = pairs.sorted_by(model.kind.gather(1, pairs.model))
    kinds = model.kind.gather(1, pairs.model)
    agree = _agreeing_pairs(pairs, Invariants.of(model), Invariants.of(measured))
    twos = agree.nonzero()
    found = [
        _solve(model, measured, pairs, _sample(sets, limit, generator))
        for sets in (_of_kinds(twos, kinds, TWO), _threes(twos, agree, kinds))
    ]
    return Hypotheses.join(*found)


def _agreeing_pairs(pairs: Pairs, model: Invariants, measured: Invariants) -> Tensor:
    """Which pairs a < b of each member may hold together, ``(batch, pair, pair)``."""
    count = pairs.model.shape[1]
    first, second = torch.triu_indices(count, count, 1, device=pairs.model.device)

    def both(values: Tensor) -> tuple[Tensor, Tensor]:
        return values.index_select(1, first), values.index_select(1, second)

    own, others, valid = both(pairs.model), both(pairs.measured), both(pairs.valid)
    batch = torch.arange(len(pairs.model), device=first.device)[:, None].expand_as(own[0])
    agree = valid[0] & valid[1]
    agree = agree & (own[0] != own[1]) & (others[0] != others[1])
    agree = agree & model.agree(measured, batch, own, others)
    table = pairs.valid.new_zeros(len(pairs.model), count, count)
    table[:, first, second] = agree
    return table


def _of_kinds(sets: Tensor, kinds: Tensor, wanted: tuple[tuple[int, ...], ...]) -> Tensor:
    """Those rows (batch, pair, ...) whose kinds are one of the combinations."""
    found = kinds[sets[:, :1], sets[:, 1:]]
    choices = torch.tensor(wanted, device=sets.device)
    return sets[(found[:, None] == choices).all(-1).any(-1)]


def _threes(twos: Tensor, agree: Tensor, kinds: Tensor) -> Tensor:
    """Rows (batch, a, b, c) of pairs that agree with one another, without lines."""
    without = kinds[twos[:, :1], twos[:, 1:]].ne(L).all(-1)
    batch, a, b = twos[without].unbind(-1)
    third = agree[batch, a] & agree[batch, b] & kinds[batch].ne(L)
    row, c = third.nonzero(as_tuple=True)
    return torch.stack([batch[row], a[row], b[row], c], -1)


def _sample(sets: Tensor, limit: int, generator: torch.Generator) -> Tensor:
    """At most ``limit`` rows of each member of the batch, drawn at random where there are more."""
    batch = sets[:, 0]
    count = batch.bincount()
    if len(sets) == 0 or int(count.max()) <= limit:
        return sets
    chance = torch.rand(len(sets), dtype=torch.float64, generator=generator).to(sets.device)
    order = (batch + chance).argsort()
    return sets[order[place_in_group(batch, count) < limit]]


def _solve(model: Elements, measured: Elements, pairs: Pairs, sets: Tensor) -> Hypotheses:
    """The poses of the sets (batch, pair, ...) that determine one."""
    batch, members = sets[:, 0], sets[:, 1:]
    rows = batch[:, None]
    own = rows, pairs.model[rows, members]
    others = rows, pairs.measured[rows, members]
    kind = model.kind[own]
    p, d = model.point[own], model.direction[own]
    q = measured.point[others]
    found = []
    for sign in _signs(kind):
        e = measured.direction[others] * sign[:, None]
        one, two = _two_directions(kind, p, d), _two_directions(kind, q, e)
        T = _pose(kind, one, two, p, q, e)
        is_choice = ((kind == L) | (sign > 0)).all(1)  # only lines may be turned
        keep = is_choice & _is_determined(one, two, kind) & T.isfinite().all(-1).all(-1)
        found.append(Hypotheses(batch=batch[keep], T=T[keep]))
    return Hypotheses.join(*found)


def _signs(kind: Tensor) -> Tensor:
    """Every choice of the senses of the lines in any of the sets, ``(choice, member)``."""
    may_turn = (kind == L).any(0)
    one, both = kind.new_tensor([1]), kind.new_tensor([1, -1])
    return torch.cartesian_prod(*[both if turn else one for turn in may_turn.tolist()]).view(
        -1, kind.shape[1]
    )


def _two_directions(kind: Tensor, p: Tensor, d: Tensor) -> Tensor:
    """The two directions that fix the rotation of each set, ``(set, 2, 3)``.

    Points give the directions between them, lines and planes their own, a point beside a line the
    perpendicular from the point to it.
    """
    offset = p[:, 1] - p[:, 0]
    foot = offset - d[:, 1] * (d[:, 1] * offset).sum(-1, keepdim=True)
    starts_with_point = (kind[:, 0] == P)[:, None]
    next_is_point = (kind[:, 1] == P)[:, None]
    next_is_line = (kind[:, 1] == L)[:, None]
    first = torch.where(starts_with_point & next_is_line, foot, d[:, 0])
    first = torch.where(starts_with_point & next_is_point, offset, first)
    second = d[:, 1]
    if kind.shape[1] == 3:
        first = torch.where(starts_with_point & (kind[:, 1] == E)[:, None], d[:, 2], first)
        last_is_point = (kind[:, 2] == P)[:, None]
        far = torch.where(last_is_point, p[:, 2] - p[:, 0], d[:, 2])
        second = torch.where(next_is_point, far, second)
    return torch.stack([first, second], 1)


def _pose(kind: Tensor, one: Tensor, two: Tensor, p: Tensor, q: Tensor, e: Tensor) -> Tensor:
    """Rotation from the directions; then the position is linear: sum N (q - R p - t) = 0."""
    R = rotation_from_directions(one, two)
    offset = q - p @ R.mT
    if (kind == P).all():
        return se3.from_rotation_translation(R, offset.mean(1))
    outer = e[..., :, None] * e[..., None, :]
    eye = torch.eye(3, dtype=p.dtype, device=p.device)
    N = torch.where((kind == E)[..., None, None], outer, eye - outer)
    t = solve_3x3(N.sum(1), (N @ offset[..., None]).sum(1)[..., 0], least=PARALLEL**2)
    return se3.from_rotation_translation(R, t)


def _is_determined(one: Tensor, two: Tensor, kind: Tensor) -> Tensor:
    """Whether the directions are not parallel, and those of lines at one angle in both frames."""
    sine = torch.linalg.cross(one[:, 0], one[:, 1]).norm(dim=-1)
    size = one.norm(dim=-1).prod(-1)
    cosine = (one[:, 0] * one[:, 1]).sum(-1) / size
    other = (two[:, 0] * two[:, 1]).sum(-1) / two.norm(dim=-1).prod(-1)
    same_sense = (cosine - other).abs() < AGREEMENT
    return (sine > PARALLEL * size) & (same_sense | kind.ne(L).all(-1))
