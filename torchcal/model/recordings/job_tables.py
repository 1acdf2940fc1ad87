"""From a recording to the tables of a job file, with remarks for what a person has to look at."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole, Spherical
from torchcal.model.recordings.recorded import Optics, Recorded, Taken

_TAKEN_OVER = ("sigma", "drift", "beam", "range", "depth_unit")
"""Keys of the sensor that another job states, and a recording only guesses."""
_POSE_SIGMAS = {"position_sigma": 0.05, "rotation_sigma_deg": 3.0}
_REMARKS = {
    "sensor.sigma": "a guess: what does the data sheet say?",
    "sensor.range": "what was measured: what does the data sheet say?",
    "unknown.base": "What may be wrong, and by how much, is yours to say.",
}
_ORDER = ("world", "robot", "sensor", "frame", "unknown", "search")


@dataclass(frozen=True, kw_only=True, slots=True)
class Written:
    """What was written of a recording before its job."""

    images: tuple[str | None, ...]
    """As the job names them; None for those in which nothing was measured, which it leaves out."""
    limits: tuple[float, float]
    """Nearest and farthest range (m) in them."""
    whole: bool
    """Whether their pixels are integers."""
    urdf: str | None
    """The robot's file; None without a robot."""
    world: str | None
    """The model's file; None where nobody has named one."""


def job_tables(recorded: Recorded, written: Written) -> dict[str, Any]:
    """The tables of a job, in the keys of a job file."""
    tables: dict[str, Any] = {"sensor": _sensor(recorded.optics, written)}
    if written.world is not None:
        tables["world"] = {"model": written.world}
    carrier = recorded.carrier
    if carrier is not None:
        mount = {"link": carrier.link, "mount": pose_table(carrier.T_link_sensor)}
        tables["robot"] = {"urdf": written.urdf, "base": pose_table(carrier.T_world_base)}
        tables["sensor"] = mount | tables["sensor"]
    pairs = zip(written.images, recorded.frames, strict=True)
    tables["frame"] = [_frame(file, taken) for file, taken in pairs if file is not None]
    tables["unknown"] = {"base": _POSE_SIGMAS}
    return _ordered(tables)


def with_tables_of(tables: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of a recording with what another job of the same cell states.

    The other job's are the unknowns, the search and the world but for its file, the robot's base,
    the sensor's noise and limits, and, if the same link carries it, the sensor's mount.
    """
    ours, theirs = tables["sensor"], other.get("sensor", {})
    keys = _TAKEN_OVER + (("mount",) if theirs.get("link") == ours.get("link", "") else ())
    out = {**tables, "sensor": ours | {key: theirs[key] for key in keys if key in theirs}}
    out |= {name: other[name] for name in ("unknown", "search") if name in other}
    if "robot" in tables:
        out["robot"] = {**other.get("robot", {}), "urdf": tables["robot"]["urdf"]}
        out["robot"].setdefault("base", tables["robot"]["base"])
    if "world" in tables:
        out["world"] = {**other.get("world", {}), **tables["world"]}
    return _ordered(out)


def remarks_of(to_fill_in: Mapping[str, str], other: Mapping[str, Any]) -> dict[str, str]:
    """Comments for keys that the recording does not know, and that no other job states either."""
    remarks = {**_REMARKS, **{key: f"FILL IN: {words}" for key, words in to_fill_in.items()}}
    return {key: words for key, words in remarks.items() if not _states(other, key)}


def pose_table(T: Float[Tensor, "4 4"] | None) -> dict[str, list[float]]:
    """A pose as a job has it: metres, and roll, pitch, yaw in degrees; nobody knows it: zeros."""
    xyz, rpy = se3.to_xyz_rpy(torch.eye(4, dtype=torch.float64) if T is None else T)
    # Adding 0 takes the sign from zeros.
    return {"xyz": (xyz + 0.0).tolist(), "rpy_deg": (rpy.rad2deg() + 0.0).tolist()}


def _states(tables: Mapping[str, Any], key: str) -> bool:
    name, _, inner = key.partition(".")
    return name in tables and (name == "unknown" or inner in tables[name])


def _ordered(tables: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tables[name] for name in _ORDER if name in tables}


def _frame(file: str, taken: Taken) -> dict[str, Any]:
    if taken.joints is not None:
        return {"depth": file, "joints": dict(taken.joints)}
    return {"depth": file, "pose": pose_table(taken.T_world_sensor)}


def _sensor(optics: Optics, written: Written) -> dict[str, Any]:
    unit = {"depth_unit": optics.depth_unit} if written.whole else {}
    near, far = written.limits if optics.limits is None else optics.limits
    return {
        **_optics(optics.projection),
        **unit,
        "range": [near, far],
        "sigma": list(optics.sigma),
        "beam": optics.beam,
    }


def _optics(projection: Pinhole | Spherical) -> dict[str, Any]:
    if isinstance(projection, Pinhole):
        keys = (each.name for each in fields(projection))
        return {"model": "pinhole", **{key: getattr(projection, key) for key in keys}}
    return {
        "model": "spherical",
        "columns": projection.width,
        "rows": projection.height,
        "azimuth_deg": [math.degrees(angle) for angle in projection.azimuth],
        "elevation_deg": [math.degrees(angle) for angle in projection.elevation],
    }
