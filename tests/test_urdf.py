"""Reading URDF: every mistake is one clear error that names its key and what is possible."""

from pathlib import Path

import pytest

from torchcal.errors import JobError
from torchcal.model.robot import load_robot


def joint(
    name: str = "j", kind: str = "fixed", parent: str = "a", child: str = "b", inside: str = ""
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inside}</joint>'


def robot(*inside: str, links: str = "ab") -> str:
    return (
        f'<robot name="r">{"".join(f"<link name={chr(34)}{name}{chr(34)}/>" for name in links)}'
        + (f"{''.join(inside)}</robot>")
    )


def visual(geometry: str, extra: str = "") -> str:
    shape = f"<visual>{extra}<geometry>{geometry}</geometry></visual>"
    return f'<robot name="r"><link name="a">{shape}</link></robot>'


def write(folder: Path, text: str) -> Path:
    file = folder / "robot.urdf"
    file.write_text(text)
    return file


LIMIT = '<limit lower="-1" upper="1"/>'

MISTAKES = {
    "not XML": ("<robot", "", "unclosed token", "<robot>"),
    "no URDF": ("<sdf/>", "", "<sdf>", "<robot>"),
    "xacro": (
        '<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include/></robot>',
        "",
        "xacro",
        "run xacro",
    ),
    "entities": ('<!DOCTYPE r [<!ENTITY a "aa">]><robot name="&a;"/>', "", "DOCTYPE", "<robot>"),
    "no links": ('<robot name="r"/>', "", "no links", "one tree"),
    "two roots": (robot(), "", "2 root links (a, b)", "one root link"),
    "cycle": (robot(joint(), joint("k", parent="b", child="a")), "", "0 root links", "one tree"),
    "cycle beside": (
        robot(joint(), joint("k", parent="b", child="a"), links="abc"),
        "",
        "a cycle through a, b",
        "one tree",
    ),
    "two parents": (
        robot(joint(parent="a", child="c"), joint("k", parent="b", child="c"), links="abc"),
        "joint.j.child",
        "'c'",
        "one parent",
    ),
    "unknown parent": (robot(joint(parent="x")), "joint.j.parent", "'x'", "one of a, b"),
    "unknown child": (robot(joint(child="x")), "joint.j.child", "'x'", "one of a, b"),
    "link twice": (robot(links="aa"), "link.a", "twice", "one link"),
    "joint twice": (robot(joint(), joint(child="c"), links="abc"), "joint.j", "twice", "one joint"),
    "planar": (robot(joint(kind="planar")), "joint.j.type", "'planar'", "continuous, fixed"),
    "floating": (robot(joint(kind="floating")), "joint.j.type", "'floating'", "prismatic"),
    "no type": (robot(joint(kind="")), "joint.j.type", "''", "revolute"),
    "axis zero": (
        robot(joint(kind="continuous", inside='<axis xyz="0 0 0"/>')),
        "joint.j.axis.xyz",
        "'0 0 0'",
        "not 0",
    ),
    "no limits": (robot(joint(kind="revolute")), "joint.j.limit", "nothing", "revolute"),
    "limits turned": (
        robot(joint(kind="prismatic", inside='<limit lower="1" upper="-1"/>')),
        "joint.j.limit",
        "lower 1",
        "lower <= upper",
    ),
    "words for numbers": (
        robot(joint(inside='<origin xyz="0 0 up"/>')),
        "joint.j.origin.xyz",
        "'0 0 up'",
        "3 finite numbers",
    ),
    "not finite": (
        robot(joint(inside='<origin xyz="0 0 nan"/>')),
        "joint.j.origin.xyz",
        "nan",
        "3 finite numbers",
    ),
    "mimic of nothing": (
        robot(joint(kind="revolute", inside=f'{LIMIT}<mimic joint="x"/>')),
        "joint.j.mimic.joint",
        "'x'",
        "one of j",
    ),
    "mimic of itself": (
        robot(joint(kind="revolute", inside=f'{LIMIT}<mimic joint="j"/>')),
        "joint.j.mimic.joint",
        "circle",
        "does not follow",
    ),
    "capsule": (visual("<capsule/>"), "link.a.visual[0].geometry", "<capsule>", "box, cylinder"),
    "no geometry": (visual(""), "link.a.visual[0].geometry", "nothing", "box, cylinder"),
    "flat box": (
        visual('<box size="1 1 0"/>'),
        "link.a.visual[0].geometry.box",
        "1 1 0",
        "above 0",
    ),
    "no radius": (visual("<sphere/>"), "link.a.visual[0].geometry.sphere", "no radius", "radius"),
    "mesh missing": (
        visual('<mesh filename="no.stl"/>'),
        "link.a.visual[0].geometry.mesh.filename",
        "no.stl",
        "existing file",
    ),
    "mesh elsewhere": (
        visual('<mesh filename="https://example.org/a.stl"/>'),
        "link.a.visual[0].geometry.mesh.filename",
        "https://example.org/a.stl",
        "nothing is fetched",
    ),
    "package missing": (
        visual('<mesh filename="package://nowhere/a.stl"/>'),
        "link.a.visual[0].geometry.mesh.filename",
        "package://nowhere/a.stl",
        "package folder nowhere",
    ),
    "mesh of another format": (
        visual('<mesh filename="robot.urdf"/>'),
        "link.a.visual[0].geometry.mesh.filename",
        "robot.urdf",
        ".dae, .obj, .stl",
    ),
}


@pytest.mark.parametrize(("text", "key", "found", "expected"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_names_key_and_choices(
    text: str, key: str, found: str, expected: str, tmp_path: Path
):
    file = write(tmp_path, text)
    with pytest.raises(JobError) as caught:
        load_robot(file)
    error = caught.value
    assert (error.file, error.key) == (file, key)
    assert found in error.found
    assert expected in error.expected


def test_a_missing_file_is_a_job_error(tmp_path: Path):
    with pytest.raises(JobError, match=r"no\.urdf: found no such file"):
        load_robot(tmp_path / "no.urdf")
