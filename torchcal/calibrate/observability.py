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
"""Parts of a direction below this share of it, in sigmas and in metres, are not named."""
LEVER = 1.0
"""m: at this distance a turn and a shift are compared."""
AXIS_WORDS = {
    "x": "a shift of {} along x",
    "y": "a shift of {} along y",
    "z": "a shift of {} along z",
    "rx": "a turn of {} about x",
    "ry": "a turn of {} about y",
    "rz": "a turn of {} about z",
}


def unobservable_directions(
    covariance: Float[Tensor, "parameter parameter"], parameters: Parameters
) -> tuple[UnobservableDirection, ...]:
    """Directions in which the images leave more than half of the prior's sigma.

    Where there are several, any mixture of them is as unknown as they are: each of those returned
    has as few parts as possible.
    """
    if not parameters.names:
        return ()
    ratio, direction = gaussian.left_over(covariance, parameters.prior_sigma)
    return tuple(
        UnobservableDirection(words=_words(vector, parameters), vector=vector)
        for vector in sparse_basis(direction[:, ratio > LEFT].mT)
    )


def sparse_basis(vectors: Float[Tensor, "vector n"]) -> Float[Tensor, "vector n"]:
    """Unit vectors that span the same space, each 0 where another has its largest part.

    Args:
        vectors: Linearly independent.
    """
    basis = vectors.clone()
    for row in range(len(basis)):
        place = int(basis[row:].abs().argmax())
        pivot, column = row + place // basis.shape[1], place % basis.shape[1]
        basis[[row, pivot]] = basis[[pivot, row]]
        basis[row] /= basis[row, column].clone()
        others = torch.arange(len(basis), device=basis.device) != row
        basis[others] -= basis[others, column, None] * basis[row]
    return torch.nn.functional.normalize(basis, dim=-1)


def _words(direction: Tensor, parameters: Parameters) -> str:
    effect = direction * parameters.prior_sigma * LEVER
    named = (direction.abs() > NAMED) | (effect.abs() > NAMED * effect.abs().max())
    places = named.nonzero()[:, 0].tolist()
    words = [parameter_words(parameters.names[i], parameters) for i in places]
    if len(words) == 1:
        return f"{words[0]} cannot be told from these images"
    return f"{', '.join(words[:-1])} and {words[-1]} cannot be told apart in these images"


def parameter_words(name: str, parameters: Parameters) -> str:
    """A parameter's name as a person says it.

    Args:
        name: One of ``parameters.names``.
        parameters: They know whether there is a robot: without one it is the sensor that moves.
    """
    block, _, rest = name.partition(".")
    if block == "joints":
        return f"the offset of joint {rest}"
    if block == "range":
        return f"the {rest} of the sensor's range"
    owner, _, axis = name.rpartition(".")
    return AXIS_WORDS[axis].format(_owner_words(owner, parameters))


def _owner_words(owner: str, parameters: Parameters) -> str:
    """What has a pose."""
    block, _, rest = owner.partition(".")
    if block == "frames":
        return f"the sensor in frame {rest}"
    if block == "objects":
        return f"object {rest}"
    if block == "mount":
        return "the sensor's mount"
    if parameters.mechanism.robot is not None:
        return "the base"
    frames = len(parameters.mechanism.Ts_first_frame)
    return "the sensor" if frames == 1 else "the sensor in all frames"


def poses_are_told(
    covariance: Float[Tensor, "parameter parameter"],
    parameters: Parameters,
    jacobians: Float[Tensor, "pose 6 parameter"],
) -> bool:
    """Whether the images leave at most half of the prior's sigma in every pose.

    Where no pose depends on the unknowns, it is asked of the unknowns themselves: a robot's base
    before a sensor that stands still.

    Args:
        covariance: P of eq. 3.
        parameters: What was unknown.
        jacobians: Of the frames' sensor poses and of the unknown objects.
    """
    if not jacobians.any():
        return not unobservable_directions(covariance, parameters)
    prior = torch.diag(parameters.prior_sigma.square())
    for J in jacobians:
        before, after = (gaussian.moved_covariance(P, J) for P in (prior, covariance))
        # Metres and radians are made alike by what the prior says of each axis.
        scale = before.diagonal().clamp(min=1e-18).rsqrt()
        value, vector = torch.linalg.eigh(before * scale[:, None] * scale)
        free = value > 1e-9
        root = vector[:, free] * value[free].rsqrt() * scale[:, None]
        if free.any() and torch.linalg.eigvalsh(root.mT @ after @ root)[-1] > LEFT**2:
            return False
    return True
