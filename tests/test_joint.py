"""Elements that are ambiguous alone, decided together: walls of a room, one with two faces."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.characteristics import Candidates
from torchcal.match.elements import Elements
from torchcal.match.features import Features, Lines, Planes, Vertices
from torchcal.match.joint import Joint, joint_hypotheses
from torchcal.match.prior_gate import Expectation, Prior, moved_to_sensor

APART = 0.08  # m: between the two faces of the back wall
SIGMA = 1e-3  # m and rad: of measured planes
START = (0.05, 0.02)  # m and rad: sigma of the starting value
NORMALS = torch.tensor([[0, 0, -1], [0, 0, -1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
POINTS = torch.tensor([[0, 0, 3], [0, 0, 3 + APART], [-2, 0, 2], [0, -1, 2]], dtype=torch.float64)


def features(points: Tensor, normals: Tensor, sigma: float) -> Features:
    none = points.new_zeros(0)
    index = torch.zeros(0, dtype=torch.long)
    noise = (torch.eye(6, dtype=torch.float64) * sigma**2).expand(len(points), 6, 6)
    square = torch.tensor([[-5.0, -5.0, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]]).double()
    return Features(
        planes=Planes(
            elements=Elements.planes(points, normals, noise),
            area=torch.full_like(points[:, 0], 100.0),
            area_sigma=torch.ones_like(points[:, 0]),
            outline=tuple(point + square for point in points),
        ),
        lines=Lines(
            elements=Elements.lines(none.view(0, 3), none.view(0, 3)),
            ends=none.view(0, 2, 3),
            is_end=index.view(0, 2).bool(),
            length_sigma=none,
            kind=index,
            dihedral=none,
            dihedral_sigma=none,
            planes=index.view(0, 2),
        ),
        vertices=Vertices(
            elements=Elements.points(none.view(0, 3)),
            lines=index.view(0, 3),
            angles=none.view(0, 3),
            angles_sigma=none.view(0, 3),
        ),
    )


MODEL = features(POINTS, NORMALS, 0.0)
# The sensor stands at the origin and sees the farther face of the back wall, and both others.
SEEN = [1, 2, 3]
IMAGE = features(POINTS[SEEN], NORMALS[SEEN], SIGMA)


def matched(
    twist: tuple[float, ...],
    image: Features,
    model: Features = MODEL,
    order: tuple[int, ...] = (0, 1, 2),
) -> Joint:
    """Of an image from the origin, about a start that is off by a twist."""
    sigmas = torch.tensor([START[0]] * 3 + [START[1]] * 3, dtype=torch.float64)
    start = Prior(
        T_world_sensor=se3.exp(torch.tensor(twist, dtype=torch.float64)),
        covariance=sigmas.square().diag(),
    )
    shape = len(model.planes.area), len(image.planes.area)
    return joint_hypotheses(
        Expectation.of(model, image),
        Candidates(
            matrix=torch.ones(shape, dtype=torch.bool),
            log_likelihood=torch.zeros(shape, dtype=torch.float64),
        ),
        start,
        torch.tensor(order),
        gamma=5.0,
    )


def test_three_walls_tell_the_pose():
    found = matched((0.02, -0.03, -0.01, 0.01, -0.02, 0.01), IMAGE)
    assert found.partner[0].tolist() == SEEN
    # Three planes at 1 mm and 1 mrad, with levers of 2 to 3 m; the linear update is off by less.
    assert float(se3.log(found.T_sensor_world[0]).abs().max()) < 4e-3


def test_both_faces_remain_hypotheses_when_nothing_decides_between_them():
    halfway = (0.0, 0.0, -0.5 * APART, 0.0, 0.0, 0.0)
    found = matched(halfway, IMAGE)
    assert {tuple(row) for row in found.partner[:2].tolist()} == {(0, 2, 3), (1, 2, 3)}
    torch.testing.assert_close(found.log_likelihood[0], found.log_likelihood[1], atol=0.5, rtol=0)
    # Two poses APART with half of the likelihood each: the second moment about either of them.
    along_z = found.spread()[2, 2]
    assert 0.3 * APART**2 < float(along_z) < 0.7 * APART**2


def test_an_element_that_contradicts_the_others_stays_alone():
    points = POINTS[SEEN].clone()
    points[2, 1] -= 1.0  # 20 sigmas of the start: no wall is there
    found = matched((0.01,) + (0.0,) * 5, features(points, NORMALS[SEEN], SIGMA))
    assert found.partner[0].tolist() == [1, 2, -1]


def test_what_is_nearer_alone_gives_way_to_what_all_say():
    """The start is nearer to the wrong face, but a tilted plane tells the depth."""
    tilted = torch.tensor([[0, math.sin(0.5), -math.cos(0.5)]], dtype=torch.float64)
    model = features(torch.cat([POINTS, POINTS[:1]]), torch.cat([NORMALS, tilted]), 0.0)
    image = features(
        torch.cat([POINTS[SEEN], POINTS[:1]]), torch.cat([NORMALS[SEEN], tilted]), SIGMA
    )
    off = (0.0, 0.0, -0.6 * APART, 0.0, 0.0, 0.0)
    alone = matched(off, image, model, (0,))
    together = matched(off, image, model, (0, 1, 2, 3))
    assert int(alone.partner[0, 0]) == 0
    assert together.partner[0].tolist() == [1, 2, 3, 4]


def test_turned_pairs_and_far_places_are_out_of_the_question():
    T, P = moved_to_sensor(
        Prior(T_world_sensor=torch.eye(4).double(), covariance=0.01 * torch.eye(6).double())
    )
    beside = replace(
        MODEL.planes, outline=tuple(0.01 * corners for corners in MODEL.planes.outline)
    )
    image = features(POINTS, NORMALS, SIGMA)
    at = [
        Expectation.of(model, image).at(
            T[None], P[None], torch.tensor([0, 0, 0]), torch.tensor([0, 1, 2])
        )
        for model in (MODEL, replace(MODEL, planes=beside))
    ]
    near, small = (found.match.distance[0].tolist() for found in at)
    assert near[0] < 1e-6
    assert near[1] < 1.0  # APART in sigmas of the start
    assert near[2] == torch.inf  # at right angles
    assert small[0] >= near[0]
