"""Files that a job may name and that nobody should trust: each gets its own words, or is right."""

import json
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_job
import trimesh
from PIL import Image

from torchcal.errors import JobError
from torchcal.model.read_job import read_job

BOX = trimesh.creation.box((1.0, 1.0, 1.0))

SHAPE = (6, 8)


def depth(values: np.ndarray | float, kind: str) -> Callable[[Path], None]:
    """The second frame's image with these values."""
    return lambda folder: np.save(folder / "b.npy", np.broadcast_to(values, SHAPE).astype(kind))


def node(T: list[float]) -> Callable[[Path], None]:
    """A world of one box at a node with this diagonal, scale and all."""

    def write(folder: Path) -> None:
        scene = trimesh.Scene()
        scene.add_geometry(BOX, node_name="flat", transform=np.diag(T))
        scene.export(folder / "cell.glb")

    return write


def shifted(offset: float) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        BOX.copy().apply_translation([offset, 0, 0]).export(folder / "cell.glb")

    return write


def text(name: str, content: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / name).write_text(content)

    return write


def gltf(uri: str) -> Callable[[Path], None]:
    """A GLB whose triangle lies in another file."""
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": uri, "byteLength": 36}],
    }
    return text("cell.gltf", json.dumps(tree))


def robot(inside: str, before: str = "") -> Callable[[Path], None]:
    return text("arm.urdf", f"{before}<robot name='arm'>{inside}</robot>")


def chain(count: int) -> str:
    links = "".join(f"<link name='l{i}'/>" for i in range(count + 1))
    return links + "".join(
        f"<joint name='j{i}' type='fixed'><parent link='l{i}'/><child link='l{i + 1}'/></joint>"
        for i in range(count)
    )


def mesh(filename: str) -> str:
    shape = f"<geometry><mesh filename='{filename}'/></geometry>"
    return f"<link name='tool'><visual>{shape}</visual></link>"


BOMB = "<!DOCTYPE lol [<!ENTITY a 'ha'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;'>]>"
OUTSIDE = "../../../../../../../../etc/passwd"

