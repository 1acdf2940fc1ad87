"""What base and mount move, against finite differences of the poses themselves."""

from dataclasses import replace

import pytest
import recordings
import torch
from recordings import EYE, pose, prior
from torch import Tensor

from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.geometry import se3
from torchcal.model.job import Job, PosePrior

STEP = 1e-6
ATOL = 1e-8
"""Central differences of functions of size 1: rounding 1e-16 / STEP and curvature STEP^2."""
EXACT = 1e-12
"""Products of a few 4x4 matrices of size 1 in double precision."""
POSTURES = [torch.tensor([0.3, -0.2]).double(), torch.tensor([-0.5, 0.4]).double()]


@pytest.fixture
def robot_job(tmp_path) -> Job:
    """A carried sensor in a room; two frames, images of one value."""
    robot = recordings.arm(tmp_path)
    ranges = torch.ones(48, 64, dtype=torch.float64)
    frames = tuple(recordings.frame_of(ranges, joints=joints) for joints in POSTURES)
    return Job(
        file=tmp_path / "job.toml",
        world=recordings.world_of(recordings.room()),
        robot=robot,
        sensor=recordings.sensor(),
        link="tool",
        T_world_base=pose(0.1, -0.3, 0.2, 0.3, -0.1, 0.6),
        T_link_sensor=pose(0.05, 0.02, -0.1, -0.7, 0.4, 0.2),
        frames=frames,
        base=prior(),
        mount=prior(0.01, 0.02),
    )


@pytest.fixture
def hand_job() -> Job:
    """No robot, two frames."""
    ranges = torch.ones(48, 64, dtype=torch.float64)
    poses = [pose(0.1, 0.2, 0.3, 0.4, -0.5, 0.6), pose(-0.3, 0.1, 0.5, -0.2, 0.9, 0.1)]
    frames = tuple(recordings.frame_of(ranges, T_world_sensor=T) for T in poses)
    return Job(
        file=recordings.Path("job.toml"),
        world=recordings.world_of(recordings.room()),
        robot=None,
        sensor=recordings.sensor(),
        link=None,
        T_world_base=EYE,
        T_link_sensor=EYE,
        frames=frames,
        base=prior(),
        mount=None,
    )


def parameters_of(job: Job) -> Parameters:
    return Parameters.of(job, build_job_scene(job))


def differences(function, parameters: Parameters, state: Tensor) -> Tensor:
    """Twists that lead from f(state - step) to f(state + step) per unit step, parameter last.

    ``function`` gives twists, relative to its value at ``state``.
    """
    steps = STEP * torch.eye(len(parameters.names), dtype=state.dtype)
    columns = [
        (function(parameters.retract(state, step)) - function(parameters.retract(state, -step)))
        for step in steps
    ]
    return torch.stack(columns, -1) / (2.0 * STEP)


def assert_derivatives_are_right(parameters: Parameters) -> None:
    """At a state off the nominal one."""
    off = 0.3 * torch.sin(torch.arange(len(parameters.names)) + 1.0).double()
    state = parameters.retract(parameters.nominal, off)
    bodies = parameters.bodies_in_sensor(state)
    sensors = parameters.sensor_poses(state)

    def body_twists(moved: Tensor) -> Tensor:
        return se3.log(parameters.bodies_in_sensor(moved) @ se3.inverse(bodies))

    def sensor_twists(moved: Tensor) -> Tensor:
        return se3.log(se3.inverse(sensors) @ parameters.sensor_poses(moved))

    motion = differences(body_twists, parameters, state)
    jacobian = differences(sensor_twists, parameters, state)
    torch.testing.assert_close(parameters.motion(state), motion, atol=ATOL, rtol=0)
    torch.testing.assert_close(parameters.pose_jacobians(state), jacobian, atol=ATOL, rtol=0)


def test_derivatives_of_a_carried_sensor(robot_job):
    assert_derivatives_are_right(parameters_of(robot_job))


def test_derivatives_of_a_standing_sensor(robot_job):
    parameters = parameters_of(recordings.standing(robot_job, pose(0.5, 1.0, 2.0, 0.3, 1.0, 0.2)))
    assert_derivatives_are_right(parameters)


def test_derivatives_without_a_robot(hand_job):
    assert_derivatives_are_right(parameters_of(hand_job))


def test_derivatives_with_held_axes(robot_job):
    sigma = torch.tensor([0.1, 0.0, 0.1, 0.0, 0.2, 0.0], dtype=torch.float64)
    job = replace(robot_job, base=PosePrior(sigma=sigma), mount=PosePrior(sigma=sigma.flip(0)))
    assert_derivatives_are_right(parameters_of(job))


def test_a_batch_of_states_is_a_loop_over_states(robot_job):
    parameters = parameters_of(robot_job)
    steps = torch.linspace(-0.3, 0.3, 24, dtype=torch.float64).view(2, 12)
    states = parameters.retract(parameters.nominal.expand(2, 2, 4, 4), steps)
    for function in (
        parameters.sensor_poses,
        parameters.bodies_in_sensor,
        parameters.motion,
        parameters.pose_jacobians,
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
    assert parameters.motion(state).shape[-1] == 0
