"""States, their names and priors, and where a state puts sensor and bodies."""

from dataclasses import replace

import pytest
import recordings
import torch
from kinematic_jobs import (
    POSTURES,
    motions,
    parameters_of,
    with_everything,
)
from recordings import EYE, pose

from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.geometry import se3
from torchcal.model.job import PosePrior

EXACT = 1e-12
"""Products of a few 4x4 matrices of size 1 in double precision."""


def test_a_batch_of_states_is_a_loop_over_states(robot_job):
    parameters = parameters_of(with_everything(robot_job))
    count = len(parameters.names)
    steps = torch.linspace(-0.3, 0.3, 2 * count, dtype=torch.float64).view(2, count)
    states = parameters.retract(parameters.nominal.expand(2, *parameters.nominal.shape), steps)
    for function in (
        parameters.sensor_poses,
        parameters.bodies_in_sensor,
        parameters.pose_jacobians,
        parameters.joint_offsets,
        parameters.object_poses,
        parameters.range_error,
        lambda state: motions(parameters, state),
    ):
        one_by_one = torch.stack([function(state) for state in states])
        torch.testing.assert_close(function(states), one_by_one, atol=EXACT, rtol=0)


def test_poses_of_a_carried_sensor_follow_the_chain(robot_job):
    parameters = parameters_of(robot_job)
    tool = robot_job.robot.link_index("tool")
    links = torch.stack([robot_job.robot.forward_kinematics(joints) for joints in POSTURES])
    expected = robot_job.T_world_base @ links[:, tool] @ robot_job.T_link_sensor
    found = parameters.sensor_poses(parameters.nominal)
    torch.testing.assert_close(found, expected, atol=EXACT, rtol=0)


def test_links_follow_the_base_and_objects_do_not(robot_job):
    scene = build_job_scene(robot_job)
    parameters = Parameters.of(robot_job, scene)
    state = parameters.retract(parameters.nominal, torch.full((12,), 0.1, dtype=torch.float64))
    in_world = parameters.sensor_poses(state)[:, None] @ parameters.bodies_in_sensor(state)
    tool, crate = scene.body_index("robot/tool"), scene.body_index("crate")
    for k, joints in enumerate(POSTURES):
        links = state[0] @ robot_job.robot.forward_kinematics(joints)
        expected = links[robot_job.robot.link_index("tool")]
        torch.testing.assert_close(in_world[k, tool], expected, atol=EXACT, rtol=0)
        torch.testing.assert_close(in_world[k, crate], EYE, atol=EXACT, rtol=0)


def test_a_standing_sensor_ignores_the_base(robot_job):
    T_world_sensor = pose(0.5, 1.0, 2.0, 0.3, 1.0, 0.2)
    parameters = parameters_of(recordings.standing(robot_job, T_world_sensor))
    step = torch.zeros(12, dtype=torch.float64)
    step[:6] = 0.2
    state = parameters.retract(parameters.nominal, step)
    found = parameters.sensor_poses(state)
    torch.testing.assert_close(found, T_world_sensor.expand(2, 4, 4), atol=EXACT, rtol=0)


def test_frames_without_a_robot_share_one_correction(hand_job):
    parameters = parameters_of(hand_job)
    xi = torch.tensor([0.05, -0.02, 0.1, 0.1, -0.2, 0.3], dtype=torch.float64)
    found = parameters.sensor_poses(parameters.retract(parameters.nominal, xi))
    T_1, T_2 = (frame.T_world_sensor for frame in hand_job.frames)
    moved = T_1 @ se3.exp(xi)
    expected = torch.stack([moved, moved @ se3.inverse(T_1) @ T_2])
    torch.testing.assert_close(found, expected, atol=EXACT, rtol=0)


def test_difference_undoes_retract(robot_job):
    parameters = parameters_of(robot_job)
    origin = parameters.retract(parameters.nominal, torch.full((12,), 0.1, dtype=torch.float64))
    step = torch.linspace(-0.4, 0.5, 12, dtype=torch.float64)
    found = parameters.difference(parameters.retract(origin, step), origin)
    # The logarithm of a rotation of 0.5 rad loses two digits of double precision.
    torch.testing.assert_close(found, step, atol=1e-11, rtol=0)


def test_names_and_sigmas_leave_out_held_axes(robot_job):
    sigma = torch.tensor([0.1, 0.0, 0.3, 0.0, 0.0, 0.6], dtype=torch.float64)
    parameters = parameters_of(replace(robot_job, mount=PosePrior(sigma=sigma)))
    base = ("base.x", "base.y", "base.z", "base.rx", "base.ry", "base.rz")
    assert parameters.names == (*base, "mount.x", "mount.z", "mount.rz")
    expected = [recordings.POSITION_SIGMA] * 3 + [recordings.ROTATION_SIGMA] * 3 + [0.1, 0.3, 0.6]
    assert parameters.prior_sigma.tolist() == expected


def test_distance_from_the_nominal_state_counts_in_prior_sigmas(robot_job):
    parameters = parameters_of(robot_job)
    share = torch.linspace(-0.9, 0.9, 12, dtype=torch.float64)
    state = parameters.retract(parameters.nominal, share * parameters.prior_sigma)
    # Sigmas of a degree: rounding of 1e-16 in a rotation matrix is 1e-14 of them.
    torch.testing.assert_close(parameters.from_nominal(state), share, atol=1e-11, rtol=0)
    product = parameters.prior_precision * parameters.prior_sigma.square()
    torch.testing.assert_close(product, torch.ones_like(product), atol=1e-14, rtol=0)


@pytest.mark.parametrize(("share", "expected"), [(0.99, False), (-1.01, True)])
def test_one_parameter_beyond_five_sigmas_contradicts_the_prior(robot_job, share, expected):
    parameters = parameters_of(robot_job)
    step = torch.zeros(12, dtype=torch.float64)
    step[7] = share * 5.0 * parameters.prior_sigma[7]
    state = parameters.retract(parameters.nominal, step)
    assert bool(parameters.contradicts_prior(state)) is expected


def test_held_axes_do_not_move(robot_job):
    sigma = torch.tensor([0.1, 0.0, 0.3, 0.0, 0.0, 0.6], dtype=torch.float64)
    parameters = parameters_of(replace(robot_job, base=None, mount=PosePrior(sigma=sigma)))
    state = parameters.retract(parameters.nominal, torch.ones(3, dtype=torch.float64))
    assert torch.equal(state[0], parameters.nominal[0])
    moved = se3.log(se3.inverse(parameters.nominal[1]) @ state[1])
    expected = torch.tensor([1.0, 0.0, 1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(moved, expected, atol=1e-11, rtol=0)


def test_nothing_unknown_is_an_empty_vector(hand_job):
    parameters = parameters_of(replace(hand_job, base=None))
    assert parameters.names == ()
    state = parameters.retract(parameters.nominal, torch.zeros(0, dtype=torch.float64))
    torch.testing.assert_close(state, parameters.nominal, atol=0, rtol=0)
    assert parameters.motion(state, 0).shape[-1] == 0
