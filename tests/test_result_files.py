"""The files that other programs read."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from display_scene import calibration
from PIL import Image

from torchcal.calibrate.check_result import (
    FrameCheck,
    JobCheck,
    ParameterCheck,
)
from torchcal.calibrate.parameters import AXES
from torchcal.calibrate.result import (
    ObjectVerdict,
    Status,
    UnobservableDirection,
    Verdict,
)
from torchcal.cli.result_files import (
    as_json,
    check_dict,
    result_dict,
    without_nan,
    write_results,
)
from torchcal.geometry import se3
from torchcal.model.job import RangePrior
from torchcal.model.robot import load_robot

KEYS = (
    "status message parameters names covariance unobservable alternatives frames objects added"
    " timing next_view warnings pixels"
).split()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    write_results(calibration(("0001", "0001", "wide")), folder)
    return folder


def test_result_has_exactly_the_agreed_keys_in_order():
    assert list(result_dict(calibration())) == KEYS


def test_sensor_pose_stands_for_the_base_without_a_robot():
    parameters = result_dict(calibration())["parameters"]
    assert list(parameters) == ["sensor", "joints", "objects", "range"]
    sensor = parameters["sensor"]
    np.testing.assert_allclose(sensor["position_sigma_m"], [1e-3, 2e-3, 0.0], rtol=1e-12)
    np.testing.assert_allclose(sensor["rotation_sigma_rad"], [3e-4, 4e-4, 5e-4], rtol=1e-12)


def test_frames_count_their_pixels():
    frame = result_dict(calibration())["frames"][0]
    assert frame["depth"] == "depth/0001.png"
    assert frame["nearer"] == 168
    assert frame["farther"] == 256
    assert frame["missing"] == 140
    assert frame["unmodelled"] == 70
    compared = ("agree", "nearer", "farther", "unmodelled")
    assert frame["measured"] == sum(frame[name] for name in compared)


def test_added_objects_have_size_and_place():
    (added,) = result_dict(calibration())["added"]
    np.testing.assert_allclose(added["extent_m"], [0.2, 0.3, 0.4])
    np.testing.assert_allclose(added["bounds_m"], [[0.9, -0.15, -0.2], [1.1, 0.15, 0.2]])


def test_doubts_are_in_the_result():
    result = result_dict(calibration(status=Status.AMBIGUOUS))
    assert result["unobservable"][0]["words"] == "movement along the wall"
    assert result["unobservable"][0]["vector"] == [0.0, 1.0, 0.0, 0.0, 0.0]
    assert result["alternatives"][0]["score"] == 0.85
    assert np.shape(result["alternatives"][0]["Ts_world_sensor"]) == (2, 4, 4)


def test_numbers_that_are_not_finite_become_null():
    assert without_nan({"a": [float("nan"), 1.0], "b": (float("inf"),)}) == {
        "a": [None, 1.0],
        "b": [None],
    }
    whole = calibration()
    covariance = torch.full_like(whole.estimate.covariance, torch.nan)
    broken = dataclasses.replace(
        whole, estimate=dataclasses.replace(whole.estimate, covariance=covariance)
    )
    assert json.loads(as_json(result_dict(broken)))["covariance"][0][0] is None


def test_the_same_answer_gives_the_same_text():
    assert as_json(result_dict(calibration())) == as_json(result_dict(calibration()))


def test_numbers_survive_to_their_last_digit():
    read = json.loads(as_json(result_dict(calibration())))
    assert read["covariance"][3][3] == float(calibration().estimate.covariance[3, 3])


def test_every_file_is_written(written):
    files = {str(path.relative_to(written)) for path in written.rglob("*") if path.is_file()}
    names = ("0001", "0001-2", "wide")
    pictures = {f"{part}/{name}.png" for part in ("hybrid", "comparison") for name in names}
    kept = {f"frames/{name}.npz" for name in names}
    kept |= {"model/world.glb", "model/added.glb", "model/record.json"}
    assert files == {"result.json", "world.glb", "report.html"} | pictures | kept


def test_written_result_is_the_result(written):
    text = (written / "result.json").read_text(encoding="utf-8")
    assert json.loads(text) == result_dict(calibration(("0001", "0001", "wide")))


def test_written_pictures_can_be_opened(written):
    for file in written.glob("*/*.png"):
        with Image.open(file) as picture:
            assert min(picture.size) > 300


def test_written_world_lacks_what_was_removed_and_has_what_was_added(written):
    scene = trimesh.load_scene(written / "world.glb")
    assert set(scene.geometry) == {"wall", "added-1"}


def test_a_check_becomes_strict_json():
    frame = FrameCheck(
        name="0001",
        measured_fraction=0.5,
        usable_fraction=0.25,
        model_fraction=0.0,
        median_range_m=2.0,
        predicted_median_range_m=float("nan"),
        warnings=("the model is not seen",),
    )
    check = JobCheck(
        frames=(frame,),
        parameters=(
            ParameterCheck(name="base.x", unit="m", prior_sigma=0.1, expected_sigma=0.001),
        ),
        unobservable=(UnobservableDirection(words="all", vector=torch.ones(1)),),
        warnings=(),
    )
    read = json.loads(as_json(check_dict(check)))
    assert list(read) == ["frames", "parameters", "unobservable", "warnings"]
    assert read["frames"][0]["predicted_median_range_m"] is None
    assert read["unobservable"] == [{"words": "all", "vector": [1.0]}]


@pytest.fixture
def arm_calibration(tmp_path):
    """The same answer with a robot that carries the sensor."""
    file = tmp_path / "arm.urdf"
    file.write_text(
        '<robot name="arm"><link name="root"/><link name="tool"/>'
        '<joint name="turn" type="revolute"><parent link="root"/><child link="tool"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>',
        encoding="utf-8",
    )
    whole = calibration()
    frames = [
        dataclasses.replace(frame, joints=torch.zeros(1, dtype=torch.float64))
        for frame in whole.job.frames
    ]
    robot, T = load_robot(file), se3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.2]).double())
    return dataclasses.replace(
        whole,
        job=dataclasses.replace(whole.job, robot=robot, link="tool", frames=tuple(frames)),
        estimate=dataclasses.replace(whole.estimate, T_world_base=T),
    )


def test_base_and_mount_are_given_with_a_robot(arm_calibration):
    parameters = result_dict(arm_calibration)["parameters"]
    assert list(parameters) == ["base", "mount", "joints", "objects", "range"]
    assert parameters["base"]["T_world_base"] == arm_calibration.estimate.T_world_base.tolist()
    assert parameters["mount"]["position_sigma_m"] == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(parameters["base"]["position_sigma_m"], [1e-3, 2e-3, 0.0])


def test_corrected_urdf_places_the_base(arm_calibration, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    write_results(arm_calibration, folder)
    read = load_robot(folder / "robot.urdf")
    poses = read.forward_kinematics(torch.zeros(1, 1, dtype=torch.float64))
    T_world_root = poses[0, read.link_index("root")]
    torch.testing.assert_close(T_world_root, arm_calibration.estimate.T_world_base)


def test_every_block_has_its_entry_with_its_sigma():
    """Values of a calibration in which joints, an object and the range were unknown."""
    known = calibration()
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = 0.25
    names = ("joints.elbow", *(f"objects.wall.{axis}" for axis in AXES), "range.offset")
    variances = torch.arange(1.0, 9.0, dtype=torch.float64).square()
    estimate = replace(
        known.estimate,
        names=names,
        covariance=variances.diag(),
        joint_offsets={"elbow": 0.02},
        Ts_world_object={"wall": T},
        range_offset=0.003,
        range_scale=0.0,
    )
    job = replace(known.job, range=RangePrior(offset_sigma=0.01, scale_sigma=0.0))
    parameters = result_dict(replace(known, estimate=estimate, job=job))["parameters"]
    assert parameters["joints"] == {"elbow": {"offset": 0.02, "sigma": 1.0}}
    assert parameters["objects"] == {
        "wall": {
            "T_world_object": T.tolist(),
            "position_sigma_m": [2.0, 3.0, 4.0],
            "rotation_sigma_rad": [5.0, 6.0, 7.0],
        }
    }
    assert parameters["range"] == {
        "offset_m": 0.003,
        "scale": 0.0,
        "offset_sigma_m": 8.0,
        "scale_sigma": 0.0,
    }


def test_an_object_that_moved_says_where_to():
    known = calibration()
    T = se3.exp(torch.tensor([0.1, 0.2, 0.3, 0.1, 0.0, 0.2], dtype=torch.float64))
    verdict = ObjectVerdict(
        verdict=Verdict.MOVED, agree=9, seen_through=0, hidden=0, T_world_object=T
    )
    update = replace(known.update, verdicts={**known.update.verdicts, "wall": verdict})
    objects = result_dict(replace(known, update=update))["objects"]
    assert objects["wall"]["T_world_object"] == T.tolist()
