"""Pixels for a new thing, against it, and those that are hidden from it."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh
from wall_comparison import BOX, DEPTH_CAMERA, SHAPE, comparison, scene

from torchcal.calibrate.evidence import borne_out, evidence_of
from torchcal.calibrate.result import AddedObject, Evidence
from torchcal.model.job import Job

EYE = torch.eye(4, dtype=torch.float64)
NOISE = 0.002  # m
FRONT = 58 * 58
"""Pixels of a box of 60 x 60 that lie inside its outline by more than the edge's own pixel."""


def job() -> Job:
    return Job(
        file=Path("job.toml"),
        world=None,
        robot=None,
        sensor=DEPTH_CAMERA,
        link=None,
        T_world_base=EYE,
        T_link_sensor=EYE,
        frames=(),
        base=None,
        mount=None,
    )


def front(supporting: int = 3600, name: str = "added_1") -> AddedObject:
    """The front of a box 2.7 m away that fills the pixels of ``BOX``."""
    rows, columns = BOX
    corners = [
        (2.7 * (u - 99.5) / 549.0, 2.7 * (v - 79.5) / 549.0, 2.7)
        for v in (rows.start - 0.5, rows.stop - 0.5)
        for u in (columns.start - 0.5, columns.stop - 0.5)
    ]
    mesh = trimesh.Trimesh(corners, [[0, 2, 1], [1, 2, 3]], process=False)
    evidence = Evidence(supporting=supporting, contradicting=0, hidden=0)
    return AddedObject(name=name, frames=("frame",), mesh=mesh, evidence=evidence)


def evidence(*measured, **kwargs) -> Evidence:
    frames = [comparison(each, scene(), NOISE, **kwargs) for each in measured]
    return evidence_of(front(), job(), frames, EYE.expand(len(frames), 4, 4))


def test_a_frame_that_shows_it_says_nothing_against_it():
    assert evidence(scene(2.7)) == Evidence(supporting=3600, contradicting=0, hidden=0)


def test_a_frame_that_sees_the_wall_behind_it_contradicts():
    found = evidence(scene(2.7), scene())
    assert found.contradicting == pytest.approx(FRONT, rel=0.01)
    assert found.hidden == 0


def test_what_stands_before_it_hides_it():
    found = evidence(scene(1.5))
    assert found.hidden == pytest.approx(FRONT, rel=0.01)
    assert found.contradicting == 0


def test_pixels_outside_the_mask_say_nothing():
    found = evidence(scene(), usable=torch.zeros(SHAPE, dtype=torch.bool))
    assert (found.contradicting, found.hidden) == (0, 0)


def test_what_more_pixels_see_through_than_show_is_not_proposed():
    frames = [comparison(scene(2.7), scene(), NOISE), comparison(scene(), scene(), NOISE)]
    Ts = EYE.expand(2, 4, 4)
    ghost, real = front(supporting=3000), front(supporting=3600, name="added_2")
    (kept,) = borne_out((ghost, real), job(), frames, Ts)
    assert kept == replace(real, name="added_1", evidence=kept.evidence)
    assert kept.evidence.contradicting == pytest.approx(FRONT, rel=0.01)
