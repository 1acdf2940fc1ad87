"""Make the README's picture from what ``torchcal demo`` left behind.

Two hybrid views side by side, one with what was added to the cell and one with what was removed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from PIL import Image

FRAMES = ("0002", "0004")
"""They show the drum that the model does not know, and the crate that is gone."""
WIDTH = 1200
"""Pixels of the picture."""


@dataclass(frozen=True)
class Args:
    """Where the demo's result is and where the picture goes."""

    demo: Path = Path("torchcal-demo")
    """The folder that ``torchcal demo`` wrote."""
    out: Path = Path(__file__).parents[1] / "docs" / "hybrid.png"
    """The picture."""


def side_by_side(views: Sequence[Image.Image]) -> Image.Image:
    """The views in one row, scaled to ``WIDTH``."""
    row = Image.new("RGB", (sum(view.width for view in views), max(view.height for view in views)))
    left = 0
    for view in views:
        row.paste(view, (left, 0))
        left += view.width
    return row.resize((WIDTH, round(row.height * WIDTH / row.width)), Image.Resampling.LANCZOS)


def main(args: Args) -> None:
    views = [Image.open(args.demo / "result" / "hybrid" / f"{name}.png") for name in FRAMES]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    side_by_side(views).save(args.out, optimize=True)
    print(f"{args.out}: {args.out.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
