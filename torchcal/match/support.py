"""How well poses explain the measured elements: a score that needs no truth."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.elements import Deviation, Elements, Kind
from torchcal.match.minimal_sets import Hypotheses


def explained(
    hypotheses: Hypotheses,
    model: Elements,
    measured: Elements,
    deviation: Deviation,
    *,
    gate: float,
) -> Bool[Tensor, "hypothesis model measured"]:
    """Which measured elements lie within ``gate`` standard deviations of which of the model's.

    Args:
        hypotheses: Poses that carry the model's elements onto the measured ones.
        model: Elements of each member of the batch.
        measured: Elements of each member of the batch.
        deviation: ``measured.deviation()``.
        gate: Standard deviations.
    """
    batch = hypotheses.batch
    distance, turn = _differences(hypotheses, model, measured)
    near = distance <= gate * deviation.position[batch][:, None]
    if turn is None:
        return near
    return near & (turn <= gate * deviation.direction[batch][:, None])


def standard_errors(
    hypotheses: Hypotheses, model: Elements, measured: Elements, deviation: Deviation
) -> Float[Tensor, "hypothesis model measured"]:
    """How many standard deviations every measured element is away from every one of the model's.

    The larger of the number for the points and that for the directions; infinite between elements
    of different kinds and where one is not finite.

    Args:
        hypotheses: Poses that carry the model's elements onto the measured ones.
        model: Elements of each member of the batch.
        measured: Elements of each member of the batch.
        deviation: ``measured.deviation()``.
    """
    batch = hypotheses.batch
    distance, turn = _differences(hypotheses, model, measured)
    error = distance / deviation.position[batch][:, None]
    if turn is not None:
        turned = turn / deviation.direction[batch][:, None]
        error = torch.where(turn == 0, error, torch.maximum(error, turned))
    return error.nan_to_num(nan=torch.inf, posinf=torch.inf)


def _differences(
    hypotheses: Hypotheses, model: Elements, measured: Elements
) -> tuple[Tensor, Tensor | None]:
    """Distances (m) and chords between directions; None for these where all elements are points.

    From a line the distance across, from a plane along its normal; infinite between kinds.
    """
    batch, T = hypotheses.batch, hypotheses.T
    x, q = se3.transform(T, model.point[batch]), measured.point[batch]
    # Differences first: the expansion with a matrix product would lose small distances far away.
    distance = torch.cdist(x, q, compute_mode="donot_use_mm_for_euclid_dist")
    if not (model.directed or measured.directed):
        return distance, None
    kind = model.kind[batch][:, :, None]
    e, n = model.direction[batch] @ T[:, :3, :3].mT, measured.direction[batch]
    along = ((e * x).sum(-1, keepdim=True) - e @ q.mT).abs()
    across = (distance.square() - along.square()).clamp(min=0.0).sqrt()
    distance = torch.where(kind == Kind.LINE, across, distance)
    distance = torch.where(kind == Kind.PLANE, along, distance)
    chord = torch.cdist(e, n, compute_mode="donot_use_mm_for_euclid_dist")
    opposed = torch.cdist(e, -n, compute_mode="donot_use_mm_for_euclid_dist")
    chord = torch.where(kind == Kind.LINE, torch.minimum(chord, opposed), chord)
    chord = torch.where(kind == Kind.POINT, 0.0, chord)
    same = kind == measured.kind[batch][:, None]
    return torch.where(same, distance, torch.inf), chord


def count_distinct(pairs: Bool[Tensor, "*batch model measured"]) -> Int[Tensor, "*batch"]:
    """The number of pairs when no element counts twice, at most: the fewer of both sides."""
    return torch.minimum(pairs.any(-1).sum(-1), pairs.any(-2).sum(-1))


def fingerprints(
    hypotheses: Hypotheses,
    model: Elements,
    measured: Elements,
    pairs: Bool[Tensor, "hypothesis model measured"],
) -> Int[Tensor, " hypothesis"]:
    """Numbers that are equal where poses explain the same pairs with lines in the same senses.

    Such hypotheses are one pose. (The numbers are random sums of 64 bits.)

    Args:
        hypotheses: Poses that carry the model's elements onto the measured ones.
        model: Elements of each member of the batch.
        measured: Elements of each member of the batch.
        pairs: What each pose explains.
    """
    generator = torch.Generator().manual_seed(0)
    size = 2 * model.count * measured.count
    words = torch.randint(-(2**62), 2**62, (size,), generator=generator).to(pairs.device)
    straight, turned = words.view(2, model.count, measured.count)
    prints = torch.where(pairs, straight, 0).sum((1, 2))
    if not (model.directed and measured.directed):
        return prints
    batch = hypotheses.batch
    e = model.direction[batch] @ hypotheses.T[:, :3, :3].mT
    opposed = (e @ measured.direction[batch].mT) < 0
    return prints + torch.where(pairs & opposed, turned, 0).sum((1, 2))


def are_new(
    batch: Int[Tensor, " hypothesis"], prints: Int[Tensor, " hypothesis"]
) -> Bool[Tensor, " hypothesis"]:
    """Whether no earlier hypothesis of the same member of the batch has the same fingerprint."""
    order = prints.argsort(stable=True)
    order = order[batch[order].argsort(stable=True)]
    same = (prints[order].diff() == 0) & (batch[order].diff() == 0)
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = ~same
    return torch.zeros_like(first).index_put((order,), first)


def are_best(
    batch: Int[Tensor, " hypothesis"], score: Int[Tensor, " hypothesis"], members: int
) -> Bool[Tensor, " hypothesis"]:
    """Whether no hypothesis of the same member of the batch has a higher score."""
    least = torch.iinfo(score.dtype).min
    highest = score.new_full((members,), least).scatter_reduce(0, batch, score, "amax")
    return score == highest[batch]
