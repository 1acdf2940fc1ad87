"""What of the images' information can be relied on, and how many pixels it is worth."""

from dataclasses import replace

import recordings
import torch
import trimesh
from recordings import EYE, twist

from torchcal.calibrate.compare import Belief
from torchcal.calibrate.estimate import worth_words
from torchcal.calibrate.observation import observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.refine import Refined, fine_fit
from torchcal.calibrate.reliability import reliability
from torchcal.model.job import Job
from torchcal.model.sensor import Drift

NEARBY = twist(0.004, -0.003, 0.002, 0.002, -0.002, 0.001)


def refined(job: Job) -> Refined:
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    return fine_fit(observe(job), scene.surface, parameters, parameters.nominal, factor=1)


def standing_tube(strips: int) -> trimesh.Trimesh:
    """About an axis along y, 2 m before the sensor; both ends are out of view."""
    ring = trimesh.creation.cylinder(0.5, 8.0, sections=strips)
    ring.apply_transform(trimesh.transformations.rotation_matrix(torch.pi / 2, (1, 0, 0)))
    ring.apply_translation((0.0, 0.0, 2.0))
    return ring


def tube_job(sigma: float) -> Job:
    """A round tube, whose model has 36 flat strips and may have turned and moved."""
    sensor = recordings.sensor(sigma=sigma)
    real = {"tube": standing_tube(3600)}
    job = recordings.hand_held(sensor, [EYE], error=torch.zeros(6).double(), real=real)
    world = recordings.world_of({"tube": standing_tube(36)})
    return replace(job, world=world, base=None, objects={"tube": recordings.prior()})


def test_the_flat_strips_of_a_round_thing_do_not_tell_its_turn():
    found = refined(tube_job(0.002))
    names, prior = found.fit.parameters.names, found.fit.parameters.prior_sigma
    turn = names.index("objects.tube.ry")
    # By their own word the slopes of the strips tell the turn to a small part of the prior ...
    information = found.solution.equations.information[0]
    assert float(information.inverse()[turn, turn].sqrt()) < 0.05 * float(prior[turn])
    # ... and nothing of it is true.
    P = reliability(found).covariance
    assert float(P[turn, turn].sqrt()) > 0.9 * float(prior[turn])
    for name in ("objects.tube.x", "objects.tube.z", "objects.tube.rz"):
        place = names.index(name)
        assert float(P[place, place].sqrt()) < 0.1 * float(prior[place])


def test_pixels_with_errors_of_their_own_are_independent():
    job = recordings.hand_held(recordings.sensor(sigma=0.01), [EYE], error=NEARBY)
    told = reliability(refined(job))
    # Those that edges cross are left out.
    assert 0.6 * 48 * 64 < told.used_pixels <= 48 * 64
    # The biweight's weights of what is no outlier are 0.85 on average.
    assert 0.6 * told.used_pixels < told.independent_pixels <= told.used_pixels


def test_an_error_that_neighbours_share_leaves_few_independent_pixels():
    drift = Drift(sigma=0.01, pixels=6.0)
    job = recordings.hand_held(recordings.sensor(sigma=0.01, drift=drift), [EYE], error=NEARBY)
    told = reliability(refined(job))
    # Half of the variance is alike over some 2 pi 6^2 pixels, about 200 of 3072.
    assert 10 < told.independent_pixels < 0.3 * told.used_pixels


def test_words_say_what_the_pixels_are_worth():
    def words(independent: float) -> str:
        eye = torch.eye(4)[None]
        belief = Belief(
            state=eye,
            covariance=eye[0],
            drift_sigma=0.0,
            drift_pixels=0.0,
            used_pixels=123_456,
            independent_pixels=independent,
        )
        return worth_words(belief)

    assert "the 123,456 that were used count as about 1,200 independent ones" in words(1234.5)
    assert "err independently" in words(120_000.0)
    assert words(0.0) == ""
