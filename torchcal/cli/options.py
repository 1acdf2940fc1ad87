"""The commands and their options, as data; tyro makes the command line of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from torchcal.fleet.table import RobotBy

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
JobFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="JOB")]
ResultFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
Names = Annotated[
    tuple[str, ...], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="(default: none)")
]


@dataclass(frozen=True, kw_only=True, slots=True)
class Options:
    """What every command takes."""

    device: Annotated[
        Literal["cpu", "cuda"] | None,
        tyro.conf.arg(metavar="{cpu,cuda}", help_behavior_hint="(default: cuda if there is one)"),
    ] = None
    """Where to compute."""
    seed: int = 0
    """Of all random numbers: the same seed gives the same answer."""
    json: Flag = False
    """Print the result as JSON on standard output, and nothing else there."""


def _optional(metavar: str, default: str) -> object:
    """How the help shows an option that need not be given."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=default)


_BY_SHARE = "(default: a hundredth of its sigma in the job)"

Shared = Annotated[Options, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


@dataclass(frozen=True, kw_only=True, slots=True)
class Calibrate:
    """Estimate what is wrong, compare every pixel, propose the corrected model."""

    job: JobFile
    """The job: a TOML file."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results; an earlier result there is replaced as a whole."""
    estimate: Flag = True
    """Compare at the nominal pose, with the uncertainty that the job states."""
    options: Shared = Options()


@dataclass(frozen=True, kw_only=True, slots=True)
class Follow:
    """Estimate frame by frame, and raise an alarm when something was moved."""

    job: JobFile
    """The job: a TOML file; its frames in the order in which they were taken."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for frames.jsonl and result.json; an earlier one is replaced as a whole."""
    shift: Annotated[float | None, tyro.conf.arg(metavar="M", help_behavior_hint=_BY_SHARE)] = None
    """Metres that the base, or a sensor without a robot, may move from frame to frame (1 sigma)."""
    turn_deg: Annotated[
        float | None, tyro.conf.arg(metavar="DEG", help_behavior_hint=_BY_SHARE)
    ] = None
    """Degrees that it may turn."""
    options: Shared = Options()


@dataclass(frozen=True, kw_only=True, slots=True)
class Render:
    """Show what the model predicts at the nominal pose."""

    job: JobFile
    """The job: a TOML file."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for depth/*.npy and preview/*.png; an earlier one is replaced as a whole."""
    options: Shared = Options()


@dataclass(frozen=True, kw_only=True, slots=True)
class Check:
    """Read everything, change nothing, say what can and cannot be found out."""

    job: JobFile
    """The job: a TOML file."""
    options: Shared = Options()


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch:
    """Calibrate many jobs, one after the other or at once; run again, it goes on where it ended."""

    jobs: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="JOB...", help_behavior_hint="(required)"),
    ]
    """Job files, and folders of which every job.toml is taken."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for a result of each job, the table and the page; finished jobs there are kept."""
    workers: Annotated[
        int | None,
        tyro.conf.arg(metavar="N", help_behavior_hint="(default: this process; with --ray, all)"),
    ] = None
    """How many jobs at once: here, in processes of one thread each; with --ray, at most so many on
    the cluster, which --ray local starts with so many processors."""
    ray: Annotated[
        str | None, tyro.conf.arg(metavar="ADDRESS", help_behavior_hint="(default: no cluster)")
    ] = None
    """Run on a Ray cluster; local starts one here."""
    attempts: Annotated[int, tyro.conf.arg(metavar="N")] = 3
    """How often a job is tried that fails or whose worker is killed."""
    robot: Annotated[
        RobotBy | None,
        tyro.conf.arg(
            metavar="{folder,job,urdf}",
            help_behavior_hint="(default: folder for jobs in folders of folders, else urdf)",
        ),
    ] = None
    """What tells robots apart: the folder above the job's, the job's own, or the URDF's name."""
    options: Shared = Options()


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """Show a calibration, or a job before it, in a browser."""

    result: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR|JOB")]
    """What torchcal calibrate wrote, or a job: it is shown at the nominal pose."""
    follow: Annotated[
        Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="(default: none)")
    ] = None
    """Follow the torchcal follow of this JOB that writes, or wrote, into DIR."""
    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 is every network that this machine is in."""
    port: Annotated[int | None, _optional("PORT", "(default: the first free one from 8080)")] = None
    """The port to listen on."""
    options: Shared = Options()


@dataclass(frozen=True, kw_only=True, slots=True)
class Import:
    """Make a job of a bag of ROS 1 or ROS 2, an MCAP file, depth images or point clouds."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """A bag, a folder of depth PNGs with Open3D's intrinsics, or PLY or PCD clouds."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the job; it must be new or empty."""
    world: Annotated[Path | None, _optional("FILE", "(default: yours to fill in)")] = None
    """The CAD model of the surroundings."""
    like: Annotated[Path | None, _optional("JOB", "")] = None
    """Another job of the same cell, from which what the recording cannot know is taken over."""
    frames: Annotated[int, tyro.conf.arg(metavar="N")] = 20
    """The most images to take; one for each posture in which nothing moved."""
    use: Annotated[tuple[str, ...], _optional("NAME ...", "(default: if there is no choice)")] = ()
    """The topics, or files of a folder, to read where there are several."""
    urdf: Annotated[Path | None, _optional("FILE", "(default: robot_description)")] = None
    """The robot."""
    package: Annotated[tuple[str, ...], _optional("NAME=DIR ...", "")] = ()
    """Where the packages are that package:// means in the URDF."""
    link: Annotated[str | None, _optional("NAME", "(default: by tf_static)")] = None
    """The link that carries the sensor, or "world"."""
    depth_unit: Annotated[float | None, _optional("M", "(default: 0.001, floats 1)")] = None
    """Metres of one unit of the images."""
    resolution: Annotated[float | None, _optional("DEG", "(default: by the points)")] = None
    """Degrees between the pixels onto which points without an order are projected."""
    position: Annotated[
        tuple[float, float, float] | None, _optional("X Y Z", "(default: that of the points)")
    ] = None
    """Where the sensor stood (m), for clouds in the axes of the world."""
    options: Shared = Options()


@dataclass(frozen=True, kw_only=True, slots=True)
class Update:
    """List the proposed changes of the model; accept or reject them."""

    result: ResultFolder
    """What torchcal calibrate wrote."""
    accept: Names = ()
    """Changes that stay in DIR/world.glb; all: every one that is not named."""
    reject: Names = ()
    """Changes that are taken back; all: every one that is not named."""
    options: Shared = Options()


@dataclass(frozen=True, kw_only=True, slots=True)
class Demo:
    """Make a robot, a cell and a recording, calibrate it, compare with the truth."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("torchcal-demo")
    """Folder for the job and its result; an earlier demo there is replaced as a whole."""
    options: Shared = Options()


Command = Calibrate | Follow | Render | Check | Batch | Import | View | Update | Demo

COMMANDS: dict[str, type] = {
    "calibrate": Calibrate,
    "follow": Follow,
    "render": Render,
    "check": Check,
    "batch": Batch,
    "import": Import,
    "view": View,
    "update": Update,
    "demo": Demo,
}


def parse(arguments: list[str] | None = None) -> Command:
    """The command that a person typed.

    Raises:
        SystemExit: With 2 for a mistake, with 0 after ``--help``.
    """
    return tyro.extras.subcommand_cli_from_dict(
        COMMANDS,
        prog="torchcal",
        description="Tells a robot where its model of the world is wrong, from range images.",
        args=arguments,
        sort_subcommands=False,
    )
