"""How right the predicted images and their derivatives are, beside Embree and beside differences.

The scene is the machine hall of ``torchcal.demo``; the reference casts at least 277 rays into every
pixel, on a square lattice turned off the pixels' axes, and shares no code with ``torchcal.render``.
"""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import maximum_filter
from torch import Tensor

import torchcal
from torchcal import se3
from torchcal.demo import raycast
from torchcal.demo.machine_hall import machine_hall, random_view

VIEW = math.radians(50.0)
JUMP = 0.03
"""Share of the range that its second difference has at a silhouette."""
STEPS = (1e-3, 1e-4, 1e-5, 1e-6)
"""Of the central differences (m, rad)."""
ROLL = (math.radians(5.0), math.radians(20.0))

Optics = Literal["pinhole", "spherical", "ultrasonic-array", "laser-scanner"]


@dataclass(frozen=True)
class Args:
    """What is measured."""

    optics: tuple[Optics, ...] = ("pinhole", "spherical")
    """Sensors: 50 degrees of view and a beam of 21 pixels, or a preset with its own."""
    size: int = 512
    """Pixels along a side; presets have their own."""
    views: int = 4
    """Random views of each sensor."""
    seed: int = 0
    """Chooses the views."""
    json: Path | None = None
    """A file for the figures."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Figure:
    """One measured number; the worst over the views unless its name says otherwise."""

    optics: str
    name: str
    value: float
    limit: float
    unit: str


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """One sensor pose in the hall."""

    scene: torchcal.Scene
    sensor: torchcal.Sensor
    T_world_sensor: Float[Tensor, "4 4"]
    Ts_world_body: Float[Tensor, "body 4 4"]

    def moved(self, twist: Float[Tensor, " 6"]) -> "View":
        """The same with the sensor moved by a twist (m, rad) in its own frame."""
        return replace(self, T_world_sensor=self.T_world_sensor @ se3.exp(twist))

    def synthesis(
        self, *, dtype: torch.dtype = torch.float64, motion: Tensor | None = None
    ) -> torchcal.Synthesis:
        """What is predicted."""
        poses = (se3.inverse(self.T_world_sensor) @ self.Ts_world_body).to(dtype)
        return torchcal.synthesise(self.scene.surface, poses, self.sensor, motion)

    def caster(self) -> raycast.View:
        """The same scene for the independent ray caster."""
        return raycast.view(MESHES, self.T_world_sensor.numpy())


WORLD = machine_hall()
MESHES = [item.mesh.copy().apply_transform(item.T_world_object.numpy()) for item in WORLD.objects]


def main(args: Args) -> None:
    figures = [figure for optics in args.optics for figure in measured(optics, args)]
    print(f"{'sensor':<17} {'what':<54} {'measured':>10} {'limit':>8}")
    for each in figures:
        verdict = "" if each.value <= each.limit else "  missed"
        print(
            f"{each.optics:<17} {each.name:<54} {each.value:>10.3g} {each.limit:>8.3g} "
            f"{each.unit}{verdict}"
        )
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(each) for each in figures], indent=2))


def measured(optics: Optics, args: Args) -> Iterator[Figure]:
    """All figures of one sensor."""
    rng = torch.Generator().manual_seed(args.seed)
    views = [view_in_hall(sensor_of(optics, args.size), rng) for _ in range(args.views)]
    rows: list[tuple[str, float, str, Callable[[View], float]]] = [
        ("depth off silhouettes, float32 to Embree, relative", 1e-5, "", depth_error),
        ("blurred image, rms where a window holds a silhouette", 1.0, "mm", blurred_rms),
        ("blurred image, mean there", 0.1, "mm", blurred_mean),
        ("change over half a pixel of motion, relative", 0.02, "", half_pixel_error),
    ]
    for name, limit, unit, measure in rows:
        value = max(abs(measure(view)) for view in views)
        yield Figure(optics=optics, name=name, value=value, limit=limit, unit=unit)
    for name, motion_of in (("sensor", sensor_motion), ("one object", object_motion)):
        for step in STEPS:
            value = max(derivative_error(view, motion_of(view), step) for view in views)
            title = f"derivative to the pose of {name}, differences over {step:.0e}"
            yield Figure(optics=optics, name=title, value=value, limit=1e-3, unit="")


def sensor_of(optics: Optics, size: int) -> torchcal.Sensor:
    """50 degrees of view and a beam of 21 pixels of 512; or a preset's figures."""
    noise = torchcal.Noise(a=0.05)
    beam = max(1, 2 * round(10 * size / 512) + 1)
    half = VIEW / 2 * (size - 1) / size
    projection = torchcal.Spherical(
        width=size, height=size, azimuth=(-half, half), elevation=(half, -half)
    )
    if optics == "pinhole":
        focal, middle = size / 2 / math.tan(VIEW / 2), (size - 1) / 2
        projection = torchcal.Pinhole(
            width=size, height=size, fx=focal, fy=focal, cx=middle, cy=middle
        )
    elif optics != "spherical":
        sensor = torchcal.preset_sensor(optics)
        return replace(sensor, noise=noise, near=0.0, far=100.0)
    return torchcal.Sensor(projection=projection, noise=noise, near=0.0, far=100.0, beam=beam)


