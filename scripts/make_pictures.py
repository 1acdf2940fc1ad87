"""Make the README's pictures from what ``torchcal demo`` left behind.

``hybrid.png``: two hybrid views side by side, one with what was added to the cell and one with what
was removed. ``comparison.jpg``: how the second came about.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from PIL import Image

FRAMES = ("0002", "0004")
"""They show the drum that the model does not know, and the crate that is gone."""
QUALITY = 85
"""Of the picture that is full of noise, which a PNG would keep grain by grain."""


@dataclass(frozen=True)
class Args:
    """Where the demo's result is and where the pictures go."""

    demo: Path = Path("torchcal-demo")
    """The folder that ``torchcal demo`` wrote."""
    out: Path = Path(__file__).parents[1] / "docs"
    """The folder of the pictures."""


def side_by_side(views: Sequence[Image.Image]) -> Image.Image:
    """The views in one row, as they are: not a pixel of their text is resampled."""
    row = Image.new("RGB", (sum(view.width for view in views), max(view.height for view in views)))
    left = 0
    for view in views:
        row.paste(view, (left, 0))
        left += view.width
    return row


def main(args: Args) -> None:
    result = args.demo / "result"
    pictures = {
        "hybrid.png": [Image.open(result / "hybrid" / f"{name}.png") for name in FRAMES],
        "comparison.jpg": [Image.open(result / "comparison" / f"{FRAMES[-1]}.png")],
    }
    args.out.mkdir(parents=True, exist_ok=True)
    for name, views in pictures.items():
        file = args.out / name
        side_by_side(views).save(file, optimize=True, quality=QUALITY, subsampling=0)
        print(f"{file}: {file.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
