"""Bags of ROS 1 and ROS 2 and MCAP files, read by the rosbags library without any ROS."""

import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcal.errors import JobError, TorchcalError

SUFFIXES = (".bag", ".mcap", ".db3")


@dataclass(frozen=True, kw_only=True, slots=True)
class Stamps:
    """When the messages of a topic were made and received: nanoseconds."""

    made: NDArray[np.int64]
    """By the clock of the sender."""
    received: NDArray[np.int64]
    """By the clock of the recorder."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Bag:
    """An open bag."""

    file: Path
    reader: Any
    topics: Mapping[str, str]
    """The type of each topic that holds messages, such as ``sensor_msgs/msg/Image``."""

    def messages(self, topic: str, received: int | None = None) -> Iterator[tuple[int, Any]]:
        """The messages of a topic, each with when it was received (ns).

        Args:
            topic: One of ``topics``.
            received: Only the message that was received then (ns); None: all.

        Raises:
            JobError: If the bag is damaged.
        """
        with _blamed_on(self.file):
            for connection, time, raw in self._raw(topic, received):
                yield time, self.reader.deserialize(raw, connection.msgtype)

    def first(self, topic: str) -> Any:
        """The first message of a topic.

        Raises:
            JobError: If the bag is damaged or holds no message of this topic.
        """
        for _, message in self.messages(topic):
            return message
        raise JobError(self.file, topic, "no messages", "some")

    def stamps(self, topic: str) -> Stamps:
        """When the messages of a topic were made and received; they begin with a header.

        Raises:
            JobError: If the bag is damaged.
        """
        with _blamed_on(self.file):
            pairs = [(self._made(raw), time) for _, time, raw in self._raw(topic)]
        made, received = np.array(pairs, np.int64).reshape(-1, 2).T
        return Stamps(made=made, received=received)

    def of_type(self, *kinds: str) -> list[str]:
        """The topics of some types, such as ``Image``."""
        return [topic for topic, kind in self.topics.items() if kind.rsplit("/", 1)[-1] in kinds]

    def _raw(self, topic: str, received: int | None = None) -> Iterator[tuple[Any, int, bytes]]:
        connections = [each for each in self.reader.connections if each.topic == topic]
        stop = None if received is None else received + 1
        return self.reader.messages(connections=connections, start=received, stop=stop)

    def _made(self, raw: bytes) -> int:
        """The stamp (ns) of a header, without reading what follows it: images are large."""
        if self.reader.is2:
            seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
        else:
            seconds, nanoseconds = struct.unpack_from("<II", raw, 4)
        return seconds * 1_000_000_000 + nanoseconds


def header_stamp(header: Any) -> int:
    """When a message was made (ns), by its header."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def bag_files(source: Path) -> list[Path]:
    """What the library has to open for a bag: files, or the folder of a ROS 2 bag; else nothing."""
    if source.is_file():
        return [source] if source.suffix in SUFFIXES else []
    if (source / "metadata.yaml").is_file():
        return [source]
    return sorted(path for path in source.glob("*") if path.suffix in SUFFIXES and path.is_file())


@contextmanager
def opened_bag(source: Path) -> Iterator[Bag]:
    """A bag for as long as the context lasts.

    Args:
        source: A ``.bag``, ``.mcap`` or ``.db3`` file, or a folder with such files.

    Raises:
        TorchcalError: If the rosbags library is not installed.
        JobError: If the bag cannot be read.
    """
    library, typesys = _library(source)
    with _blamed_on(source):
        # Bags of older ROS 2 do not say what their messages are made of.
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        reader = library.AnyReader(bag_files(source), default_typestore=types)
        reader.open()
    try:
        topics: dict[str, str] = {
            each.topic: each.msgtype for each in reader.connections if each.msgcount
        }
        yield Bag(file=source, reader=reader, topics=topics)
    finally:
        reader.close()


def _library(source: Path) -> tuple[Any, Any]:
    try:
        return import_module("rosbags.highlevel"), import_module("rosbags.typesys")
    except ImportError as error:
        raise TorchcalError(
            f"{source}: found a bag, and the library rosbags is not installed; expected it: "
            'pip install "torchcal[bags]"'
        ) from error


@contextmanager
def _blamed_on(file: Path) -> Iterator[None]:
    """Whatever the library and its databases raise on a damaged bag becomes one sentence."""
    try:
        yield
    except TorchcalError:
        raise
    except Exception as error:  # the library passes on errors of SQLite, LZ4, Zstandard and struct
        words = " ".join(str(error).split()) or type(error).__name__
        expected = "a whole bag of ROS 1 or ROS 2, or a whole MCAP file"
        raise JobError(file, "", f"a recording that cannot be read ({words})", expected) from error
