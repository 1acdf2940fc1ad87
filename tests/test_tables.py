"""What the terminal shows: as many digits as the sigmas deserve, and how to read the axes."""

import io
import re
from dataclasses import replace

import pytest
from display_scene import calibration
from PIL import Image
from rich.console import Console

from torchcal.calibrate.kept_result import kept
from torchcal.calibrate.result import Calibration, ObjectVerdict, Verdict
from torchcal.cli.tables import calibration_view
from torchcal.display.report import FramePictures, report
from torchcal.display.summary import OWN_AXES
from torchcal.display.view.words import object_words


def shown(found: Calibration) -> str:
    console = Console(width=200, file=io.StringIO())
    with console.capture() as capture:
        console.print(calibration_view(found))
    return capture.get()


def test_a_small_sigma_is_not_shown_as_none():
    found = calibration()
    sure = replace(found.estimate, pose_covariances=1e-6 * found.estimate.pose_covariances)
    text = shown(replace(found, estimate=sure))
    assert not re.search(r" 0\.0+ (mm|°)", text)
    assert re.search(r"\+9\.9980 mm │ +0\.0010 mm │", text)


def test_a_comparison_at_the_nominal_pose_is_not_called_an_answer():
    found = calibration()
    nominal = replace(found, estimate=replace(found.estimate, estimated=False))
    assert "The answer can be used" in shown(found)
    assert "answer" not in shown(nominal)
    assert "Compared at the nominal pose" in shown(nominal)


def test_a_small_addition_has_a_size():
    found = calibration()
    (added,) = found.update.added
    mesh = added.mesh.copy()
    mesh.apply_scale(0.01)
    update = replace(found.update, added=(replace(added, mesh=mesh),))
    assert "0.0020 × 0.0030 × 0.0040 m" in shown(replace(found, update=update))


def test_rows_of_a_pose_say_whose_axes_they_are_of():
    assert OWN_AXES in shown(calibration())


@pytest.mark.parametrize(("pixels", "words"), [(0, "unseen"), (10, "hardly seen")])
def test_what_was_seen_a_little_is_not_called_unseen(pixels, words):
    found = calibration()
    far = ObjectVerdict(verdict=Verdict.UNSEEN, agree=pixels, seen_through=0, hidden=5)
    found = replace(found, update=replace(found.update, verdicts={"far": far}))
    picture = Image.new("RGB", (8, 6))
    pictures = FramePictures(hybrid=picture, comparison=picture)
    assert re.search(rf"far +│ +{words} │ +{pixels} │", shown(found))
    assert f">{words}</td>" in report(found, {0: pictures, 1: pictures})
    assert f": {words}. {pixels} pixels agree" in object_words("far", kept(found).transaction)
