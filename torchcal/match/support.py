"""How well poses explain the measured elements: a score that needs no truth."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.elements import Elements, Kind
from torchcal.match.minimal_sets import Hypotheses


def squared_errors(
    hypotheses: Hypotheses, model: Elements, measured: Elements
) -> Float[Tensor, "hypothesis model measured"]:
    """Squared distance in standard deviations of every measured from every model's element.

    The larger of that of the points and that of the directions; infinite between elements of
    different kinds and where one is not finite. The standard deviations are bounds over all axes.

    Args:
        hypotheses: Poses that carry the model's elements onto the measured ones.
        model: Elements of each member of the batch.
        measured: Elements of each member of the batch.
    """
    batch, T = hypotheses.batch, hypotheses.T
    position_sigma, direction_sigma = measured.deviation()
    precision = position_sigma.square().reciprocal()[batch][:, None]
    x, q = se3.transform(T, model.point[batch]), measured.point[batch]
    # Differences first: the expansion with a matrix product would lose small distances far away.
    squared = torch.cdist(x, q, compute_mode="donot_use_mm_for_euclid_dist").square()
    if not model.directed:
        return _without_nan(squared * precision)
    kind = model.kind[batch][:, :, None]
    e = model.direction[batch] @ T[:, :3, :3].mT
    along = ((e * x).sum(-1, keepdim=True) - e @ q.mT).square()
    squared = torch.where(kind == Kind.LINE, (squared - along).clamp(min=0.0), squared)
    squared = torch.where(kind == Kind.PLANE, along, squared) * precision
    cosine = e @ measured.direction[batch].mT
    cosine = torch.where(kind == Kind.LINE, cosine.abs(), cosine)
    turned = (2.0 - 2.0 * cosine) / direction_sigma.square()[batch][:, None]
    squared = torch.where(kind == Kind.POINT, squared, torch.maximum(squared, turned))
    same = kind == measured.kind[batch][:, None]
    return _without_nan(torch.where(same, squared, torch.inf))


def distinct(pairs: Bool[Tensor, "*batch model measured"]) -> Int[Tensor, "*batch"]:
    """The number of pairs when no element counts twice, at most: the fewer of both sides."""
    return torch.minimum(pairs.any(-1).sum(-1), pairs.any(-2).sum(-1))


def are_new(
    batch: Int[Tensor, " hypothesis"], pairs: Bool[Tensor, "hypothesis model measured"]
) -> Bool[Tensor, " hypothesis"]:
    """Whether no earlier hypothesis of the same member of the batch explains the same pairs.

    Such hypotheses are one pose. (Pairs are compared by random sums of 64 bits.)
    """
    generator = torch.Generator().manual_seed(0)
    size = pairs.shape[-1] * pairs.shape[-2]
    words = torch.randint(-(2**62), 2**62, (size,), generator=generator).to(pairs.device)
    prints = torch.where(pairs.flatten(1), words, 0).sum(1)
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


def _without_nan(squared: Tensor) -> Tensor:
    return torch.where(squared.isnan(), torch.inf, squared)
