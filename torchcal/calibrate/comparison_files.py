"""The comparison of a frame as a file of compressed arrays; what is compared, to the last bit."""

from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcal.calibrate.result import FrameComparison
from torchcal.errors import TorchcalError

ARRAYS = ("measured", "predicted", "sigma", "label", "body", "colour", "normal", "usable")


def write_comparison(comparison: FrameComparison, file: Path) -> None:
    """Writes ``.npz`` that ``read_comparison`` reads: single precision, colours as bytes."""
    np.savez_compressed(
        file,
        measured=_array(comparison.measured).astype(np.float32),
        predicted=_array(comparison.predicted).astype(np.float32),
        sigma=_array(comparison.sigma).astype(np.float32),
        label=_array(comparison.label).astype(np.uint8),
        body=_array(comparison.body).astype(np.int32),
        colour=np.round(255.0 * _array(comparison.colour)).astype(np.uint8),
        normal=_array(comparison.normal).astype(np.float16),
        usable=_array(comparison.usable),
    )


def read_comparison(file: Path, name: str) -> FrameComparison:
    """The comparison of the frame ``name``; normals are true to a thousandth.

    Raises:
        TorchcalError: If the file is missing or is not what ``write_comparison`` wrote.
    """
    try:
        with np.load(file) as data:
            arrays = {key: torch.from_numpy(data[key]) for key in ARRAYS}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise _damaged(file, f"{type(error).__name__}: {error}") from error
    if len({array.shape[:2] for array in arrays.values()}) > 1:
        raise _damaged(file, "arrays of different sizes")
    return FrameComparison(
        name=name,
        measured=arrays["measured"],
        predicted=arrays["predicted"],
        sigma=arrays["sigma"],
        label=arrays["label"].long(),
        body=arrays["body"].long(),
        colour=arrays["colour"].float() / 255.0,
        normal=arrays["normal"].float(),
        usable=arrays["usable"],
    )


def _damaged(file: Path, found: str) -> TorchcalError:
    return TorchcalError(f"{file}: found {found}; expected what torchcal calibrate wrote")


def _array(tensor: Tensor) -> NDArray:
    return tensor.detach().cpu().numpy()
