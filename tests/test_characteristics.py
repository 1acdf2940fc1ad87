"""Candidates between a model of boxes and what an image would hold of it."""

import time
from dataclasses import replace

import pytest
import torch
from scenes import at_rest, box, surface_of
from torch import Tensor

from torchcal.calibrate.element_pose import find_element_poses
from torchcal.geometry import se3
from torchcal.match.characteristics import JOINED_LENGTH, all_elements, candidate_pairs
from torchcal.match.elements import Elements, Kind
from torchcal.match.features import Features, LineKind, Lines, Planes, Vertices
from torchcal.match.model.features import find_model_features
from torchcal.match.prior_gate import Prior
from torchcal.match.wholes import whole_areas, whole_lengths

POSITION, DIRECTION = 0.01, 0.01  # standard deviations (m, rad) of what is measured
LENGTH, ANGLE, AREA = 0.02, 0.05, 0.05  # and of lengths (m), angles (rad) and areas (share)


def crate_on_floor() -> Features:
    surface = surface_of(
        box((1.0, 2.0, 3.0), (0.0, 0.0, 1.5), (0, 0, 0.3)), box((10, 10, 0.2), (0, 0, -0.1))
    )
    return find_model_features(surface, at_rest(surface)).features


def placed(elements: Elements, T: Tensor) -> Elements:
    """In another frame, with the noise of a measurement."""
    noise = torch.tensor([POSITION**2] * 3 + [DIRECTION**2] * 3, dtype=torch.float64)
    return Elements(
        kind=elements.kind,
        point=se3.transform(T, elements.point),
        direction=elements.direction @ T[:3, :3].mT,
        covariance=torch.diag(noise).expand(elements.count, 6, 6),
    )


def measured(model: Features, T_sensor_world: Tensor) -> Features:
    """Everything of the model, whole, as an image would hold it."""
    planes, lines, vertices = model.planes, model.lines, model.vertices
    return Features(
        planes=replace(
            planes,
            elements=placed(planes.elements, T_sensor_world),
            area_sigma=AREA * planes.area,
        ),
        lines=replace(
            lines,
            elements=placed(lines.elements, T_sensor_world),
            length_sigma=torch.full_like(lines.length, LENGTH),
            dihedral_sigma=torch.full_like(lines.length, ANGLE),
        ),
        vertices=replace(
            vertices,
            elements=placed(vertices.elements, T_sensor_world),
            angles_sigma=torch.full_like(vertices.angles, ANGLE),
        ),
    )


def pose(*twist: float) -> Tensor:
    return se3.exp(torch.tensor(twist, dtype=torch.float64))


def lines_of(candidates: Tensor, model: Features, image: Features) -> Tensor:
    """The block of C that compares lines."""
    first, other = len(model.planes.area), len(image.planes.area)
    return candidates[first : first + len(model.lines.kind)][
        :, other : other + len(image.lines.kind)
    ]


MODEL = crate_on_floor()
T_WORLD_SENSOR = pose(3.0, -2.0, 1.0, 0.4, -0.3, 0.8)
IMAGE = measured(MODEL, se3.inverse(T_WORLD_SENSOR))


def test_every_element_is_its_own_candidate_and_kinds_do_not_mix():
    found = candidate_pairs(MODEL, IMAGE)
    assert found.matrix.diagonal().all()
    kind = all_elements(MODEL).kind
    assert not (found.matrix & (kind[:, None] != kind)).any()
    assert torch.equal(found.matrix, found.log_likelihood.isfinite())


def is_no_longer(lengths: Tensor) -> Tensor:
    """Of the measured ones (columns), within five standard deviations and what the blur joins."""
    sigma = torch.hypot(torch.tensor(LENGTH), JOINED_LENGTH * lengths)
    return lengths - lengths[:, None] < 5.0 * sigma


def test_lengths_of_whole_lines_tell_them_apart():
    block = lines_of(candidate_pairs(MODEL, IMAGE).matrix, MODEL, IMAGE)
    lengths, kinds = MODEL.lines.length, MODEL.lines.kind
    no_shorter = lengths[:, None] - lengths < 5.0 * LENGTH
    same = kinds[:, None] == kinds
    assert torch.equal(block, no_shorter & is_no_longer(lengths) & same)
    assert not block[same].all()


def test_a_line_that_is_cut_may_be_part_of_any_longer_one():
    cut = replace(IMAGE, lines=replace(IMAGE.lines, is_end=torch.zeros_like(IMAGE.lines.is_end)))
    block = lines_of(candidate_pairs(MODEL, cut).matrix, MODEL, cut)
    lengths, kinds = MODEL.lines.length, MODEL.lines.kind
    assert torch.equal(block, is_no_longer(lengths) & (kinds[:, None] == kinds))


