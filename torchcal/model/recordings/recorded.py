"""What every kind of recording is turned into before a job is written, and what is asked of it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchcal.errors import JobError, choices
from torchcal.geometry.projection import Pinhole, Spherical

RangePixels = NDArray[np.uint16] | NDArray[np.float32]
"""A range image: units of the sensor where the pixels are integers, metres where they are not."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """What to take of a recording; each default is right where there is nothing to choose."""

    frames: int = 20
    """The most images to take."""
    use: tuple[str, ...] = ()
    """Topics of a bag, or names of files in a folder, where there are several."""
    urdf: Path | None = None
    """Instead of the recording's own ``robot_description``."""
    spare_urdf: Path | None = None
    """Where the recording has no ``robot_description``."""
    link: str | None = None
    """The link that carries the sensor; None: the one that the recording says."""
    depth_unit: float | None = None
    """Metres of one unit of the images; None: 0.001 for integers, 1 for floats."""
    spare_unit: float | None = None
    """Of integer images, where ``depth_unit`` is None; None: 0.001."""
    resolution_deg: float | None = None
    """Of the grid onto which unorganised points are projected; None: from their distances."""
    position: tuple[float, float, float] | None = None
    """Where the sensor stood (m), for clouds whose points are in the axes of the world."""

    def refuse_others(self, source: Path, files: Iterable[Path]) -> None:
        """Raises for a name in ``use`` that none of a folder's files has.

        Raises:
            JobError: With the names that there are.
        """
        names = [file.name for file in files]
        for name in self.use:
            if name not in names:
                raise JobError(source, "--use", name, choices(names))


@dataclass(frozen=True, kw_only=True, slots=True)
class Optics:
    """A sensor as far as a recording knows it."""

    projection: Pinhole | Spherical
    sigma: tuple[float, float, float]
    """A guess of a, b and c in a + b z + c z^2 (m) from the kind of sensor."""
    beam: int
    depth_unit: float = 0.001
    """Metres of one unit of an integer image."""
    limits: tuple[float, float] | None = None
    """Nearest and farthest range (m) by the sensor's own word."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotSource:
    """A URDF that is still somewhere else."""

    xml: bytes
    named: Path
    """Where it comes from; mesh files are looked for around it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Taken:
    """One image of a recording, without its pixels."""

    joints: Mapping[str, float] | None = None
    """rad, m; None without a robot."""
    T_world_sensor: Float[Tensor, "4 4"] | None = None
    """None with a robot, or where nobody knows."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Carrier:
    """What carries the sensor: a link of a robot."""

    robot: RobotSource
    link: str
    T_link_sensor: Float[Tensor, "4 4"]
    T_world_base: Float[Tensor, "4 4"] | None = None
    """None: the recording does not say."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Recorded:
    """A recording, whatever it was read from."""

    optics: Optics
    frames: tuple[Taken, ...]
    images: Iterable[RangePixels]
    """One for each frame, in their order; read when they are asked for."""
    carrier: Carrier | None = None
    notes: tuple[str, ...] = ()
    """What a person should know of how it was read."""
    to_fill_in: Mapping[str, str] = field(default_factory=dict)
    """Keys of the job that the recording does not know, each with what belongs there."""
