"""The update: what is gone is removed, what is new is added, and nobody else is accused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from wall_comparison import (
    BOX,
    DEPTH_CAMERA,
    NOISY,
    SHAPE,
    comparison,
    drift,
    scene,
    white,
)

from torchcal.calibrate.result import (
    AddedObject,
    Change,
    Evidence,
    ObjectVerdict,
    Proposal,
    Update,
    Verdict,
)
from torchcal.calibrate.update import added_objects, frame_regions, object_verdicts
from torchcal.model.job import Frame, Job
from torchcal.model.range_image import RangeImage
from torchcal.model.scene import Body
from torchcal.model.world import World, WorldObject

EYE = torch.eye(4, dtype=torch.float64)
BODIES = (
    Body(name="wall", link=None),
    Body(name="crate", link=None),
    Body(name="robot/hand", link="hand"),
)
SEEDS = range(10)


def world(complete=False):
    crate = trimesh.creation.box(extents=(0.3, 0.3, 0.3))
    objects = [
        WorldObject(name=body.name, mesh=crate, T_world_object=EYE)
        for body in BODIES
        if body.link is None
    ]
    return World(objects=tuple(objects), complete=complete)


def job(sensor, surroundings):
    image = RangeImage(
        name="frame",
        file="frame.npy",
        range=torch.ones(SHAPE, dtype=torch.float64),
        usable=torch.ones(SHAPE, dtype=torch.bool),
    )
    return Job(
        file=Path("job.toml"),
        world=surroundings,
        robot=None,
        sensor=sensor,
        link=None,
        T_world_base=EYE,
        T_link_sensor=EYE,
        frames=(Frame(image=image, joints=None, T_world_sensor=EYE),),
        base=None,
        mount=None,
    )


def bodies(index=1, place=BOX):
    """The wall, and another body in the box's pixels."""
    body = torch.zeros(SHAPE, dtype=torch.long)
    body[place] = index
    return body


def noisy(measured, predicted, seed=0, **kwargs):
    return comparison(measured + white(seed), predicted, 0.05, **kwargs)


def proposed_of(recorded, *frames, scene_bodies=BODIES, correlation=0.0):
    """What single frames say, before anything that moved is looked for."""
    regions = frame_regions(recorded, frames, correlation_pixels=correlation)
    return Update(
        verdicts=object_verdicts(recorded, frames, regions, scene_bodies, {}),
        added=added_objects(recorded, frames, regions, EYE.expand(len(frames), 4, 4)),
    )


def update(*frames, sensor=NOISY, surroundings=None, correlation=0.0):
    surroundings = world() if surroundings is None else surroundings
    return proposed_of(job(sensor, surroundings), *frames, correlation=correlation)


def crate_model(beam=21):
    return scene(2.7, beam=beam)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_scene_as_modelled_is_left_alone(seed):
    proposed = update(noisy(crate_model(), crate_model(), seed, body=bodies()))
    assert [v.verdict for v in proposed.verdicts.values()] == ["agrees", "agrees"]
    assert proposed.added == ()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_crate_that_is_gone_is_removed_and_the_wall_is_not(seed):
    proposed = update(noisy(scene(), crate_model(), seed, body=bodies()))
    assert proposed.verdicts["crate"].verdict == "removed"
    assert proposed.verdicts["wall"].verdict == "agrees"
    assert proposed.verdicts["wall"].seen_through == 0
    assert proposed.added == ()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_new_crate_is_added_where_it_stands_and_hides_the_wall(seed):
    proposed = update(noisy(crate_model(), scene(), seed))
    (added,) = proposed.added
    assert added.name == "added_1"
    assert added.frames == ("frame",)
    assert added.mesh.bounds.mean(0)[:2] == pytest.approx([0.0, 0.0], abs=0.03)
    assert added.mesh.centroid[2] == pytest.approx(2.7, abs=0.02)
    assert added.mesh.extents[:2] == pytest.approx([0.29, 0.29], abs=0.04)
    assert proposed.verdicts["wall"].verdict == "agrees"
    assert proposed.verdicts["wall"].hidden > 2500


