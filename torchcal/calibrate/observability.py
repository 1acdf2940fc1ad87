"""What the images cannot tell: directions in which the prior is all that is known."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.result import UnobservableDirection
from torchcal.geometry import gaussian

LEFT = 0.5
"""Share of the prior's sigma: where more of it is left, the images said next to nothing."""
NAMED = 0.3
"""Components of a unit direction below this are not named."""
WORDS = {
    "x": "a shift of the {} along x",
    "y": "a shift of the {} along y",
    "z": "a shift of the {} along z",
    "rx": "a turn of the {} about x",
    "ry": "a turn of the {} about y",
    "rz": "a turn of the {} about z",
}
BLOCKS = {"base": "base", "mount": "sensor's mount", "sensor": "sensor"}


def unobservable_directions(
    covariance: Float[Tensor, "parameter parameter"], parameters: Parameters
) -> tuple[UnobservableDirection, ...]:
    """Directions in which the images leave more than half of the prior's sigma."""
    if not parameters.names:
        return ()
    ratio, direction = gaussian.left_over(covariance, parameters.prior_sigma)
    return tuple(
        UnobservableDirection(
            words=_words(direction[:, i], parameters.names), vector=direction[:, i]
        )
        for i in range(len(ratio))
        if ratio[i] > LEFT
    )


def _words(direction: Tensor, names: tuple[str, ...]) -> str:
    named = [
        WORDS[axis].format(BLOCKS[block])
        for name, share in zip(names, direction.tolist(), strict=True)
        if abs(share) > NAMED
        for block, axis in [name.split(".")]
    ]
    if len(named) == 1:
        return f"{named[0]} cannot be told from these images"
    return f"{', '.join(named[:-1])} and {named[-1]} cannot be told apart in these images"


def poses_are_told(
    covariance: Float[Tensor, "parameter parameter"],
    parameters: Parameters,
    pose_jacobians: Float[Tensor, "frame 6 parameter"],
) -> bool:
    """Whether the images leave at most half of the prior's sigma in every frame's sensor pose.

    Where no sensor pose depends on the unknowns, it is asked of the unknowns themselves: a robot's
    base before a sensor that stands still.
    """
    if not pose_jacobians.any():
        return not unobservable_directions(covariance, parameters)
    prior = torch.diag(parameters.prior_sigma.square())
    for J in pose_jacobians:
        before, after = (gaussian.moved_covariance(P, J) for P in (prior, covariance))
        # Metres and radians are made alike by what the prior says of each axis.
        scale = before.diagonal().clamp(min=1e-18).rsqrt()
        value, vector = torch.linalg.eigh(before * scale[:, None] * scale)
        free = value > 1e-9
        root = vector[:, free] * value[free].rsqrt() * scale[:, None]
        if free.any() and torch.linalg.eigvalsh(root.mT @ after @ root)[-1] > LEFT**2:
            return False
    return True
