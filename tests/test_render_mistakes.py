"""What cannot be rendered is named before anything is rendered."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scenes import CAMERA, at_rest, box, sensor_of, surface_of, wall
from torch import Tensor

from torchcal.errors import TorchcalError
from torchcal.model.scene import Surface, build_scene
from torchcal.model.world import World, WorldObject
from torchcal.render.mistakes import check_views
from torchcal.render.synthesis import synthesise

SURFACE = surface_of(wall(5.0), box((1.0, 1.0, 1.0), (0.0, 0.0, 2.5)))
POSES = at_rest(SURFACE)
SENSOR = sensor_of(CAMERA)
MOTION = torch.zeros(2, 6, 3, dtype=torch.float64)


def pose_with(R: Tensor) -> Tensor:
    poses = POSES.clone()
    poses[1, :3, :3] = R
    return poses


def world_of(mesh: trimesh.Trimesh) -> World:
    pose = torch.eye(4, dtype=torch.float64)
    crate = WorldObject(name="crate", mesh=mesh, T_world_object=pose)
    return World(objects=(crate,))


def test_a_sound_view_is_no_mistake():
    check_views(SURFACE, POSES, SENSOR, MOTION)
    check_views(SURFACE, POSES.expand(3, 0, 2, 4, 4), SENSOR, None)


@pytest.mark.parametrize("beam", [-1, 2, 20])
def test_a_beam_has_a_middle_pixel(beam: int):
    with pytest.raises(TorchcalError, match=f"beam of {beam} pixels; expected 0, 1 or an odd"):
        synthesise(SURFACE, POSES, replace(SENSOR, beam=beam))


def test_limits_are_in_order():
    with pytest.raises(TorchcalError, match=r"3\.0 to 1\.0 m; expected 0 <= near < far"):
        synthesise(SURFACE, POSES, replace(SENSOR, near=3.0, far=1.0))


def test_a_mesh_has_faces_and_finite_vertices():
    empty = replace(SURFACE, faces=SURFACE.faces[:0], face_colour=SURFACE.face_colour[:0])
    with pytest.raises(TorchcalError, match="without faces"):
        synthesise(empty, POSES, SENSOR)
    vertices = SURFACE.vertices.clone()
    vertices[5, 1] = torch.nan
    with pytest.raises(TorchcalError, match=r"vertex 5 at .*nan"):
        synthesise(replace(SURFACE, vertices=vertices), POSES, SENSOR)


@pytest.mark.parametrize("wrong", [-2, len(SURFACE.vertices)])
def test_faces_and_edges_have_vertices_that_are_there(wrong: int):
    for name in ("faces", "edges"):
        index = getattr(SURFACE, name).clone()
        index[3, 1] = wrong
        with pytest.raises(TorchcalError, match=f"with vertex {wrong}; expected 0 to"):
            synthesise(replace(SURFACE, **{name: index}), POSES, SENSOR)


@pytest.mark.parametrize(
    "R",
    [
        2.0 * torch.eye(3),
        torch.diag(torch.tensor([1.0, 1.0, -1.0])),
        torch.tensor([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        torch.zeros(3, 3),
    ],
    ids=["scaled", "mirrored", "sheared", "zero"],
)
def test_a_pose_is_a_rotation_and_a_translation(R: Tensor):
    with pytest.raises(TorchcalError, match="expected a rotation and a translation"):
        synthesise(SURFACE, pose_with(R.double()), SENSOR)


def test_the_last_row_of_a_pose_is_that_of_a_pose():
    poses = POSES.clone()
    poses[0, 3, 0] = 1.0
    with pytest.raises(TorchcalError, match="expected a rotation"):
        synthesise(SURFACE, poses, SENSOR)


def test_a_pose_in_single_precision_is_a_rotation(rng: torch.Generator):
    Q, _ = torch.linalg.qr(torch.randn(3, 3, generator=rng, dtype=torch.float32))
    Q = Q * torch.linalg.det(Q)
    check_views(SURFACE, pose_with(Q.double()).float(), SENSOR, None)


def test_there_is_one_pose_for_each_body():
    with pytest.raises(TorchcalError, match=r"poses \(1, 4, 4\); expected \(\*batch, 2, 4, 4\)"):
        check_views(SURFACE, POSES[:1], SENSOR, None)
    with pytest.raises(TorchcalError, match=r"poses \(4, 4\)"):
        check_views(SURFACE, POSES[0], SENSOR, None)
    with pytest.raises(TorchcalError, match=r"poses of torch\.int64"):
        check_views(SURFACE, POSES.long(), SENSOR, None)


def test_a_motion_fits_the_poses():
    for wrong in (MOTION[:1], MOTION[:, :5], MOTION.expand(4, 2, 6, 3)):
        with pytest.raises(TorchcalError, match=r"expected \(2, 6, parameter\)"):
            check_views(SURFACE, POSES, SENSOR, wrong)
    with pytest.raises(TorchcalError, match=r"motion of torch\.float32 .* expected torch\.float64"):
        check_views(SURFACE, POSES, SENSOR, MOTION.float())


def unchecked(surface: Surface, **tables: Tensor) -> Surface:
    """As from a caller whose annotations nobody checks."""
    copy = replace(surface)
    for name, table in tables.items():
        object.__setattr__(copy, name, table)
    return copy


def test_tables_have_the_shapes_of_a_mesh():
    with pytest.raises(TorchcalError, match=r"\(face, 3\)"):
        check_views(unchecked(SURFACE, faces=SURFACE.faces[:, :2]), POSES, SENSOR, None)
    body = SURFACE.vertex_body[1:]
    with pytest.raises(TorchcalError, match="bodies of"):
        check_views(unchecked(SURFACE, vertex_body=body), POSES, SENSOR, None)
    with pytest.raises(TorchcalError, match="floating-point"):
        check_views(unchecked(SURFACE, vertices=SURFACE.vertices.long()), POSES, SENSOR, None)


@pytest.mark.parametrize("wrong", ["nan", "index", "nothing"])
def test_a_scene_names_the_body_whose_mesh_is_wrong(wrong: str):
    mesh = trimesh.creation.box((1.0, 1.0, 1.0))
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    expected = {"nan": "not finite", "index": "vertex 99", "nothing": "no faces"}[wrong]
    if wrong == "nan":
        vertices[3, 0] = np.nan
    elif wrong == "index":
        faces[2, 1] = 99
    else:
        faces = faces[:0]
    broken = trimesh.Trimesh(vertices, faces, process=False)
    with pytest.raises(TorchcalError, match=f"crate: found .*{expected}"):
        build_scene(world_of(broken), None, dtype=torch.float64, device=torch.device("cpu"))
