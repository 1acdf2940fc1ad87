"""The scene: bodies in order, welded triangles, complete edge tables, poses of bodies."""

import time
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torchcal.errors import TorchcalError
from torchcal.geometry import se3
from torchcal.model.meshes import painted
from torchcal.model.robot import Robot, load_robot
from torchcal.model.scene import Scene, body_poses, build_scene, edge_tables
from torchcal.model.world import World, WorldObject

ROVER = Path(__file__).parents[1] / "robots" / "rover" / "rover.urdf"
CPU = torch.device("cpu")


def world_of(**meshes: trimesh.Trimesh) -> World:
    poses = {name: se3.exp(torch.full((6,), 0.1 * i)) for i, name in enumerate(meshes)}
    return World(
        objects=tuple(
            WorldObject(name=name, mesh=mesh, T_world_object=poses[name].double())
            for name, mesh in meshes.items()
        )
    )


def soup(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same triangles without any shared vertex, as in STL."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def scene_of(world: World | None = None, robot: Robot | None = None) -> Scene:
    return build_scene(world, robot, dtype=torch.float64, device=CPU)


def test_bodies_are_the_objects_and_then_the_links_with_meshes():
    box, robot = trimesh.creation.box((1, 1, 1)), load_robot(ROVER)
    scene = scene_of(world_of(crate=box, table=box.copy()), robot)
    names = [body.name for body in scene.bodies]
    assert names[:3] == ["crate", "table", "robot/base_link"]
    assert "robot/lidar" not in names
    assert [body.link for body in scene.bodies[:3]] == [None, None, "base_link"]
    assert scene.body_index("robot/tilt_link") == names.index("robot/tilt_link")


def test_an_unknown_body_and_an_empty_model_are_errors():
    scene = scene_of(world_of(crate=trimesh.creation.box((1, 1, 1))))
    with pytest.raises(TorchcalError, match="found body 'box'; expected one of crate"):
        scene.body_index("box")
    with pytest.raises(TorchcalError, match="without triangles"):
        scene_of()


def test_a_soup_of_triangles_is_welded_into_a_closed_surface():
    ball = trimesh.creation.icosphere(subdivisions=3)
    surface = scene_of(world_of(ball=soup(ball))).surface
    vertices, edges, faces = len(ball.vertices), len(ball.edges_unique), len(ball.faces)
    assert (len(surface.vertices), len(surface.edges)) == (vertices, edges)
    assert len(surface.faces) == faces
    assert (surface.edge_faces >= 0).all()
    corners = surface.vertices[surface.faces].numpy()
    np.testing.assert_array_equal(corners, ball.vertices[ball.faces])


def test_vertices_that_differ_by_rounding_are_one():
    mesh = soup(trimesh.creation.box((1, 1, 1)))
    jitter = np.random.default_rng(0).uniform(-3e-8, 3e-8, mesh.vertices.shape)
    mesh.vertices = mesh.vertices + jitter
    assert len(scene_of(world_of(box=mesh)).surface.vertices) == 8


def test_bodies_share_no_vertices_even_where_they_touch():
    box = trimesh.creation.box((1, 1, 1))
    surface = scene_of(world_of(a=box, b=box.copy())).surface
    assert len(surface.vertices) == 16
    assert surface.vertex_body.tolist() == [0] * 8 + [1] * 8
    bodies = surface.vertex_body[surface.faces]
    assert (bodies == bodies[:, :1]).all()


def test_an_open_sheet_has_border_edges():
    vertices = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    sheet = trimesh.Trimesh(vertices, [(0, 1, 2), (0, 2, 3)], process=False)
    surface = scene_of(world_of(sheet=sheet)).surface
    rows = {
        tuple(edge): tuple(faces)
        for edge, faces in zip(surface.edges.tolist(), surface.edge_faces.tolist(), strict=True)
    }
    assert rows == {
        (0, 1): (0, -1),
        (1, 2): (0, -1),
        (0, 2): (0, 1),
        (2, 3): (1, -1),
        (0, 3): (1, -1),
    }


@pytest.mark.parametrize("leaves", [1, 2, 3, 4, 5])
def test_every_face_is_in_three_rows_however_many_share_an_edge(leaves: int):
    faces = np.array([(0, 1, 2 + leaf) for leaf in range(leaves)])
    edges, edge_faces = edge_tables(faces)
    counts = np.bincount(edge_faces[edge_faces >= 0], minlength=leaves)
    np.testing.assert_array_equal(counts, 3)
    spine = (edges == (0, 1)).all(1)
    assert spine.sum() == (leaves + 1) // 2
    for edge, pair in zip(edges, edge_faces, strict=True):
        assert all(set(edge) <= set(faces[face]) for face in pair if face >= 0)


def test_colours_come_from_faces_and_grey_stands_for_none():
    plain = trimesh.creation.box((1, 1, 1))
    red = painted(plain, np.array([255, 51, 0, 255], dtype=np.uint8))
    colours = scene_of(world_of(plain=plain, red=red)).surface.face_colour
    torch.testing.assert_close(colours[12:], torch.tensor([1.0, 0.2, 0.0]).double().expand(12, 3))
    assert (colours[:12] == colours[0, 0]).all()


def test_dtype_and_shapes_of_an_index_are_those_asked_for():
    world = world_of(box=trimesh.creation.box((1, 1, 1)))
    surface = build_scene(world, None, dtype=torch.float32, device=CPU).surface
    assert surface.vertices.dtype == surface.face_colour.dtype == torch.float32
    assert surface.faces.dtype == surface.edges.dtype == torch.int64


def test_poses_of_objects_are_the_worlds_and_of_links_the_kinematics():
    world, robot = world_of(box=trimesh.creation.box((1, 1, 1))), load_robot(ROVER)
    scene = scene_of(world, robot)
    Ts_world_base = se3.exp(torch.linspace(-1, 1, 12, dtype=torch.float64).reshape(2, 6))
    joints = torch.linspace(0, 0.3, 15, dtype=torch.float64).reshape(3, 1, 5)
    poses = body_poses(scene, world, robot, Ts_world_base, joints)
    assert poses.shape == (3, 2, len(scene.bodies), 4, 4)
    torch.testing.assert_close(poses[2, 1, 0], world.objects[0].T_world_object)
    T_base_links = robot.forward_kinematics(joints[2, 0])
    expected = Ts_world_base[1] @ T_base_links[robot.link_index("tilt_link")]
    torch.testing.assert_close(poses[2, 1, scene.body_index("robot/tilt_link")], expected)


def test_poses_without_a_robot_take_the_batch_of_the_base():
    world = world_of(a=trimesh.creation.box((1, 1, 1)), b=trimesh.creation.box((1, 1, 1)))
    base = torch.eye(4).expand(5, 4, 4)
    poses = body_poses(scene_of(world), world, None, base, None)
    assert poses.shape == (5, 2, 4, 4)
    assert poses.dtype == torch.float32


def test_a_robot_without_joints_is_an_error_that_names_them():
    robot = load_robot(ROVER)
    with pytest.raises(ValueError, match="expected values of front_left_wheel"):
        body_poses(scene_of(robot=robot), None, robot, torch.eye(4).double(), None)


def test_sixty_thousand_faces_of_soup_take_under_a_second():
    ball = trimesh.creation.icosphere(subdivisions=6)
    mesh = soup(trimesh.Trimesh(ball.vertices, ball.faces[:60_000], process=False))
    start = time.perf_counter()
    scene_of(world_of(ball=mesh))
    assert time.perf_counter() - start < 1.0
