"""A job from a recording of a cylinder by a camera on a robot's flange.

The folder holds ``view1d.pcd`` .. (clouds of the cylinder in the camera's frame, in metres) and
``RobotPoses.dat`` (the flange in the robot's base; one row for each view: rx, ry, rz in radians,
x, y, z in mm), as in the data of RegHEC, github.com/Shiyu-Xing/RegHEC. The cylinder's radius is
fitted first and its side is the model; masks leave its end out. The robot is known by its flange
alone, so it is written as three slides and three turns that carry it. Where camera and cylinder are
is given as a person would read it off a ruler; the rest is left to ``torchcal calibrate``.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from cylinders.hand_eye import along_z, mount_and_axis, rounded
from cylinders.recording import read_views
from cylinders.shape import find_cylinder
from cylinders.writing import job_text, urdf_text, write_images, write_tube


@dataclass(frozen=True, kw_only=True)
class Options:
    """A job from a recording of a cylinder."""

    folder: tyro.conf.Positional[Path]
    """With the clouds and the poses of the flange."""
    out: Path
    """Where the job is written; must not exist."""
    views: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = ()
    """The views to use, from 1; all if left out."""
    hold: bool = False
    """Take the slide along the cylinder's axis and the turn about it for known."""
    focal: float = 300.0
    """Pixels."""
    margin: float = 0.004
    """m: what counts as the side ends so far below the plane of the end."""
    sigma: float = 0.001
    """m: what the robot's poses are off by; the noise of a single view is 0.05 mm."""
    ruler: float = 0.01
    """m: the places of mount and cylinder are written down in steps of this."""
    protractor: float = 5.0
    """Degrees: their turns, in steps of this."""
    length: float = 0.5
    """m: of the model; longer than the cylinder, so that its ends say nothing."""
    sections: int = 512
    """Flat strips that the round side is made of."""
    seed: int = 0
    """Of the planes among which the end is found."""


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    rng = np.random.default_rng(options.seed)
    views = read_views(options.folder)
    views = tuple(views[number - 1] for number in options.views) or views
    seen = [find_cylinder(view.points, margin=options.margin, rng=rng) for view in views]
    radius = float(np.median([each.radius for each in seen]))
    mount, middle, axis = mount_and_axis(
        np.stack([view.T_base_flange for view in views]),
        np.stack([each.centre for each in seen]),
        np.stack([each.axis for each in seen]),
        rng,
    )
    options.out.mkdir(parents=True)
    optics = write_images(options.out, views, [each.side for each in seen], options.focal)
    write_tube(
        options.out / "cylinder.glb",
        radius=radius,
        length=options.length,
        sections=options.sections,
    )
    (options.out / "flange.urdf").write_text(urdf_text(views), encoding="utf-8")
    steps = {"metres": options.ruler, "degrees": options.protractor}
    text = job_text(
        views,
        optics=optics,
        sigma=options.sigma,
        mount=rounded(mount, **steps),
        cylinder=rounded(along_z(middle, axis), **steps),
        believed=(options.ruler, options.protractor),
        hold=options.hold,
    )
    (options.out / "job.toml").write_text(text, encoding="utf-8")
    found = {"radius_m": radius, "radii_m": [each.radius for each in seen]}
    found |= {"noise_m": [each.noise for each in seen], "job": str(options.out / "job.toml")}
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
