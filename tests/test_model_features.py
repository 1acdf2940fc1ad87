"""Elements of models whose planes, lines and vertexes are counted by hand."""

import math
import time

import numpy as np
import pytest
import torch
import trimesh
from scenes import at_rest, ball, box, sheet, surface_of

from torchcal.demo.machine_hall import machine_hall
from torchcal.geometry import se3
from torchcal.match.features import LineKind
from torchcal.match.model.features import ModelFeatures, find_model_features
from torchcal.match.model.tolerances import Tolerances
from torchcal.model.scene import body_poses, build_scene

RIGHT = math.pi / 2
EXACT = 1e-9  # closed forms of coordinates of a few metres


def near(actual: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(actual, expected, atol=EXACT, rtol=EXACT)


def found(*bodies: trimesh.Trimesh, tolerances: Tolerances | None = None) -> ModelFeatures:
    surface = surface_of(*bodies)
    return find_model_features(surface, at_rest(surface), tolerances)


def kinds(model: ModelFeatures) -> list[int]:
    """Convex, concave, jump."""
    return model.features.lines.kind.bincount(minlength=3).tolist()


def l_shape() -> trimesh.Trimesh:
    """A bar of 1 m with the section of an L, with ends in the planes x = 0 and x = 1."""
    section = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
    halves = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    front = np.column_stack([np.zeros(6), section])
    vertices = np.concatenate([front, front + np.array([1.0, 0.0, 0.0])])
    ends = [face[::-1] for face in halves] + [[i + 6 for i in face] for face in halves]
    sides = [
        side
        for i in range(6)
        for side in ([i, (i + 1) % 6, i + 6], [(i + 1) % 6, (i + 1) % 6 + 6, i + 6])
    ]
    mesh = trimesh.Trimesh(vertices, ends + sides, process=False)
    assert mesh.is_volume
    return mesh


@pytest.mark.parametrize("finer", [0, 2])
def test_a_box_has_six_planes_twelve_edges_and_eight_corners(finer: int):
    mesh = trimesh.creation.box((1.0, 2.0, 3.0))
    for _ in range(finer):
        mesh = mesh.subdivide()
    model = found(mesh)
    planes, lines, vertices = (
        model.features.planes,
        model.features.lines,
        model.features.vertices,
    )
    expected = torch.tensor([2.0, 2.0, 3.0, 3.0, 6.0, 6.0], dtype=torch.float64)
    near(planes.area.sort().values, expected)
    assert kinds(model) == [12, 0, 0]
    assert lines.is_end.all()
    lengths = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).repeat_interleave(4)
    near(lines.length.sort().values, lengths)
    near(lines.dihedral, torch.full_like(lines.dihedral, RIGHT))
    assert len(vertices.angles) == 8
    near(vertices.angles, torch.full_like(vertices.angles, RIGHT))
    corners = vertices.elements.point.abs().round(decimals=9)
    assert (corners == torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64)).all()


def test_normals_point_outwards_and_outlines_are_the_corners():
    planes = found(box((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))).features.planes
    outwards = (planes.elements.point * planes.elements.direction).sum(-1)
    assert (outwards > 0.4).all()
    for corners in planes.outline:
        size = corners.abs()
        assert len(corners) == 4
        assert (size == torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64)).all()
        sides = (corners - corners.roll(1, 0)).abs()
        assert ((sides > 0).sum(1) == 1).all()  # in order: never across the diagonal


def test_an_l_shape_has_one_concave_line():
    model = found(l_shape())
    assert len(model.features.planes.area) == 8
    assert kinds(model) == [17, 1, 0]
    concave = model.features.lines.kind == LineKind.CONCAVE
    ends = model.features.lines.ends[concave][0]
    assert (ends[:, 1:] == 1.0).all()
    assert ends[:, 0].sort().values.tolist() == [0.0, 1.0]
    ell = [corners for corners in model.features.planes.outline if len(corners) == 6]
    assert len(ell) == 2


def test_the_foot_of_a_box_on_the_floor_is_concave_and_hides_its_lower_edges():
    crate = box((1.0, 2.0, 3.0), (0.0, 0.0, 1.5), (0.0, 0.0, 0.3))
    floor = box((10.0, 10.0, 0.2), (0.0, 0.0, -0.1))
    model = found(crate, floor)
    lines = model.features.lines
    assert kinds(model) == [8 + 12, 4, 0]
    foot = lines.kind == LineKind.CONCAVE
    near(lines.ends[foot][..., 2], torch.zeros(4, 2).double())
    assert lines.length[foot].sort().values.tolist() == pytest.approx([1.0, 1.0, 2.0, 2.0])
    assert model.line_body[foot].sort(1).values.tolist() == [[0, 1]] * 4
    assert lines.is_end[foot].all()
    assert len(model.features.vertices.angles) == 16


