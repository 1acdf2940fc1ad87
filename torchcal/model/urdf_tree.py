"""What a URDF says of a robot, as frozen data."""

from dataclasses import dataclass
from pathlib import Path

JOINT_KINDS = ("fixed", "revolute", "continuous", "prismatic")
GEOMETRIES = ("box", "cylinder", "mesh", "sphere")


@dataclass(frozen=True, kw_only=True, slots=True)
class Origin:
    """Where a frame stands in its parent: metres, and roll, pitch, yaw in radians."""

    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Shape:
    """One piece of a link's geometry."""

    key: str
    """Where it stands, for errors."""
    kind: str
    """One of ``GEOMETRIES``."""
    size: tuple[float, ...]
    """Box: three sides; cylinder: radius and length; sphere: radius; mesh: three scales."""
    filename: str
    """Of a mesh; empty for the others."""
    origin: Origin
    colour: tuple[float, ...] | None
    """RGBA, 0 to 1; None where the URDF gives none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Mimic:
    """A joint that follows another: value = multiplier * other + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Joint:
    """One joint of the tree."""

    name: str
    kind: str
    """One of ``JOINT_KINDS``."""
    parent: str
    child: str
    origin: Origin
    axis: tuple[float, ...]
    """In the child's frame, not 0; any length."""
    limits: tuple[float, float]
    """rad or m; infinite where there are none."""
    mimic: Mimic | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Link:
    """One link and what it looks like: its visual geometry, else its collision geometry."""

    name: str
    shapes: tuple[Shape, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Urdf:
    """Everything of a URDF that torchcal uses; the joints make a tree over the links."""

    file: Path
    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]

    @property
    def root(self) -> str:
        """The one link that is no joint's child."""
        children = {joint.child for joint in self.joints}
        return next(link.name for link in self.links if link.name not in children)
