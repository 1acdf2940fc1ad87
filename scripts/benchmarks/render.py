"""Range images of cells and meshes by Embree, Open3D and torchcal, from the same poses."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

import torchcal
from torchcal import Noise, Pinhole, Scene, Sensor, World, WorldObject, build_scene, pixel_grid, se3
from torchcal.demo.machine_hall import looking, machine_hall

from .table import NOTHING, REPORT, interleaved, write_section

FACES = (300, 20_000, 200_000)
VIEWS = ((64, 1), (64, 16), (64, 256), (256, 1), (256, 16), (512, 1), (512, 16))
"""Side of the image (pixels) and number of poses."""
ALONE = 4
"""Most poses that the other programs are given: they take one after the other."""
FIELD_OF_VIEW = math.radians(50.0)
BEAM = 21
NEAR, FAR = 0.1, 20.0
ABOUT = f"""\
First hits of all pixels' rays, with `scripts/benchmark.py render --rounds {{rounds}}`. Milliseconds
for one pose, the least of {{rounds}} rounds in which the programs take turns; single precision, all
cores. In brackets: over Embree's time in the same row.

- Embree: `intersects_first` of trimesh with embreex; Open3D: `RaycastingScene.cast_rays`. Both hold
  the scene ready, with rays in its frame, and are given {ALONE} poses at most.
- torchcal, depth: `synthesise` with an ideal ray, all poses in one call.
- torchcal, depth and derivative: with silhouettes, a beam of {BEAM} pixels and the derivative to
  the six parameters of the sensor's pose.
