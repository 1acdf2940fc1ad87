"""The scene of the paper's 4.2: how many edges a sensor sees, by rays only, and from how far."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import Float
from numpy import ndarray

from torchcal.demo import raycast
from torchcal.demo.machine_hall import looking, machine_hall, random_view
from torchcal.demo.recording import SENSOR
from torchcal.geometry.projection import Pinhole

assert isinstance(SENSOR.projection, Pinhole)
CAMERA = SENSOR.projection
VIEWS = 12
EDGES, LONGER = 36, 60.0  # edges of more than so many pixels
BEND, JUMP = np.cos(np.radians(20.0)), 0.3  # m
BESIDE, STEP = 1.5, 2.0  # pixels: how far beside an edge, and how often along it, rays look
CLOSE, BORDER = 0.1, 3.0  # m before the sensor, pixels of the image's border that are left out


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """The places on one mesh edge at which it is seen."""

    start: Float[ndarray, "2"]
    direction: Float[ndarray, "2"]
    length: float
    places: Float[ndarray, "place 2"]


def meshes() -> list[trimesh.Trimesh]:
    objects = machine_hall().objects
    return [item.mesh.copy().apply_transform(item.T_world_object.numpy()) for item in objects]


def before_sensor(ends: ndarray, T_world_sensor: ndarray) -> ndarray:
    """Edges in the sensor's frame, cut off ``CLOSE`` before it."""
    ends = (ends - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3]
    ends = ends[(ends[..., 2] > CLOSE).any(1)]
    a, b = ends[:, 0], ends[:, 1]

    def pulled(p: ndarray, q: ndarray) -> ndarray:
        share = (CLOSE - p[:, 2:]) / np.where(p[:, 2:] < CLOSE, (q - p)[:, 2:], 1.0)
        return np.where(p[:, 2:] < CLOSE, p + share * (q - p), p)

    return np.stack([pulled(a, b), pulled(b, a)], 1)


def places_along(edge: ndarray, camera: Pinhole) -> tuple[ndarray, ndarray]:
    """Places every ``STEP`` pixels along an edge inside the image, and their depth (m)."""
    ends = np.array([camera.fx, camera.fy]) * edge[:, :2] / edge[:, 2:]
    ends += (camera.cx, camera.cy)
    length = float(np.hypot(*(ends[1] - ends[0])))
    share = np.linspace(0.0, 1.0, int(np.clip(length / STEP, 2, 20_000)))[:, None]
    places = ends[0] + share * (ends[1] - ends[0])
    limits = np.array([camera.width, camera.height]) - 1.0 - BORDER
    inside = ((places > BORDER) & (places < limits)).all(1)
    depth = 1.0 / ((1.0 - share[:, 0]) / edge[0, 2] + share[:, 0] / edge[1, 2])
    return places[inside], depth[inside]


def seen_run(view: raycast.View, edge: ndarray, camera: Pinhole) -> Run | None:
    """Where rays on both sides of an edge meet it and tell of a bend or a jump."""
    places, depth = places_along(edge, camera)
    if len(places) < 4:
        return None
    direction = (places[-1] - places[0]) / np.hypot(*(places[-1] - places[0]))
    across = BESIDE * np.array([-direction[1], direction[0]])
    u, v = np.stack([places + across, places - across]).transpose(2, 0, 1)
    rays = camera.rays(torch.from_numpy(u), torch.from_numpy(v)).numpy()
    ranges, face = raycast.cast(view, rays)
    normal = view.normals[face] / np.linalg.norm(view.normals[face], axis=-1, keepdims=True)
    on_edge = np.abs(ranges - depth) < 0.02 + 0.02 * depth
    bend = on_edge.all(0) & (np.abs((normal[0] * normal[1]).sum(-1)) < BEND)
    jump = on_edge.any(0) & (np.abs(ranges[0] - ranges[1]) > JUMP)
    found = places[bend | jump]
    if not len(found):
        return None
    length = float(np.hypot(*(places[-1] - places[0])))
    return Run(start=places[0], direction=direction, length=length, places=found)


def long_edges(runs: list[Run]) -> int:
    """Pieces longer than ``LONGER`` pixels; runs on one line of the image are one edge."""
    lines: list[tuple[Run, list[ndarray]]] = []
    for run in sorted(runs, key=lambda each: -each.length):
        for line, places in lines:
            across = np.array([-line.direction[1], line.direction[0]])
            if (np.abs((run.places - line.start) @ across) < STEP).all():
                places.append(run.places)
                break
        else:
            lines.append((run, [run.places]))
    count = 0
    for line, places in lines:
        along = np.sort((np.concatenate(places) - line.start) @ line.direction)
        pieces = np.split(along, np.flatnonzero(np.diff(along) > 4 * STEP) + 1)
        count += sum(float(piece[-1] - piece[0]) > LONGER for piece in pieces)
    return count


def visible_edges(bodies: list[trimesh.Trimesh], T_world_sensor: ndarray, camera: Pinhole) -> int:
    view = raycast.view(bodies, T_world_sensor)
    ends = np.concatenate([mesh.vertices[mesh.edges_unique] for mesh in bodies])
    runs = (seen_run(view, edge, camera) for edge in before_sensor(ends, T_world_sensor))
    return long_edges([run for run in runs if run is not None])


def test_the_edges_of_a_box_are_counted():
    """Seen from the side and above: three faces, nine edges, all longer than 60 pixels."""
    box = trimesh.creation.box((1.0, 1.0, 1.0)).subdivide()
    eye, middle = torch.tensor([(2.0, 2.5, 2.2), (0.0, 0.0, 0.0)], dtype=torch.float64)
    pose = looking(eye, middle, torch.tensor(0.2, dtype=torch.float64)).numpy()
    ground = trimesh.creation.box((90.0, 90.0, 0.1)).apply_translation((0.0, 0.0, -9.0))
    assert visible_edges([box, ground], pose, CAMERA) == 9


@pytest.mark.slow
def test_every_view_has_as_many_edges_as_the_papers(rng: torch.Generator):
    bodies = meshes()
    counts = [visible_edges(bodies, random_view(rng).numpy(), CAMERA) for _ in range(VIEWS)]
    assert min(counts) >= EDGES


def test_the_machinery_is_two_to_six_metres_away_and_no_ray_leaves_the_room(rng: torch.Generator):
    bodies = meshes()
    for _ in range(VIEWS):
        depth = raycast.predict(
            raycast.view(bodies, random_view(rng).numpy()), CAMERA.resized(8), 0
        )
        assert np.isfinite(depth).all()
        assert depth.min() > 1.4  # the floor before the machinery
        assert 2.0 < np.median(depth) < 6.0
        assert np.mean((depth > 2.0) & (depth < 6.0)) > 0.8


def test_views_follow_their_generator():
    first, again = (random_view(torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, random_view(torch.Generator().manual_seed(4)))


def test_a_sensor_that_looks_at_a_point_sees_it_in_the_middle():
    eye, target = torch.tensor([(0.3, -2.0, 1.8), (-0.6, 1.0, 0.9)], dtype=torch.float64)
    pose = looking(eye, target, torch.tensor(0.3, dtype=torch.float64))
    ahead = torch.linalg.inv(pose) @ torch.cat([target, target.new_ones(1)])
    expected = torch.tensor([0.0, 0.0, float((target - eye).norm()), 1.0], dtype=torch.float64)
    torch.testing.assert_close(ahead, expected)
    right = looking(eye, target, torch.tensor(0.0, dtype=torch.float64))[:3, 0]
    assert abs(right[2]) < 1e-12
