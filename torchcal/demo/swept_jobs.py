"""Jobs with known truth in which one thing at a time gets worse: a benchmark for any program.

The images are cast by ``torchcal.demo.raycast``; each job has a seed of its own.
"""

import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.demo import cell, raycast
from torchcal.demo.calibration_jobs import arm_job, prior
from torchcal.demo.calibration_trials import draw_trial
from torchcal.demo.drawn_rooms import (
    Room,
    corner,
    drawn_boxes,
    drawn_room,
    drawn_view,
    symmetric_room,
)
from torchcal.demo.range_trials import meshes_in_world
from torchcal.demo.recording import JOINTS, LINK
from torchcal.demo.robots import robot_folder
from torchcal.demo.swept_settings import FACTORS, Setting, Tier
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Job
from torchcal.model.range_image import RangeImage
from torchcal.model.sensor import Drift, Noise, Sensor
from torchcal.model.world import World, WorldObject, write_world
from torchcal.model.write_job import write_job

FIELD_OF_VIEW = math.radians(60.0)
NEAR, FAR = 0.2, 12.0
"""m"""
FEWEST = 3
"""Planes from which on a pose can be told."""
CORNER = math.pi / 4
"""rad: where the planes of a room of few planes meet."""
BLOB = 0.08
"""Side of a patch without a measurement, in the image's."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Truth:
    """What a program should find out about a job."""

    factor: str
    level: str
    Ts_world_sensor: Float[Tensor, "frame 4 4"]
    symmetries: Float[Tensor, "symmetry 4 4"]
    """``T_world_world``: poses that no image can tell apart, the identity first."""
    observable: bool
    """Whether the images can tell the pose: not with few planes, nor one of several alike."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SweptJob:
    """One job of a benchmark, still to be made."""

    name: str
    factor: str
    level: str
    setting: Setting
    side: int
    seed: tuple[int, ...]

    def write(self, folder: Path) -> Truth:
        """Makes the job and all that it names.

        Args:
            folder: Is made.

        Raises:
            TorchcalError: If Embree is not installed.
        """
        folder.mkdir(parents=True)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed))
        if self.setting.joints_deg > 0.0:
            return self._truth(_write_arm_job(folder, self.setting, self.side, rng))
        room, T_world_sensor = _write_room_job(folder, self.setting, self.side, rng)
        enough = self.setting.planes is None or self.setting.planes >= FEWEST
        return replace(
            self._truth(T_world_sensor[None]),
            symmetries=torch.stack(room.symmetries),
            observable=enough and len(room.symmetries) == 1,
        )

    def _truth(self, Ts_world_sensor: Tensor) -> Truth:
        return Truth(
            factor=self.factor,
            level=self.level,
            Ts_world_sensor=Ts_world_sensor,
            symmetries=torch.eye(4, dtype=torch.float64)[None],
            observable=True,
        )


def swept_jobs(tier: Tier, seed: int) -> Iterator[SweptJob]:
    """All jobs of a benchmark; each depends on nothing but its own place in it and the seed."""
    for f, (factor, levels) in enumerate(FACTORS.items()):
        for k, (level, setting) in enumerate(levels.items()):
            for number in range(tier.seeds):
                yield SweptJob(
                    name=f"{factor.replace(',', '').replace(' ', '-')}-{k + 1}-{number + 1:03d}",
                    factor=factor,
                    level=level,
                    setting=setting,
                    side=tier.side,
                    seed=(seed, f, k, number),
                )


def _write_room_job(
    folder: Path, setting: Setting, side: int, rng: np.random.Generator
) -> tuple[Room, Tensor]:
    """One image of a room by a sensor in somebody's hand."""
    room = _room(setting, rng)
    T_world_sensor = drawn_view(rng, heading=None if setting.planes is None else CORNER)
    sensor = swept_sensor(setting, side)
    real = World(objects=_real_objects(setting, room.world, rng))
    scene = raycast.view(meshes_in_world(real), T_world_sensor.numpy())
    image = raycast.measure(raycast.predict(scene, sensor.projection, sensor.beam), sensor, rng)
    np.save(folder / "0001.npy", _spoilt(image, setting, rng).astype(np.float32))
    write_world(room.world, folder / "room.glb")
    write_job(folder / "job.toml", _room_tables(setting, sensor, T_world_sensor, rng))
    return room, T_world_sensor


def _room_tables(
    setting: Setting, sensor: Sensor, T_world_sensor: Tensor, rng: np.random.Generator
) -> dict[str, Any]:
    tables: dict[str, Any] = {"world": {"model": "room.glb"}, "sensor": _sensor_table(sensor)}
    if setting.start is None:
        tables["frame"] = [{"depth": "0001.npy"}]
        tables["unknown"] = {"base": _sigmas((1.0, 90.0))}
        return tables | {"search": {"initial": "anywhere"}}
    nominal = T_world_sensor @ _motion(setting.start, rng)
    tables["frame"] = [{"depth": "0001.npy", "pose": _pose_table(nominal)}]
    tables["unknown"] = {"base": _sigmas(setting.start)}
    return tables


