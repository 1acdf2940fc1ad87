"""What a caller may get wrong with a tensor: found where it is handed over, not deep inside."""

import torch
from torch import Tensor

from torchcal.errors import TorchcalError


def check_floats(what: str, value: object, *shape: int | str) -> None:
    """Raises unless a value is a tensor of floats.

    Args:
        what: The value's name.
        value: What was handed over.
        shape: Its lengths; a word stands for any length.

    Raises:
        TorchcalError: With what was found and what is expected.
    """
    if not isinstance(value, Tensor) or not value.is_floating_point() or not _fits(value, shape):
        raise _mistake(what, value, "floats", shape)


def check_booleans(what: str, value: object, *shape: int | str) -> None:
    """Raises unless a value is a tensor of booleans; as ``check_floats``."""
    if not isinstance(value, Tensor) or value.dtype != torch.bool or not _fits(value, shape):
        raise _mistake(what, value, "booleans", shape)


def _fits(value: Tensor, shape: tuple[int | str, ...]) -> bool:
    return value.ndim == len(shape) and all(
        isinstance(length, str) or length == there
        for length, there in zip(shape, value.shape, strict=True)
    )


def _mistake(what: str, value: object, kind: str, shape: tuple[int | str, ...]) -> TorchcalError:
    if isinstance(value, Tensor):
        found = f"{str(value.dtype).removeprefix('torch.')} of shape {_spelled(tuple(value.shape))}"
    else:
        found = f"a {type(value).__name__}"
    return TorchcalError(
        f"{what}: found {found}; expected a tensor of {kind} of shape {_spelled(shape)}"
    )


def _spelled(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))})"
