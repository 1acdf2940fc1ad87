"""Which topics of a bag to read: told by their types, and by name where there are several."""

from dataclasses import dataclass

from torchcal.errors import JobError, choices
from torchcal.model.recordings.bag import Bag
from torchcal.model.recordings.depth_messages import is_depth

_IMAGES = ("Image", "CompressedImage")
_TRANSPORTS = ("/compressedDepth", "/compressed")
CALIBRATION = "camera_info"


@dataclass(frozen=True, kw_only=True, slots=True)
class Topics:
    """The topics to read; None where the bag has none."""

    ranges: str
    """Of the range images, scans or clouds."""
    camera: str | None
    """Of the ``CameraInfo`` of depth images."""
    joints: tuple[str, ...]
    description: str | None
    """Of the URDF."""


def find_topics(bag: Bag, use: tuple[str, ...]) -> Topics:
    """Chooses the topics of a bag.

    Args:
        bag: An open bag.
        use: Those that a person chose; the type of each says what for.

    Raises:
        JobError: If there is no topic with range images, or several between which only a person can
            choose, or a chosen one does not exist.
    """
    for topic in use:
        if topic not in bag.topics:
            raise JobError(bag.file, topic, "no such topic", choices(bag.topics))
    ranges = _ranges(bag, use)
    is_image = ranges in bag.of_type(*_IMAGES)
    joints = bag.of_type("JointState")
    return Topics(
        ranges=ranges,
        camera=_camera(bag, ranges, use) if is_image else None,
        joints=tuple(topic for topic in joints if topic in use) or tuple(joints),
        description=_description(bag, use),
    )


def _ranges(bag: Bag, use: tuple[str, ...]) -> str:
    """Depth images before clouds, and clouds before scans."""
    chosen = [topic for topic in bag.of_type(*_IMAGES, "PointCloud2", "LaserScan") if topic in use]
    if chosen:
        return _the_only(bag, chosen)
    depth = [topic for topic in bag.of_type(*_IMAGES) if is_depth(bag.first(topic))]
    for found in (_of_one_camera(bag, depth), bag.of_type("PointCloud2"), bag.of_type("LaserScan")):
        if found:
            return _the_only(bag, found)
    kinds = "depth images (16UC1, 32FC1, compressedDepth), a PointCloud2 or a LaserScan"
    raise JobError(bag.file, "", f"the topics {', '.join(sorted(bag.topics)) or 'none'}", kinds)


def _the_only(bag: Bag, found: list[str]) -> str:
    if len(found) > 1:
        named = ", ".join(sorted(found))
        raise JobError(
            bag.file, "", f"{len(found)} topics with range images: {named}", "--use TOPIC"
        )
    return found[0]


def _of_one_camera(bag: Bag, depth: list[str]) -> list[str]:
    """Without those that lack the camera's own calibration, and without compressed copies."""
    with_camera = [topic for topic in depth if _beside(topic) in bag.topics] or depth
    raw = {_bare(topic): topic for topic in sorted(with_camera, key=len, reverse=True)}
    return list(raw.values())


def _camera(bag: Bag, images: str, use: tuple[str, ...]) -> str:
    """The calibration beside the images, or the only one in their frame and of their size."""
    found = bag.of_type("CameraInfo")
    chosen = [topic for topic in found if topic in use]
    if chosen or _beside(images) in found:
        return chosen[0] if chosen else _beside(images)
    frame = bag.first(images).header.frame_id
    same = [topic for topic in found if bag.first(topic).header.frame_id == frame]
    if len(same) == 1:
        return same[0]
    expected = f"--use TOPIC: {choices(found)}" if found else "a sensor_msgs/CameraInfo"
    raise JobError(bag.file, images, f"no {_beside(images)}", expected)


def _description(bag: Bag, use: tuple[str, ...]) -> str | None:
    found = bag.of_type("String")
    chosen = [topic for topic in found if topic in use]
    named = [topic for topic in found if topic.rsplit("/", 1)[-1] == "robot_description"]
    return next(iter(chosen or sorted(named, key=len)), None)


def _bare(topic: str) -> str:
    """The topic of which this is a compressed copy, or itself."""
    for transport in _TRANSPORTS:
        topic = topic.removesuffix(transport)
    return topic


def _beside(topic: str) -> str:
    return f"{_bare(topic).rpartition('/')[0]}/{CALIBRATION}"