def view_in_hall(sensor: torchcal.Sensor, rng: torch.Generator) -> View:
    """A random view with a roll of 5 to 20 degrees."""
    scene = torchcal.build_scene(WORLD, None, dtype=torch.float64, device=torch.device("cpu"))
    eye = torch.eye(4, dtype=torch.float64)
    T_world_sensor = random_view(rng)
    roll = math.asin(float(T_world_sensor[2, 0]))
    while not ROLL[0] < abs(roll) < ROLL[1]:
        T_world_sensor = random_view(rng)
        roll = math.asin(float(T_world_sensor[2, 0]))
    poses = torchcal.body_poses(scene, WORLD, None, eye, None)
    return View(scene=scene, sensor=sensor, T_world_sensor=T_world_sensor, Ts_world_body=poses)


def reference(view: View) -> Float[ndarray, "h w"]:
    """The blurred image by 277 rays a pixel, or 4001 where a beam is one pixel wide."""
    beam = view.sensor.beam
    lattice = raycast.LATTICE if beam > 1 else raycast.FINE_LATTICE
    means = raycast.sampled_means(view.caster(), view.sensor.projection, lattice)
    return raycast.box_mean(*means, beam)


def depth_error(view: View) -> float:
    """The largest relative error of single precision's ideal rays, two pixels off silhouettes."""
    sharp = replace(view, sensor=replace(view.sensor, beam=0))
    expected = raycast.predict(view.caster(), view.sensor.projection, 0)
    ranges = sharp.synthesis(dtype=torch.float32).range.double().numpy()
    off = ~windows(silhouettes(expected), 5)
    return float(np.abs(ranges / expected - 1.0)[off].max())


def blurred_rms(view: View) -> float:
    error = blurred_error(view)
    return 1e3 * float(np.sqrt(np.square(error).mean()))


def blurred_mean(view: View) -> float:
    return 1e3 * float(blurred_error(view).mean())


def blurred_error(view: View) -> Float[ndarray, " pixel"]:
    """Of the pixels whose window holds a silhouette (m)."""
    sharp = raycast.predict(view.caster(), view.sensor.projection, 0)
    window = windows(silhouettes(sharp), view.sensor.beam)
    return (view.synthesis().range.numpy() - reference(view))[window]


def silhouettes(ranges: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Where the range jumps between neighbouring rays: its inverse is straight on a plane."""
    found = np.zeros(ranges.shape, bool)
    for axis in (0, 1):
        bend = np.abs(np.diff(1.0 / ranges, 2, axis=axis))
        margin = [(1, 1) if axis == each else (0, 0) for each in (0, 1)]
        found |= np.pad(bend, margin) * np.square(ranges) > JUMP * ranges
    return found


def windows(mask: Bool[ndarray, "h w"], side: int) -> Bool[ndarray, "h w"]:
    """Pixels whose window of so many pixels a side holds one of the mask."""
    return np.asarray(maximum_filter(mask, side), bool)


def half_pixel_error(view: View) -> float:
    """The worst relative error of the change when the picture moves by half a pixel, four ways."""
    rays = view.sensor.projection.rays(torch.zeros(2).double(), torch.arange(2).double())
    angle = 0.5 * float((rays[1] - rays[0]).norm() / rays[0].norm())
    start, expected_start = view.synthesis().range.numpy(), reference(view)
    errors = []
    for axis, way in ((3, 1.0), (3, -1.0), (4, 1.0), (4, -1.0)):
        twist = torch.zeros(6, dtype=torch.float64)
        twist[axis] = way * angle
        moved = view.moved(twist)
        expected = reference(moved) - expected_start
        change = moved.synthesis().range.numpy() - start
        errors.append(np.linalg.norm(change - expected) / np.linalg.norm(expected))
    return float(max(errors))


def sensor_motion(view: View) -> Float[Tensor, "body 6 parameter"]:
    """The scene moves against the sensor."""
    bodies = len(view.Ts_world_body)
    return torch.eye(6, dtype=torch.float64).expand(bodies, 6, 6)


def object_motion(view: View) -> Float[Tensor, "body 6 parameter"]:
    """The object that fills most of the image moves, of those that are no wall or floor."""
    surface = view.scene.surface
    body = surface.vertex_body[surface.faces[:, 0]]
    seen = body[view.synthesis().face.clamp(min=0)].flatten().bincount(minlength=len(WORLD.objects))
    room = ("wall", "floor", "ceiling")
    for index, item in enumerate(WORLD.objects):
        if item.name.startswith(room):
            seen[index] = 0
    motion = torch.zeros(len(view.Ts_world_body), 6, 6, dtype=torch.float64)
    motion[seen.argmax()] = torch.eye(6, dtype=torch.float64)
    return motion


def derivative_error(view: View, motion: Float[Tensor, "body 6 parameter"], step: float) -> float:
    """Relative Frobenius error against central differences of the float64 image."""
    poses = se3.inverse(view.T_world_sensor) @ view.Ts_world_body
    jacobian = view.synthesis(motion=motion).jacobian
    assert jacobian is not None
    columns = []
    for unit in torch.eye(6, dtype=torch.float64):
        ahead, behind = (
            torchcal.synthesise(
                view.scene.surface, se3.exp(way * step * motion @ unit) @ poses, view.sensor
            ).range
            for way in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2.0 * step))
    difference = torch.stack(columns, -1)
    return float((jacobian - difference).norm() / difference.norm())


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
