"""Every mistake in a job is one error that names the key, what was found and what is possible."""

import pytest
import tiny_job
import torch
from torch.testing import assert_close

from torchcal.errors import JobError
from torchcal.model.read_job import read_job

SENSOR_LINK = 'link = "tool"\n'
FIRST_JOINTS = "joints = { shoulder = 0.1 }"
POSE = "pose = { xyz = [1, 2, 3] }"

# What is replaced in the job by what; then the key, what was found and what is possible.
ARM_MISTAKES = [
    # not TOML
    ("width = 8", "width = ", "", "line 12", "TOML"),
    ("width = 8", "width = 8\nwidth = 9", "", "line 13", "TOML"),
    # unknown keys
    ("width = 8", "widht = 8", "sensor.widht", "unknown key", "width (the closest), one of az"),
    ("[world]", "[wrold]", "wrold", "unknown key", "world (the closest), one of frame"),
    ("mask =", "masks =", "frame[1].masks", "unknown key", "mask (the closest), one of depth"),
    ("xyz = [0, 0, 0.1]", "xzy = [0]", "sensor.mount.xzy", "unknown key", "one of rpy_deg, xyz"),
    ("[unknown.base]", "[unknown.bsae]", "unknown.bsae", "unknown key", "base (the closest)"),
    ("[unknown.base]\nposition_sigma", "[unknown.base]\nsigma", "unknown.base.sigma", "unknown key",
     "position_sigma"),
    # missing keys
    ('model = "cell.glb"', "", "world.model", "nothing", "the name of a file"),
    ('urdf = "arm.urdf"', "", "robot.urdf", "nothing", "the name of a URDF"),
    ('model = "pinhole"', "", "sensor.model", "nothing", '"pinhole" or "spherical"'),
    ("fx = 9.0", "", "sensor.fx", "nothing", 'pixels from 0.001 to 1e7, for the model "pinhole"'),
    ("range = [0.3, 4.0]", "", "sensor.range", "nothing", "two numbers [near, far]"),
    ("sigma = 0.01", "", "sensor.sigma", "nothing", "one number in metres"),
    ('depth = "b.npy"', "", "frame[2].depth", "nothing", "16-bit PNG"),
    ("rotation_sigma_deg", "# ", "unknown.base.rotation_sigma_deg", "nothing", "degrees or three"),
    (SENSOR_LINK, "", "sensor.link", "nothing", 'or "world" if it stands still'),
    # wrong types
    ("width = 8", 'width = "8"', "sensor.width", '"8"', "a whole number of pixels"),
    ("width = 8", "width = 8.0", "sensor.width", "8.0", "a whole number of pixels"),
    ("width = 8", "width = true", "sensor.width", "true", "a whole number of pixels"),
    ("fx = 9.0", "fx = [9.0]", "sensor.fx", "[9.0]", "a number of pixels"),
    ('model = "cell.glb"', "model = 3", "world.model", "3", "the name of a file"),
    ('[world]\nmodel = "cell.glb"', 'world = "cell.glb"', "world", '"cell.glb"', "a table [world]"),
    ('model = "cell.glb"', 'model = "cell.glb"\ncomplete = 1', "world.complete", "1", "true or"),
    ("xyz = [1, 2, 3]", "xyz = [1, 2]", "robot.base.xyz", "[1, 2]", "three numbers in metres"),
    ("xyz = [1, 2, 3]", 'xyz = [1, 2, "3"]', "robot.base.xyz", '[1, 2, "3"]', "three numbers"),
    ("shoulder = 0.1", 'shoulder = "0.1"', "frame[1].joints.shoulder", '"0.1"', "radians"),
    (FIRST_JOINTS, "joints = [0.1]", "frame[1].joints", "[0.1]", "for each joint"),
    ("sigma = 0.01", "sigma = 0.01\ndrift = true", "sensor.drift", "true", '"auto", 0 or a table'),
    # wrong values
    ("width = 8", "width = 0", "sensor.width", "0", "from 1 to 100000"),
    ("width = 8", "width = 1_000_000_000", "sensor.width", "1000000000", "from 1 to 100000"),
    ("fx = 9.0", "fx = nan", "sensor.fx", "nan", "a number of pixels from 0.001"),
    ("fx = 9.0", "fx = 1e-300", "sensor.fx", "1e-300", "from 0.001 to 1e7"),
    ("cx = 3.5", "cx = 1e300", "sensor.cx", "1e+300", "at most 1e7"),
    ("fy = 9.5", "fy = -9.5", "sensor.fy", "-9.5", "from 0.001"),
    ("sigma = 0.01", "sigma = -0.01", "sensor.sigma", "-0.01 m at a range of 0.3 m", "above 0"),
    ("sigma = 0.01", "sigma = [0.1, -0.1, 0]", "sensor.sigma", "-0.3 m at a range of 4 m", "above"),
    ("sigma = 0.01", "sigma = [1, -2, 1]", "sensor.sigma", "0 m at a range of 1 m", "above 0"),
    ("sigma = 0.01", "sigma = [0.1, 0]", "sensor.sigma", "[0.1, 0]", "three numbers [a, b, c]"),
    ("sigma = 0.01", "sigma = 0.01\nbeam = 4", "sensor.beam", "4", "an odd number"),
    ("sigma = 0.01", "sigma = 0.01\nbeam = -1", "sensor.beam", "-1", "an odd number"),
    ("sigma = 0.01", "sigma = 0.01\ndrift = 0.1", "sensor.drift", "0.1", '"auto", 0 or a table'),
    ("sigma = 0.01", "sigma = 0.01\ndrift = { sigma = 0.1 }", "sensor.drift.pixels", "nothing",
     "a correlation length"),
    ("[0.3, 4.0]", "[4.0, 0.3]", "sensor.range", "[4.0, 0.3]", "0 <= near < far"),
    ("[0.3, 4.0]", "[0.3, 4.0, 5.0]", "sensor.range", "[0.3, 4.0, 5.0]", "two numbers"),
    ("[0.3, 4.0]", "4.0", "sensor.range", "4.0", "two numbers"),
    ("[0.3, 4.0]", "[0.3, inf]", "sensor.range", "inf", "two numbers"),
    ("depth_unit = 0.001", "depth_unit = 0", "sensor.depth_unit", "0", "from 1e-9 to 1e6"),
    ('model = "cell.glb"', 'model = "cell.glb"\nunit = 1e300', "world.unit", "1e+300",
     "from 1e-9 to 1e6"),
    ("xyz = [1, 2, 3]", "xyz = [1, 2, 3e30]", "robot.base.xyz", "[1, 2, 3e+30]",
     "at most a million"),
    ("position_sigma = 0.1", "position_sigma = -0.1", "unknown.base.position_sigma", "-0.1",
     "at least 0"),
    ("[180, 90, 0]", "[180, 90]", "unknown.base.rotation_sigma_deg", "[180, 90]", "one number"),
    ('model = "pinhole"', 'model = "fisheye"', "sensor.model", '"fisheye"', '"pinhole" or "spheri'),
    ("[unknown.base]", "[search]\nalpha = 0\n[unknown.base]", "search.alpha", "0", "above 0"),
    ("[unknown.base]", '[search]\ninitial = "auto"\n[unknown.base]', "search.initial", '"auto"',
     '"nominal" or "anywhere"'),
    # keys that do not go together
    ("width = 8", "width = 8\nrows = 6", "sensor.rows", "6", 'for the model "pinhole" only width'),
    ("width = 8", 'width = 8\npreset = "laser-scanner"', "sensor.model", '"pinhole"', "no preset"),
    ('model = "pinhole"', 'preset = "laser-scanner"', "sensor.width", "8", "only columns, rows"),
    ("width = 8", 'width = 8\npreset = "lidar"', "sensor.preset", '"lidar"', "laser-scanner, "),
    ('depth = "b.npy"', 'depth = "b.npy"\n' + POSE, "frame[2].pose", "a pose", "robot.base"),
    # files
    ("cell.glb", "cel.glb", "world.model", '"cel.glb", a file that does', 'mean "cell.glb"?'),
    ("arm.urdf", "arms.urdf", "robot.urdf", '"arms.urdf", a file that does', 'mean "arm.urdf"?'),
    ("a.png", "c.png", "frame[1].depth", '"c.png", a file that does not exist', "a file at"),
    ("a.png", "x" * 300, "frame[1].depth", "a file that does not exist", "a file at"),
    ("a.png", ".", "frame[1].depth", '".", a folder', "a file at"),
    ("mask.png", "mast.png", "frame[1].mask", '"mast.png", a file that does', '"mask.png"?'),
    ("a.png", "arm.urdf", "frame[1].depth", 'ends in ".urdf"', "one of .npy, .png, .tif, .tiff"),
    ("a.png", "broken.png", "frame[1].depth", "cannot be read", "a readable png"),
    # images
    ("a.png", "short.png", "frame[1].depth", "8x5 pixels", "8x6, the size of the sensor"),
    ("a.png", "eight_bit.png", "frame[1].depth", "an 8-bit image", "16-bit integers"),
    ("a.png", "colour.png", "frame[1].depth", "3 channels", "one channel of 16-bit"),
    ("a.png", "stack.npy", "frame[1].depth", "of shape (2, 6, 8)", "one channel"),
    ("a.png", "complex.npy", "frame[1].depth", "an array of complex64", "floats in metres"),
    ("a.png", "empty.png", "frame[1].depth", "every pixel is 0", "some measured pixels"),
    ("a.png", "far.png", "frame[1].depth", "a median of 15 m", "0.3 and 4 m (sensor.range)"),
    ("depth_unit = 0.001", "depth_unit = 1", "frame[1].depth", "1500 m", "depth_unit = 1?"),
    ("mask.png", "short.png", "frame[1].mask", "8x5 pixels", "8x6, the size of the sensor"),
    ("mask.png", "colour.png", "frame[1].mask", "3 channels", "one channel"),
    ("mask.png", "empty.png", "frame[1].mask", "0 everywhere", "some pixels that are not 0"),
    # names
    ("shoulder = 0.1", "sholder = 0.1", "frame[1].joints.sholder", '"sholder"',
     "shoulder (the closest), one of elbow, lift, shoulder"),
    ("shoulder = 0.1", "flange = 0.1", "frame[1].joints.flange", "not have as a moving", "lift"),
    ("shoulder = 0.1", "twin = 0.1", "frame[1].joints.twin", "a mimic joint", 'only "shoulder"'),
    ("shoulder = 0.1", "shoulder = 90", "frame[1].joints.shoulder", "90", "radians; as degrees"),
    ('link = "tool"', 'link = "tol"', "sensor.link", '"tol"', "tool (the closest), one of fin"),
    ('link = "tool"', 'link = "cam"', "sensor.link", '"cam"', "tool, upper, world"),
    # unknowns, by form and name
    ("[unknown.base]", "[unknown.joints]\nsigma_deg = 1\n[unknown.base]", "unknown.joints.sigma",
     "nothing", 'metres for the prismatic joint "lift"'),
    ("[unknown.base]", "[unknown.joints]\nsigma = 1\nnames = ['elbow']\n[unknown.base]",
     "unknown.joints.sigma_deg", "nothing", 'for the continuous joint "elbow"'),
    ("[unknown.base]",
     "[unknown.joints]\nsigma_deg = 1\nsigma = 1\nnames = ['elbow']\n[unknown.base]",
     "unknown.joints.sigma", "no unknown joint is prismatic", "sigma_deg"),
    ("[unknown.base]",
     "[unknown.joints]\nsigma_deg = 1\nsigma = 1\nnames = ['lift']\n[unknown.base]",
     "unknown.joints.sigma_deg", "no unknown joint is revolute or continuous", "sigma"),
    ("[unknown.base]", "[unknown.joints]\nsigma_deg = 1\nnames = ['wrist']\n[unknown.base]",
     "unknown.joints.names", '"wrist"', "one of elbow, lift, shoulder"),
    ("[unknown.base]", "[unknown.joints]\nsigma_deg = 1\nnames = []\n[unknown.base]",
     "unknown.joints.names", "[]", "a list of names"),
    ("[unknown.base]",
     "[unknown.joints]\nsigma_deg = 1\nnames = ['elbow', 'elbow']\n[unknown.base]",
     "unknown.joints.names", '"elbow" twice', "each joint once"),
    ("[unknown.base]\nposition_sigma = 0.1", "[unknown.object.crate]",
     "unknown.object.crate.position_sigma", "nothing", "metres or three"),
    ("[unknown.base]", "[unknown.object.crat]", "unknown.object.crat", "does not have", "crate ("),
    ("[unknown.base]\nposition_sigma", "[unknown.object.crate]\nsigma",
     "unknown.object.crate.sigma", "unknown key", "position_sigma"),
    ("[unknown.base]", "[unknown.range]\noffset_sigma = -1\nscale_sigma = 1\n[unknown.base]",
     "unknown.range.offset_sigma", "-1", "at least 0"),
    ("[unknown.base]", "[unknown.frames]", "unknown.frames", "has a [robot]", "unknown.base"),
]  # fmt: skip

