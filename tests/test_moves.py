"""Objects that were pushed are found where they stand; what is gone is found nowhere."""

from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import EYE, pose

from torchcal.calibrate.compare import Belief, compare_as_believed
from torchcal.calibrate.moves import Looked, find_moved, suspects
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.geometry.projection import Pinhole

CAMERA = Pinhole(width=96, height=72, fx=82.0, fy=82.0, cx=47.5, cy=35.5)
VIEWS = [EYE, pose(0.6, 0.1, 0.2, 0.02, -0.2, 0.0), pose(-0.5, -0.2, 0.1, 0.05, 0.15, 0.1)]


def moved(name: str, xyz: tuple[float, ...]) -> dict:
    room = recordings.room()
    return {**room, name: room[name].copy().apply_translation(xyz)}


def looked(real: dict, **changes) -> Looked:
    """The room as modelled against images of a real one from poses that are known."""
    sensor = recordings.sensor(CAMERA)
    error = torch.zeros(6, dtype=torch.float64)
    job = recordings.hand_held(sensor, VIEWS, error=error, real=real)
    job = replace(job, **changes)
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    belief = Belief(
        state=parameters.nominal,
        covariance=1e-8 * torch.eye(len(parameters.names), dtype=torch.float64),
        drift_sigma=0.0,
        drift_pixels=0.0,
    )
    comparisons = compare_as_believed(job, scene, parameters, belief)
    return Looked.of(job, scene, parameters, belief, comparisons)


def names(seen: Looked) -> list[str]:
    return [seen.scene.bodies[index].name for index in suspects(seen)]


@pytest.mark.parametrize(
    "xyz", [(0.1, 0.0, 0.0), (0.0, 0.0, -0.1), (0.0, 0.0, 0.1), (0.06, -0.08, 0.0)]
)
def test_a_crate_that_was_pushed_is_found_where_it_stands(rng, xyz):
    found = find_moved(looked(moved("crate", xyz)), rng)
    assert list(found) == ["crate"]
    # Thousands of pixels of 3 cm with 5 mm of noise: its sides are known to a millimetre or two.
    expected = torch.tensor(xyz, dtype=torch.float64)
    torch.testing.assert_close(found["crate"][:3, 3], expected, atol=3e-3, rtol=0)


def test_what_is_gone_is_found_nowhere(rng):
    real = recordings.room()
    del real["crate"]
    seen = looked(real)
    assert "crate" in names(seen)
    assert find_moved(seen, rng) == {}


def test_another_thing_in_its_place_is_not_the_crate(rng):
    real = recordings.room()
    real["crate"] = scenes.ball(0.4, (-0.6, 0.3, 2.2))
    assert find_moved(looked(real), rng) == {}


def test_nobody_is_suspected_in_a_room_as_modelled(rng):
    seen = looked(recordings.room())
    assert suspects(seen) == []
    assert find_moved(seen, rng) == {}


def test_objects_that_the_job_declares_unknown_are_left_to_the_estimate():
    real = moved("crate", (0.1, 0.0, 0.0))
    assert "crate" in names(looked(real))
    assert "crate" not in names(looked(real, objects={"crate": recordings.prior()}))