def test_what_stands_in_one_body_meets_as_well():
    """Two boxes of one body, the upper one a little inside the lower one."""
    upper, lower = box((1, 1, 1), (0, 0, 0.4)), box((3, 3, 1), (0, 0, -0.5))
    both = trimesh.util.concatenate([upper, lower])
    assert isinstance(both, trimesh.Trimesh)
    model = found(both)
    assert model.features.lines.kind.bincount(minlength=3)[LineKind.CONCAVE] == 4


def test_a_box_beside_a_wall_meets_it_only_where_they_touch():
    wall, crate = box((0.2, 4, 4), (-0.1, 0, 0)), box((1, 1, 1), (0.6, 0, 0))
    assert kinds(found(wall, crate)) == [24, 0, 0]


def test_two_stacked_boxes_with_flush_sides_show_no_line_between_flush_sides():
    lower, upper = box((1, 1, 1), (0, 0, 0.5)), box((1, 0.5, 1), (0, 0, 1.5))
    lines = found(lower, upper).features.lines
    concave = lines.ends[lines.kind == LineKind.CONCAVE]
    assert len(concave) == 2
    near(concave[..., 1].abs(), torch.full((2, 2), 0.25).double())


def test_facets_of_curved_surfaces_are_no_elements():
    assert len(found(ball(1.0, (0, 0, 0), 4)).features.planes.area) == 0
    pipe = found(trimesh.creation.cylinder(0.5, 2.0, sections=32))
    assert len(pipe.features.planes.area) == 2
    assert len(pipe.limbs.kind) == 32
    assert (pipe.limbs.kind == LineKind.JUMP).all()
    near(pipe.limbs.length, torch.full((32,), 2.0).double())


def test_a_rounded_box_keeps_its_flat_sides():
    corners = trimesh.creation.icosphere(subdivisions=3, radius=0.05).vertices
    centres = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    hull = trimesh.PointCloud((corners + centres[:, None]).reshape(-1, 3)).convex_hull
    planes = found(hull).features.planes
    assert int((planes.area > 0.9).sum()) == 6


def test_a_gentle_curve_of_many_facets_is_not_one_plane():
    arc = trimesh.creation.cylinder(0.5, 2.0, sections=360)
    assert len(found(arc).features.planes.area) == 2


def test_the_border_of_a_sheet_is_a_jump():
    model = found(sheet((0, 0, 1), (1, 0, 1), (1, 2, 1), (0, 2, 1)))
    assert kinds(model) == [0, 0, 4]
    assert model.features.lines.dihedral.isnan().all()
    assert (model.features.lines.planes == torch.tensor([0, -1])).all()


def test_noise_below_the_tolerances_changes_nothing():
    generator = np.random.default_rng(0)
    mesh = trimesh.creation.box((1.0, 2.0, 3.0)).subdivide().subdivide()
    mesh.vertices = mesh.vertices + 1e-4 * generator.standard_normal(mesh.vertices.shape)
    loose = Tolerances(distance=1e-3, angle=0.05, least_area=0.05, least_length=0.1)
    model = found(mesh, tolerances=loose)
    assert len(model.features.planes.area) == 6
    assert kinds(model) == [12, 0, 0]
    assert float((model.features.lines.dihedral - RIGHT).abs().max()) < 2e-3


def test_elements_stand_where_the_bodies_do():
    surface = surface_of(box((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)))
    T = se3.exp(torch.tensor([[1.0, -2.0, 0.5, 0.3, -0.2, 0.9]], dtype=torch.float64))
    own, placed = (find_model_features(surface, pose) for pose in (at_rest(surface), T))
    for name in ("planes", "lines", "vertices"):
        here, there = (getattr(each.features, name).elements for each in (own, placed))
        near(there.point, se3.transform(T[0], here.point))
        turned = here.direction @ T[0, :3, :3].mT
        near(there.direction, turned)


@pytest.mark.parametrize("wrong", [{"distance": 0.0}, {"angle": 0.5}, {"least_length": -1.0}])
def test_tolerances_that_make_no_sense_are_named(wrong: dict[str, float]):
    values = {"distance": 1e-3, "least_area": 0.01, "least_length": 0.1}
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Tolerances(**(values | wrong))


def test_the_machine_hall_is_taken_apart_in_less_than_a_second():
    world, eye = machine_hall(), torch.eye(4, dtype=torch.float64)
    scene = build_scene(world, None, dtype=torch.float64, device=torch.device("cpu"))
    poses = body_poses(scene, world, None, eye, None)
    began = time.process_time()
    model = find_model_features(scene.surface, poses)
    assert time.process_time() - began < 1.0
    lines, planes = model.features.lines, model.features.planes
    assert len(planes.area) < 600
    assert 300 < len(lines.kind) < 1000
    floor = planes.elements.point[:, 2].abs() < 1e-6
    room = (planes.area > 40.0) & floor & (planes.elements.direction[:, 2] > 0.99)
    assert int(room.sum()) == 1
