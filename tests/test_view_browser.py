"""The view in a real browser: it loads, sliders change the picture, a button decides."""

import base64
import io
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from display_scene import calibration
from PIL import Image

from torchcal.calibrate.compare import reclassified
from torchcal.calibrate.decisions import Decision
from torchcal.calibrate.result_folder import decide, read_result
from torchcal.cli.result_files import write_results
from torchcal.display.view.pictures import hybrid_picture, raw_picture
from torchcal.display.view.source import FolderSource
from torchcal.model.world import World, WorldObject

FLAGS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
]
PATIENCE = 120.0
"""Seconds: a browser without a GPU, on a machine that does other things."""
SCENE = (790, 450)
"""Pixels of the window: the middle of the scene, between the panels."""

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A result: a wall before the sensor, a crate that is gone behind it, something new."""
    whole = calibration(("0001", "0002"))
    objects = tuple(
        WorldObject(name=name, mesh=trimesh.creation.box(sides), T_world_object=at(z))
        for name, sides, z in (("wall", (8, 8, 0.1), 2.6), ("crate", (0.2, 0.2, 0.2), -5.0))
    )
    job = replace(whole.job, world=World(objects=objects))
    write_results(replace(whole, job=job), tmp_path / "out")
    return tmp_path / "out"


def at(z: float) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[2, 3] = z
    return T


@pytest.fixture
def browser() -> Iterator[Any]:
    """Chromium without a window."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("needs the program chromium")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=program, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def view(folder: Path) -> Iterator[Any]:
    """The folder as ``torchcal view`` serves it."""
    pytest.importorskip("viser", reason="needs viser, the extra view")
    app = pytest.importorskip("torchcal.display.view.app")
    window = app.View(FolderSource(folder), host="127.0.0.1", port=8650)
    yield window
    window.stop()


@pytest.fixture
def page(view, browser) -> Any:
    """The view, loaded."""
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.set_default_timeout(1000.0 * PATIENCE)
    page.goto(view.address)
    page.get_by_role("button", name="Accept").wait_for()
    return page


def shown(page: Any) -> np.ndarray:
    """The picture beside the scene, as the browser has it."""
    url = page.evaluate(
        """() => {
            const images = [...document.querySelectorAll('img')];
            const image = images.sort((a, b) => b.naturalWidth - a.naturalWidth)[0];
            const canvas = document.createElement('canvas');
            canvas.width = Math.max(1, image.naturalWidth);
            canvas.height = Math.max(1, image.naturalHeight);
            canvas.getContext('2d').drawImage(image, 0, 0);
            return canvas.toDataURL('image/png');
        }"""
    )
    picture = Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2])))
    return np.asarray(picture.convert("RGB"))


def comes(true: Callable[[], bool]) -> bool:
    """Whether something becomes true before patience ends."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.2)
    return False


def shows(page: Any, expected: np.ndarray) -> bool:
    """Whether the picture becomes the expected one, pixel by pixel."""
    return comes(lambda: np.array_equal(shown(page), expected))


def test_a_person_sees_changes_and_decides_in_a_browser(folder, view, page):
    first, second = read_result(folder).comparisons
    assert shows(page, hybrid_picture(reclassified(first, 3.0)))
    text = page.inner_text("body")
    assert "256 pixels see through it" in text
    assert "measured nearer than the model" in text

    page.get_by_role("slider").nth(1).focus()  # alpha
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    assert shows(page, hybrid_picture(reclassified(first, 5.0)))
    page.get_by_role("slider").nth(0).focus()  # frame
    page.keyboard.press("ArrowRight")
    assert shows(page, hybrid_picture(reclassified(second, 5.0)))

    page.keyboard.press("r")
    assert shows(page, raw_picture(second))
    assert not view.settings.shows_model
    page.keyboard.press("r")
    assert comes(lambda: view.settings.shows_model)

    page.get_by_role("button", name="Accept").click()
    assert comes(lambda: "Decision: accepted" in page.inner_text("body"))
    assert read_result(folder).transaction.decisions["crate"] == Decision.ACCEPTED
    page.get_by_role("button", name="Reject").click()
    assert comes(lambda: "Decision: rejected" in page.inner_text("body"))
    assert read_result(folder).transaction.decisions["crate"] == Decision.REJECTED


def test_a_click_asks_about_an_object_and_decisions_of_others_are_seen(folder, view, page):
    first = read_result(folder).comparisons[0]
    assert shows(page, hybrid_picture(reclassified(first, 3.0)))
    assert view.settings.selected == "crate"

    def clicked() -> bool:
        page.mouse.click(*SCENE)
        return comes_soon(lambda: view.settings.selected == "wall")

    assert comes(clicked)
    assert comes(lambda: "900 pixels agree" in page.inner_text("body"))
    assert page.get_by_role("button", name="Accept").is_disabled()
    decide(folder, accept=["added-1"])
    view.refresh()
    assert comes(lambda: "accepted" in page.inner_text("body"))


def comes_soon(true: Callable[[], bool]) -> bool:
    """Whether something becomes true within a few seconds."""
    for _ in range(20):
        if true():
            return True
        time.sleep(0.2)
    return False