SIGMAS = "position_sigma = 1\nrotation_sigma_deg = 1\n"

TRIPOD_MISTAKES = [
    ('[world]\nmodel = "cell.glb"', "", "world", "neither [world] nor [robot]", "one of the two"),
    ("[sensor]", "[scanner]", "scanner", "unknown key", "one of frame, robot, search, sensor"),
    ('[[frame]]\ndepth = "a.png"\n' + POSE, "", "frame", "nothing", "one or more tables [[frame]]"),
    ("[[frame]]", "[frame]", "frame", "a table with depth, pose", "in two brackets"),
    ("[sensor]", '[sensor]\nlink = "tool"', "sensor.link", "has no [robot]", "no such key"),
    ("[sensor]", "[sensor]\nmount = {}", "sensor.mount", "has no [robot]", "no such key"),
    (POSE, POSE + "\njoints = { a = 1 }", "frame[1].joints", "has no [robot]", "no such key"),
    (POSE, "", "frame[1].pose", "nothing", "the nominal pose of the sensor"),
    (POSE, '[[frame]]\ndepth = "a.png"\n[search]\ninitial = "anywhere"', "frame[1].pose", "nothing",
     "the nominal pose"),
    (POSE, POSE + "\n[unknown.mount]\n" + SIGMAS, "unknown.mount", "has no [robot]", "a [robot]"),
    (POSE, POSE + "\n[unknown.joints]\nsigma_deg = 1", "unknown.joints", "has no [robot]", "no "),
    (POSE, POSE + "\n[unknown.frames]\nposition_sigma = 1", "unknown.frames.rotation_sigma_deg",
     "nothing", "degrees or three"),
    ("columns = 8", "columns = 1", "sensor.azimuth_deg", "sensor.columns = 1", "twice the same"),
    ("[30, -30]", "[30, 30]", "sensor.elevation_deg", "[30, 30] for 6 rows", "two different"),
    ("[30, -30]", "[95, -30]", "sensor.elevation_deg", "[95, -30]", "between -90 and 90"),
    ("[-40, 40]", "[-190, 190]", "sensor.azimuth_deg", "[-190, 190]", "at most a turn apart"),
]  # fmt: skip


