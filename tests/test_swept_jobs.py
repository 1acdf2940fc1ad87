"""The benchmark's jobs hold what their truth says, and answers are judged as a person would."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchcal.demo import raycast
from torchcal.demo.drawn_rooms import corner, drawn_room, drawn_view, symmetric_room
from torchcal.demo.range_trials import meshes_in_world
from torchcal.demo.swept_jobs import SweptJob, Truth, swept_jobs, swept_sensor
from torchcal.demo.swept_score import (
    Answer,
    judged,
    read_answer,
    read_truth,
    score,
    truth_data,
)
from torchcal.demo.swept_settings import FACTORS, STANDARD, TIERS
from torchcal.errors import JobError
from torchcal.geometry import se3
from torchcal.model.read_job import read_job

SIDE = 24
SENSOR = swept_sensor(STANDARD, SIDE)


def swept(**changes) -> SweptJob:
    setting = replace(STANDARD, **changes)
    return SweptJob(
        name="job", factor="factor", level="level", setting=setting, side=SIDE, seed=(0, 1)
    )


def seen(meshes, T_world_sensor, sensor):
    scene = raycast.view(meshes, T_world_sensor.numpy())
    return raycast.predict(scene, sensor.projection, sensor.beam)


def moved(*twist: float) -> torch.Tensor:
    return se3.exp(torch.tensor(twist, dtype=torch.float64))


def truth(**changes) -> Truth:
    eye = torch.eye(4, dtype=torch.float64)[None]
    plain = Truth(factor="f", level="l", Ts_world_sensor=eye, symmetries=eye, observable=True)
    return replace(plain, **changes)


def answer(T, sigma=None, *, status="converged") -> Answer:
    return Answer(status=status, Ts_world_sensor=T[None], sigma=sigma)


def test_every_factor_is_swept_from_seeds_of_its_own():
    jobs = list(swept_jobs(TIERS["tiny"], 0))
    assert len(jobs) == sum(len(levels) for levels in FACTORS.values())
    assert len({job.name for job in jobs}) == len({job.seed for job in jobs}) == len(jobs)
    assert {job.factor for job in jobs} == set(FACTORS)
    assert len(FACTORS) >= 10
    for levels in FACTORS.values():
        for setting in levels.values():
            changed = [k for k in setting.__slots__ if getattr(setting, k) != getattr(STANDARD, k)]
            assert set(changed) <= {"folds", "start"} or len(changed) == 1


def test_a_job_shows_what_stands_there_from_where_the_truth_says(tmp_path):
    found = swept(sigma=0.001, beam=1).write(tmp_path / "job")
    job = read_job(tmp_path / "job" / "job.toml")
    assert job.world is not None
    image = seen(meshes_in_world(job.world), found.Ts_world_sensor[0], job.sensor)
    difference = job.frames[0].image.range.numpy() - image
    assert np.nanstd(difference) == pytest.approx(0.001, rel=0.15)
    nominal = job.frames[0].T_world_sensor
    assert nominal is not None
    offset = se3.log(se3.inverse(nominal) @ found.Ts_world_sensor[0])
    # A start 50 mm and 3 degrees off; a twist's translation is not quite the shift.
    assert float(offset[:3].norm()) == pytest.approx(0.05, rel=0.01)
    assert math.degrees(float(offset[3:].norm())) == pytest.approx(3.0)


def test_the_same_seed_is_the_same_job(tmp_path):
    for name in ("one", "other"):
        swept(outliers=0.1).write(tmp_path / name)
    one, other = (np.load(tmp_path / name / "0001.npy") for name in ("one", "other"))
    np.testing.assert_array_equal(one, other)


def test_missing_and_extra_objects_change_the_image_and_not_the_model(tmp_path):
    swept().write(tmp_path / "same")
    model = (tmp_path / "same" / "room.glb").read_bytes()
    for changes in ({"missing": 8}, {"extra": 8}):
        name = next(iter(changes))
        swept(**changes).write(tmp_path / name)
        assert (tmp_path / name / "room.glb").read_bytes() == model
        before, after = (np.load(tmp_path / each / "0001.npy") for each in ("same", name))
        assert (np.abs(before - after) > 0.1).mean() > 0.02


def test_outliers_and_dropouts_are_as_many_as_stated(tmp_path):
    swept().write(tmp_path / "clean")
    swept(dropouts=0.5).write(tmp_path / "lost")
    clean, lost = (np.load(tmp_path / name / "0001.npy") for name in ("clean", "lost"))
    assert np.isfinite(clean).all()
    assert np.isnan(lost).mean() == pytest.approx(0.5, abs=0.15)


def test_a_symmetric_room_looks_the_same_after_each_turn():
    rng = np.random.default_rng(0)
    for folds in (2, 4):
        room = symmetric_room(rng, folds)
        view = drawn_view(rng)
        meshes = meshes_in_world(room.world)
        images = [seen(meshes, T @ view, SENSOR) for T in room.symmetries]
        assert len(images) == folds
        for image in images[1:]:
            np.testing.assert_allclose(image, images[0], atol=1e-4)


def test_a_room_of_few_planes_has_no_more_and_shows_them():
    rng = np.random.default_rng(0)
    for planes in (1, 2, 3):
        room = corner(planes)
        assert len(room.world.objects) == planes
        image = seen(meshes_in_world(room.world), drawn_view(rng, heading=math.pi / 4), SENSOR)
        assert np.isfinite(image).mean() > 0.2
    assert len(drawn_room(rng).world.objects) == 14


@pytest.mark.parametrize("planes", [1, 2])
def test_no_image_of_few_planes_tells_how_far_along_them_it_was_taken(planes):
    meshes = meshes_in_world(corner(planes).world)
    here = drawn_view(np.random.default_rng(1), heading=math.pi / 4)
    there = here.clone()
    there[0, 3] += 0.3
    images = [seen(meshes, T, SENSOR) for T in (there, here)]
    one, other = (np.where(image <= SENSOR.far, image, np.nan) for image in images)
    np.testing.assert_allclose(one, other, atol=1e-5, equal_nan=True)


def test_an_arm_with_offset_joints_is_a_job_too(tmp_path):
    found = swept(joints_deg=1.0).write(tmp_path / "job")
    job = read_job(tmp_path / "job" / "job.toml")
    assert len(job.frames) == len(found.Ts_world_sensor) == 6
    assert set(job.joints.values()) == {math.radians(1.0)}


def test_right_is_near_and_usable():
    near, far = moved(0.005, 0, 0, 0, 0.005, 0), moved(0.02, 0, 0, 0, 0, 0)
    assert judged(answer(near), truth()).found
    assert not judged(answer(far), truth()).found
    assert not judged(answer(near, status="failed"), truth()).found
    assert not judged(None, truth()).found
    assert judged(answer(far), truth()).position == pytest.approx(0.02)


def test_where_nothing_can_be_told_saying_so_is_right():
    blind = truth(observable=False)
    anywhere = moved(1, 0, 0, 0, 0, 0)
    for status in ("unobservable", "ambiguous"):
        assert judged(answer(anywhere, status=status), blind).found
    assert not judged(answer(anywhere, status="failed"), blind).found
    assert not judged(None, blind).found
    assert not judged(answer(anywhere), blind).found


def test_a_symmetric_pose_is_as_right():
    half_turn = moved(0, 0, 0, 0, 0, math.pi)
    symmetric = truth(symmetries=torch.stack([torch.eye(4, dtype=torch.float64), half_turn]))
    assert judged(answer(half_turn), symmetric).found
    assert not judged(answer(half_turn), truth()).found


def test_wrong_and_sure_is_by_the_programs_own_sigmas():
    off = moved(0.02, 0, 0, 0, 0, 0)
    wide, narrow = (torch.full((1, 6), sigma, dtype=torch.float64) for sigma in (0.01, 0.001))
    assert not judged(answer(off, wide), truth()).deceived
    assert judged(answer(off, narrow), truth()).deceived
    assert judged(answer(off), truth()).deceived
    assert not judged(answer(off, narrow, status="failed"), truth()).deceived


def test_a_score_counts_and_takes_medians_of_usable_answers():
    answers = [answer(moved(x, 0, 0, 0, 0, 0)) for x in (0.001, 0.003, 0.5)]
    judgements = [judged(each, truth()) for each in answers]
    found = score([*judgements, judged(None, truth())])
    assert (found.jobs, found.found, found.deceived) == (4, 2, 1)
    assert found.position == pytest.approx(0.003)
    assert math.isnan(score([judged(None, truth())]).position)


def test_answers_and_truths_survive_their_files(tmp_path):
    file = tmp_path / "result.json"
    assert read_answer(file) is None
    frame = {"T_world_sensor": torch.eye(4).tolist(), "position_sigma_m": [1, 2, 3]}
    frame["rotation_sigma_rad"] = [4, 5, 6]
    file.write_text(json.dumps({"status": "converged", "frames": [frame]}))
    read = read_answer(file)
    assert read is not None
    assert read.usable
    assert_close(read.sigma, torch.tensor([[1, 2, 3, 4, 5, 6]], dtype=torch.float64))
    again = read_truth(file, json.loads(json.dumps(truth_data(truth()))))
    assert_close(again.symmetries, truth().symmetries)
    for broken in ("{", "[]", '{"status": "converged", "frames": [{}]}'):
        file.write_text(broken)
        with pytest.raises(JobError, match=r"result\.json: found .*; expected JSON with"):
            read_answer(file)
