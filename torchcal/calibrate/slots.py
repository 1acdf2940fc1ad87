"""Which rigid motion of a state is what."""

from dataclasses import dataclass

BASE, MOUNT = 0, 1
"""Slots that every state has: ``T_world_base`` and ``T_link_sensor``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Slots:
    """Where the parts of q that only some jobs have are in a state."""

    joints: tuple[int, ...] = ()
    """Joints of the robot (``Robot.joint_names``) with an unknown offset (rad, m)."""
    objects: tuple[int, ...] = ()
    """Bodies of the scene with an unknown pose: that of the centre of their bounding box."""
    frames: int = 0
    """Frames whose sensor pose has an error of its own: all or none."""
    ranges: int = 0
    """2 where the sensor's offset (m) and scale are unknown, else 0."""

    @property
    def of_joints(self) -> slice:
        """Slots of the joints' offsets."""
        return slice(MOUNT + 1, MOUNT + 1 + len(self.joints))

    @property
    def of_objects(self) -> slice:
        """Slots of the objects' centres in the world."""
        return _after(self.of_joints, len(self.objects))

    @property
    def of_frames(self) -> slice:
        """Slots of the frames' errors, on the right of ``T_world_sensor``."""
        return _after(self.of_objects, self.frames)

    @property
    def of_ranges(self) -> slice:
        """Slots of the sensor's offset and scale."""
        return _after(self.of_frames, self.ranges)

    @property
    def count(self) -> int:
        """All slots of a state."""
        return self.of_ranges.stop


def _after(before: slice, count: int) -> slice:
    return slice(before.stop, before.stop + count)
