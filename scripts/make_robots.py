"""Make the meshes of the arm in robots/arm.

Every link is made of solids of revolution and capsules with rounded edges, in the link's own frame
(m). The rover needs no meshes. Running this again writes the same files.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro
from trimesh.exchange.dae import export_collada
from trimesh.exchange.obj import export_obj
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from torchcal.model.meshes import merged

X_AXIS, Y_AXIS, Z_AXIS = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
BLUE, STEEL = (38, 92, 150, 255), (168, 174, 180, 255)
BLACK = (36, 38, 42, 255)
SECTIONS = 32
"""Around a solid of revolution: a chord leaves a radius of 50 mm by 0.24 mm."""


@dataclass(frozen=True)
class Args:
    """Where the robots are."""

    out: Path = Path(__file__).parents[1] / "robots"
    """The folder that holds arm/."""


def turned(
    profile: Sequence[tuple[float, float]],
    axis: tuple[float, float, float] = Z_AXIS,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sections: int = SECTIONS,
) -> trimesh.Trimesh:
    """A solid of revolution of (radius, height) points, its axis turned from z and moved."""
    solid = trimesh.creation.revolve(np.asarray(profile), sections=sections)
    solid.apply_transform(trimesh.geometry.align_vectors(Z_AXIS, axis))
    return solid.apply_translation(at)


def drum(
    radius: float, low: float, high: float, fillet: float = 0.008
) -> list[tuple[float, float]]:
    """The profile of a cylinder with rounded edges from height ``low`` to ``high``."""
    inner, angles = radius - fillet, np.radians([0.0, 30.0, 60.0, 90.0])
    bottom = [
        (inner + fillet * np.sin(angle), low + fillet * (1 - np.cos(angle))) for angle in angles
    ]
    top = [(r, high + low - z) for r, z in reversed(bottom)]
    return [(0.0, low), *bottom, *top, (0.0, high)]


def rounded_box(
    size: tuple[float, float, float], at: tuple[float, float, float]
) -> trimesh.Trimesh:
    """The hull of eight small spheres."""
    radius = 0.2 * min(size)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * (np.asarray(size) - 2 * radius)
    points = (corners[:, None] + ball.vertices[None]).reshape(-1, 3)
    return trimesh.convex.convex_hull(points).apply_translation(at)


def base() -> list[trimesh.Trimesh]:
    """A flange and a tapered foot, up to 0.12."""
    foot = [(0.0, 0.0), (0.1, 0.0), (0.1, 0.016), (0.096, 0.02), (0.078, 0.022), (0.07, 0.04)]
    bolt = drum(0.008, 0.018, 0.026, 0.002)
    bolts = [
        turned(bolt, at=(0.087 * np.cos(a), 0.087 * np.sin(a), 0.0), sections=12)
        for a in np.radians([45.0, 135.0, 225.0, 315.0])
    ]
    return [turned([*foot, (0.066, 0.1), (0.066, 0.117), (0.063, 0.12), (0.0, 0.12)]), *bolts]


def shoulder() -> list[trimesh.Trimesh]:
    """A turret on the base and the drum of the shoulder joint, whose axis is y at height 0.09."""
    return [
        turned(drum(0.066, 0.002, 0.08)),
        turned(drum(0.065, -0.07, 0.058), Y_AXIS, (0.0, 0.0, 0.09)),
    ]


def upper_arm() -> list[trimesh.Trimesh]:
    """Beside the shoulder: a tube of 0.4 between two drums."""
    tube = [
        (0.0, 0.0),
        (0.05, 0.0),
        (0.047, 0.1),
        (0.042, 0.2),
        (0.042, 0.3),
        (0.046, 0.4),
        (0.0, 0.4),
    ]
    return [
        turned(drum(0.063, 0.06, 0.175), Y_AXIS),
        turned(tube, at=(0.0, 0.118, 0.0)),
        turned(drum(0.056, 0.06, 0.17), Y_AXIS, (0.0, 0.0, 0.4)),
    ]


def forearm() -> list[trimesh.Trimesh]:
    """The drum of the elbow and a tapered tube up to 0.2."""
    tube = [(0.0, 0.0), (0.046, 0.0), (0.044, 0.08), (0.039, 0.14), (0.039, 0.196), (0.036, 0.199)]
    return [turned(drum(0.054, -0.06, 0.058), Y_AXIS), turned([*tube, (0.0, 0.199)])]


def wrist_1() -> list[trimesh.Trimesh]:
    """A tube that ends in a fork around the axis y at height 0.2."""
    tube = [
        (0.0, 0.001),
        (0.036, 0.001),
        (0.039, 0.004),
        (0.039, 0.1),
        (0.046, 0.135),
        (0.046, 0.145),
    ]
    cheeks = [rounded_box((0.055, 0.016, 0.1), (0.0, side * 0.042, 0.175)) for side in (-1, 1)]
    caps = [
        turned(drum(0.026, side * 0.05 - 0.006, side * 0.05 + 0.006, 0.003), Y_AXIS, (0, 0, 0.2))
        for side in (-1, 1)
    ]
    return [turned([*tube, (0.04, 0.15), (0.0, 0.15)]), *cheeks, *caps]


def wrist_2() -> list[trimesh.Trimesh]:
    """The drum between the cheeks and a neck up to 0.07."""
    neck = [(0.0, 0.0), (0.026, 0.0), (0.026, 0.05), (0.034, 0.06), (0.034, 0.069), (0.0, 0.069)]
    return [turned(drum(0.032, -0.032, 0.032), Y_AXIS), turned(neck)]


def wrist_3() -> list[trimesh.Trimesh]:
    """The tool flange and the arm that holds the camera at x = 0.08."""
    return [
        turned(drum(0.036, 0.001, 0.03, 0.004)),
        rounded_box((0.06, 0.024, 0.012), (0.055, 0.0, 0.012)),
    ]


def camera() -> list[trimesh.Trimesh]:
    """A bar along y that looks along z; its front is at z = 0."""
    lens = drum(0.008, -0.004, 0.001, 0.001)
    lenses = [turned(lens, at=(0.0, y, 0.0), sections=16) for y in (-0.03, 0.0, 0.03)]
    return [rounded_box((0.026, 0.092, 0.026), (0.0, 0.0, -0.013)), *lenses]


def write_stl(file: Path, parts: Sequence[trimesh.Trimesh]) -> None:
    """Binary STL; the URDF gives the colour."""
    merged(parts).export(file)


def write_obj(file: Path, parts: Sequence[trimesh.Trimesh], colour: tuple[int, ...]) -> None:
    """OBJ with its colour in a material file beside it."""
    mesh = merged(parts)
    material = SimpleMaterial(diffuse=np.asarray(colour, np.uint8), name=file.stem)
    mesh.visual = TextureVisuals(material=material)
    name = file.with_suffix(".mtl").name
    text, materials = export_obj(
        mesh,
        return_texture=True,
        mtl_name=name,
        include_normals=False,
        digits=6,
        header="made by scripts/make_robots.py",
    )
    file.write_text(text)
    lines = materials[name].decode().splitlines()
    kept = [line for line in lines if line and not line.startswith("#")]
    file.with_name(name).write_text("\n".join(kept) + "\n")


def write_dae(
    file: Path, parts: Sequence[trimesh.Trimesh], colours: Sequence[tuple[int, ...]]
) -> None:
    """COLLADA in metres with a colour for each part; without the dates and random names."""
    for part, colour in zip(parts, colours, strict=True):
        part.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=colour))
    text = export_collada(list(parts)).decode()
    names = dict.fromkeys(re.findall(r"\b[0-9a-f]{32}\b", text))
    for index, name in enumerate(names):
        text = text.replace(name, f"part{index}")
    text = re.sub(r"(<(created|modified)>).*?(</)", r"\g<1>2000-01-01T00:00:00\3", text)
    unit = '<unit name="meter" meter="1"/>\n    <up_axis>Z_UP</up_axis>'
    file.write_text(text.replace("<up_axis>Y_UP</up_axis>", unit))


def main(args: Args) -> None:
    """Writes every mesh of the arm."""
    folder = args.out / "arm" / "meshes"
    folder.mkdir(parents=True, exist_ok=True)
    solids = (base, shoulder, forearm, wrist_2)
    for make in solids:
        write_stl(folder / f"{make.__name__}.stl", make())
    write_obj(folder / "upper_arm.obj", upper_arm(), BLUE)
    write_obj(folder / "wrist_1.obj", wrist_1(), BLUE)
    write_obj(folder / "wrist_3.obj", wrist_3(), STEEL)
    bar, *lenses = camera()
    write_dae(folder / "camera.dae", [bar, *lenses], [STEEL] + [BLACK] * len(lenses))
    for file in sorted(folder.iterdir()):
        print(f"{file.relative_to(args.out)}  {file.stat().st_size / 1000:.1f} kB")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
