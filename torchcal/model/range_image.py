"""Measured range images and the files that hold them."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from torchcal.errors import JobError, choices
from torchcal.model.regular_file import refuse_irregular
from torchcal.model.sensor import Sensor
from torchcal.model.tensor_mistakes import check_booleans, check_floats


@dataclass(frozen=True, kw_only=True, slots=True)
class RangeImage:
    """One measured image.

    Raises:
        TorchcalError: If ``range`` or ``usable`` is no image, or they differ in size.
    """

    name: str
    """The file's name without its folder and ending."""
    file: str
    """The file as the job names it."""
    range: Float[Tensor, "h w"]
    """Depth or distance (m); NaN where nothing was measured."""
    usable: Bool[Tensor, "h w"]
    """Pixels that may be used at all: the job's mask."""

    def __post_init__(self):
        check_floats("RangeImage.range", self.range, "h", "w")
        check_booleans("RangeImage.usable", self.usable, *self.range.shape)

    @staticmethod
    def blank(name: str, file: str, sensor: Sensor) -> "RangeImage":
        """An image that is still to be taken: nothing was measured."""
        shape = sensor.projection.height, sensor.projection.width
        return RangeImage(
            name=name,
            file=file,
            range=torch.full(shape, torch.nan, dtype=torch.float64),
            usable=torch.ones(shape, dtype=torch.bool),
        )


def read_range(file: Path, sensor: Sensor) -> Float[Tensor, "h w"]:
    """The ranges (m, float64) of an image file; NaN where nothing was measured.

    Integers are multiplied by ``sensor.depth_unit``, floats are metres. Nothing was measured where
    a pixel is 0, NaN, infinite or outside ``sensor.near`` to ``sensor.far``.

    Args:
        file: A 16-bit PNG, .npy or .tiff file.
        sensor: The sensor that took it.

    Raises:
        JobError: If the file cannot be read, is of the wrong kind or size, or holds no measurement.
    """
    array = _read_array(file)
    _check_ranges(file, array)
    _check_size(file, array, sensor)
    whole = np.issubdtype(array.dtype, np.integer)
    with np.errstate(over="ignore"):
        ranges = array.astype(np.float64) * (sensor.depth_unit if whole else 1.0)
    inside = (ranges != 0) & (ranges >= sensor.near) & (ranges <= sensor.far)
    if not inside.any():
        raise _no_measurement(file, ranges, sensor, whole)
    return torch.from_numpy(np.where(inside, ranges, np.nan))


def read_mask(file: Path, sensor: Sensor) -> Bool[Tensor, "h w"]:
    """The pixels of an image file that are not 0.

    Args:
        file: A PNG (8-bit, 16-bit or black and white), .npy or .tiff file with one channel.
        sensor: The sensor whose images it masks.

    Raises:
        JobError: If the file cannot be read, is of the wrong kind or size, or is 0 everywhere.
    """
    array = _read_array(file)
    _check_mask(file, array)
    _check_size(file, array, sensor)
    mask = np.nan_to_num(array) != 0
    if not mask.any():
        raise JobError(file, "", "a mask that is 0 everywhere", "some pixels that are not 0")
    return torch.from_numpy(mask)


def _read_array(file: Path) -> np.ndarray:
    read = _READERS.get(file.suffix.lower())
    if read is None:
        raise JobError(file, "", f'a name that ends in "{file.suffix}"', choices(_READERS))
    refuse_irregular(file)
    try:
        return read(file)
    except Exception as error:  # what the readers raise on a broken file is not documented
        expected = f"a readable {file.suffix.lower()[1:]} file with one image"
        raise JobError(file, "", f"a file that cannot be read ({error})", expected) from error


def _read_picture(file: Path) -> np.ndarray:
    # Pillow warns of odd metadata and of large files; neither is a mistake here.
    with warnings.catch_warnings(action="ignore"), Image.open(file) as image:
        if getattr(image, "n_frames", 1) > 1:
            raise ValueError("it holds more than one image")
        return np.array(image)


def _read_numpy(file: Path) -> np.ndarray:
    return np.asarray(np.load(file, allow_pickle=False))


_READERS = {
    ".png": _read_picture,
    ".tif": _read_picture,
    ".tiff": _read_picture,
    ".npy": _read_numpy,
}


def _check_ranges(file: Path, array: np.ndarray) -> None:
    expected = "one channel of 16-bit integers, or of floats in metres"
    whole = np.issubdtype(array.dtype, np.integer)
    if whole and array.dtype.itemsize == 1:
        raise JobError(file, "", f"an 8-bit image{_channels(array)}", expected)
    if array.ndim != 2 or not (whole or np.issubdtype(array.dtype, np.floating)):
        raise JobError(file, "", f"an array of {array.dtype}{_channels(array)}", expected)


def _check_mask(file: Path, array: np.ndarray) -> None:
    real = array.dtype == bool or np.issubdtype(array.dtype, np.number)
    if array.ndim != 2 or not real:
        found = f"an array of {array.dtype}{_channels(array)}"
        raise JobError(file, "", found, "one channel in which the usable pixels are not 0")


def _channels(array: np.ndarray) -> str:
    if array.ndim == 2:
        return ""
    colour = array.ndim == 3 and array.shape[2] in (2, 3, 4)
    return f" with {array.shape[2]} channels" if colour else f" of shape {array.shape}"


def _check_size(file: Path, array: np.ndarray, sensor: Sensor) -> None:
    height, width = array.shape
    if (width, height) != (sensor.projection.width, sensor.projection.height):
        expected = f"{sensor.projection.width}x{sensor.projection.height}, the size of the sensor"
        raise JobError(file, "", f"{width}x{height} pixels (width x height)", expected)


def _no_measurement(file: Path, ranges: np.ndarray, sensor: Sensor, whole: bool) -> JobError:
    measured = ranges[np.isfinite(ranges) & (ranges != 0)]
    if measured.size == 0:
        found = "an image in which every pixel is 0, NaN or infinite"
        return JobError(file, "", found, "some measured pixels")
    found = f"{measured.size} pixels with a median of {np.median(measured):g} m, none in the range"
    unit = f" with depth_unit = {sensor.depth_unit:g}" if whole else ", which floats always are"
    limits = f"some between {sensor.near:g} and {sensor.far:g} m (sensor.range)"
    return JobError(file, "", found, f"{limits}; is the file in metres{unit}?")
