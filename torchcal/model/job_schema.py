"""The tables and keys of a job file, each with the words that say what it may hold.

A field's description completes the sentence "expected ..." of an error message. What needs more
than one table (a joint of the robot, keys of a sensor's model) is checked where it is used.
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from torchcal.errors import choices
from torchcal.model.meshes import FARTHEST
from torchcal.model.sensor import PRESETS, Drift

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Count = Annotated[int, Field(strict=True, gt=0, le=100_000)]
Length = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-FARTHEST, le=FARTHEST)]
Focal = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-3, le=1e7)]
Unit = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-9, le=1e6)]
Offset = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e7, le=1e7)]
Flag = Annotated[bool, Field(strict=True)]
Three = tuple[Number, Number, Number]
Place = tuple[Length, Length, Length]
Pair = tuple[Number, Number]
Limits = tuple[Length, Length]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _three_times(value: object) -> object:
    return (value, value, value) if _is_number(value) else value


def _constant_sigma(value: object) -> object:
    return (value, 0.0, 0.0) if _is_number(value) else value


def _drift_table(value: object) -> object:
    if value == "auto":
        return None
    if _is_number(value) and value == 0:
        return {"sigma": 0.0, "pixels": 1.0}
    if not isinstance(value, dict):
        raise ValueError
    return value


def _ascending(limits: Limits) -> Limits:
    if not 0 <= limits[0] < limits[1]:
        raise ValueError
    return limits


def _known_preset(name: str) -> str:
    if name not in PRESETS:
        raise ValueError
    return name


def _odd_or_zero(side: int) -> int:
    if side != 0 and side % 2 == 0:
        raise ValueError
    return side


def _up_to_a_turn(degrees: Pair) -> Pair:
    if max(map(abs, degrees)) > 360 or abs(degrees[1] - degrees[0]) > 360:
        raise ValueError
    return degrees


def _up_to_the_poles(degrees: Pair) -> Pair:
    if max(map(abs, degrees)) > 90:
        raise ValueError
    return degrees


Sigmas = Annotated[tuple[NotNegative, NotNegative, NotNegative], BeforeValidator(_three_times)]


class Table(BaseModel):
    """A table of the job file; unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class PoseTable(Table):
    """A pose."""

    xyz: Place = Field(
        default=(0.0, 0.0, 0.0), description="three numbers in metres, at most a million"
    )
    rpy_deg: Three = Field(
        default=(0.0, 0.0, 0.0), description="three numbers in degrees: roll, pitch, yaw as in URDF"
    )


_POSE = "a table { xyz = [x, y, z], rpy_deg = [roll, pitch, yaw] } in metres and degrees"


class WorldTable(Table):
    """The CAD model of the surroundings."""

    model: str = Field(description="the name of a file that trimesh reads as a scene")
    unit: Unit = Field(
        default=1.0, description="metres for one unit of the file, a number from 1e-9 to 1e6"
    )
    pose: PoseTable = Field(default=PoseTable(), description=_POSE)
    complete: Flag = Field(default=False, description="true or false")


class RobotTable(Table):
    """The robot that carries the sensor or is watched by it."""

    urdf: str = Field(description="the name of a URDF file")
    base: PoseTable = Field(default=PoseTable(), description=_POSE)


class DriftTable(Table):
    """A slowly varying range error."""

    sigma: NotNegative = Field(description="a number in metres, at least 0")
    pixels: float = Field(
        ge=1.0, allow_inf_nan=False, description="a correlation length in pixels, at least 1"
    )

    def as_drift(self) -> Drift:
        """The same as the method uses it."""
        return Drift(sigma=self.sigma, pixels=self.pixels)


_FOCAL = "a number of pixels from 0.001 to 1e7"
_CENTRE = "a number of pixels, at most 1e7"


