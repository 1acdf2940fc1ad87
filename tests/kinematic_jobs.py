"""Jobs for the kinematics of everything that may be unknown, and differences of their poses."""

from dataclasses import replace
from pathlib import Path

import recordings
import torch
from recordings import EYE, pose, prior
from torch import Tensor

from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.geometry import se3
from torchcal.model.job import Job, RangePrior

STEP = 1e-6
ATOL = 1e-8
"""Central differences of functions of size 1: rounding 1e-16 / STEP and curvature STEP^2."""
POSTURES = [torch.tensor([0.3, -0.2]).double(), torch.tensor([-0.5, 0.4]).double()]


def robot_job(folder: Path) -> Job:
    """A carried sensor in a room; two frames, images of one value."""
    robot = recordings.arm(folder)
    ranges = torch.ones(48, 64, dtype=torch.float64)
    frames = tuple(recordings.frame_of(ranges, joints=joints) for joints in POSTURES)
    return Job(
        file=folder / "job.toml",
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


def hand_job() -> Job:
    """No robot, two frames."""
    ranges = torch.ones(48, 64, dtype=torch.float64)
    poses = [pose(0.1, 0.2, 0.3, 0.4, -0.5, 0.6), pose(-0.3, 0.1, 0.5, -0.2, 0.9, 0.1)]
    frames = tuple(recordings.frame_of(ranges, T_world_sensor=T) for T in poses)
    return Job(
        file=Path("job.toml"),
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


def motions(parameters: Parameters, state: Tensor) -> Tensor:
    """Of all frames; 0 for parameters that a frame does not depend on."""
    frames = []
    for k in range(len(parameters.mechanism.Ts_first_frame)):
        some = parameters.motion(state, k)
        every = some.new_zeros(*some.shape[:-1], len(parameters.names))
        every[..., parameters.active(k)] = some
        frames.append(every)
    return torch.stack(frames, -4)


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
    torch.testing.assert_close(motions(parameters, state), motion, atol=ATOL, rtol=0)
    torch.testing.assert_close(parameters.pose_jacobians(state), jacobian, atol=ATOL, rtol=0)


def with_everything(job: Job) -> Job:
    """All blocks that a robot may have."""
    return replace(
        job,
        joints={"nod": 0.1, "turn": 0.2},
        objects={"shelf": prior(), "crate": prior(0.02, 0.03)},
        range=RangePrior(offset_sigma=0.01, scale_sigma=0.02),
    )