@pytest.mark.parametrize("seed", SEEDS)
def test_the_drift_of_a_depth_camera_changes_nothing(seed):
    measured = crate_model(beam=1) + drift(seed) + white(seed, 0.002)
    frame = comparison(measured, crate_model(beam=1), 0.0036, body=bodies())
    proposed = update(frame, sensor=DEPTH_CAMERA, correlation=30.0)
    assert [v.verdict for v in proposed.verdicts.values()] == ["agrees", "agrees"]
    assert proposed.added == ()


def test_a_crate_seen_through_by_less_than_half_agrees():
    model = scene(2.7)
    measured = model.copy()
    measured[50:74, 70:130] = 3.0
    frame = comparison(measured, model, 0.0036, body=bodies())
    proposed = update(frame, sensor=DEPTH_CAMERA, correlation=30.0)
    verdict = proposed.verdicts["crate"]
    assert verdict.verdict == "agrees"
    assert 0.3 < verdict.seen_through / (verdict.agree + verdict.seen_through) < 0.45


@pytest.mark.parametrize("reason", ["masked", "hidden", "not measured", "no frame shows it"])
def test_an_object_without_evidence_is_unseen_and_never_removed(reason):
    usable, body = torch.ones(SHAPE, dtype=torch.bool), bodies()
    measured = crate_model(beam=1)
    if reason == "masked":
        usable[BOX] = False
        measured[BOX] = 3.0
    elif reason == "hidden":
        measured[BOX] = 1.5
    elif reason == "not measured":
        measured[BOX] = np.nan
    else:
        body = torch.zeros_like(body)
    frame = comparison(measured, crate_model(beam=1), 0.0036, usable=usable, body=body)
    proposed = update(frame, sensor=DEPTH_CAMERA, correlation=30.0)
    assert proposed.verdicts["crate"].verdict == "unseen"


def test_the_pixels_that_a_beam_mixes_accuse_nobody():
    # 2 cm to the side, a fifth of the beam: every pixel that differs lies on a silhouette.
    shifted = np.roll(crate_model(), 4, axis=1)
    verdicts = update(noisy(shifted, crate_model(), body=bodies())).verdicts
    assert [v.verdict for v in verdicts.values()] == ["agrees", "agrees"]
    assert verdicts["crate"].seen_through < 0.1 * verdicts["crate"].agree
    assert verdicts["wall"].seen_through == 0


def test_links_of_the_robot_get_no_verdict():
    links = bodies(index=2)
    assert sorted(update(noisy(scene(), crate_model(), body=links)).verdicts) == ["crate", "wall"]


def test_two_frames_of_one_new_thing_make_one_object():
    first = noisy(crate_model(), scene(), seed=1, name="first")
    second = noisy(crate_model(), scene(), seed=2, name="second")
    (added,) = update(first, second).added
    assert added.frames == ("first", "second")


def test_the_same_images_give_the_same_update_and_stay_as_they_were():
    frame = noisy(crate_model(), scene())
    before = frame.measured.clone()
    one, other = update(frame), update(frame)
    assert one.verdicts == other.verdicts
    np.testing.assert_array_equal(one.added[0].mesh.vertices, other.added[0].mesh.vertices)
    torch.testing.assert_close(frame.measured, before)


def empty_right_half():
    model = scene()
    model[:, 100:] = np.nan
    return model


def added_widths(measured, model, surroundings):
    frame = comparison(measured, model, 0.0036)
    found = update(frame, sensor=DEPTH_CAMERA, surroundings=surroundings, correlation=30.0).added
    return [round(549 * float(a.mesh.extents[0]) / 2.7) for a in found]


