"""How much memory large images and long recordings take; Linux only."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from .table import NOTHING, REPORT, Row, table, write_section

ROOM = np.array([6.0, 5.0, 2.8])
"""m: its inside, seen from about its middle."""
CRATE = (2.2, 1.8, -1.1)
"""m: where the model has one that is not there."""
SIGMA = 0.005
JOB = """\
[world]
model = "room.glb"
[sensor]
model = "pinhole"
width = {width}
height = {height}
fx = {focal}
fy = {focal}
cx = {cx}
cy = {cy}
range = [0.3, 8.0]
sigma = 0.005
drift = 0
beam = 1
[unknown.base]
position_sigma = 0.02
rotation_sigma_deg = 1
"""
FRAME = """\
[[frame]]
depth = "{name}"
pose = {{ xyz = [0.02, 0, 0], rpy_deg = [{rpy[0]}, {rpy[1]}, {rpy[2]}] }}
"""
COMMAND = """\
import sys
from pathlib import Path
from torchcal.cli.main import main
status = main(sys.argv[2:])
words = Path("/proc/self/status").read_text().split()
Path(sys.argv[1]).write_text(words[words.index("VmHWM:") + 1])
sys.exit(status)
"""
"""What Linux tells of a child that has ended counts the one that started it as well."""
ABOUT = """\
The most memory that a command held at once, on images of a room in which a crate of the model
is gone, the camera's pose unknown (`scripts/benchmark.py memory`); bytes a pixel are those beyond
the first row, over all pixels of all frames; seconds are of the processor.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Load:
    """One recording and what is done with it."""

    command: Literal["calibrate", "follow"]
    frames: int
    width: int
    height: int

    @property
    def pixels(self) -> int:
        """Of all frames."""
        return self.frames * self.width * self.height

    @property
    def name(self) -> str:
        """As the table calls it."""
        return f"`{self.command}`, {self.frames} x {self.width} x {self.height}"


LOADS = (
    Load(command="calibrate", frames=1, width=64, height=48),
    Load(command="calibrate", frames=1, width=3840, height=2160),
    Load(command="calibrate", frames=1000, width=160, height=120),
    Load(command="follow", frames=1000, width=160, height=120),
)


def measure(*, seed: int = 0, out: Path = REPORT) -> None:
    """Peak memory with a 4K image and with 1000 frames.

    Args:
        seed: Of the images.
        out: Where the section `memory` is written.
    """
    held = {}
    for load in LOADS:
        with TemporaryDirectory() as folder:
            write_room(Path(folder) / "job", load, np.random.default_rng(seed))
            held[load] = _run(load.command, Path(folder))
        print(f"{load.name}: {held[load].bytes / 1e9:.2f} GB", file=sys.stderr, flush=True)
    rows = [_row(load, each, held[LOADS[0]].bytes) for load, each in held.items()]
    body = f"{ABOUT}\n{table(rows, 'everything')}"
    print(body)
    write_section(out, "memory", body)


def write_room(folder: Path, load: Load, rng: np.random.Generator) -> None:
    """A job of a camera that turns about itself; its ranges are those of six planes."""
    folder.mkdir(parents=True)
    room = trimesh.creation.box(ROOM)
    room.invert()
    crate = trimesh.creation.box((0.5, 0.5, 0.5)).apply_translation(CRATE)
    trimesh.Scene({"room": room, "crate": crate}).export(folder / "room.glb")
    focal, middle = 0.6 * load.width, (0.5 * (load.width - 1), 0.5 * (load.height - 1))
    job = JOB.format(width=load.width, height=load.height, focal=focal, cx=middle[0], cy=middle[1])
    v, u = np.mgrid[: load.height, : load.width]
    rays = np.stack([(u - middle[0]) / focal, (v - middle[1]) / focal, np.ones_like(u)], -1)
    for number, yaw in enumerate(np.linspace(20.0, 70.0, load.frames)):
        name = f"{number:04d}.npy"
        # Rolled by a quarter turn and more, the camera looks level and a little down.
        rpy = (-105.0, 0.0, yaw - 90.0)
        ways = rays @ Rotation.from_euler("ZYX", rpy[::-1], degrees=True).as_matrix().T
        with np.errstate(divide="ignore"):
            ranges = (0.5 * ROOM / np.abs(ways)).min(-1)
        noisy = ranges + rng.normal(0.0, SIGMA, ranges.shape)
        np.save(folder / name, noisy.astype(np.float32))
        job += FRAME.format(name=name, rpy=rpy)
    (folder / "job.toml").write_text(job, encoding="utf-8")


@dataclass(frozen=True, kw_only=True, slots=True)
class _Held:
    """What one command needed."""

    bytes: int
    """At most."""
    seconds: float
    """Of the processor."""


def _row(load: Load, held: _Held, least: int) -> Row:
    each = f"{(held.bytes - least) / load.pixels:.0f}" if held.bytes > least else NOTHING
    cells = {"peak": f"{held.bytes / 1e9:.2f} GB", "bytes a pixel": each}
    return Row(program=load.name, cells=cells, seconds=held.seconds)


def _run(command: str, folder: Path) -> _Held:
    """Runs one command in a process of its own."""
    words = [command, str(folder / "job" / "job.toml"), "--out", str(folder / "out"), "--json"]
    peak = folder / "peak"
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, str(peak), *words],
        stdout=subprocess.DEVNULL,
        stderr=sys.stderr,
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        code = os.waitstatus_to_exitcode(status)
        raise RuntimeError(f"torchcal {' '.join(words)}: found exit {code}; expected 0")
    seconds = used.ru_utime + used.ru_stime
    return _Held(bytes=1024 * int(peak.read_text()), seconds=seconds)