def mistake_of(folder, text: str) -> JobError:
    with pytest.raises(JobError) as caught:
        read_job(tiny_job.write(folder, text))
    return caught.value


def check(folder, text: str, mistake: tuple[str, str, str, str, str]) -> None:
    old, new, key, found, expected = mistake
    assert old in text
    error = mistake_of(folder, text.replace(old, new))
    assert (error.file, error.key) == (folder / "job.toml", key)
    assert found in error.found
    assert expected in error.expected
    where = f"{error.file}: {key}: " if key else f"{error.file}: "
    assert str(error) == f"{where}found {error.found}; expected {error.expected}"


@pytest.mark.parametrize("mistake", ARM_MISTAKES, ids=lambda mistake: mistake[1])
def test_mistake_in_a_job_with_a_robot_is_named(tmp_path, mistake):
    check(tmp_path, tiny_job.ARM_JOB, mistake)


@pytest.mark.parametrize("mistake", TRIPOD_MISTAKES, ids=lambda mistake: mistake[1])
def test_mistake_in_a_hand_held_job_is_named(tmp_path, mistake):
    check(tmp_path, tiny_job.TRIPOD_JOB, mistake)


def test_mask_without_a_measurement_is_named(tmp_path):
    file = tiny_job.write(tmp_path, tiny_job.ARM_JOB)
    half = tiny_job.depth_with_upper_half_missing()
    half.save(tmp_path / "a.png")
    with pytest.raises(JobError, match=r"frame\[1\].mask: found \"mask.png\", in which no usable"):
        read_job(file)


def test_a_joint_far_beyond_a_turn_is_possible_where_it_turns_on(tmp_path):
    text = tiny_job.ARM_JOB.replace("elbow = -0.2", "elbow = -20.0")
    joints = read_job(tiny_job.write(tmp_path, text)).frames[1].joints
    assert_close(joints, torch.tensor([0.0, -20.0, 0.05], dtype=torch.float64))