def test_where_the_model_ends_only_the_part_before_the_model_is_added():
    # The box is 60 pixels wide, 30 of them before the wall: 29 steps from centre to centre.
    measured = scene(2.7)
    measured[:, 130:] = np.nan
    assert added_widths(measured, empty_right_half(), world()) == [29]


def test_a_complete_world_ends_in_empty_space_in_which_everything_is_new():
    measured = np.where(np.isnan(empty_right_half()), np.nan, scene())
    measured[BOX] = 2.7
    assert added_widths(measured, empty_right_half(), world(complete=True)) == [59]


def test_a_small_gap_of_the_model_that_a_new_thing_covers_is_part_of_it():
    model = scene()
    model[60:100, 110:125] = np.nan
    frame = comparison(scene(2.7), model, 0.0036)
    (added,) = update(frame, sensor=DEPTH_CAMERA, correlation=30.0).added
    assert 3550 < added.mesh.metadata["pixels"] <= 3600  # the half maximum rounds the corners


def test_what_stands_alone_in_a_gap_is_not_proposed_unless_the_world_is_complete():
    model = scene()
    model[BOX] = np.nan
    assert added_widths(scene(2.7), model, world()) == []
    assert added_widths(scene(2.7), model, world(complete=True)) == [59]


def test_without_a_world_there_are_no_verdicts_but_a_tool_before_the_robot_is_added():
    model = np.full(SHAPE, np.nan)
    model[30:130, 50:150] = 3.0
    measured = np.full(SHAPE, 4.0)
    measured[30:130, 50:150] = 3.0
    measured[BOX] = 2.7
    frame = comparison(measured, model, 0.0036, body=torch.full(SHAPE, 2))
    proposed = proposed_of(
        job(DEPTH_CAMERA, None), frame, scene_bodies=BODIES[2:], correlation=30.0
    )
    assert proposed.verdicts == {}
    assert len(proposed.added) == 1


def test_alpha_of_the_job_widens_what_counts_as_agreement():
    few = replace(job(NOISY, world()), alpha=3.0)
    strict = replace(few, alpha=60.0)
    frame = noisy(scene(2.9, beam=21), scene())
    assert len(proposed_of(few, frame).added) == 1
    assert proposed_of(strict, frame).added == ()


def test_added_objects_never_take_the_name_of_one_of_the_world():
    taken = (replace(BODIES[0], name="added_1"), *BODIES[1:])
    wall, *others = world().objects
    surroundings = World(objects=(replace(wall, name="added_1"), *others))
    frame = noisy(scene(2.9, beam=21), scene())
    proposed = proposed_of(job(NOISY, surroundings), frame, scene_bodies=taken)
    assert [item.name for item in proposed.added] == ["added_1-2"]


def test_proposals_are_the_changes_with_their_evidence():
    verdicts = {
        name: ObjectVerdict(verdict=verdict, agree=5, seen_through=90, hidden=3)
        for name, verdict in (
            ("wall", Verdict.AGREES),
            ("crate", Verdict.REMOVED),
            ("drum", Verdict.MOVED),
            ("far", Verdict.UNSEEN),
        )
    }
    verdicts["drum"] = replace(verdicts["drum"], frames=("b", "c"))
    evidence = Evidence(supporting=70, contradicting=1, hidden=2)
    through = Evidence(supporting=90, contradicting=5, hidden=3)
    shown = Evidence(supporting=5, contradicting=90, hidden=3)
    new = AddedObject(name="added_1", frames=("a",), mesh=trimesh.Trimesh(), evidence=evidence)
    assert Update(verdicts=verdicts, added=(new,)).proposals == (
        Proposal(name="crate", change=Change.REMOVE, evidence=through, frames=()),
        Proposal(name="drum", change=Change.MOVE, evidence=shown, frames=("b", "c")),
        Proposal(name="added_1", change=Change.ADD, evidence=evidence, frames=("a",)),
    )
