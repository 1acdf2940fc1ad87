"""Lists of pairs of elements."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor


def place_in_group(group: Int[Tensor, " row"], count: Int[Tensor, " group"]) -> Int[Tensor, " row"]:
    """The number of each row within its group.

    Args:
        group: Of each row, in ascending order.
        count: Rows of each group.
    """
    return torch.arange(len(group), device=group.device) - (count.cumsum(0) - count)[group]


@dataclass(frozen=True, kw_only=True, slots=True)
class Pairs:
    """Pairs (i, j) with C_ij = 1 for every problem of a batch, padded to the same length."""

    model: Int[Tensor, "problem pair"]
    measured: Int[Tensor, "problem pair"]
    valid: Bool[Tensor, "problem pair"]
    """False for padding."""

    @staticmethod
    def of(candidates: Bool[Tensor, "problem model measured"]) -> "Pairs":
        """The ones of the matrices C of eq. 6, in the order of the model's elements."""
        problem, model, measured = candidates.nonzero(as_tuple=True)
        count = candidates.flatten(1).sum(1)
        column = place_in_group(problem, count)
        shape = (len(candidates), int(count.max()) if len(count) else 0)
        padded = model.new_zeros(3, *shape)
        padded[:, problem, column] = torch.stack([model, measured, torch.ones_like(model)])
        return Pairs(model=padded[0], measured=padded[1], valid=padded[2].bool())

    def sorted_by(self, key: Int[Tensor, "problem pair"]) -> "Pairs":
        """In ascending order of a key, padding last."""
        order = torch.where(self.valid, key, torch.iinfo(key.dtype).max).argsort(dim=1, stable=True)
        return Pairs(
            model=self.model.gather(1, order),
            measured=self.measured.gather(1, order),
            valid=self.valid.gather(1, order),
        )
