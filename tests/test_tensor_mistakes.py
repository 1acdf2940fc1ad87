"""Tensors of a wrong shape or kind: each is found where it is handed over, and named."""

from collections.abc import Iterator
from dataclasses import replace

import jaxtyping
import pytest
import recordings
import scenes
import torch
from torch import Tensor

from torchcal import Site, Tracker, calibrate, check, localise_pixels, predict
from torchcal.errors import TorchcalError
from torchcal.match.prior_gate import Prior
from torchcal.model.job import Frame, Job, PosePrior
from torchcal.model.range_image import RangeImage
from torchcal.model.world import WorldObject


@pytest.fixture(autouse=True)
def as_for_a_user() -> Iterator[None]:
    """Without the checks of annotations, which only the tests have."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


EYE = torch.eye(4, dtype=torch.float64)


def image(ranges: object, usable: object = None) -> RangeImage:
    allowed = torch.ones(3, 4, dtype=torch.bool) if usable is None else usable
    return RangeImage(name="a", file="a.npy", range=ranges, usable=allowed)  # pyright: ignore


@pytest.mark.parametrize(
    ("ranges", "usable", "words"),
    [
        (torch.ones(1, 3, 4), None, r"range: found float32 of shape \(1, 3, 4\).*shape \(h, w\)"),
        (torch.ones(3, 4, dtype=torch.int16), None, "range: found int16 .* a tensor of floats"),
        ([[1.0, 2.0]], None, "range: found a list; expected a tensor of floats"),
        (torch.ones(4, 3), None, r"usable: found bool of shape \(3, 4\); .* shape \(4, 3\)"),
        (torch.ones(3, 4), torch.ones(3, 4), "usable: found float32 .* a tensor of booleans"),
    ],
)
def test_an_image_is_a_matrix_of_ranges(ranges: object, usable: object, words: str):
    with pytest.raises(TorchcalError, match=f"RangeImage.{words}"):
        image(ranges, usable)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"T_world_sensor": torch.eye(3)}, r"T_world_sensor: found .*\(3, 3\); .*\(4, 4\)"),
        ({"T_world_sensor": EYE.int()}, "T_world_sensor: found int32"),
        ({"joints": torch.ones(1, 2)}, r"joints: found .*\(1, 2\); expected .*\(joint\)"),
        ({"joints": [0.1, 0.2]}, "joints: found a list"),
    ],
)
def test_a_frame_has_joints_and_a_pose(more: dict, words: str):
    with pytest.raises(TorchcalError, match=f"Frame.{words}"):
        Frame(image=image(torch.ones(3, 4)), **{"joints": None, "T_world_sensor": None, **more})


def test_a_prior_has_six_sigmas_and_an_object_a_pose():
    with pytest.raises(TorchcalError, match=r"PosePrior.sigma: .*\(3\); expected .*\(6\)"):
        PosePrior(sigma=torch.ones(3))
    with pytest.raises(TorchcalError, match=r"WorldObject.T_world_object: found .*\(7\)"):
        WorldObject(
            name="a",
            mesh=scenes.box((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)),
            T_world_object=torch.ones(7),
        )


def test_the_frames_of_a_job_fit_its_sensor(hand_job: Job):
    frame = replace(hand_job.frames[1], image=image(torch.ones(3, 4)))
    with pytest.raises(TorchcalError, match=r"frames\[1\].image.range: found .*\(3, 4\); .*\("):
        replace(hand_job, frames=(hand_job.frames[0], frame))


@pytest.mark.parametrize("joints", [torch.zeros(1), torch.zeros(7), None])
def test_the_frames_of_a_job_fit_its_robot(robot_job: Job, joints: Tensor | None):
    frame = replace(robot_job.frames[0], joints=joints)
    with pytest.raises(TorchcalError, match=r"Job.frames\[0\].joints: found .* of shape \(\d\)$"):
        replace(robot_job, frames=(frame,))


@pytest.mark.parametrize("name", ["T_world_base", "T_link_sensor"])
def test_the_poses_of_a_job_are_matrices(hand_job: Job, name: str):
    with pytest.raises(TorchcalError, match=rf"Job.{name}: found float64 of shape \(3, 4\)"):
        replace(hand_job, **{name: EYE[:3]})


def test_a_job_without_frames_or_poses_cannot_be_compared(hand_job: Job):
    nowhere = replace(hand_job, frames=(replace(hand_job.frames[0], T_world_sensor=None),))
    for job, words in (
        (replace(hand_job, frames=()), "found no frames; expected at least one"),
        (nowhere, r"frames\[0\]: found neither a robot nor a T_world_sensor"),
    ):
        with pytest.raises(TorchcalError, match=words):
            calibrate(job, generator=torch.Generator())
        for use in (check, predict):
            with pytest.raises(TorchcalError, match=words):
                use(job)


def test_a_tracker_begins_without_frames(hand_job: Job):
    job = replace(hand_job, frames=(), base=recordings.prior())
    assert Tracker.of(job, generator=torch.Generator()).parameters.names


def test_the_image_of_a_localisation_is_that_of_its_sensor():
    sensor = recordings.sensor()
    surface = scenes.surface_of(*recordings.room().values())
    site = Site.of(surface, scenes.at_rest(surface), torch.Generator())
    start = Prior(T_world_sensor=EYE, covariance=0.01 * torch.eye(6, dtype=torch.float64))
    with pytest.raises(TorchcalError, match=r"range_image: found .*\(48, 63\); .*\(48, 64\)"):
        localise_pixels(torch.ones(48, 63), site, sensor, start=start, generator=torch.Generator())
