"""What a bag holds: images of one sensor, and where robot or sensor were when each was taken."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchcal.errors import JobError
from torchcal.model.recordings.bag import Bag, Stamps, opened_bag
from torchcal.model.recordings.bag_images import Sight, sight_of
from torchcal.model.recordings.bag_mount import find_mount, poses_of, transforms
from torchcal.model.recordings.clock import Clock, common_clock
from torchcal.model.recordings.joints import joint_series
from torchcal.model.recordings.recorded import Recorded, RobotSource, Selection, Taken
from torchcal.model.recordings.robot_files import moving_joints, urdf_file
from torchcal.model.recordings.stillness import STILL, Motion, choose, evenly, motion_of
from torchcal.model.recordings.topics import Topics, find_topics
from torchcal.model.recordings.transforms import frame_name


def read_bag(source: Path, selection: Selection) -> Recorded:
    """What a bag of ROS 1 or ROS 2 or an MCAP file holds.

    With a robot one image is taken for each posture in which its joints stood still; without, one
    for each place at which the sensor did, as ``tf`` has it.

    Args:
        source: A file, or the folder of a ROS 2 bag.
        selection: What to take of it; ``use`` names topics.

    Raises:
        TorchcalError: If the rosbags library is not installed.
        JobError: If the bag cannot be read, or lacks something that only a person knows.
    """
    with opened_bag(source) as bag:
        topics = find_topics(bag, selection.use)
        robot = _robot(bag, topics, selection)
        if robot is None:
            return _without_robot(bag, topics, selection)
        return _with_robot(bag, topics, selection, robot)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Timing:
    """When the images of a bag were taken."""

    clock: Clock
    stamps: Stamps
    """Of the images."""

    @property
    def times(self) -> NDArray[np.int64]:
        """When they were made (ns)."""
        return self.clock.times(self.stamps)

    def received(self, chosen: Iterable[int]) -> tuple[int, ...]:
        """When the recorder received some images (ns)."""
        return tuple(int(self.stamps.received[k]) for k in chosen)


def _timing(bag: Bag, images: str, others: tuple[str, ...] = ()) -> _Timing:
    stamps = {topic: bag.stamps(topic) for topic in (images, *others)}
    return _Timing(clock=common_clock(stamps), stamps=stamps[images])


def _robot(bag: Bag, topics: Topics, selection: Selection) -> RobotSource | None:
    if selection.urdf is None and topics.description is not None:
        named = bag.file.parent / topics.description.strip("/")
        return RobotSource(xml=bag.first(topics.description).data.encode(), named=named)
    urdf = selection.urdf or selection.spare_urdf
    return None if urdf is None else urdf_file(urdf)


def _frame(bag: Bag, topics: Topics) -> str:
    return frame_name(bag.first(topics.ranges).header.frame_id)


def _with_robot(bag: Bag, topics: Topics, selection: Selection, robot: RobotSource) -> Recorded:
    names = moving_joints(robot)
    if names and not topics.joints:
        expected = f"the values of {', '.join(names)}"
        raise JobError(bag.file, "", "no sensor_msgs/JointState", expected)
    timing = _timing(bag, topics.ranges, topics.joints)
    series = joint_series(bag, topics.joints, timing.clock, names)
    motion = motion_of(list(series.values()), timing.times)
    _check_pairs(bag, topics, motion)
    chosen = choose(motion, selection.frames)
    mount = find_mount(bag, timing.clock, robot, _frame(bag, topics), selection.link)
    sight = sight_of(bag, topics, timing.received(chosen), selection)
    values = motion.values[chosen].tolist()
    to_fill_in = {}
    if mount.T_link_frame is None:
        to_fill_in["sensor.mount"] = f"where the sensor is on {mount.link}: the bag does not say"
    if mount.T_world_base is None:
        to_fill_in["robot.base"] = "where the robot stands in the world: the bag does not say"
    return replace(
        _recorded(sight, (Taken(joints=dict(zip(series, row, strict=True))) for row in values)),
        carrier=mount.carrier(robot, sight.T_frame_sensor),
        notes=(
            *_notes(topics, timing, motion, chosen, "the joints"),
            *_missing(names, series),
            *sight.notes,
        ),
        to_fill_in=to_fill_in,
    )


def _without_robot(bag: Bag, topics: Topics, selection: Selection) -> Recorded:
    timing, frame = _timing(bag, topics.ranges), _frame(bag, topics)
    tree = transforms(bag, timing.clock, static=False)
    root = tree.root(frame)
    if root == frame:
        chosen = evenly(len(timing.times), selection.frames)
        sight = sight_of(bag, topics, timing.received(chosen), selection)
        said = f"{len(chosen)} of {len(timing.times)} images of {topics.ranges} were taken"
        return replace(
            _recorded(sight, (Taken() for _ in chosen)),
            notes=(f"{said}, at equal steps", _NO_ROBOT, *sight.notes),
            to_fill_in={"frame.pose": "where the sensor was: the bag does not say"},
        )
    Ts, motion = poses_of(tree, frame, timing.times)
    _check_pairs(bag, topics, motion)
    chosen = choose(motion, selection.frames)
    sight = sight_of(bag, topics, timing.received(chosen), selection)
    frames = (Taken(T_world_sensor=Ts[k] @ sight.T_frame_sensor) for k in chosen)
    notes = _notes(topics, timing, motion, chosen, f"{frame} in {root}")
    return replace(
        _recorded(sight, frames),
        notes=(*notes, _NO_ROBOT, f"poses are those of {frame} in {root}, by tf", *sight.notes),
    )


_NO_ROBOT = "there is no robot_description: --urdf FILE makes a job with a robot"


def _recorded(sight: Sight, frames: Iterable[Taken]) -> Recorded:
    return Recorded(optics=sight.optics, frames=tuple(frames), images=sight.images)


def _check_pairs(bag: Bag, topics: Topics, motion: Motion) -> None:
    if np.isfinite(motion.change).any():
        return
    nearest = float(np.abs(motion.offset).min())
    found = f"no image within 0.5 s of joints or transforms; the nearest is {nearest:.3g} s away"
    raise JobError(bag.file, topics.ranges, found, "images and joints of the same time")


def _notes(
    topics: Topics, timing: _Timing, motion: Motion, chosen: list[int], what: str
) -> tuple[str, ...]:
    """How images were chosen, and how far they and their joints are apart."""
    offset, change = motion.offset[chosen] * 1e3, float(motion.change[chosen].max())
    notes = [
        f"{len(chosen)} of {len(motion.change)} images of {topics.ranges} were taken, one for each "
        f"posture in which {what} stood still",
    ]
    if change > STILL:
        notes[0] = (
            f"WARNING: {what} never stood still: {len(chosen)} of {len(motion.change)} images of "
            f"{topics.ranges} were taken, about which {what} moved by up to {change:.2g} rad or m"
        )
    if np.ptp(motion.values, axis=0).max(initial=0.0) <= STILL:
        notes.append(f"WARNING: {what} never moved")
    notes.append(
        f"the nearest samples are {np.median(offset):+.1f} ms (median) and at most "
        f"{np.abs(offset).max():.1f} ms from the images"
    )
    return (*notes, timing.clock.note) if timing.clock.note else tuple(notes)


def _missing(names: list[str], series: Iterable[str]) -> tuple[str, ...]:
    missing = [name for name in names if name not in set(series)]
    said = f"WARNING: no values of the joints {', '.join(missing)}: they are taken for 0"
    return (said,) if missing else ()
