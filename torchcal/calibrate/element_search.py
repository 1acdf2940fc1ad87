"""What a caller says about a search for the pose of elements, and what is wrong with it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.geometry import robust
from torchcal.match.elements import Elements, Kind


@dataclass(frozen=True, kw_only=True, slots=True)
class ElementSearch:
    """Settings of the search for a pose."""

    sets: int = 1000
    """Most minimal sets of candidates for each problem; more are sampled."""
    restarts: int = 4
    """Most repetitions of the search where good estimation cannot be obtained: the first among all
    pairs of elements, C ignored, the others from random poses."""
    starts: int = 64
    """Random poses in each of those."""
    enough: float = 0.75
    """Share of the measured elements that a good estimate explains."""
    least_cutoff: float = robust.EFFICIENT
    """Where c of eq. 16 stops shrinking in the last fit; 0 for the literal equation."""
    chunk: int = 2000
    """Most problems that are solved at a time: it bounds the memory."""

    def __post_init__(self) -> None:
        least = {"sets": 1, "restarts": 0, "starts": 1, "chunk": 1, "least_cutoff": 0.0}
        for name, bound in least.items():
            if not getattr(self, name) >= bound:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {bound}")
        if not 0.0 < self.enough <= 1.0:
            raise ValueError(f"enough is {self.enough}; it must be above 0 and at most 1")


def check_elements(model: Elements, measured: Elements, candidates: Tensor) -> None:
    """Finds what does not belong together.

    Raises:
        ValueError: If shapes or dtypes differ, a side is empty, or measured elements are exact.
    """
    found, expected = tuple(candidates.shape[-2:]), (model.count, measured.count)
    if found != expected:
        raise ValueError(
            f"candidates have the shape {found} (model, measured) for {expected[0]} elements of "
            f"the model and {expected[1]} measured ones"
        )
    if 0 in expected:
        raise ValueError(
            f"{expected[0]} elements of the model and {expected[1]} measured ones; "
            "there must be one of each at least"
        )
    if candidates.dtype != torch.bool:
        raise ValueError(f"candidates are {candidates.dtype}; the matrix C must be torch.bool")
    types = {model.point.dtype, measured.point.dtype}
    if len(types) > 1 or not types <= {torch.float32, torch.float64}:
        raise ValueError(
            f"the model's elements are {model.point.dtype}, the measured ones "
            f"{measured.point.dtype}; both must be float32, or both float64"
        )
    for name, elements in (("model", model), ("measured", measured)):
        own, batch = elements.kind.shape[:-1], candidates.shape[:-2]
        fits = all(a in (1, b) for a, b in zip(own[::-1], batch[::-1], strict=False))
        if len(own) > len(batch) or not fits:
            raise ValueError(
                f"the {name} elements have the batch {tuple(own)}, the candidates {tuple(batch)}"
            )
    deviation = measured.deviation()
    exact = (deviation.position == 0) | ((deviation.direction == 0) & (measured.kind != Kind.POINT))
    if exact.any():
        raise ValueError(
            "measured elements without a covariance; give that of their noise: of the point (m^2) "
            "and, for lines and planes, of the direction (rad^2)"
        )