# What is wrong: how the file is written, what in the job is replaced by what, what was found and
# what is possible.
MISTAKES = {
    # depth images
    "bytes swapped": (depth(56325, "<u2"), None, "a median of 56.325 m", "depth_unit = 0.001?"),
    "every pixel 65535": (depth(65535, "<u2"), None, "65.535 m, none in", "between 0.3 and 4 m"),
    "millimetres as floats": (depth(1500.0, "<f4"), None, "1500 m", "which floats always are"),
    "centimetres": (depth(150, "<u2"), None, "a median of 0.15 m", "depth_unit = 0.001?"),
    "negative": (depth(-1500, "<i2"), None, "a median of -1.5 m", "between 0.3 and 4 m"),
    "all NaN": (depth(np.nan, "<f4"), None, "every pixel is 0, NaN", "some measured pixels"),
    "64 bits": (depth(2.0**63, "<u8"), None, "none in the range", "depth_unit = 0.001?"),
    "truth values": (depth(1, "bool"), None, "an array of bool", "16-bit integers"),
    "rows for columns": (
        lambda folder: np.save(folder / "b.npy", np.full(SHAPE[::-1], 1.5)),
        None,
        "6x8 pixels (width x height)",
        "8x6, the size of the sensor",
    ),
    "pickled": (
        lambda folder: np.save(folder / "b.npy", np.full(SHAPE, None), allow_pickle=True),
        None,
        "cannot be read (Object arrays",
        "a readable npy file",
    ),
    "cut off": (
        lambda folder: (folder / "b.npy").write_bytes((folder / "b.npy").read_bytes()[:-7]),
        None,
        "cannot be read",
        "a readable npy file",
    ),
    "two pages": (
        lambda folder: Image.new("I;16", (8, 6)).save(
            folder / "two.tif", save_all=True, append_images=[Image.new("I;16", (8, 6))]
        ),
        ("b.npy", "two.tif"),
        "more than one image",
        "with one image",
    ),
    "no image at all": (lambda folder: None, ("a.png", "/dev/zero"), "a device", "a regular file"),
    "text": (text("b.npy", "1.5 1.5"), None, "cannot be read", "a readable npy file"),
    "a name of no file": (
        lambda folder: None,
        ("a.png", "a\\u0000.png"),
        '"a\0.png", a file that does not exist',
        "a file at",
    ),
    "a path that leads outside": (lambda folder: None, ("a.png", OUTSIDE), "passwd", "one of .npy"),
    # the world
    "no bytes": (
        lambda folder: (folder / "cell.glb").write_bytes(b""),
        None,
        "cell.glb, which cannot be read",
        "a file with triangles",
    ),
    "no triangles": (
        lambda folder: trimesh.Scene(trimesh.PointCloud(np.eye(3))).export(folder / "cell.glb"),
        None,
        "no triangles",
        "a scene of meshes",
    ),
    "a flattened node": (node([0, 0, 0, 1]), None, "no triangles", "a scene of meshes"),
    "a node nowhere": (node([1, np.nan, 1, 1]), None, "a coordinate of nan m", "finite numbers"),
    "a world beyond the moon": (shifted(4e8), None, "4e+08 m", "is world.unit = 1 right?"),
    "a world fetched from elsewhere": (
        gltf("https://example.org/x.bin"),
        ("cell.glb", "cell.gltf"),
        "which cannot be read (https://example.org/x.bin)",
        "a file with triangles",
    ),
    "a world from outside its folder": (
        gltf(OUTSIDE),
        ("cell.glb", "cell.gltf"),
        "which cannot be read",
        "a file with triangles",
    ),
    "a program": (
        text("cell.py", "print()"),
        ("cell.glb", "cell.py"),
        "file_type 'py' not supported",
        "a file with triangles",
    ),
    # the robot
    "an entity bomb": (robot("&b;", BOMB), None, "a DOCTYPE (lol)", "a URDF"),
    "another file as an entity": (
        robot("&a;", f"<!DOCTYPE x [<!ENTITY a SYSTEM 'file://{OUTSIDE}'>]>"),
        None,
        "a DOCTYPE (x)",
        "a URDF",
    ),
    "links without end": (robot(chain(300)), None, "300 joints in a chain", "at most 200"),
    "tags without end": (robot("<a>" * 10**5 + "</a>" * 10**5), None, "no links", "one tree"),
    "a mesh from elsewhere": (
        robot(mesh("https://example.org/a.stl")),
        None,
        "https://example.org/a.stl",
        "nothing is fetched",
    ),
    "a mesh that is none": (robot(mesh(OUTSIDE)), None, "passwd", "a mesh file: .dae, .obj, .stl"),
    "a box of light years": (
        text("arm.urdf", tiny_job.urdf().replace("0.1 0.1 0.1", "1e16 1 1")),
        None,
        "'1e16 1 1'",
        "3 finite numbers of at most 1e+06",
    ),
    "a joint of light years": (
        text("arm.urdf", tiny_job.urdf().replace("0 0 0.2", "0 0 1e16")),
        None,
        "'0 0 1e16'",
        "3 finite numbers of at most 1e+06",
    ),
    # the job itself
    "lists without end": (text("cell.py", ""), ("[world]", f"a = {'[' * 5000}"), "nested", "TOML"),
}


@pytest.mark.parametrize(("write", "change", "found", "expected"), MISTAKES.values(), ids=MISTAKES)
def test_a_file_that_cannot_be_used_says_why(tmp_path, no_network, write, change, found, expected):
    old, new = change or ("", "")
    file = tiny_job.write(tmp_path, tiny_job.ARM_JOB.replace(old, new))
    write(tmp_path)
    with pytest.raises(JobError) as caught:
        read_job(file)
    assert found in caught.value.found
    assert expected in caught.value.expected
    assert str(caught.value).isprintable()


FINE = {
    "the other byte order": depth(1500, ">u2"),
    "half precision": depth(1.5, "<f2"),
    "65535 for nothing": depth(np.where(np.eye(*SHAPE), 65535, 1500), "<u2"),
    "a mesh inside out": lambda folder: trimesh.Scene(
        {"crate": BOX.copy().apply_transform(np.diag([-1, -1, -1, 1]))}
    ).export(folder / "cell.glb"),
    "a material in no file": text("cell.obj", "mtllib no.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3"),
}


@pytest.mark.parametrize("write", FINE.values(), ids=FINE)
def test_what_only_looks_odd_is_read(tmp_path, no_network, write):
    job = tiny_job.ARM_JOB
    file = tiny_job.write(tmp_path, job)
    write(tmp_path)
    if (tmp_path / "cell.obj").exists():
        file.write_text(job.replace("cell.glb", "cell.obj"))
    read = read_job(file)
    ranges = read.frames[1].image.range
    np.testing.assert_allclose(ranges[ranges.isfinite()], 1.5)
    assert ranges.isfinite().sum() >= 42
    assert read.world is not None
    assert len(read.world.objects) == 1


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing may be fetched: any socket is an error that no reader may swallow."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a reader opened a socket")

    monkeypatch.setattr(socket, "socket", refuse)
