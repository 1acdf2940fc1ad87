"""Real bags of all three kinds, written by the rosbags library, and the messages in them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra bags")

from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("ros1", "sqlite3", "mcap")
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
"""ns: when all recordings of the tests begin."""

TFMESSAGE = "tf2_msgs/msg/TFMessage"


class Messages:
    """Messages for bags of one kind; times are seconds after ``START``."""

    def __init__(self, kind: str):
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if TFMESSAGE not in self.store.types:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, TFMESSAGE))

    def make(self, kind: str, /, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, time: float, frame: str = "", clock: float = 0.0) -> Any:
        stamp = START + round((time + clock) * SECOND)
        at = self.make("builtin_interfaces/msg/Time", sec=stamp // SECOND, nanosec=stamp % SECOND)
        more = {"seq": 0} if self.kind == "ros1" else {}
        return self.make("std_msgs/msg/Header", stamp=at, frame_id=frame, **more)

    def image(self, header: Any, pixels: np.ndarray, encoding: str, big: bool = False) -> Any:
        data = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
        return self.make(
            "sensor_msgs/msg/Image",
            header=header,
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(big),
            step=data.strides[0],
            data=np.frombuffer(data.tobytes(), np.uint8),
        )

    def compressed(self, header: Any, words: str, data: bytes) -> Any:
        pixels = np.frombuffer(data, np.uint8)
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=header, format=words, data=pixels
        )

    def camera(
        self,
        header: Any,
        size: tuple[int, int],
        matrix: Iterable[float],
        lens: tuple[float, ...] = (),
        model: str = "plumb_bob",
        rectified: tuple[float, float, float, float] | None = None,
    ) -> Any:
        fx, fy, cx, cy = rectified or (0.0, 0.0, 0.0, 0.0)
        names = "DKRP" if self.kind == "ros1" else "dkrp"
        values = (
            lens,
            tuple(matrix),
            np.eye(3).ravel(),
            (fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0),
        )
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            width=size[0],
            height=size[1],
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **{name: np.array(each, float) for name, each in zip(names, values, strict=True)},
        )

    def joints(self, header: Any, values: dict[str, float]) -> Any:
        none = np.zeros(0)
        return self.make(
            "sensor_msgs/msg/JointState",
            header=header,
            name=list(values),
            position=np.array(list(values.values()), float),
            velocity=none,
            effort=none,
        )

    def transforms(self, *each: Any) -> Any:
        return self.make(TFMESSAGE, transforms=list(each))

    def transform(
        self,
        header: Any,
        child: str,
        xyz: tuple[float, float, float],
        xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
    ) -> Any:
        shift = self.make("geometry_msgs/msg/Vector3", x=xyz[0], y=xyz[1], z=xyz[2])
        turn = self.make("geometry_msgs/msg/Quaternion", x=xyzw[0], y=xyzw[1], z=xyzw[2], w=xyzw[3])
        inner = self.make("geometry_msgs/msg/Transform", translation=shift, rotation=turn)
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=header,
            child_frame_id=child,
            transform=inner,
        )

    def text(self, words: str) -> Any:
        return self.make("std_msgs/msg/String", data=words)

    def scan(self, header: Any, first: float, step: float, ranges: np.ndarray) -> Any:
        return self.make(
            "sensor_msgs/msg/LaserScan",
            header=header,
            angle_min=first,
            angle_max=first + step * (len(ranges) - 1),
            angle_increment=step,
            time_increment=0.0,
            scan_time=0.1,
            range_min=0.1,
            range_max=30.0,
            ranges=ranges.astype(np.float32),
            intensities=np.zeros(0, np.float32),
        )

    def cloud(self, header: Any, points: np.ndarray) -> Any:
        """Organised where the points are ``(h w 3)``; four bytes of padding after each."""
        rows = points if points.ndim == 3 else points[None]
        padded = np.zeros((*rows.shape[:2], 4), np.float32)
        padded[..., :3] = rows
        field = "sensor_msgs/msg/PointField"
        fields = [
            self.make(field, name=name, offset=4 * k, datatype=7, count=1)
            for k, name in enumerate("xyz")
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=header,
            height=rows.shape[0],
            width=rows.shape[1],
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * rows.shape[1],
            data=np.frombuffer(padded.tobytes(), np.uint8),
            is_dense=False,
        )


def write_bag(folder: Path, messages: Messages, content: list[tuple[str, float, Any]]) -> Path:
    """Writes topics, times of reception (s after ``START``) and messages; the file or folder."""
    store, path = messages.store, folder / f"recording-{messages.kind}"
    first = messages.kind == "ros1"
    path = path.with_suffix(".bag") if first else path
    writer = rosbag1.Writer(path) if first else _second(path, messages.kind)
    with writer:
        connections: dict[str, Any] = {}
        for topic, time, message in sorted(content, key=lambda each: each[1]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            pack = store.serialize_ros1 if first else store.serialize_cdr
            writer.write(connections[topic], START + round(time * SECOND), pack(message, kind))
    return path


def _second(path: Path, kind: str) -> rosbag2.Writer:
    plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
    return rosbag2.Writer(path, version=9, storage_plugin=plugin)
