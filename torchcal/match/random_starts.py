"""The random search of the initial values (3.5)."""

import torch

from torchcal.geometry import se3
from torchcal.match.elements import Elements
from torchcal.match.minimal_sets import Hypotheses


def random_starts(
    model: Elements, measured: Elements, count: int, *, generator: torch.Generator
) -> Hypotheses:
    """Poses with uniform rotations that carry some element's point onto some measured one's.

    Args:
        model: Elements of each member of the batch.
        measured: Elements of each member of the batch.
        count: Poses for each member of the batch.
        generator: For the draws.
    """
    members = len(model.kind)
    like = measured.point
    batch = torch.arange(members, device=like.device).repeat_interleave(count)

    def drawn(elements: Elements) -> torch.Tensor:
        choice = torch.randint(elements.count, (len(batch),), generator=generator).to(like.device)
        return elements.point[batch, choice]

    R = se3.random_rotations(len(batch), generator=generator).to(like)
    p, q = drawn(model), drawn(measured)
    return Hypotheses(
        batch=batch, T=se3.from_rotation_translation(R, q - (R @ p[..., None])[..., 0])
    )
