"""PCD files of the Point Cloud Library: text, binary and compressed."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchcal.errors import JobError
from torchcal.geometry import se3
from torchcal.model.recordings.lzf import decode_lzf
from torchcal.model.recordings.point_fields import xyz
from torchcal.model.regular_file import refuse_irregular

_HEADER_KEYS = {"FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA"}
_HEADER_BYTES = 4096
_MOST_POINTS = 100_000_000
_NO_TURN = ("0", "0", "0", "1", "0", "0", "0")


@dataclass(frozen=True, kw_only=True, slots=True)
class CloudFile:
    """What a file with points holds."""

    points: NDArray[np.float64]
    """``(h w 3)`` (m); one row where they stand in no order."""
    T_world_sensor: Float[Tensor, "4 4"]
    """Where the sensor stood, in whose axes the points are."""


def read_pcd(file: Path) -> CloudFile:
    """The points of a PCD file, and its VIEWPOINT.

    Raises:
        JobError: If the file cannot be read, or has no x, y and z.
    """
    refuse_irregular(file)
    try:
        content = file.read_bytes()
        header, body = _header(content)
        records = _records(header, body)
        height, width = int(header["HEIGHT"][0]), int(header["WIDTH"][0])
        points = xyz(records).reshape(height, width, 3)
        pose = _viewpoint(header.get("VIEWPOINT", _NO_TURN))
    except (OSError, KeyError, ValueError, IndexError, struct.error, TypeError) as error:
        found = f"a cloud that cannot be read ({error})"
        raise JobError(file, "", found, "a PCD file of version 0.7 with x, y and z") from error
    return CloudFile(points=points, T_world_sensor=pose)


def _viewpoint(words: Sequence[str]) -> Float[Tensor, "4 4"]:
    """Position and quaternion, its real part first."""
    view = torch.tensor([float(word) for word in words], dtype=torch.float64)
    if len(view) != len(_NO_TURN) or not view.isfinite().all() or view[3:].norm() == 0.0:
        found = f"the VIEWPOINT {' '.join(words)}"
        raise ValueError(f"{found}; expected tx ty tz qw qx qy qz, the quaternion not 0")
    return se3.from_quaternion(view[:3], view[3:])


def _header(content: bytes) -> tuple[dict[str, list[str]], bytes]:
    """The words after each key, and what follows the header."""
    words: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in words:
        end = content.find(b"\n", start, _HEADER_BYTES)
        if end < 0:
            raise ValueError("a header without DATA")
        line = content[start:end].decode("ascii", errors="replace").split("#")[0].split()
        words |= {line[0]: line[1:]} if line else {}
        start = end + 1
    missing = sorted(_HEADER_KEYS - words.keys())
    if missing:
        raise ValueError(f"a header without {', '.join(missing)}")
    return words, content[start:]


def _records(header: dict[str, list[str]], body: bytes) -> np.ndarray:
    kind, count = _record_kind(header), int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    if int(header["WIDTH"][0]) < 0 or not 0 <= count <= _MOST_POINTS:
        size = f"{header['WIDTH'][0]} x {header['HEIGHT'][0]}"
        raise ValueError(f"{size} points; expected WIDTH and HEIGHT, at most {_MOST_POINTS} points")
    match header["DATA"][0]:
        case "ascii":
            return _from_text(header, body, kind, count)
        case "binary":
            return np.frombuffer(body, kind, count)
        case "binary_compressed":
            packed, whole = struct.unpack_from("<II", body)
            return _from_columns(decode_lzf(body[8 : 8 + packed], whole), kind, count)
        case other:
            raise ValueError(f"DATA {other}; expected ascii, binary or binary_compressed")


def _record_kind(header: dict[str, list[str]]) -> np.dtype:
    """One record; padding, which may bear one name several times, gets numbers."""
    letters = {"F": "f", "I": "i", "U": "u"}
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True)
    return np.dtype(
        [
            (name if name in "xyz" else f"{name}-{k}", f"<{letters[kind]}{size}", (int(count),))
            if int(count) > 1
            else (name if name in "xyz" else f"{name}-{k}", f"<{letters[kind]}{size}")
            for k, (name, kind, size, count) in enumerate(columns)
        ]
    )


def _from_text(header: dict[str, list[str]], body: bytes, kind: np.dtype, count: int) -> np.ndarray:
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(header["FIELDS"]))]
    numbers = np.array([float(word) for word in body.split()], np.float64)
    rows = numbers.reshape(count, sum(counts))
    records = np.zeros(count, kind)
    # A number that is too large for its field becomes infinite: not measured.
    with np.errstate(over="ignore", invalid="ignore"):
        for name in "xyz":
            if name in header["FIELDS"]:
                records[name] = rows[:, sum(counts[: header["FIELDS"].index(name)])]
    return records


def _from_columns(data: bytes, kind: np.dtype, count: int) -> np.ndarray:
    """Compressed files hold all values of one field before those of the next."""
    records, start = np.zeros(count, kind), 0
    for name in kind.names or ():
        size = kind[name].itemsize * count
        column = np.frombuffer(data[start : start + size], kind[name].base)
        records[name] = column.reshape(records[name].shape)
        start += size
    return records
