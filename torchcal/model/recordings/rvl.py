"""RVL, the lossless compression of depth images that ROS sends beside PNG.

A. D. Wilson, Fast lossless depth image compression, 2017: numbers of three bits a nibble, a fourth
bit says that more follow; runs of zeros and of differences between neighbouring pixels take turns.
"""

import struct

import numpy as np
from numpy.typing import NDArray

_SIZE = "<II"
"""Columns and rows stand before the first nibble."""


def decode_rvl(data: bytes) -> NDArray[np.uint16]:
    """The image of an RVL stream with its size before it.

    Raises:
        ValueError: If the stream ends before the image does.
    """
    columns, rows = struct.unpack_from(_SIZE, data)
    words = data[struct.calcsize(_SIZE) :]
    numbers = _numbers(np.frombuffer(words[: len(words) // 4 * 4], "<u4"))
    pixels = np.zeros(columns * rows, np.uint16)
    done = read = 0
    last = np.int64(0)
    while done < len(pixels):
        if read + 2 > len(numbers):
            raise ValueError(f"an RVL image that ends after {done} of {len(pixels)} pixels")
        zeros, count = (int(number) for number in numbers[read : read + 2])
        deltas = _signed(numbers[read + 2 : read + 2 + count])
        start, end = done + zeros, done + zeros + count
        if len(deltas) < count or end > len(pixels):
            raise ValueError(f"an RVL image that is broken after {done} of {len(pixels)} pixels")
        values = last + np.cumsum(deltas)
        pixels[start:end] = values.astype(np.uint16)
        last = values[-1] if count else last
        done, read = end, read + 2 + count
        if zeros == count == 0:
            raise ValueError(f"an RVL image that stands still after {done} pixels")
    return pixels.reshape(rows, columns)


def _numbers(words: NDArray[np.uint32]) -> NDArray[np.int64]:
    """The numbers: the first nibble of a word is its highest, the first of a number its lowest."""
    shifts = np.arange(28, -1, -4, dtype=np.uint32)
    nibbles = ((words[:, None] >> shifts) & 15).ravel().astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    if len(ends) == 0:
        return np.zeros(0, np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    nibbles = nibbles[: ends[-1] + 1]
    place = np.arange(len(nibbles)) - np.repeat(starts, ends - starts + 1)
    # More places than a pixel needs are a broken stream; they must not overflow.
    return np.add.reduceat((nibbles & 7) << (3 * np.minimum(place, 20)), starts)


def _signed(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """0, -1, 1, -2, 2 ... of 0, 1, 2, 3, 4 ..."""
    return (numbers >> 1) ^ -(numbers & 1)