def test_the_ends_of_a_jump_say_nothing_of_its_length():
    """What stands before an edge cuts it short, and seems its end."""
    lines = MODEL.lines
    jumps = replace(
        MODEL, lines=replace(lines, kind=torch.full_like(lines.kind, LineKind.JUMP.value))
    )
    seen = measured(jumps, se3.inverse(T_WORLD_SENSOR))
    middle = seen.lines.ends.mean(1, keepdim=True)
    short = replace(seen.lines, ends=middle + 0.01 * (seen.lines.ends - middle))
    found = candidate_pairs(jumps, replace(seen, lines=short)).matrix
    assert lines_of(found, jumps, seen).all()


def test_a_convex_edge_may_be_seen_as_a_jump_and_a_concave_one_may_not():
    kind = torch.full_like(IMAGE.lines.kind, LineKind.JUMP.value)
    blind = torch.full_like(IMAGE.lines.dihedral, torch.nan)
    seen = replace(
        IMAGE,
        lines=replace(IMAGE.lines, kind=kind, dihedral=blind, dihedral_sigma=blind + torch.inf),
    )
    found = candidate_pairs(MODEL, seen)
    block = lines_of(found.matrix, MODEL, seen)
    convex = MODEL.lines.kind == LineKind.CONVEX
    assert torch.equal(block.diagonal(), convex)
    likely = lines_of(candidate_pairs(MODEL, IMAGE).log_likelihood, MODEL, IMAGE).diagonal()
    as_jump = lines_of(found.log_likelihood, MODEL, seen).diagonal()
    assert (likely[convex] > as_jump[convex]).all()


def test_a_dihedral_angle_beyond_gamma_is_no_candidate():
    for turn, is_candidate in ((4.0 * ANGLE, True), (6.0 * ANGLE, False)):
        image = replace(IMAGE, lines=replace(IMAGE.lines, dihedral=IMAGE.lines.dihedral + turn))
        block = lines_of(candidate_pairs(MODEL, image).matrix, MODEL, image)
        assert bool(block.any()) == is_candidate
    assert not lines_of(candidate_pairs(MODEL, IMAGE, gamma=1e-9).matrix, MODEL, IMAGE).all()


def test_the_part_of_a_plane_that_is_seen_is_no_larger_than_the_plane():
    planes = len(MODEL.planes.area)
    # The blur may join a neighbour: 0.5 are 2.2 standard deviations of 1.5, and 4 are 5.3 of 5.
    for share, are_all in ((0.1, True), (1.5, True), (5.0, False)):
        area = share * IMAGE.planes.area
        image = replace(IMAGE, planes=replace(IMAGE.planes, area=area))
        block = candidate_pairs(MODEL, image).matrix[:planes, :planes]
        assert bool(block.diagonal().any()) == are_all


def test_angles_of_vertexes_are_compared():
    turned = replace(
        IMAGE, vertices=replace(IMAGE.vertices, angles=IMAGE.vertices.angles - 6.0 * ANGLE)
    )
    corners = len(MODEL.vertices.angles)
    assert candidate_pairs(MODEL, IMAGE).matrix[-corners:, -corners:].all()
    assert not candidate_pairs(MODEL, turned).matrix[-corners:, -corners:].any()


def prior_of(twist: tuple[float, ...], position: float, rotation: float) -> Prior:
    variance = torch.tensor([position**2] * 3 + [rotation**2] * 3, dtype=torch.float64)
    return Prior(T_world_sensor=T_WORLD_SENSOR @ pose(*twist), covariance=torch.diag(variance))


def test_an_exact_start_leaves_each_element_alone():
    found = candidate_pairs(MODEL, IMAGE, prior=prior_of((0.0,) * 6, 1e-6, 1e-6))
    assert torch.equal(found.matrix, torch.eye(len(found.matrix), dtype=torch.bool))


def test_a_start_within_its_sigma_keeps_the_right_pairs_and_drops_most_others():
    twist = (0.06, -0.05, 0.06, 0.05, -0.05, 0.05)
    found = candidate_pairs(MODEL, IMAGE, prior=prior_of(twist, 0.1, 0.087))
    assert found.matrix.diagonal().all()
    free = candidate_pairs(MODEL, IMAGE).matrix
    assert not (found.matrix & ~free).any()
    assert float(found.matrix.sum()) < 0.6 * float(free.sum())


def test_a_start_that_is_off_by_many_sigmas_keeps_nothing():
    found = candidate_pairs(
        MODEL, IMAGE, prior=prior_of((0.0, 0.0, 0.0, 0.7, 0.7, 0.7), 0.01, 0.01)
    )
    assert not found.matrix.any()


