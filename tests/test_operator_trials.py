"""Trials of the operator's experiment: what is drawn is what the truth says."""

import numpy as np
import pytest
import torch

from torchcal.demo.operator_trials import (
    OFFSET,
    PUSH,
    box_overlap,
    depth_camera,
    draw_trial,
    paper_sensor,
)
from torchcal.geometry import se3

SMALL = depth_camera(32)
ALL = ("removed", "moved", "added")


def test_a_trial_follows_seed_and_number():
    first, again, later = (draw_trial(SMALL, 1, k, frames=2, changes=ALL) for k in (0, 0, 1))
    for one, other in zip(first.job.frames, again.job.frames, strict=True):
        torch.testing.assert_close(one.image.range, other.image.range, equal_nan=True)
    assert not torch.equal(first.Ts_world_sensor, later.Ts_world_sensor)


def test_the_job_is_off_by_as_much_as_its_prior_says():
    trial = draw_trial(SMALL, 0, 0, frames=2, changes=())
    nominal = trial.job.frames[0].T_world_sensor
    assert nominal is not None
    error = se3.log(se3.inverse(trial.Ts_world_sensor[0]) @ nominal)
    assert float(error[:3].norm()) == pytest.approx(OFFSET[0])
    assert float(error[3:].norm()) == pytest.approx(OFFSET[1])


def test_all_frames_are_off_alike():
    trial = draw_trial(SMALL, 0, 1, frames=3, changes=())
    errors = [
        frame.T_world_sensor @ se3.inverse(truth)
        for frame, truth in zip(trial.job.frames, trial.Ts_world_sensor, strict=True)
        if frame.T_world_sensor is not None
    ]
    torch.testing.assert_close(errors[1], errors[0])
    torch.testing.assert_close(errors[2], errors[0])


def test_what_was_pushed_stands_ten_centimetres_off_on_the_floor():
    trial = draw_trial(SMALL, 0, 2, frames=1, changes=ALL)
    world, T = trial.job.world, trial.changes.T_world_moved
    assert world is not None
    assert T is not None
    (old,) = (x.T_world_object for x in world.objects if x.name == trial.changes.moved)
    step = T[:3, 3] - old[:3, 3].numpy()
    assert np.linalg.norm(step) == pytest.approx(PUSH)
    assert step[2] == 0.0
    assert trial.changes.removed != trial.changes.moved


def test_what_was_seen_of_the_added_object_lies_on_it():
    trial = draw_trial(SMALL, 0, 3, frames=3, changes=("added",))
    added = trial.changes.added
    assert added is not None
    assert trial.changes.removed is None
    assert len(trial.seen_of_added) > 10
    low, high = added.bounds
    assert (trial.seen_of_added > low - 1e-6).all()
    assert (trial.seen_of_added < high + 1e-6).all()


def test_nothing_changes_that_is_not_asked_for():
    changes = draw_trial(SMALL, 0, 0, frames=1, changes=()).changes
    assert (changes.removed, changes.moved, changes.added) == (None, None, None)


@pytest.mark.parametrize(("side", "beam"), [(512, 21), (256, 11), (128, 5)])
def test_the_papers_beam_keeps_its_angle(side, beam):
    assert paper_sensor(side).beam == beam


def test_overlap_of_boxes_by_hand():
    unit = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert box_overlap(unit, unit) == 1.0
    assert box_overlap(unit, unit + np.array([0.5, 0.0, 0.0])) == pytest.approx(0.5 / 1.5)
    assert box_overlap(unit, unit + 2.0) == 0.0
