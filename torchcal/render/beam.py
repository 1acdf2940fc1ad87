"""The beam of eq. 17 and 18: the mean over a square of pixels."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


def box_sum(image: Float[Tensor, "*batch h w"], side: int) -> Float[Tensor, "*batch h w"]:
    """Sum over the part inside the image of the ``side`` x ``side`` box about each pixel (eq. 18).

    Args:
        image: Any batch of images.
        side: Odd number of pixels (2N + 1).
    """
    return _window_sum(_window_sum(image, side, -2), side, -1)


def _window_sum(image: Tensor, side: int, axis: int) -> Tensor:
    """Sums over windows about each place of an axis, put together from sums over powers of two."""
    size = image.shape[axis]
    side = min(side, 2 * size - 1)  # a wider window holds the whole axis everywhere, too
    half = side // 2
    padding = (half, half) if axis == -1 else (0, 0, half, half)
    part = functional.pad(image, padding)
    total = torch.zeros_like(image)
    width, start = 1, 0
    while True:
        if side & width:
            total += part.narrow(axis, start, size)
            start += width
        if 2 * width > side:
            return total
        length = part.shape[axis] - width
        part = part.narrow(axis, 0, length) + part.narrow(axis, width, length)
        width *= 2


def beam_area(height: int, width: int, side: int, like: Tensor) -> Float[Tensor, "h w"]:
    """Area (pixels) of the part inside the image of the box about each pixel."""
    return box_sum(like.new_ones(height, width), side)
