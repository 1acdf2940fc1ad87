"""What a sensor sees of boxes: counted by hand, with faces from the independent ray caster."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scenes import at_rest, box, sheet, surface_of, turned, wall

from torchcal.demo import raycast
from torchcal.geometry.projection import Pinhole, Projection, Spherical, pixel_grid
from torchcal.match.features import LineKind
from torchcal.match.model.expected import expected_features
from torchcal.match.model.features import ModelFeatures, find_model_features
from torchcal.match.model.visibility import INVISIBLE, Seen, visible

CAMERA = Pinhole(width=200, height=160, fx=200.0, fy=200.0, cx=99.5, cy=79.5)
LIDAR = Spherical(width=200, height=160, azimuth=(-0.5, 0.5), elevation=(0.4, -0.4))
JUMP = 0.3
CORNER_ON = (math.atan(math.sqrt(0.5)), math.pi / 4, 0.0)  # a corner of the cube looks at us
STEP = 3.0  # pixels that the ends of a line may lack


def looked_at(
    *bodies: trimesh.Trimesh, projection: Projection = CAMERA, jump: float = JUMP
) -> tuple[ModelFeatures, Seen]:
    """From the origin along z."""
    surface = surface_of(*bodies)
    model = find_model_features(surface, at_rest(surface))
    grid = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    view = raycast.view(bodies, np.eye(4))
    _, face = raycast.cast(view, projection.rays(*grid).numpy())
    eye = torch.eye(4, dtype=torch.float64)
    return model, visible(model, eye, projection, torch.from_numpy(face), jump=jump)


def counted(seen: Seen) -> list[int]:
    """Lines seen as convex, concave, jump and not at all."""
    kinds = seen.lines.kind
    every = (LineKind.CONVEX, LineKind.CONCAVE, LineKind.JUMP, INVISIBLE)
    return [int((kinds == kind).sum()) for kind in every]


@pytest.mark.parametrize("projection", [CAMERA, LIDAR])
def test_of_a_cube_corner_on_three_creases_and_six_jumps_are_seen(projection: Projection):
    cube = turned(trimesh.creation.box((0.5, 0.5, 0.5)), (0.0, 0.0, 1.5), CORNER_ON)
    _, seen = looked_at(cube, wall(9.0, 5.0), projection=projection)
    assert counted(seen) == [3, 0, 6, 3 + 4]
    assert int((seen.plane_pixels > 0).sum()) == 3 + 1


def test_lengths_are_those_of_the_image():
    """A square of 1 m at 2 m, 200 pixels to a radian: 100 pixels."""
    _, seen = looked_at(sheet((-0.5, -0.3, 2), (0.5, -0.3, 2), (0.5, 0.3, 2), (-0.5, 0.3, 2)))
    expected = torch.tensor([60.0, 60.0, 100.0, 100.0], dtype=torch.float64)
    torch.testing.assert_close(seen.lines.pixels.sort().values, expected, atol=STEP, rtol=0.0)
    assert (seen.lines.kind == LineKind.JUMP).all()
    assert seen.lines.piece_is_end.all()


def test_the_seen_area_of_a_plane_is_its_own_where_nothing_hides_it():
    slanted = turned(
        sheet((-0.4, -0.3, 0), (0.4, -0.3, 0), (0.4, 0.3, 0), (-0.4, 0.3, 0)),
        (0.1, 0.0, 2.0),
        (0.5, 0.6, 0.2),
    )
    for projection in (CAMERA, LIDAR):
        model, seen = looked_at(slanted, projection=projection)
        # Pixels on the border count whole or not at all: a perimeter of 250 pixels of 5000.
        torch.testing.assert_close(seen.plane_area, model.features.planes.area, atol=0.0, rtol=0.02)


def test_a_crate_on_the_floor_shows_concave_lines_and_not_its_lower_edges():
    crate = box((0.5, 0.5, 0.5), (0.0, 0.25, 2.0), (0.0, math.pi / 4, 0.0))
    floor = box((4.0, 0.2, 4.0), (0.0, 0.6, 2.0))  # y is down
    tilted = [turned(body, (0, 0.3, 0), (0.5, 0, 0)) for body in (crate, floor)]
    _, seen = looked_at(*tilted, wall(20.0, 9.0))
    convex, concave, _, _ = counted(seen)
    assert concave == 2
    assert convex == 3  # the upright edge and two of the top


def test_a_step_lower_than_a_jump_is_not_seen():
    plate, low = box((0.6, 0.6, 0.1), (0.0, 0.0, 1.95)), box((3.0, 3.0, 0.1), (0.0, 0.0, 2.05))
    _, seen = looked_at(plate, low)
    assert int((seen.lines.kind == LineKind.JUMP).sum()) == 0
    _, seen = looked_at(plate, low, jump=0.05)
    assert int((seen.lines.kind == LineKind.JUMP).sum()) == 4


def test_a_pole_before_an_edge_parts_it_into_two_pieces():
    board = sheet((-0.6, -0.2, 2), (0.6, -0.2, 2), (0.6, 0.4, 2), (-0.6, 0.4, 2))
    pole = box((0.1, 3.0, 0.1), (0.0, 0.0, 1.0))
    model, seen = looked_at(board, pole, wall(9.0, 5.0))
    upper = (model.features.lines.ends[..., 1] == -0.2).all(1)
    upper = (upper & (model.features.lines.length > 1.0)).nonzero()[0, 0]
    mine = seen.lines.piece_line == upper
    assert int(mine.sum()) == 2
    # The pole hides 0.1 m at 0.95 m, 21 pixels of 120.
    shown = seen.lines.piece_pixels[mine].sum()
    torch.testing.assert_close(shown, seen.lines.pixels[upper])
    assert float(shown) == pytest.approx(120.0 - 0.1 / 0.95 * 200.0, abs=2 * STEP)
    assert seen.lines.piece_is_end[mine].sum(1).tolist() == [1, 1]


def test_what_is_behind_the_sensor_is_not_seen():
    behind = box((1.0, 1.0, 1.0), (0.0, 0.0, -3.0))
    around = box((2.0, 2.0, 8.0), (0.0, 0.0, 0.0))  # its long edges pass the sensor
    _, seen = looked_at(behind, turned(around, (0, 0, 0), (0, 0, 0)))
    assert (seen.lines.kind[:12] == INVISIBLE).all()
    assert seen.lines.pixels.isfinite().all()


def test_the_sides_of_a_pipe_are_seen_as_jumps():
    pipe = turned(trimesh.creation.cylinder(0.2, 3.0, sections=32), (0, 0, 2), (math.pi / 2, 0, 0))
    _, seen = looked_at(pipe, wall(5.0, 4.0))
    jumps = seen.limbs.kind == LineKind.JUMP
    assert int((seen.limbs.pixels > 100).sum()) == 2
    assert int(jumps.sum()) == 2


def test_expected_elements_keep_their_numbers():
    cube = turned(trimesh.creation.box((0.5, 0.5, 0.5)), (0.0, 0.0, 1.5), CORNER_ON)
    model, seen = looked_at(cube, wall(9.0, 5.0))
    expected = expected_features(model, seen, pixels=10.0)
    own = expected.features
    # Of the seven corners in view, three lack the line that is hidden.
    assert (len(own.planes.area), len(own.lines.kind), len(own.vertices.angles)) == (4, 9, 4)
    assert torch.equal(own.lines.ends, model.features.lines.ends[expected.lines])
    kept = own.vertices.lines
    assert torch.equal(expected.lines[kept], model.features.vertices.lines[expected.vertices])
    sides = own.lines.planes
    assert torch.equal((sides >= 0).sum(1).sort().values, torch.tensor([1] * 6 + [2] * 3))
    both = (sides >= 0).all(1)
    beside = expected.planes[sides[both]]
    assert torch.equal(beside, model.features.lines.planes[expected.lines[both]])


def test_single_precision_sees_the_same():
    cube = turned(trimesh.creation.box((0.5, 0.5, 0.5)), (0.0, 0.0, 1.5), CORNER_ON)
    double, single = (surface_of(cube, dtype=dtype) for dtype in (torch.float64, torch.float32))
    grid = pixel_grid(CAMERA, dtype=torch.float64, device=torch.device("cpu"))
    _, face = raycast.cast(raycast.view([cube], np.eye(4)), CAMERA.rays(*grid).numpy())
    seen = []
    for surface in (double, single):
        model = find_model_features(surface, at_rest(surface))
        eye = torch.eye(4, dtype=surface.vertices.dtype)
        seen.append(visible(model, eye, CAMERA, torch.from_numpy(face), jump=JUMP))
    assert seen[1].plane_area.dtype == torch.float32
    assert torch.equal(seen[0].lines.kind, seen[1].lines.kind)
    # A place at the end of a line may fall on either side.
    torch.testing.assert_close(
        seen[1].lines.pixels.double(), seen[0].lines.pixels, atol=STEP, rtol=0
    )
