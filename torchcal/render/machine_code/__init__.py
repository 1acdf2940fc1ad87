"""Where machine code takes the place of tensor operations: on the CPU, where numba is installed."""

from functools import cache
from importlib import import_module
from types import ModuleType

from torch import Tensor
from torch.autograd import forward_ad


def machine_code_for(tensor: Tensor, module: str) -> ModuleType | None:
    """A module of compiled functions; None where the tensor's device or this machine has none."""
    return _loaded(module) if tensor.device.type == "cpu" else None


def is_traced(tensor: Tensor) -> bool:
    """Whether automatic differentiation, reverse or forward, follows a tensor."""
    return tensor.requires_grad or forward_ad.unpack_dual(tensor).tangent is not None


@cache
def _loaded(module: str) -> ModuleType | None:
    """None where numba is missing or finds no place to keep what it compiles."""
    try:
        return import_module(f"torchcal.render.machine_code.{module}")
    except (ImportError, RuntimeError):
        return None
