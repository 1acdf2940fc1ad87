"""The model as it is drawn: every decision shows, and every object says why."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from display_scene import MOVED, calibration, comparison, transaction_of_all_kinds
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from torchcal.calibrate.decisions import Transaction
from torchcal.calibrate.kept_result import kept
from torchcal.calibrate.result import Status, Verdict
from torchcal.display.view import words
from torchcal.display.view.objects import GONE, NEW, for_browser, shown_objects
from torchcal.display.view.settings import Settings, object_names, shoulder_look
from torchcal.geometry import se3
from torchcal.model.meshes import face_colours, painted


@pytest.fixture
def transaction() -> Transaction:
    return transaction_of_all_kinds()


def drawn(transaction: Transaction) -> list[tuple]:
    return [
        (item.name, item.paint, item.opacity < 1.0, float(item.T_world_object[0, 3]))
        for item in shown_objects(transaction)
    ]


def test_proposals_shine_through(transaction):
    x = float(MOVED[0, 3])
    assert drawn(transaction) == [
        ("wall", GONE, True, 0.0),
        ("wall", None, False, x),
        ("crate", GONE, True, 0.0),
        ("added-1", NEW, True, 0.0),
    ]


def test_what_is_adjusted_stands_there_once(transaction):
    verdicts = transaction.update.verdicts
    wall = replace(verdicts["wall"], verdict=Verdict.AGREES)
    update = replace(transaction.update, verdicts={**verdicts, "wall": wall})
    adjusted = Transaction.undecided("job.toml", transaction.world, update)
    assert [each for each in drawn(adjusted) if each[0] == "wall"] == [
        ("wall", None, False, float(MOVED[0, 3]))
    ]
    rejected = adjusted.decided(reject=["wall"])
    assert ("wall", None, False, 0.0) in drawn(rejected)


def test_accepted_changes_are_drawn_as_the_model(transaction):
    x = float(MOVED[0, 3])
    accepted = transaction.decided(accept=["all"])
    assert drawn(accepted) == [("wall", None, False, x), ("added-1", NEW, False, 0.0)]


def test_rejected_changes_leave_the_old_model(transaction):
    rejected = transaction.decided(reject=["all"])
    assert drawn(rejected) == [("wall", None, False, 0.0), ("crate", None, False, 0.0)]


def test_colours_of_the_screen_become_shares_of_light():
    """IEC 61966-2-1: the byte 188 of a screen is half of the light."""
    box = painted(trimesh.creation.box((1, 1, 1)), np.array([188, 0, 255, 255], np.uint8))
    assert abs(int(face_colours(for_browser(box))[0, 0]) - 128) <= 1
    assert face_colours(for_browser(box))[0, 1:].tolist() == [0, 255, 255]


def test_textured_meshes_are_left_alone():
    box = trimesh.creation.box((1, 1, 1))
    box.visual = TextureVisuals(uv=np.zeros((8, 2)), material=PBRMaterial())
    assert for_browser(box) is box


def test_every_object_says_what_the_images_say_of_it(transaction):
    assert "256 pixels see through it, 0 show it where" in words.object_words("crate", transaction)
    assert "What speaks for it is in 0001." in words.object_words("crate", transaction)
    assert "Decision: **proposed**" in words.object_words("crate", transaction)
    assert "90 pixels show it where it was found" in words.object_words("wall", transaction)
    added = words.object_words("added-1", transaction.decided(accept=["added-1"]))
    assert "What speaks for it is in 0001." in added
    assert "Decision: **accepted**" in added
    untouched = kept(calibration()).transaction
    assert "agrees. 900 pixels agree" in words.object_words("wall", untouched)
    assert "part of the robot" in words.object_words("robot/tool", untouched)


def test_names_are_no_markup(transaction):
    verdicts = {"a_b*<i>": transaction.update.verdicts["crate"]}
    update = replace(transaction.update, verdicts=verdicts)
    odd = Transaction.undecided("job.toml", None, update)
    assert r"**a\_b\*&lt;i&gt;**" in words.object_words("a_b*<i>", odd)
    assert r"| a\_b\*&lt;i&gt; |" in words.proposal_list(odd)


def test_the_list_has_every_proposal_with_its_decision(transaction):
    listed = words.proposal_list(transaction.decided(reject=["crate"]))
    assert "| crate | remove | **rejected** |" in listed
    assert "| added-1 | add | **proposed** |" in listed
    nothing = Transaction.undecided("", None, replace(transaction.update, verdicts={}, added=()))
    assert words.proposal_list(nothing) == "No change of the model is proposed."


def test_the_headline_says_whether_the_answer_can_be_used():
    assert "✔ The answer can be used" in words.headline(kept(calibration()))
    plain = calibration()
    nominal = replace(plain, estimate=replace(plain.estimate, estimated=False))
    assert words.headline(kept(nominal)) == "**All is well.**"
    doubtful = words.headline(kept(calibration(status=Status.AMBIGUOUS)))
    assert "✘ Not usable" in doubtful
    assert "&lt;z&gt;" in doubtful


def test_the_ellipsoids_size_is_told_and_whether_it_can_be_seen():
    place = kept(calibration()).frames[0]
    told = words.uncertainty_words(place)
    assert "± 6 × 3 × 0 mm" in told  # 3 sigma of 2, 1 and 0 mm
    assert "too small to see" in told
    large = replace(place, pose_covariance=100.0 * place.pose_covariance)
    assert "± 60 × 30 × 0 mm" in words.uncertainty_words(large)
    assert "too small" not in words.uncertainty_words(large)


def test_shares_of_the_legend_are_those_of_the_frame():
    frame = comparison()
    assert "5.5 %" in words.legend(frame)  # 168 of 3072 pixels are nearer
    assert "0.0 %" in words.legend(None)
    assert "within 3 σ′" in words.frame_words(frame, 3.0)


def test_proposals_come_first_and_one_is_chosen():
    result = kept(calibration())
    assert object_names(result) == ("crate", "added-1", "wall")
    assert Settings.of(result).selected == "crate"
    assert Settings.of(replace(result, alpha=99.0)).alpha == 20.0


def test_raw_shows_points_and_no_model_whatever_is_switched():
    settings = Settings(alpha=3.0, selected="", raw=True, model=True, measurement=False)
    assert (settings.shows_model, settings.shows_points) == (False, True)
    assert Settings(alpha=3.0, selected="", model=False).shows_model is False


def test_the_first_look_is_from_behind_the_sensor_at_what_it_sees():
    eye, target = shoulder_look(MOVED.numpy(), comparison())
    p_eye, p_target = (
        se3.transform(se3.inverse(MOVED), torch.from_numpy(p)[None])[0] for p in (eye, target)
    )
    assert p_eye[2] < 0.0  # behind
    assert p_eye[1] < 0.0  # above
    assert 1.0 < p_target[2] < 3.0  # the wall stands at 2 to 3 m
