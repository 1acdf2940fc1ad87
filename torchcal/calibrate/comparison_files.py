"""The comparison of a frame as a file of compressed arrays."""

from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch

from torchcal.calibrate.result import FrameComparison
from torchcal.errors import TorchcalError

RANGES = ("measured", "predicted", "sigma")
ARRAYS = (*RANGES, "label", "body", "colour", "normal", "usable")


def write_comparison(comparison: FrameComparison, file: Path) -> None:
    """Writes ``.npz`` that ``read_comparison`` reads; ranges in single precision."""
    arrays = {key: getattr(comparison, key).detach().cpu() for key in ARRAYS}
    ranges = {key: arrays[key].float() for key in RANGES}
    np.savez_compressed(file, **{key: each.numpy() for key, each in (arrays | ranges).items()})


def read_comparison(file: Path, name: str) -> FrameComparison:
    """The comparison of the frame ``name``.

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
    return FrameComparison(name=name, **arrays)


def _damaged(file: Path, found: str) -> TorchcalError:
    return TorchcalError(f"{file}: found {found}; expected what torchcal calibrate wrote")
