"""What the images cannot tell: directions in which the prior is all that is known."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.parameters import AXES, Parameters
from torchcal.calibrate.result import UnobservableDirection
from torchcal.geometry import gaussian

LEFT = 0.5
"""Share of the prior's sigma: where more of it is left, the images said next to nothing."""
NAMED = 0.3
"""Parts of a direction below this share of it, in sigmas and in metres, are not named."""
MOST_NAMED = 4
"""Parts of a direction that are named; of smaller ones only the number is."""
TURNS = 200
"""Most rounds of the search for a sparse basis; it needs a few dozen."""
STILL = 1e-9
"""It ends when a round raises the sum of fourth powers by less."""
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

    Where there are several, any mixture of them is as unknown as they are: those returned are
    orthogonal and span the same space with as few parts as possible. Directions that are one thing
    to a person, such as the six of a whole pose, have the same words.
    """
    if not parameters.names:
        return ()
    ratio, direction = gaussian.left_over(covariance, parameters.prior_sigma)
    basis = sparse_basis(direction[:, ratio > LEFT].mT)
    return tuple(
        UnobservableDirection(words=words, vector=vector)
        for words, vector in zip(_sentences(basis, parameters), basis, strict=True)
    )


def sentences(directions: Sequence[UnobservableDirection]) -> tuple[str, ...]:
    """What is to be said of directions: each sentence once."""
    return tuple(dict.fromkeys(direction.words for direction in directions))


def sparse_basis(vectors: Float[Tensor, "vector n"]) -> Float[Tensor, "vector n"]:
    """Orthonormal vectors of the same space with few large parts, by the place of the largest.

    Among all orthonormal bases it has the largest sum of fourth powers (the quartimax criterion of
    factor analysis): 1 for each vector of a single part, 1/2 for one of two equal parts.

    Args:
        vectors: Orthonormal.
    """
    if len(vectors) == 0:
        return vectors
    basis, powers = vectors, vectors.new_tensor(0.0)
    for _ in range(TURNS):
        left, _, right = torch.linalg.svd(basis.pow(3) @ vectors.mT)
        basis, before = left @ right @ vectors, powers
        powers = basis.pow(4).sum()
        if powers - before < STILL:
            break
    largest = basis.abs().argmax(1)
    basis = basis * basis.gather(1, largest[:, None]).sign()
    return basis[largest.argsort(stable=True)]


def _sentences(basis: Tensor, parameters: Parameters) -> list[str]:
    """What to say of each vector of a basis."""
    named = [_named(vector, parameters) for vector in basis]
    alone = {names[0] for names in named if len(names) == 1}
    coupled = [frozenset(_owner(name) for name in names) for names in named]
    return [
        _of_one(names[0], alone, parameters)
        if len(names) == 1
        else _of_poses(owners, parameters)
        if coupled.count(owners) == len(AXES) and len(owners) > 1
        else _of_parts(names, parameters)
        for names, owners in zip(named, coupled, strict=True)
    ]


def _named(direction: Tensor, parameters: Parameters) -> list[str]:
    """The parameters that count in a direction, the largest first."""
    effect = (direction * parameters.prior_sigma * LEVER).abs()
    size = torch.maximum(direction.abs(), effect / effect.max())
    order = size.argsort(descending=True, stable=True).tolist()
    return [parameters.names[i] for i in order if size[i] > NAMED]


def _owner(name: str) -> str:
    """What a parameter belongs to: ``base``, ``objects.crate``; a joint's offset is its own."""
    owner, _, axis = name.rpartition(".")
    return owner if axis in AXES else name


def _of_one(name: str, alone: set[str], parameters: Parameters) -> str:
    """Of a parameter of which nothing is told, with those of its pose that share this."""
    owner, _, axis = name.rpartition(".")
    if axis not in AXES or owner == "joints":
        return f"{parameter_words(name, parameters)} cannot be told from these images"
    frames = sorted({each for each in map(_owner, parameters.names) if each.startswith("frames.")})
    words = _owner_words(owner, parameters)
    in_all = len(frames) > 1 and all(f"{each}.{axis}" in alone for each in frames)
    if owner in frames and in_all:
        words = "the sensor in each frame"
    half = AXES[:3] if axis in AXES[:3] else AXES[3:]
    if all(f"{owner}.{each}" in alone for each in AXES):
        what = f"the whole pose of {words}"
    elif all(f"{owner}.{each}" in alone for each in half):
        what = f"any {'shift' if axis in AXES[:3] else 'turn'} of {words}"
    else:
        what = AXIS_WORDS[axis].format(words)
    return f"{what} cannot be told from these images"


def _of_poses(owners: frozenset[str], parameters: Parameters) -> str:
    """Of poses that move the images in the same six ways."""
    places = {_owner(name): place for place, name in reversed([*enumerate(parameters.names)])}
    words = [_whole_words(each, parameters) for each in sorted(owners, key=places.__getitem__)]
    return f"{_listed(list(dict.fromkeys(words)))} cannot be told apart in these images"


def _whole_words(owner: str, parameters: Parameters) -> str:
    block = owner.partition(".")[0]
    if block == "frames":
        return "the sensor's own pose in each frame"
    if block in ("joints", "range"):
        return parameter_words(owner, parameters)
    return f"the whole pose of {_owner_words(owner, parameters)}"


def _of_parts(names: Sequence[str], parameters: Parameters) -> str:
    """Of a direction with several parts: the largest of them, in the order of the parameters."""
    largest = sorted(names[:MOST_NAMED], key=parameters.names.index)
    words = [parameter_words(name, parameters) for name in largest]
    left = len(names) - len(largest)
    words += [f"{left} smaller part{'s' if left > 1 else ''}"] if left else []
    return f"{_listed(words)} cannot be told apart in these images"


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


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
