"""Matches against what an image of a crate truly shows."""

import math
from dataclasses import replace

import numpy as np
import torch
import trimesh
from scenes import at_rest, box, surface_of
from torch import Tensor

from torchcal.demo.machine_hall import looking
from torchcal.demo.match_score import Truth, right_matches
from torchcal.demo.range_trials import FIELD_OF_VIEW, range_sensor
from torchcal.geometry import se3
from torchcal.match.elements import Elements
from torchcal.match.features import Features
from torchcal.match.model.features import find_model_features

PROJECTION = range_sensor(256).projection
SURFACE = surface_of(box((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
MODEL = find_model_features(SURFACE, at_rest(SURFACE)).features
VIEW = looking(
    torch.tensor([2.0, -3.0, 1.5]).double(), torch.zeros(3).double(), torch.tensor(0.1).double()
)
TRUTH = Truth.of([trimesh.creation.box((1.0, 1.0, 1.0))], VIEW, PROJECTION)
FACING = (MODEL.planes.elements.direction * (VIEW[:3, 3] - MODEL.planes.elements.point)).sum(1) > 0


def moved(elements: Elements, T: Tensor) -> Elements:
    return replace(
        elements,
        point=se3.transform(T, elements.point),
        direction=elements.direction @ T[:3, :3].mT,
    )


def image_at(T_world_sensor: Tensor) -> Features:
    """All elements as a sensor elsewhere would have them."""
    T = se3.inverse(T_world_sensor)
    planes, lines, vertices = MODEL.planes, MODEL.lines, MODEL.vertices
    outline = tuple(se3.transform(T, corners) for corners in planes.outline)
    return Features(
        planes=replace(planes, elements=moved(planes.elements, T), outline=outline),
        lines=replace(
            lines,
            elements=moved(lines.elements, T),
            ends=se3.transform(T, lines.ends.flatten(0, 1)).view(-1, 2, 3),
        ),
        vertices=replace(vertices, elements=moved(vertices.elements, T)),
    )


def judged(model: Features, measured: Features) -> np.ndarray:
    """All pairs of one number."""
    number = torch.arange(6 + 12 + 8)
    return right_matches(model, measured, torch.stack([number, number], 1), TRUTH)


def test_what_is_seen_is_itself():
    right = judged(MODEL, image_at(VIEW))
    assert right[:6].tolist() == FACING.tolist()  # nothing is shown of the sides behind
    assert int(FACING.sum()) == 3
    assert right[6:].all()


def test_other_elements_are_not():
    planes, lines = FACING.nonzero()[:, 0], torch.arange(12)
    pairs = [
        torch.stack([planes.roll(1), planes], 1),
        6 + torch.stack([lines, lines.roll(1)], 1),
        18 + torch.stack([torch.arange(8), torch.arange(8).roll(1)], 1),
    ]
    assert not right_matches(MODEL, image_at(VIEW), torch.cat(pairs), TRUTH).any()


def test_a_plane_of_the_model_beside_what_is_shown_is_wrong():
    for offset, is_right in ((0.005, True), (0.04, False)):
        inward = MODEL.planes.elements.point - offset * MODEL.planes.elements.direction
        elements = replace(MODEL.planes.elements, point=inward)
        other = replace(MODEL, planes=replace(MODEL.planes, elements=elements))
        right = judged(other, image_at(VIEW))[:6]
        assert right[FACING.numpy()].tolist() == [is_right] * 3


def test_lines_and_vertexes_may_be_off_by_a_few_pixels():
    """A turn of one pixel's angle moves what is ahead by a pixel."""
    pixel = 2.0 * math.tan(0.5 * FIELD_OF_VIEW) / PROJECTION.width
    for pixels, is_right in ((3.0, True), (9.0, False)):
        turn = torch.tensor([0, 0, 0, pixels * pixel, pixels * pixel, 0], dtype=torch.float64)
        right = judged(MODEL, image_at(VIEW @ se3.exp(turn)))
        assert right[18:].tolist() == [is_right] * 8
        across = right[6:18]
        assert across.all() == is_right
