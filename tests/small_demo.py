"""The demo's arm and cell in two small images: calibrated in seconds."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchcal
from torchcal.demo import cell, raycast, recording, robot_folder
from torchcal.geometry import se3

SIDE = 64  # pixels; the demo has 512

SENSOR = replace(
    recording.SENSOR,
    projection=torchcal.Pinhole(
        width=SIDE, height=SIDE, fx=68.6, fy=68.6, cx=(SIDE - 1) / 2, cy=(SIDE - 1) / 2
    ),
    noise=torchcal.Noise(a=0.005, drift=torchcal.Drift(sigma=0.0, pixels=1.0)),
    beam=3,
)

JOB = f"""\
[world]
model = "cell.glb"
complete = true

[robot]
urdf = "arm/arm.urdf"
base = {{ xyz = [0.0, 0.0, {cell.PEDESTAL_HEIGHT}] }}

[sensor]
link = "{recording.LINK}"
model = "pinhole"
width = {SIDE}
height = {SIDE}
fx = 68.6
fy = 68.6
cx = {(SIDE - 1) / 2}
cy = {(SIDE - 1) / 2}
range = [0.3, 10.0]
sigma = 0.005
drift = 0
beam = 3

[unknown.base]
position_sigma = 0.03
rotation_sigma_deg = 1.0
"""


def write_small_demo(folder: Path) -> torch.Tensor:
    """The demo's arm and cell in two small images; where the robot really stands."""
    shutil.copytree(robot_folder("arm"), folder / "arm")
    cell.as_scene(cell.modelled_objects()).export(folder / "cell.glb")
    error = torch.tensor([0.02, -0.01, 0.015, 0.01, -0.005, 0.01], dtype=torch.float64)
    T_world_base = recording.nominal_T_world_base() @ se3.exp(error)
    robot, rng = torchcal.load_robot(folder / "arm" / "arm.urdf"), np.random.default_rng(0)
    frames = []
    for posture in recording.POSTURES[:2]:
        view = recording.view_of(cell.modelled_objects(), robot, T_world_base, posture)
        image = raycast.predict(view, SENSOR.projection, SENSOR.beam)
        name = f"{len(frames)}.npy"
        np.save(folder / name, raycast.measure(image, SENSOR, rng).astype(np.float32))
        joints = ", ".join(
            f"{key} = {value}" for key, value in zip(recording.JOINTS, posture, strict=True)
        )
        frames.append(f'\n[[frame]]\ndepth = "{name}"\njoints = {{ {joints} }}\n')
    (folder / "job.toml").write_text(JOB + "".join(frames))
    return T_world_base