def _write_arm_job(folder: Path, setting: Setting, side: int, rng: np.random.Generator) -> Tensor:
    """The demo's arm in its cell, its joints off; the poses of its sensor."""
    job, sensor = arm_job(side=512), swept_sensor(setting, side)
    frames = (
        replace(each, image=RangeImage.blank(each.image.name, each.image.file, sensor))
        for each in job.frames
    )
    job = replace(
        job,
        sensor=sensor,
        frames=tuple(frames),
        base=prior(0.02, 1.0),
        joints=dict.fromkeys(JOINTS[1:], math.radians(setting.joints_deg)),
    )
    trial = draw_trial(job, int(rng.integers(2**31)), 0)
    shutil.copytree(robot_folder("arm"), folder / "arm")
    cell.as_scene(cell.modelled_objects()).export(folder / "cell.glb")
    for frame in trial.job.frames:
        ranges = frame.image.range.numpy().astype(np.float32)
        np.save(folder / f"{frame.image.name}.npy", ranges)
    write_job(folder / "job.toml", _arm_tables(trial.job, setting))
    parameters = Parameters.of(trial.job, build_job_scene(trial.job))
    return parameters.sensor_poses(trial.state)


def _arm_tables(job: Job, setting: Setting) -> dict[str, Any]:
    frames = [
        {
            "depth": f"{frame.image.name}.npy",
            "joints": dict(zip(JOINTS, frame.joints.tolist(), strict=True)),
        }
        for frame in job.frames
        if frame.joints is not None
    ]
    return {
        "world": {"model": "cell.glb"},
        "robot": {"urdf": "arm/arm.urdf", "base": _pose_table(job.T_world_base)},
        "sensor": {"link": LINK, **_sensor_table(job.sensor)},
        "frame": frames,
        "unknown": {
            "base": _sigmas((0.02, 1.0)),
            "joints": {"sigma_deg": setting.joints_deg, "names": list(JOINTS[1:])},
        },
    }


def _room(setting: Setting, rng: np.random.Generator) -> Room:
    if setting.planes is not None:
        return corner(setting.planes)
    return symmetric_room(rng, setting.folds) if setting.folds > 1 else drawn_room(rng)


def _real_objects(
    setting: Setting, model: World, rng: np.random.Generator
) -> tuple[WorldObject, ...]:
    """What is there: the model without its last boxes, and boxes that nobody drew."""
    there = model.objects[: len(model.objects) - setting.missing]
    return (*there, *drawn_boxes(rng, setting.extra, name="extra"))


def swept_sensor(setting: Setting, side: int) -> Sensor:
    """The camera of a setting, with so many pixels along a side."""
    focal, middle = side / 2 / math.tan(FIELD_OF_VIEW / 2), (side - 1) / 2
    return Sensor(
        projection=Pinhole(width=side, height=side, fx=focal, fy=focal, cx=middle, cy=middle),
        noise=Noise(a=setting.sigma, drift=Drift(sigma=0.0, pixels=1.0)),
        near=NEAR,
        far=FAR,
        beam=setting.beam,
    )


def _sensor_table(sensor: Sensor) -> dict[str, Any]:
    projection = sensor.projection
    assert isinstance(projection, Pinhole)
    return {
        "model": "pinhole",
        **{each.name: getattr(projection, each.name) for each in fields(projection)},
        "range": [sensor.near, sensor.far],
        "sigma": sensor.noise.a,
        "drift": 0,
        "beam": sensor.beam,
    }


def _pose_table(T: Tensor) -> dict[str, Any]:
    xyz, rpy = se3.to_xyz_rpy(T)
    return {"xyz": xyz.tolist(), "rpy_deg": torch.rad2deg(rpy).tolist()}


def _sigmas(start: tuple[float, float]) -> dict[str, float]:
    return {"position_sigma": start[0], "rotation_sigma_deg": start[1]}


def _motion(start: tuple[float, float], rng: np.random.Generator) -> Tensor:
    """So far in a random direction, turned so far about a random axis."""
    parts = [rng.standard_normal(3) for _ in range(2)]
    sizes = (start[0], math.radians(start[1]))
    twist = [s * part / np.linalg.norm(part) for s, part in zip(sizes, parts, strict=True)]
    return se3.exp(torch.from_numpy(np.concatenate(twist)))


def _spoilt(
    image: Float[np.ndarray, "h w"], setting: Setting, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """With outliers, and without what drops out."""
    wild = rng.random(image.shape) < setting.outliers
    image = np.where(wild, rng.uniform(NEAR, FAR, image.shape), image)
    side = max(1, round(BLOB * len(image)))
    coarse = -(-len(image) // side)
    lost = np.kron(rng.random((coarse, coarse)) < setting.dropouts, np.ones((side, side), bool))
    return np.where(lost[: image.shape[0], : image.shape[1]], np.nan, image)
