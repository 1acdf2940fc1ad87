"""Tensors on any device as arrays for drawing."""

import numpy as np
from torch import Tensor


def as_array(tensor: Tensor) -> np.ndarray:
    """The values of a tensor of any shape, on the CPU and without its gradient."""
    return tensor.detach().cpu().numpy()
