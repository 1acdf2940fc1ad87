"""The beam of eq. 17 and 18: the mean over a square of pixels."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchcal.render.machine_code import is_traced, machine_code_for


def box_sum(image: Float[Tensor, "*batch h w"], side: int) -> Float[Tensor, "*batch h w"]:
    """Sum over the part inside the image of the ``side`` x ``side`` box about each pixel (eq. 18).

    On the CPU it is done in machine code where numba is installed, else, and if gradients are to
    be traced, by tensors.

    Args:
        image: Any batch of finite images.
        side: Odd number of pixels (2N + 1).
    """
    if side == 1:
        return image
    module = None if is_traced(image) else machine_code_for(image, "beam")
    of_images = plain_box_sum if module is None else module.box_sum
    return of_images(image, side)


def plain_box_sum(image: Float[Tensor, "*batch h w"], side: int) -> Float[Tensor, "*batch h w"]:
    """The same by tensor operations, on any device."""
    height, width = image.shape[-2:]
    # A wider window holds the whole axis everywhere, too.
    rows, columns = min(side, 2 * height - 1), min(side, 2 * width - 1)
    padded = functional.pad(image, (columns // 2, columns // 2, rows // 2, rows // 2))
    return _window_sum(_window_sum(padded, rows, -2), columns, -1)


def _window_sum(part: Tensor, side: int, axis: int) -> Tensor:
    """Sums over all windows within an axis, put together from sums over powers of two."""
    size = part.shape[axis] - side + 1
    total = part.narrow(axis, 0, size)  # ``side`` is odd
    width, start = 1, 1
    while 2 * width <= side:
        length = part.shape[axis] - width
        part = part.narrow(axis, 0, length) + part.narrow(axis, width, length)
        width *= 2
        if side & width:
            total = total + part.narrow(axis, start, size)
            start += width
    return total


def beam_area(height: int, width: int, side: int, like: Tensor) -> Float[Tensor, "h w"]:
    """Area (pixels) of the part inside the image of the box about each pixel."""
    rows, columns = (_inside(size, side, like) for size in (height, width))
    return rows[:, None] * columns


def _inside(size: int, side: int, like: Tensor) -> Tensor:
    """How many pixels of each window are inside an axis."""
    place = torch.arange(size, dtype=like.dtype, device=like.device)
    half = side // 2
    return (place + half).clamp(max=size - 1) - (place - half).clamp(min=0) + 1
