"""Make the README's picture of ``torchcal view``: a demo's result in Chromium without a window.

Needs the extra ``view``, playwright and the program chromium.
"""

import io
import shutil
from dataclasses import dataclass
from pathlib import Path

import tyro
from PIL import Image

import torchcal

FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
)
COLOURS = 256
"""Of the picture: half the size, and hardly a difference that one sees."""
WIDTH, HEIGHT = 1500, 900
"""Pixels of the browser's window."""


@dataclass(frozen=True)
class Args:
    """What is shown and where the picture goes."""

    result: Path = Path("torchcal-demo") / "result"
    """The folder of a calibration."""
    out: Path = Path(__file__).parents[1] / "docs" / "view.png"
    """The picture."""
    frame: int = 4
    """The frame that is shown, from 1."""
    patience: float = 20.0
    """Seconds until everything is drawn."""


def screenshot(address: str, args: Args) -> Image.Image:
    """The view of one frame."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415, --help needs no browser

    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        raise torchcal.TorchcalError(
            "found no program chromium; expected one to take the picture with"
        )
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(300_000.0)
        page.goto(address)
        page.get_by_role("button", name="Accept").wait_for()
        page.get_by_role("slider").first.focus()
        for _ in range(args.frame - 1):
            page.keyboard.press("ArrowRight")
        page.wait_for_timeout(1000.0 * args.patience)
        for close in page.locator(".mantine-Notification-closeButton").all():
            close.click()
        page.mouse.move(0.0, 0.0)
        page.wait_for_timeout(0.2 * 1000.0 * args.patience)
        picture = Image.open(io.BytesIO(page.screenshot()))
        browser.close()
    return picture.convert("RGB")


def main(args: Args) -> None:
    from torchcal.display.view.app import View  # noqa: PLC0415, --help needs no viser
    from torchcal.display.view.source import FolderSource  # noqa: PLC0415

    view = View(FolderSource(args.result), host="127.0.0.1", port=8640)
    try:
        picture = screenshot(view.address, args)
    finally:
        view.stop()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    palette = picture.quantize(COLOURS)
    dithered = picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
    dithered.save(args.out, optimize=True)
    print(f"{args.out}: {args.out.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
