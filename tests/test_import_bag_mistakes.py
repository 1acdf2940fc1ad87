"""Bags that lack something, are broken, or leave a choice: what is said of each."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from arm_bag import (
    DEPTH,
    FRAME,
    HEIGHT,
    JOINTS,
    MATRIX,
    WIDTH,
    arm,
    depth,
    imported,
)
from bags import KINDS, Messages, write_bag

from torchcal.errors import JobError, TorchcalError
from torchcal.model.read_job import read_job
from torchcal.model.recordings.import_recording import import_recording
from torchcal.model.recordings.recorded import Selection
from torchcal.model.recordings.transforms import transforms_of


def test_clocks_that_differ_are_told_and_the_recorders_is_taken(tmp_path: Path):
    m = Messages("sqlite3")
    made = imported(tmp_path, arm(m, clock=-3600.0), m)
    assert any("clocks of" in note and "differ by 3.6e+03 s" in note for note in made.notes)
    assert made.frames == 3


def test_clocks_that_nearly_agree_are_those_of_the_senders(tmp_path: Path):
    m = Messages("sqlite3")
    made = imported(tmp_path, arm(m, clock=0.2), m)
    assert not any("clocks of" in note for note in made.notes)
    assert any("at most 30.0 ms" in note for note in made.notes)


def test_joints_and_images_of_different_times_are_a_mistake(tmp_path: Path):
    m = Messages("mcap")
    late = [(JOINTS, 100.0 + k, m.joints(m.header(100.0 + k), {"shoulder": 0.1})) for k in range(3)]
    late += arm(m, without=(JOINTS,))
    with pytest.raises(JobError, match=r"no image within 0.5 s of joints .* 92\.\d s away"):
        imported(tmp_path, late, m)


def test_a_bag_without_joints_says_which_it_lacks(tmp_path: Path):
    m = Messages("mcap")
    with pytest.raises(JobError, match=r"no sensor_msgs/JointState; expected .* shoulder, elbow"):
        imported(tmp_path, arm(m, without=(JOINTS,)), m)


def test_a_bag_without_images_lists_what_it_has(tmp_path: Path):
    m = Messages("ros1")
    with pytest.raises(JobError, match=r"/camera/depth/camera_info, /joint_states.*16UC1"):
        imported(tmp_path, arm(m, without=(DEPTH,)), m)


def test_of_several_depth_topics_the_one_with_a_camera_is_taken(tmp_path: Path):
    m = Messages("mcap")
    other = ("/other/depth", 0.1, m.image(m.header(0.1, "other"), depth(0), "16UC1"))
    assert imported(tmp_path, [*arm(m), other], m).frames == 3


def two_cameras(m: Messages) -> list:
    image = m.image(m.header(0.53, FRAME), depth(700), "16UC1")
    info = m.camera(m.header(0.0, FRAME), (WIDTH, HEIGHT), MATRIX)
    return [*arm(m), ("/left/depth", 0.53, image), ("/left/camera_info", 0.0, info)]


def test_of_several_cameras_a_person_has_to_choose(tmp_path: Path):
    m = Messages("mcap")
    expected = r"2 topics .*: /camera/depth/image_rect_raw, /left/depth; expected --use TOPIC"
    with pytest.raises(JobError, match=expected):
        imported(tmp_path, two_cameras(m), m)


def test_the_chosen_topic_is_read(tmp_path: Path):
    m = Messages("mcap")
    made = imported(tmp_path, two_cameras(m), m, selection=Selection(use=("/left/depth",)))
    assert float(read_job(made.job).frames[0].image.range[3, 3]) == 1.7


def test_a_topic_that_is_not_there_is_answered_with_those_that_are(tmp_path: Path):
    m = Messages("mcap")
    with pytest.raises(JobError, match=r"/depth: found no such topic; expected one of /camera"):
        imported(tmp_path, arm(m), m, selection=Selection(use=("/depth",)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_bag_is_one_clear_error(tmp_path: Path, kind: str):
    m = Messages(kind)
    source = write_bag(tmp_path, m, arm(m))
    file = source if source.is_file() else next(f for f in source.glob("*") if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(JobError, match=r"a recording that cannot be read .* whole bag of ROS 1"):
        import_recording(source, tmp_path)


def test_without_the_library_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    m = Messages("ros1")
    source = write_bag(tmp_path, m, arm(m))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(TorchcalError, match=r'pip install "torchcal\[bags\]"'):
        import_recording(source, tmp_path)


def test_a_sensor_that_hangs_on_no_link_asks_for_it(tmp_path: Path):
    m = Messages("mcap")
    content = arm(m, without=("/tf_static",))
    with pytest.raises(JobError, match=r"'depth_optical_frame', .* expected --link: one of .*tool"):
        imported(tmp_path, content, m)


def test_a_robot_that_never_stands_still_is_told(tmp_path: Path):
    m = Messages("mcap")
    moving = [
        (JOINTS, 0.1 * k, m.joints(m.header(0.1 * k), {"shoulder": 0.01 * k})) for k in range(80)
    ]
    made = imported(tmp_path, [*arm(m, without=(JOINTS,)), *moving], m)
    assert made.notes[0].startswith("WARNING: the joints never stood still")


def test_a_robot_that_never_moves_is_told(tmp_path: Path):
    m = Messages("mcap")
    still = [(JOINTS, 0.1 * k, m.joints(m.header(0.1 * k), {"shoulder": 0.3})) for k in range(80)]
    made = imported(tmp_path, [*arm(m, without=(JOINTS,)), *still], m)
    assert "WARNING: the joints never moved" in made.notes
    assert made.frames == 1


def moved(seconds: float, w: float) -> SimpleNamespace:
    """A message of ``tf`` with one transform."""
    turn, shift = SimpleNamespace(w=w, x=0.0, y=0.0, z=0.0), SimpleNamespace(x=1.0, y=2.0, z=3.0)
    header = SimpleNamespace(frame_id="/map", seconds=seconds)
    pose = SimpleNamespace(translation=shift, rotation=turn)
    each = SimpleNamespace(child_frame_id="camera", header=header, transform=pose)
    return SimpleNamespace(transforms=[each])


def test_quaternions_of_length_0_are_left_out_as_ros_leaves_them_out():
    messages = [(k, moved(k, w)) for k, w in enumerate((1.0, 0.0, float("nan"), 1.0))]
    tree = transforms_of(messages, lambda received, _: received)
    assert tree.edges["camera"].times.tolist() == [0, 3]


def test_a_frame_without_a_rigid_motion_is_a_mistake():
    with pytest.raises(ValueError, match=r"from map with \[1.0, 2.0, 3.0, 0.0.*a rigid motion"):
        transforms_of([(0, moved(0, 0.0))], lambda received, _: received)
