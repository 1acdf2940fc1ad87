"""Point clouds of a camera on a flange and where the flange was."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

MILLI = 1e-3


@dataclass(frozen=True, kw_only=True)
class View:
    """What the camera saw from one place."""

    points: np.ndarray
    """(point 3), m: x right, y down, z forward."""
    flange: np.ndarray
    """x, y, z (m), yaw, pitch, roll (rad) in the base: R = Rz(yaw) Ry(pitch) Rx(roll)."""

    @property
    def T_base_flange(self) -> np.ndarray:
        """The flange's pose as a matrix."""
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("ZYX", self.flange[3:]).as_matrix()
        T[:3, 3] = self.flange[:3]
        return T


def read_views(folder: Path) -> tuple[View, ...]:
    """``view1d.pcd`` .. beside ``RobotPoses.dat``: rows of rx, ry, rz (rad), x, y, z (mm)."""
    rows = np.loadtxt(folder / "RobotPoses.dat", delimiter=",", usecols=range(6))
    return tuple(
        View(
            points=read_points(folder / f"view{number}d.pcd"),
            flange=np.concatenate([MILLI * row[3:], row[2::-1]]),
        )
        for number, row in enumerate(rows, start=1)
    )


def read_points(file: Path) -> np.ndarray:
    """The finite points (m) of a binary PCD file, by the fields that its header names."""
    data = file.read_bytes()
    marker = b"DATA binary\n"
    start = data.index(marker) + len(marker)
    header = {
        words[0]: words[1:]
        for line in data[:start].decode("ascii").splitlines()
        if (words := line.split())
    }
    kinds = {"F": "f", "U": "u", "I": "i"}
    fields = [
        (f"{name}{place}", f"<{kinds[kind]}{size}", (int(count),))
        for place, (name, kind, size, count) in enumerate(
            zip(header["FIELDS"], header["TYPE"], header["SIZE"], header["COUNT"], strict=True)
        )
    ]
    table = np.frombuffer(data, dtype=fields, offset=start, count=int(header["POINTS"][0]))
    places = [header["FIELDS"].index(axis) for axis in "xyz"]
    points = np.concatenate([table[f"{'xyz'[i]}{p}"] for i, p in enumerate(places)], 1)
    return points[np.isfinite(points).all(1)].astype(np.float64)
