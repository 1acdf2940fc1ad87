"""LZF, the compression of PCD files: runs of bytes, and copies of what came before."""

_LONGEST_RUN = 32
_LONG_COPY = 7


def decode_lzf(data: bytes, size: int) -> bytes:
    """The bytes of an LZF stream.

    Args:
        data: The stream.
        size: How many bytes it stands for.

    Raises:
        ValueError: If it stands for more or fewer.
    """
    out, at = bytearray(), 0
    while at < len(data):
        control = data[at]
        at += 1
        if control < _LONGEST_RUN:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == _LONG_COPY:
            length += data[at]
            at += 1
        start = len(out) - ((control & 31) << 8) - data[at] - 1
        at += 1
        _copy(out, start, length + 2)
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes after decompression; expected {size}")
    return bytes(out)


def _copy(out: bytearray, start: int, length: int) -> None:
    """Appends bytes that are there already, and, where they overlap, those just appended."""
    if start < 0:
        raise ValueError("a compressed cloud that refers to bytes before its first")
    period = out[start : start + length]
    out += (period * (length // len(period) + 1))[:length]