- The hall of machinery fills the image from 2 to 6 m; a cell is the same with its faces divided
  (300 faces: of its objects' boxes); a mesh is a bumpy ball in the middle of the image. The field
  of view is 50 degrees.
"""
HEADINGS = (
    ("scene", "faces", "image", "poses", "Embree", "Open3D"),
    ("torchcal, depth", "torchcal, depth and derivative"),
)

Cast = Callable[[NDArray[np.float64]], object]
"""Casts all rays of one pose T_scene_sensor."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """One scene, as all programs are given it, and where it is looked at from."""

    name: str
    scene: Scene
    mesh: trimesh.Trimesh
    T_scene_sensor: Tensor


def measure(*, rounds: int = 5, out: Path = REPORT) -> None:
    """Range images of cells and meshes: Embree, Open3D, torchcal.

    Args:
        rounds: How often every program is timed.
        out: Where the section `render` is written.
    """
    lines = [_line(sum(HEADINGS, ())), _line(["---"] * len(sum(HEADINGS, ())))]
    for setting in _settings():
        for side, poses in VIEWS:
            lines.append(_line(_compared(setting, side, poses, rounds)))
            print(lines[-1], flush=True)
            # It takes long: what was measured stays when somebody stops it.
            write_section(out, "render", "\n".join([ABOUT.format(rounds=rounds), *lines]))


def _settings() -> Iterator[Setting]:
    yield _seen_cell("hall", _hall())
    for count in FACES:
        yield _seen_cell("cell", _cell(count))
        yield _ball(count)


def _compared(setting: Setting, side: int, poses: int, rounds: int) -> list[str]:
    """One row of the table."""
    rng = torch.Generator().manual_seed(0)
    twists = 0.03 * torch.randn(poses, 6, generator=rng, dtype=torch.float64)
    views = setting.T_scene_sensor @ se3.exp(twists)
    camera = _camera(side)
    others = {"Embree": _embree(setting, camera), "Open3D": _open3d(setting, camera)}
    few = views[:ALONE].numpy()
    calls = {
        name: lambda _, cast=cast: [cast(view) for view in few] and None
        for name, cast in others.items()
        if cast is not None
    }
    calls |= {
        heading: lambda _, call=call: call()
        for heading, call in zip(HEADINGS[1], _torchcal(setting, camera, views), strict=True)
    }
    times = interleaved(calls, rounds + 1)  # the first round warms up
    shared = dict.fromkeys(others, len(few)) | dict.fromkeys(HEADINGS[1], poses)
    best = {
        name: 1e3 * min(run.seconds for run in runs[1:]) / shared[name]
        for name, runs in times.items()
    }
    cells = [setting.name, f"{len(setting.mesh.faces):,}", f"{side} x {side}", str(poses)]
    return cells + [_time(best, name) for name in (*others, *HEADINGS[1])]


def _time(best: dict[str, float], name: str) -> str:
    if name not in best:
        return NOTHING
    ratio = f" ({best[name] / best['Embree']:.2g})" if name != "Embree" and "Embree" in best else ""
    return f"{best[name]:.3g}{ratio}"


def _torchcal(setting: Setting, camera: Pinhole, views: Tensor) -> list[Callable[[], None]]:
    """Depth alone, and blurred depth with its derivative to the sensor's own motion."""
    surface, bodies = setting.scene.surface, len(setting.scene.bodies)
    poses = se3.inverse(views).float()[:, None].expand(-1, bodies, 4, 4)
    motion = -torch.eye(6).expand(len(views), bodies, 6, 6)
    sharp, blurred = (
        Sensor(projection=camera, noise=Noise(a=0.05), near=NEAR, far=FAR, beam=beam)
        for beam in (0, BEAM)
    )

    def depth() -> None:
        torchcal.synthesise(surface, poses, sharp)

    def derivative() -> None:
        torchcal.synthesise(surface, poses, blurred, motion)

    return [depth, derivative]


def _embree(setting: Setting, camera: Pinhole) -> Cast | None:
    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector  # noqa: PLC0415
    except ImportError:
        return None
    caster, rays = RayMeshIntersector(setting.mesh), _rays(camera)

    def cast(T: NDArray[np.float64]) -> object:
        directions = rays @ T[:3, :3].T
        return caster.intersects_first(np.broadcast_to(T[:3, 3], directions.shape), directions)

    return cast


def _open3d(setting: Setting, camera: Pinhole) -> Cast | None:
    try:
        open3d: Any = import_module("open3d")
    except (ImportError, OSError):
        return None
    caster, rays = open3d.t.geometry.RaycastingScene(), _rays(camera)
    caster.add_triangles(
        setting.mesh.vertices.astype(np.float32), setting.mesh.faces.astype(np.uint32)
    )

    def cast(T: NDArray[np.float64]) -> object:
        directions = rays @ T[:3, :3].T
        both = np.concatenate([np.broadcast_to(T[:3, 3], directions.shape), directions], 1)
        return caster.cast_rays(open3d.core.Tensor(both.astype(np.float32)))

    return cast


def _rays(camera: Pinhole) -> NDArray[np.float64]:
    grid = pixel_grid(camera, dtype=torch.float64, device=torch.device("cpu"))
    return camera.rays(*grid).reshape(-1, 3).numpy()


def _camera(side: int) -> Pinhole:
    middle, focal = (side - 1) / 2, side / 2 / math.tan(FIELD_OF_VIEW / 2)
    return Pinhole(width=side, height=side, fx=focal, fy=focal, cx=middle, cy=middle)


def _hall_objects() -> list[trimesh.Trimesh]:
    return [
        item.mesh.copy().apply_transform(item.T_world_object.numpy())
        for item in machine_hall().objects
    ]


def _hall() -> trimesh.Trimesh:
    hall: Any = trimesh.util.concatenate(_hall_objects())
    return hall


def _cell(count: int) -> trimesh.Trimesh:
    if count == min(FACES):
        boxes: Any = trimesh.util.concatenate(
            [part.bounding_box_oriented.to_mesh() for part in _hall_objects()]
        )
        return boxes
    hall: Any = _hall()
    edge = hall.scale / 10.0
    while len(hall.faces) < count:
        hall = hall.subdivide_to_size(edge)
        edge *= 0.8
    return hall


def _seen_cell(name: str, mesh: trimesh.Trimesh) -> Setting:
    return _setting(name, mesh, (0.0, -2.1, 1.8), (0.0, 0.9, 1.0))


def _ball(count: int) -> Setting:
    subdivisions = math.ceil(math.log(count / 20.0, 4.0))
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    bumps = np.sin(9.0 * ball.vertices).prod(1, keepdims=True)
    ball = trimesh.Trimesh(ball.vertices * (1.0 + 0.05 * bumps), ball.faces)
    ball = ball.simplify_quadric_decimation(face_count=count)
    return _setting("mesh", ball, (-2.5, 0.3, 0.2), (0.0, 0.0, 0.0))


def _setting(
    name: str,
    mesh: trimesh.Trimesh,
    position: tuple[float, ...],
    target: tuple[float, ...],
) -> Setting:
    eye = torch.eye(4, dtype=torch.float64)
    world = World(objects=(WorldObject(name=name, mesh=mesh, T_world_object=eye),))
    place, aim = (torch.tensor(point, dtype=torch.float64) for point in (position, target))
    return Setting(
        name=name,
        scene=build_scene(world, None, dtype=torch.float32, device=torch.device("cpu")),
        mesh=mesh,
        T_scene_sensor=looking(place, aim, torch.tensor(0.2, dtype=torch.float64)),
    )


def _line(cells: list[str] | tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"
