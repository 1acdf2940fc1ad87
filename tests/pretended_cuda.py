"""A device that reports to be CUDA and holds the CPU's memory: it raises where a GPU would.

It shows where tensors lie, on a machine without a GPU: with ``PretendedCuda()`` entered, whatever
is made on or moved to ``cuda`` is ``Pretended``, and so is what is computed from it. It can show
nothing of speed, of memory, of rounding and of kernels that are missing beyond the few named here.
``torch.func`` makes plain tensors of pretended ones, so that it cannot run here.
"""

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

CUDA = torch.device("cuda", 0)
CPU = torch.device("cpu")

TRANSFERS = {"to", "cuda", "cpu"}
TAKES_ANY_DEVICE = {"copy_", "new_tensor", "expand_as", "view_as", "reshape_as"}
"""They copy values or look at sizes alone."""
PRODUCTS = {"matmul", "__matmul__", "__rmatmul__", "mm", "bmm", "mv", "dot", "einsum", "tensordot"}

Found: TypeAlias = list[tuple[Tensor, bool]]
"""Tensors among arguments, and whether each is in a list: cat and its like allow no exception."""


class Pretended(Tensor):
    """Memory of the CPU that passes for a GPU's."""

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        return _called(func, args, kwargs or {})

    def __format__(self, spec: str) -> str:
        return format(self.item(), spec) if self.dim() == 0 else repr(self)

    def __deepcopy__(self, memo: dict) -> Tensor:
        return self.clone()


class PretendedCuda(TorchFunctionMode):
    """While it is entered there is one pretended GPU."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        return _called(func, args, kwargs or {})


def _called(func: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
    """What a function of torch answers, or what it raises, if there is a GPU."""
    name = getattr(func, "__name__", "")
    if name == "__get__":
        return _attribute(func, *args)
    with torch._C.DisableTorchFunctionSubclass():
        if name in TRANSFERS:
            return _transferred(name, func, args, kwargs)
        found = _tensors((*args, *kwargs.values()))
        on_cuda = any(type(each) is Pretended for each, _ in found)
        if on_cuda:
            _refuse(name, args, kwargs, found)
        if kwargs.get("device") is not None:
            on_cuda = torch.device(kwargs["device"]).type == "cuda"
            kwargs = {**kwargs, "device": CPU}
        if on_cuda:
            _refuse_generator((*args, *kwargs.values()))
        # What is indexed decides, not the index.
        if name == "__getitem__":
            on_cuda = type(args[0]) is Pretended
        result = func(*args, **kwargs)
        if name == "__iter__":
            result = list(result)
        result = _pretended(result) if on_cuda else result
        return iter(result) if name == "__iter__" else result


ATTRIBUTES: dict[Any, Callable[[bool], Any]] = {
    Tensor.device: lambda on_cuda: CUDA if on_cuda else CPU,
    Tensor.is_cuda: lambda on_cuda: on_cuda,
    Tensor.is_cpu: lambda on_cuda: not on_cuda,
}


def _attribute(get: Callable, tensor: Tensor, *kind: type) -> Any:
    on_cuda, attribute = type(tensor) is Pretended, getattr(get, "__self__", None)
    if attribute in ATTRIBUTES:
        return ATTRIBUTES[attribute](on_cuda)
    with torch._C.DisableTorchFunctionSubclass():
        result = get(tensor, *kind)
        return _pretended(result) if on_cuda else result


def _transferred(name: str, func: Callable, args: tuple, kwargs: dict[str, Any]) -> Tensor:
    """A copy where the device is another one."""
    before = type(args[0]) is Pretended
    after = {"cuda": True, "cpu": False}.get(name, before)
    result = args[0]
    if name == "to":
        for value in (*args[1:], *kwargs.values()):
            if isinstance(value, Tensor):
                after = type(value) is Pretended
            elif isinstance(value, str | torch.device):
                after = torch.device(value).type == "cuda"
        there = {key: _on_cpu(value) for key, value in kwargs.items()}
        result = func(*(_on_cpu(each) for each in args), **there)
    if before != after:
        result = result.as_subclass(Tensor).clone()
    return _pretended(result) if after else result


def _on_cpu(value: Any) -> Any:
    return CPU if isinstance(value, str | torch.device) else value


def _pretended(result: Any) -> Any:
    if type(result) is Pretended:
        return result
    if isinstance(result, Tensor):
        if result.requires_grad and result.is_leaf:
            return result.detach().as_subclass(Pretended).requires_grad_()
        return result.as_subclass(Pretended)
    if type(result) is torch.Size or not isinstance(result, tuple | list):
        return result
    return type(result)([_pretended(each) for each in result])


def _tensors(values: Iterable, listed: bool = False) -> Found:
    found: Found = []
    for value in values:
        if isinstance(value, Tensor):
            found.append((value, listed))
        elif isinstance(value, tuple | list):
            found += _tensors(value, listed=True)
    return found


def _refuse(name: str, args: tuple, kwargs: dict[str, Any], found: Found) -> None:
    """Raises what CUDA raises."""
    if name in ("numpy", "__array__"):
        raise TypeError(
            "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor "
            "to host memory first."
        )
    _refuse_missing(name, kwargs, found)
    if name == "__getitem__":
        _refuse_index(*args)
    elif name == "__setitem__":
        _refuse_assignment(*args)
    elif name not in TAKES_ANY_DEVICE:
        _refuse_mixture(found)


def _refuse_generator(values: Iterable) -> None:
    if any(type(each) is torch.Generator for each in values):
        raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")


def _refuse_missing(name: str, kwargs: dict[str, Any], found: Found) -> None:
    """What torch has no kernel for, as far as it is likely to be called."""
    if name in PRODUCTS and not any(each.is_floating_point() for each, _ in found):
        raise RuntimeError("\"addmm_cuda\" not implemented for 'Long'")
    if name == "linalg_lstsq" and kwargs.get("driver", "gels") != "gels":
        raise RuntimeError(
            "torch.linalg.lstsq: `driver` other than `gels` is not supported on CUDA"
        )
    if name in ("histogram", "histogramdd"):
        raise NotImplementedError(f"Could not run 'aten::{name}' with arguments from 'CUDA'")


def _refuse_mixture(found: Found) -> None:
    for each, listed in found:
        if type(each) is not Pretended and (listed or each.dim() > 0):
            raise RuntimeError(
                "Expected all tensors to be on the same device, but found at least two devices, "
                "cuda:0 and cpu!"
            )


def _refuse_index(indexed: Tensor, index: Any) -> None:
    if type(indexed) is Pretended:
        return
    for each, _ in _tensors((index,)):
        if type(each) is Pretended and (each.dim() > 0 or each.dtype == torch.bool):
            raise RuntimeError(
                "indices should be either on cpu or on the same device as the indexed tensor (cpu)"
            )


def _refuse_assignment(changed: Tensor, index: Any, value: Any) -> None:
    """Numbers and slices copy from one device to the other, tensors and lists do not."""
    _refuse_index(changed, index)
    parts = index if isinstance(index, tuple) else (index,)
    by_table = any(isinstance(each, list | Tensor) for each in parts)
    mixed = type(value) is not type(changed)
    if by_table and mixed and isinstance(value, Tensor) and value.dim() > 0:
        _refuse_mixture([(changed, True), (value, True)])
