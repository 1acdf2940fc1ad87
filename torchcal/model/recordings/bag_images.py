"""The images of one topic of a bag, whatever kind of message they come in."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.errors import JobError
from torchcal.model.recordings.bag import Bag, opened_bag
from torchcal.model.recordings.cameras import Camera, camera_of, centre_note
from torchcal.model.recordings.cloud_images import cloud_images
from torchcal.model.recordings.depth_messages import depth_pixels
from torchcal.model.recordings.kinds import (
    CAMERA_NOISE,
    LASER_NOISE,
    looks_like_millimetres,
    unit_note,
    unit_of,
)
from torchcal.model.recordings.layout import Points
from torchcal.model.recordings.point_fields import cloud_points
from torchcal.model.recordings.recorded import Optics, RangePixels, Selection
from torchcal.model.recordings.scans import scan_image, scan_layout
from torchcal.model.recordings.topics import Topics


@dataclass(frozen=True, kw_only=True, slots=True)
class BagImages:
    """Some images of a topic; each is read when it is asked for, also after the bag was closed."""

    source: Path
    topic: str
    received: tuple[int, ...]
    """When the recorder received each (ns)."""
    image: Callable[[Any], RangePixels]
    """Makes an image of a message."""

    def __iter__(self) -> Iterator[RangePixels]:
        with opened_bag(self.source) as bag:
            for message in _messages(bag, self.topic, self.received):
                yield _checked(self.source, self.topic, self.image, message)


@dataclass(frozen=True, kw_only=True, slots=True)
class Sight:
    """A sensor and its images."""

    optics: Optics
    T_frame_sensor: Float[Tensor, "4 4"]
    """Where the sensor of the job stands in the frame that the messages name."""
    images: BagImages
    notes: tuple[str, ...]


def sight_of(bag: Bag, topics: Topics, received: tuple[int, ...], selection: Selection) -> Sight:
    """The sensor of a bag and those of its images that were chosen.

    Args:
        bag: An open bag.
        topics: Where in it they are.
        received: When the recorder received the chosen images (ns).
        selection: ``depth_unit`` and ``resolution_deg``.

    Raises:
        JobError: If the first image or the camera's calibration cannot be used.
    """
    kind = bag.topics[topics.ranges].rsplit("/", 1)[-1]
    makers = {"LaserScan": _scans, "PointCloud2": _clouds}
    return makers.get(kind, _depth)(bag, topics, received, selection)


def _messages(bag: Bag, topic: str, received: tuple[int, ...]) -> Iterator[Any]:
    for time in received:
        yield next(message for _, message in bag.messages(topic, time))


def _checked(file: Path, topic: str, make: Callable[[Any], Any], message: Any) -> Any:
    """What is made of a message; a message that cannot be used is a mistake of its topic."""
    try:
        return make(message)
    except (ValueError, TypeError, OSError, IndexError, SyntaxError, OverflowError) as error:
        found = f"a message that cannot be used: {error}"
        raise JobError(file, topic, found, "whole messages of one kind") from error


def _depth(bag: Bag, topics: Topics, received: tuple[int, ...], selection: Selection) -> Sight:
    assert topics.camera is not None, "images have a camera"
    make = partial(camera_of, topic=topics.ranges)
    camera = _checked(bag.file, topics.camera, make, bag.first(topics.camera))
    first = next(_messages(bag, topics.ranges, received[:1]))
    pixels = _checked(bag.file, topics.ranges, depth_pixels, first)
    hole = camera.pinhole
    if pixels.shape != (hole.height, hole.width):
        found = f"images of {pixels.shape[1]}x{pixels.shape[0]} pixels"
        expected = f"{hole.width}x{hole.height}, as {topics.camera} says, or another --use TOPIC"
        raise JobError(bag.file, topics.ranges, found, expected)
    unit = unit_of(pixels.dtype, selection)
    image = partial(_depth_image, camera=camera, unit=unit)
    return Sight(
        optics=Optics(projection=hole, sigma=CAMERA_NOISE, beam=1, depth_unit=unit),
        T_frame_sensor=torch.eye(4, dtype=torch.float64),
        images=BagImages(source=bag.file, topic=topics.ranges, received=received, image=image),
        notes=_depth_notes(camera, pixels, selection, topics.ranges),
    )


def _depth_image(message: Any, camera: Camera, unit: float) -> RangePixels:
    pixels = camera.rectified(depth_pixels(message))
    with np.errstate(over="ignore", invalid="ignore"):
        return pixels if pixels.dtype.kind == "u" else (pixels * unit).astype(np.float32)


def _depth_notes(
    camera: Camera, pixels: RangePixels, selection: Selection, topic: str
) -> tuple[str, ...]:
    notes = [*centre_note(camera.pinhole)]
    if camera.lens:
        shift = camera.largest_shift()
        notes.append(
            f"{topic} is not rectified: its lens ({camera.lens}) was taken out of the images, "
            f"which moved pixels by up to {shift:.1f}"
        )
    notes += unit_note(pixels.dtype, selection)
    if selection.depth_unit is None and looks_like_millimetres(pixels):
        median = float(np.nanmedian(np.where(pixels == 0, np.nan, pixels)))
        notes.append(
            f"WARNING: a median depth of {median:.4g} m: these floats are hardly metres; import "
            "again with --depth-unit 0.001 if they are millimetres"
        )
    return tuple(notes)


def _scans(bag: Bag, topics: Topics, received: tuple[int, ...], selection: Selection) -> Sight:
    first = next(_messages(bag, topics.ranges, received[:1]))
    layout = _checked(bag.file, topics.ranges, scan_layout, first)
    limits = float(first.range_min), float(first.range_max)
    sound = 0.0 <= limits[0] < limits[1] < np.inf
    image = partial(scan_image, layout=layout)
    return Sight(
        optics=Optics(
            projection=layout.projection,
            sigma=LASER_NOISE,
            beam=0,
            limits=limits if sound else None,
        ),
        T_frame_sensor=layout.T_cloud_sensor,
        images=BagImages(source=bag.file, topic=topics.ranges, received=received, image=image),
        notes=(),
    )


def _clouds(bag: Bag, topics: Topics, received: tuple[int, ...], selection: Selection) -> Sight:
    def clouds() -> Iterator[Points]:
        for message in _messages(bag, topics.ranges, received):
            yield cloud_points(message)

    images = _checked(
        bag.file,
        topics.ranges,
        partial(cloud_images, resolution_deg=selection.resolution_deg),
        clouds,
    )

    def image(message: Any) -> RangePixels:
        return images.image(cloud_points(message))

    return Sight(
        optics=images.optics,
        T_frame_sensor=images.layout.T_cloud_sensor,
        images=BagImages(source=bag.file, topic=topics.ranges, received=received, image=image),
        notes=(images.note,),
    )
