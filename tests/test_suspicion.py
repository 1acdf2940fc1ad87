"""What looks wrong in a job that can be read is said in words, and nothing else is."""

from dataclasses import replace

import pytest
import recordings
import torch
from kinematic_jobs import POSTURES
from recordings import EYE, twist

from torchcal.calibrate.check import check
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene, calibrate
from torchcal.calibrate.readings import READINGS, misreadings
from torchcal.calibrate.suspicion import suspicions
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Job

SQUARE = Pinhole(width=48, height=48, fx=45.0, fy=45.0, cx=23.5, cy=23.5)
OFF = twist(0.02, -0.015, 0.01, 0.01, -0.015, 0.01)


def room_job() -> Job:
    return recordings.hand_held(recordings.sensor(SQUARE), [EYE], error=OFF)


def warnings_of(job: Job) -> tuple[str, ...]:
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    return misreadings(job, scene, parameters, parameters.nominal)


def reading(words: str, job: Job) -> Job:
    """What was measured, written down in this wrong way."""
    meant = next(each for each in READINGS if words in each.words).of(job)
    assert meant is not None
    return meant


def larger_world(job: Job, factor: float) -> Job:
    assert job.world is not None
    objects = tuple(
        replace(
            item,
            mesh=item.mesh.copy().apply_scale(factor),
            T_world_object=item.T_world_object * torch.tensor([[1, 1, 1, factor]]),
        )
        for item in job.world.objects
    )
    return replace(job, world=replace(job.world, objects=objects))


def test_a_good_job_is_not_suspected(robot_job):
    assert suspicions(room_job()) == ()
    assert warnings_of(room_job()) == ()
    # Its two images are the same, and that is said.
    (only,) = suspicions(robot_job)
    assert only == (
        "The images of the frames frame and frame are the same, pixel by pixel, and not the places "
        "where they were taken: were they mixed up?"
    )


def repeated(job: Job, count: int) -> Job:
    image = job.frames[0].image
    frames = [
        replace(job.frames[0], image=replace(image, name=f"f{k}")) for k in range(1, count + 1)
    ]
    return replace(job, frames=tuple(frames))


def test_images_that_are_the_same_are_one_warning_that_names_them():
    job = room_job()
    same = "are the same, pixel by pixel: only the first of them counts."
    assert suspicions(repeated(job, 3)) == (f"The images of the frames f1, f2 and f3 {same}",)
    many = repeated(job, 20)
    assert suspicions(many) == (f"The images of the frames f1, f2, f3, f4 and 16 others {same}",)
    (own,) = suspicions(replace(many, frame_poses=recordings.prior()))
    assert "each counts: sigmas of what they share are too small by that" in own


def test_an_image_that_is_there_many_times_tells_as_much_as_one():
    job = room_job()
    one, many = (
        calibrate(each, generator=torch.Generator().manual_seed(0)).estimate
        for each in (job, repeated(job, 5))
    )
    # Starts are drawn anew; were each image counted, it would be a fifth.
    torch.testing.assert_close(many.covariance, one.covariance, rtol=0.01, atol=0.0)
    assert many.used_pixels == one.used_pixels
    assert len(many.Ts_world_sensor) == 5


@pytest.mark.parametrize("words", ["left to right", "top to bottom", "half a turn", "rows and col"])
def test_a_turned_image_is_found_out(words):
    (warning,) = warnings_of(reading(words, room_job()))
    assert words in warning
    assert check(reading(words, room_job())).warnings == (warning,)


def test_the_other_kind_of_range_is_found_out():
    meant = room_job()
    cosine = reading("other kind", meant).frames[0].image.range / meant.frames[0].image.range
    frames = tuple(
        replace(frame, image=replace(frame.image, range=frame.image.range / cosine))
        for frame in meant.frames
    )
    # Along the optical axis both are the same; in the corner the ray is longer.
    assert float(cosine[23, 23]) == pytest.approx(1.0, abs=1e-3)
    assert float(cosine[0, 0]) == pytest.approx((1 + 2 * (23.5 / 45) ** 2) ** -0.5)
    (warning,) = warnings_of(replace(meant, frames=frames))
    assert "distance along the ray instead of depth" in warning


def test_what_no_reading_explains_is_no_warning():
    job = room_job()
    noise = torch.rand(48, 48, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    frames = tuple(
        replace(frame, image=replace(frame.image, range=1.0 + 3.0 * noise)) for frame in job.frames
    )
    assert warnings_of(replace(job, frames=frames)) == ()


@pytest.mark.parametrize(("words", "by"), [("frame before", 1), ("frame after", -1)])
def test_frames_may_have_the_joints_of_their_neighbours(robot_job, words, by):
    frames = tuple(
        replace(
            robot_job.frames[0],
            image=replace(robot_job.frames[0].image, name=f"{k}"),
            joints=torch.tensor([k, 0.0]),
        )
        for k in range(4)
    )
    meant = reading(words, replace(robot_job, frames=frames))
    pairs = [(int(f.image.name), int(f.joints[0])) for f in meant.frames if f.joints is not None]
    assert len(pairs) == 3
    assert all(image - joints == by for image, joints in pairs)
    few = replace(robot_job, frames=frames[:2])
    assert next(each for each in READINGS if words in each.words).of(few) is None


@pytest.mark.parametrize(("factor", "hint"), [(5000.0, "0.001"), (2e-5, "1000")])
def test_a_world_in_another_unit_is_suspected(factor, hint):
    (warning,) = suspicions(larger_world(room_job(), factor))
    assert f"is world.unit = {hint}?" in warning


def test_joints_beyond_their_limits_are_suspected(robot_job):
    limits = torch.tensor([[-1.0, 1.0], [-2.0, 2.0]], dtype=torch.float64)
    job = replace(robot_job, robot=replace(robot_job.robot, joint_limits=limits))
    frames = (replace(job.frames[0], joints=torch.tensor([1.5, 0.0]).double()), job.frames[1])
    warning, same = suspicions(replace(job, frames=frames))
    name = job.robot.joint_names[0]
    assert warning.startswith(f"The joint {name} stands at 1.5 rad, beyond its limits of -1 and 1")
    assert "pixel by pixel" in same


def test_joints_that_never_move_are_suspected_where_the_images_differ(robot_job):
    one, other = robot_job.frames
    moved = replace(other.image, range=other.image.range + 0.1)
    still = replace(robot_job, frames=(one, replace(other, image=moved, joints=POSTURES[0])))
    (warning,) = suspicions(still)
    assert warning == "The joints are the same in all 2 frames: were they recorded?"