class SensorTable(Table):
    """The range sensor; which keys must be there depends on ``model``."""

    link: str | None = Field(
        default=None, description='the name of the URDF link that carries the sensor, or "world"'
    )
    mount: PoseTable | None = Field(default=None, description=_POSE)
    preset: Annotated[str, AfterValidator(_known_preset)] | None = Field(
        default=None, description=choices(PRESETS)
    )
    model: Literal["pinhole", "spherical"] = Field(description='"pinhole" or "spherical"')
    width: Count | None = Field(
        default=None, description="a whole number of pixels from 1 to 100000"
    )
    height: Count | None = Field(
        default=None, description="a whole number of pixels from 1 to 100000"
    )
    fx: Focal | None = Field(default=None, description=_FOCAL)
    fy: Focal | None = Field(default=None, description=_FOCAL)
    cx: Offset | None = Field(default=None, description=_CENTRE)
    cy: Offset | None = Field(default=None, description=_CENTRE)
    columns: Count | None = Field(
        default=None, description="a whole number of pixels from 1 to 100000"
    )
    rows: Count | None = Field(
        default=None, description="a whole number of pixels from 1 to 100000"
    )
    azimuth_deg: Annotated[Pair, AfterValidator(_up_to_a_turn)] | None = Field(
        default=None,
        description="two numbers [first column, last column] in degrees, at most a turn apart",
    )
    elevation_deg: Annotated[Pair, AfterValidator(_up_to_the_poles)] | None = Field(
        default=None, description="two numbers [first row, last row] in degrees between -90 and 90"
    )
    depth_unit: Unit = Field(
        default=0.001,
        description="metres for one unit of an integer image, a number from 1e-9 to 1e6",
    )
    range: Annotated[Limits, AfterValidator(_ascending)] = Field(
        description="two numbers [near, far] in metres with 0 <= near < far"
    )
    sigma: Annotated[Three, BeforeValidator(_constant_sigma)] = Field(
        description="one number in metres above 0, or three numbers [a, b, c] for a + b z + c z^2"
    )
    drift: Annotated[DriftTable | None, BeforeValidator(_drift_table)] = Field(
        default=None,
        description='"auto", 0 or a table { sigma = metres, pixels = correlation length }',
    )
    beam: Annotated[int, Field(strict=True, ge=0), AfterValidator(_odd_or_zero)] = Field(
        default=1, description="an odd number of pixels, or 0 for an ideal ray"
    )


class FrameTable(Table):
    """One range image."""

    depth: str = Field(description="the name of a 16-bit PNG, .npy or .tiff file")
    mask: str | None = Field(
        default=None, description="the name of an 8-bit PNG, .npy or .tiff file"
    )
    joints: dict[str, Number] | None = Field(
        default=None,
        description="a number in radians (metres for a prismatic joint) for each joint",
    )
    pose: PoseTable | None = Field(default=None, description=_POSE)


_POSITION = "one number in metres or three, each at least 0; 0 holds an axis"
_ROTATION = "one number in degrees or three, each at least 0; 0 holds an axis"


class PoseSigmas(Table):
    """What may be wrong with a pose: one standard deviation for each axis."""

    position_sigma: Sigmas = Field(description=_POSITION)
    rotation_sigma_deg: Sigmas = Field(description=_ROTATION)


class JointSigmas(Table):
    """What may be wrong with the zero positions of the joints."""

    sigma_deg: NotNegative | None = Field(
        default=None,
        description="a number in degrees, at least 0, for revolute and continuous joints",
    )
    sigma: NotNegative | None = Field(
        default=None, description="a number in metres, at least 0, for prismatic joints"
    )
    names: Annotated[list[str], Field(min_length=1)] | None = Field(
        default=None, description="a list of names of joints; all moving joints if left out"
    )


class RangeSigmas(Table):
    """What may be wrong with the sensor's range: z_measured = offset + (1 + scale) z."""

    offset_sigma: NotNegative = Field(description="a number in metres, at least 0")
    scale_sigma: NotNegative = Field(description="a number without a unit, at least 0")


_POSE_SIGMAS = "a table with position_sigma and rotation_sigma_deg"


class UnknownTable(Table):
    """What may be wrong."""

    base: PoseSigmas | None = Field(default=None, description=_POSE_SIGMAS)
    joints: JointSigmas | None = Field(
        default=None, description="a table with sigma_deg, sigma or names"
    )
    mount: PoseSigmas | None = Field(default=None, description=_POSE_SIGMAS)
    object: dict[str, PoseSigmas] = Field(
        default={}, description=f"for each object {_POSE_SIGMAS}, as in [unknown.object.NAME]"
    )
    range: RangeSigmas | None = Field(
        default=None, description="a table with offset_sigma and scale_sigma"
    )
    frames: PoseSigmas | None = Field(default=None, description=_POSE_SIGMAS)


class SearchTable(Table):
    """How the estimate is looked for."""

    initial: Literal["nominal", "anywhere"] = Field(
        default="nominal", description='"nominal" or "anywhere"'
    )
    alpha: Annotated[float, Field(strict=True, gt=0, le=1e6)] = Field(
        default=3.0, description="a number above 0 and at most 1e6, the factor of eq. 1 and eq. 5"
    )


class JobTable(Table):
    """A whole job file."""

    world: WorldTable | None = Field(default=None, description="a table [world]")
    robot: RobotTable | None = Field(default=None, description="a table [robot]")
    sensor: SensorTable = Field(description="a table [sensor]")
    frame: Annotated[list[FrameTable], Field(min_length=1)] = Field(
        description="one or more tables [[frame]], in two brackets"
    )
    unknown: UnknownTable = Field(
        default=UnknownTable(), description="tables such as [unknown.base]"
    )
    search: SearchTable = Field(default=SearchTable(), description="a table [search]")