def test_residuals_have_the_derivatives_of_the_prior(rng: torch.Generator):
    """Starts drawn from the prior: distances follow the chi distribution of the residuals."""
    inside = []
    for _ in range(60):
        twist = torch.randn(6, generator=rng, dtype=torch.float64) * 0.02
        found = candidate_pairs(
            MODEL, IMAGE, prior=prior_of(tuple(twist.tolist()), 0.02, 0.02), gamma=3.0
        )
        free = candidate_pairs(MODEL, IMAGE, gamma=3.0)
        inside.append((found.matrix & free.matrix).diagonal().double())
    share = torch.stack(inside).mean(0)
    kind = all_elements(MODEL).kind
    # chi below 3: 0.971 for three residuals, 0.939 for four; 60 draws deviate by 0.03.
    for each, expected in ((Kind.PLANE, 0.971), (Kind.LINE, 0.939), (Kind.POINT, 0.971)):
        assert float(share[kind == each].mean()) == pytest.approx(expected, abs=0.06)


def test_candidates_within_the_prior_lead_to_the_pose():
    prior = prior_of((0.06, -0.05, 0.06, 0.05, -0.05, 0.05), 0.1, 0.087)
    candidates = candidate_pairs(MODEL, IMAGE, prior=prior)
    found = find_element_poses(
        all_elements(MODEL),
        all_elements(IMAGE),
        candidates.matrix,
        generator=torch.Generator().manual_seed(0),
    )
    # The measured elements are exact here: what is left is rounding and the iterations' end.
    T_world_sensor = se3.inverse(found.T_measured_model)
    torch.testing.assert_close(T_world_sensor, T_WORLD_SENSOR, atol=1e-5, rtol=0.0)


def test_coplanar_planes_and_collinear_lines_count_together():
    surface = surface_of(box((1, 1, 1), (0, 0, 0)), box((1, 1, 1), (1, 0, 0)))
    features = find_model_features(surface, at_rest(surface)).features
    areas = whole_areas(features.planes)
    # Four sides go on in the other box; the ends do not, nor do the faces that touch.
    assert areas.sort().values.tolist() == pytest.approx([1.0] * 4 + [2.0] * 8)
    along = features.lines.elements.direction[:, 0].abs() > 0.9
    whole = whole_lengths(features.lines)
    assert whole[along].tolist() == pytest.approx([2.0] * 8)
    assert whole[~along].tolist() == pytest.approx([1.0] * int((~along).sum()))


def test_nothing_measured_gives_an_empty_matrix():
    none = torch.arange(0)
    empty = Features(
        planes=Planes(
            elements=placed(MODEL.planes.elements, torch.eye(4).double())[none],
            area=none.double(),
            area_sigma=none.double(),
            outline=(),
        ),
        lines=Lines(
            **{
                name: getattr(IMAGE.lines, name)[none]
                for name in ("ends", "is_end", "length_sigma", "kind", "dihedral")
            },
            elements=IMAGE.lines.elements[none],
            dihedral_sigma=none.double(),
            planes=IMAGE.lines.planes[none],
        ),
        vertices=Vertices(
            elements=IMAGE.vertices.elements[none],
            lines=IMAGE.vertices.lines[none],
            angles=IMAGE.vertices.angles[none],
            angles_sigma=IMAGE.vertices.angles_sigma[none],
        ),
    )
    for prior in (None, prior_of((0.0,) * 6, 0.1, 0.1)):
        assert candidate_pairs(MODEL, empty, prior=prior).matrix.shape[1] == 0
        assert candidate_pairs(empty, IMAGE, prior=prior).matrix.shape[0] == 0


def test_gamma_must_be_positive():
    with pytest.raises(ValueError, match="gamma"):
        candidate_pairs(MODEL, IMAGE, gamma=0.0)


def test_three_hundred_lines_are_compared_with_sixty_in_milliseconds():
    own, other = (torch.arange(count) % len(MODEL.lines.kind) for count in (300, 60))

    def lines(part: Lines, rows: Tensor) -> Lines:
        return Lines(
            elements=part.elements[rows],
            ends=part.ends[rows],
            is_end=part.is_end[rows],
            length_sigma=part.length_sigma[rows],
            kind=part.kind[rows],
            dihedral=part.dihedral[rows],
            dihedral_sigma=part.dihedral_sigma[rows],
            planes=part.planes[rows],
        )

    model = replace(MODEL, lines=lines(MODEL.lines, own))
    image = replace(IMAGE, lines=lines(IMAGE.lines, other))
    prior = prior_of((0.05,) * 6, 0.1, 0.087)
    candidate_pairs(model, image, prior=prior)
    began = time.process_time()
    candidate_pairs(model, image, prior=prior)
    assert time.process_time() - began < 0.5  # 0.02 s alone; type checks and others' load aside
