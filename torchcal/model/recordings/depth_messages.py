"""From ROS messages with depth images to range images."""

import io
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from torchcal.model.recordings.recorded import RangePixels
from torchcal.model.recordings.rvl import decode_rvl

ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Depth along z: integers are millimetres by convention (REP 118), floats metres."""

_PNG = b"\x89PNG\r\n\x1a\n"
_HEADER = "<iff"
"""Of a compressedDepth payload: which compression, and both parameters of the quantisation."""


def is_depth(message: Any) -> bool:
    """Whether an ``Image`` or a ``CompressedImage`` holds depth: one channel, 16 bits or floats."""
    if hasattr(message, "encoding"):
        return message.encoding in ("16UC1", "32FC1")
    return "compressedDepth" in message.format or message.format.startswith("16UC1")


def depth_pixels(message: Any) -> RangePixels:
    """The pixels of an ``Image`` or a ``CompressedImage``.

    Raises:
        ValueError: If they are none that hold depth, or broken.
    """
    return _raw(message) if hasattr(message, "encoding") else _compressed(message)


def _raw(message: Any) -> RangePixels:
    kind = ENCODINGS.get(message.encoding)
    if kind is None:
        raise ValueError(f"the encoding {message.encoding!r}; expected {', '.join(ENCODINGS)}")
    order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    pixels = np.ascontiguousarray(rows[:, : message.width * order.itemsize]).view(order)
    return pixels.astype(kind)


def _compressed(message: Any) -> RangePixels:
    data = bytes(message.data)
    if data.startswith(_PNG):
        return _png(data)
    _, a, b = struct.unpack_from(_HEADER, data)
    payload = data[struct.calcsize(_HEADER) :]
    pixels = _png(payload) if payload.startswith(_PNG) else decode_rvl(payload)
    return _metres(pixels, a, b) if message.format.startswith("32FC1") else pixels


def _png(data: bytes) -> NDArray[np.uint16]:
    with Image.open(io.BytesIO(data)) as image:
        pixels = np.array(image)
    if pixels.ndim != 2 or pixels.dtype.itemsize == 1:
        raise ValueError(f"a PNG of {pixels.dtype} and shape {pixels.shape}; expected 16 bits")
    return pixels.astype(np.uint16)


def _metres(quantised: NDArray[np.uint16], a: float, b: float) -> NDArray[np.float32]:
    """Floats were sent as a / depth + b, 0 where nothing was measured."""
    inverse = np.where(quantised == 0, np.nan, quantised.astype(np.float64) - b)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        return (a / inverse).astype(np.float32)
