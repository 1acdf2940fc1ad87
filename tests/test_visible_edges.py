"""The edges that a sensor sees of boxes, known by hand."""

import math

import numpy as np
import trimesh

from torchcal.demo.feature_score import score_lines
from torchcal.demo.visible_edges import VisibleEdges, visible_edges
from torchcal.geometry.projection import Pinhole

OPTICS = Pinhole(width=200, height=200, fx=200.0, fy=200.0, cx=99.5, cy=99.5)
WALL = trimesh.creation.box((20.0, 20.0, 0.2)).apply_translation((0.0, 0.0, 5.1))
PANEL = trimesh.creation.box((1.0, 1.0, 0.1)).apply_translation((0.0, 0.0, 3.05))
COVER = trimesh.creation.box((0.4, 2.0, 0.1)).apply_translation((0.0, 0.0, 2.05))


def _edges(meshes: list[trimesh.Trimesh], jump: float = 0.3) -> VisibleEdges:
    return visible_edges(meshes, np.eye(4), OPTICS, dihedral=math.radians(20.0), jump=jump)


def test_panel_before_a_wall_shows_its_front_edges() -> None:
    edges = _edges([WALL, PANEL])
    strong = edges.strong > 60
    assert strong.sum() == 4
    assert np.abs(edges.ends[strong][..., 2] - 3.0).max() < 1e-6
    length = np.linalg.norm(edges.pixels[strong, 1] - edges.pixels[strong, 0], axis=1)
    assert np.abs(length - 200 / 3).max() < 3.0  # samples are a pixel apart


def test_small_jump_is_no_strong_edge() -> None:
    edges = _edges([WALL, PANEL], jump=2.5)
    assert not (edges.strong > 0).any()
    assert (edges.weak > 60).sum() == 4


def test_hidden_part_of_an_edge_is_left_out() -> None:
    edges = _edges([WALL, PANEL, COVER])
    level = np.abs(np.diff(edges.pixels[..., 1], axis=1))[:, 0] < 1.0
    panel = level & (np.abs(edges.ends[:, 0, 2] - 3.0) < 1e-6)
    hidden = 200 * 0.2 / 2.0  # half the cover's width in the image
    assert panel.sum() == 4
    assert (np.abs(edges.pixels[panel][..., 0] - 99.5).min(1) > hidden - 2.0).all()


def test_edge_is_found_once() -> None:
    edges = _edges([WALL, PANEL])
    line = edges.pixels[edges.strong > 60][0]
    score = score_lines(np.stack([line, line + 1.0, line + 20.0]), edges, longest=60.0)
    assert score.found.sum() == 1
    assert (score.edge >= 0).tolist() == [True, False, False]
