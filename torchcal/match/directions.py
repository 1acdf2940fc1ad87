"""Rotations that carry the directions of planes in an image onto those of a model (3.2).

Two directions fix a rotation. Large planes are found in any image of a built place, and a model has
few directions that many or large planes share: that leaves some dozens of rotations.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.geometry.alignment import rotation_from_directions

SAME = 0.1
"""rad within which directions count as one."""
AGREE = 0.12
"""rad: most that the angle between two directions may differ in image and model."""
LEAST_ANGLE = 0.35
"""rad: two directions must be apart by so much, from each other and from opposite ones."""
NEAR = 0.1
"""rad: rotations that are nearer than this count as one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Directions:
    """Normals that planes share, the most important first."""

    unit: Float[Tensor, "direction 3"]
    weight: Float[Tensor, " direction"]
    """Share of all planes' weight; in falling order."""

    @staticmethod
    def of(
        normal: Float[Tensor, "plane 3"], weight: Float[Tensor, " plane"], *, count: int
    ) -> "Directions":
        """Groups normals: the heaviest takes all that are near it, then the next.

        Args:
            normal: Of unit length.
            weight: How much each plane counts, such as its area.
            count: Most directions.
        """
        left, units, weights = weight.clone(), [], []
        for _ in range(min(count, len(weight))):
            heaviest = normal[left.argmax()]
            near = (normal @ heaviest > 1.0 - 0.5 * SAME**2) & (left > 0)
            if not near.any():
                break
            units.append(torch.nn.functional.normalize(weight[near] @ normal[near], dim=0))
            weights.append(left[near].sum())
            left = torch.where(near, 0.0, left)
        if not units:
            return Directions(unit=normal[:0], weight=weight[:0])
        found = torch.stack(weights) / weight.sum()
        order = found.argsort(descending=True)
        return Directions(unit=torch.stack(units)[order], weight=found[order])


def aligning_rotations(
    model: Directions, image: Directions, *, count: int
) -> Float[Tensor, "rotation 3 3"]:
    """Rotations R with ``model = R image`` for two directions at least, the likeliest first.

    Args:
        model: In the world's frame.
        image: In the sensor's frame.
        count: Most rotations.
    """
    a, b = _pairs(image.unit)
    A, B = _pairs(model.unit)
    angles, own = _angles(image.unit[a], image.unit[b]), _angles(model.unit[A], model.unit[B])
    apart = ((angles > LEAST_ANGLE) & (angles < torch.pi - LEAST_ANGLE))[:, None]
    i, j = (((angles[:, None] - own).abs() < AGREE) & apart).nonzero(as_tuple=True)
    R = rotation_from_directions(
        torch.stack([image.unit[a[i]], image.unit[b[i]]], 1),
        torch.stack([model.unit[A[j]], model.unit[B[j]]], 1),
    )
    R = _refined(R, model, image)
    return _distinct(R, _support(R, model, image), count)


def _refined(R: Tensor, model: Directions, image: Directions) -> Tensor:
    """Rotations that fit all directions best which agree (Kabsch)."""
    if len(R) == 0:
        return R
    cosine = (image.unit @ R.mT) @ model.unit.mT
    nearest = cosine.max(-1)
    weight = torch.where(nearest.values > 1.0 - 0.5 * AGREE**2, image.weight, 0.0)
    target = model.unit[nearest.indices]
    # The two directions that gave a rotation keep their say where they do not agree well.
    own = 0.01 * image.weight.sum() * R
    U, _, Vt = torch.linalg.svd((target * weight[..., None]).mT @ image.unit + own)
    turn = torch.ones(len(R), 3).to(R)
    turn[:, 2] = torch.linalg.det(U @ Vt)
    return (U * turn[:, None]) @ Vt


def _pairs(directions: Tensor) -> tuple[Tensor, Tensor]:
    """All ordered pairs of different directions."""
    one = torch.arange(len(directions), device=directions.device)
    a, b = torch.meshgrid(one, one, indexing="ij")
    keep = a != b
    return a[keep], b[keep]


def _angles(one: Tensor, two: Tensor) -> Tensor:
    return torch.acos((one * two).sum(-1).clamp(-1.0, 1.0))


def _support(R: Tensor, model: Directions, image: Directions) -> Tensor:
    """How much of the image's planes has a direction of the model, common ones before rare."""
    turned = image.unit @ R.mT
    near = turned @ model.unit.mT > 1.0 - 0.5 * AGREE**2
    common = torch.where(near, model.weight, 0.0).amax(-1)
    return (image.weight * (common > 0) * (1.0 + common)).sum(-1)


def _distinct(R: Tensor, support: Tensor, count: int) -> Tensor:
    """The best supported that are apart from all better ones."""
    order = support.argsort(descending=True)
    left, kept = R[order], []
    while len(left) and len(kept) < count:
        kept.append(left[0])
        # The trace of the turn between two rotations is 1 + 2 cos of its angle.
        apart = (left[0] * left).sum((-2, -1)) < 1.0 + 2.0 * math.cos(NEAR)
        left = left[apart]
    return torch.stack(kept) if kept else R[:0]
