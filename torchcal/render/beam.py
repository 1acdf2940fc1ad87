"""The beam of eq. 17 and 18: the mean over a square of pixels."""

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


def box_sum(image: Float[Tensor, "*batch h w"], side: int) -> Float[Tensor, "*batch h w"]:
    """Sum over the part inside the image of the ``side`` x ``side`` box about each pixel (eq. 18).

    Args:
        image: Any batch of images.
        side: Odd number of pixels (2N + 1).
    """
    flat = image.reshape(-1, 1, *image.shape[-2:])
    half = side // 2
    rows = functional.avg_pool2d(flat, (side, 1), 1, (half, 0), divisor_override=1)
    both = functional.avg_pool2d(rows, (1, side), 1, (0, half), divisor_override=1)
    return both.reshape(image.shape)


def beam_area(height: int, width: int, side: int, like: Tensor) -> Float[Tensor, "h w"]:
    """Area (pixels) of the part inside the image of the box about each pixel."""
    return box_sum(like.new_ones(height, width), side)
