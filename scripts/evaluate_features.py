"""Measure the extraction of planes and lines against what a ray caster says is to be seen.

Range images of a hall full of machinery (512 x 512, 50 degrees, a beam of 21 pixels, sigma 5 cm)
from random places; and, where they are, real images with labelled parts.
"""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from torchcal import LineKind, Noise, Pinhole, Sensor, image_features
from torchcal.demo import machine_hall, raycast
from torchcal.demo.feature_score import line_nees, plane_nees, score_lines
from torchcal.demo.labelled_parts import part_scores
from torchcal.demo.visible_edges import visible_edges

FOCAL = 256 / math.tan(math.radians(25.0))
HALL = Sensor(
    projection=Pinhole(width=512, height=512, fx=FOCAL, fy=FOCAL, cx=255.5, cy=255.5),
    noise=Noise(a=0.05),
    near=0.3,
    far=20.0,
    beam=21,
)


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to measure."""

    views: int = 10
    """Random views of the hall."""
    seed: int = 0
    json: Path | None = None
    """Where the figures go."""
    picture: Path | None = None
    """Where a picture of the last view goes."""
    parts: Path | None = None
    """A folder of real images with labelled parts (.npz: depth in m, label)."""


def main(args: Args) -> None:
    meshes = [
        item.mesh.copy().apply_transform(item.T_world_object.numpy())
        for item in machine_hall.machine_hall().objects
    ]
    rng = torch.Generator().manual_seed(args.seed)
    noise = np.random.default_rng(args.seed)
    views = [_view(meshes, rng, noise, args.picture) for _ in range(args.views)]
    figures = {"hall": _together(views), "views": views}
    if args.parts is None:
        print("parts: left out without --parts DIR")
    else:
        figures["parts"] = part_scores(args.parts)
    for name in ("hall", "parts"):
        for key, value in figures.get(name, {}).items():
            print(f"{name:6} {key:24} {value:10.3f}")
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1))


def _view(
    meshes: list, rng: torch.Generator, noise: np.random.Generator, picture: Path | None
) -> dict[str, Any]:
    T_world_sensor = machine_hall.random_view(rng).numpy()
    scene = raycast.view(meshes, T_world_sensor)
    ranges = raycast.measure(raycast.predict(scene, HALL.projection, HALL.beam), HALL, noise)
    edges = visible_edges(
        meshes, T_world_sensor, HALL.projection, dihedral=math.radians(20.0), jump=0.3
    )
    start = time.process_time()
    features = image_features(torch.from_numpy(ranges), HALL)
    seconds = time.process_time() - start
    pixels = HALL.projection.pixels(features.lines.ends).numpy()
    score = score_lines(pixels, edges, longest=60.0, beam=HALL.beam)
    planes, off = plane_nees(features.planes.elements, scene, HALL.projection)
    lines = line_nees(features.lines.elements, score.edge, edges)
    if picture:
        _draw(picture, ranges, edges.pixels[edges.strong > 60], pixels, score.edge)
    jump = features.lines.kind.numpy()[score.edge >= 0] == LineKind.JUMP
    return {
        "edges": len(score.found),
        "edges_found": int(score.found.sum()),
        "alone": int(score.alone.sum()),
        "alone_found": int((score.alone & score.found).sum()),
        "lines": len(pixels),
        "lines_spurious": int((score.edge < 0).sum()),
        "planes": features.planes.elements.count,
        "planes_spurious": int((off > 0.1).sum()),
        "vertices": features.vertices.elements.count,
        "crease_nees": lines[~jump].tolist(),
        "jump_nees": lines[jump].tolist(),
        "plane_nees": planes[off <= 0.1].tolist(),
        "cpu_seconds": seconds,
    }


def _together(views: list[dict[str, Any]]) -> dict[str, float]:
    def total(key: str) -> int:
        return sum(each[key] for each in views)

    figures: dict[str, float] = {
        "edges_found_percent": 100.0 * total("edges_found") / total("edges"),
        "alone_found_percent": 100.0 * total("alone_found") / total("alone"),
        "lines_spurious_percent": 100.0 * total("lines_spurious") / total("lines"),
    }
    for key in ("crease_nees", "jump_nees", "plane_nees"):
        values = np.concatenate([each[key] for each in views])
        figures[f"{key}_mean"] = float(values.mean())
        figures[f"{key}_median"] = float(np.median(values))
    for key in ("edges", "alone", "lines", "planes", "planes_spurious", "vertices", "cpu_seconds"):
        figures[f"{key}_mean"] = total(key) / len(views)
    return figures


def _draw(
    file: Path, ranges: np.ndarray, edges: np.ndarray, lines: np.ndarray, edge: np.ndarray
) -> None:
    import matplotlib.pyplot as plt  # noqa: PLC0415

    figure, axes = plt.subplots(figsize=(10, 10))
    axes.imshow(ranges, cmap="gray")
    for ends in edges:
        axes.plot(*ends.T, "w", lw=1)
    for ends, own in zip(lines, edge, strict=True):
        axes.plot(*ends.T, "y" if own >= 0 else "r", lw=2)
    axes.axis("off")
    figure.savefig(file, bbox_inches="tight")
    plt.close(figure)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
