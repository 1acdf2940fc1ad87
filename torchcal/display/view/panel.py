"""The controls of the view and the words and pictures beside it, drawn by viser."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from viser import GuiInputHandle

from torchcal.calibrate.kept_result import Result
from torchcal.calibrate.result import FrameComparison
from torchcal.display.view import words
from torchcal.display.view.settings import (
    ALPHA_STEP,
    LEAST_ALPHA,
    MOST_ALPHA,
    Settings,
    object_names,
)

PICTURE_WIDTH, CONTROL_WIDTH = 560, 380
"""Pixels of the browser's window."""

HINTS: dict[str, str] = {
    "model": "The world and the robot.",
    "measurement": "The measured points in the colours of their classes.",
    "hybrid": "The hybrid image of the frame, or the raw one.",
    "along": "Look over the sensor's shoulder in every frame that you choose.",
}

Change = Callable[[Callable[[Settings], Settings]], None]
"""Takes what a control makes of the settings."""


class Panel:
    """The two panels: the picture on the left, the controls on the right.

    Args:
        gui: viser's.
        result: What is shown first.
        settings: How the controls stand first.
        change: Told what a control changes.
        decide: Told whether the selected object's proposal is accepted.
        can_decide: Without it there are no buttons.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        result: Result,
        settings: Settings,
        *,
        change: Change,
        decide: Callable[[bool], None],
        can_decide: bool,
    ):
        self._gui, self._change, self._decide = gui, change, decide
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(CONTROL_WIDTH)
        pictures = gui.add_panel()
        with pictures.add_tab("Picture"):
            self._picture = gui.add_image(np.full((4, 4, 3), 255, np.uint8), format="png")
        pictures.dock_left()
        pictures.set_width(PICTURE_WIDTH)
        self._headline = gui.add_markdown(words.headline(result))
        self._add_frame(result, settings)
        self._add_switches(settings)
        self._add_objects(result, settings, can_decide)

    def _add_frame(self, result: Result, settings: Settings) -> None:
        """Which frame, and what counts as agreement."""
        with self._gui.add_folder("Frame"):
            last = max(1, len(result.frames))
            self._frame = self._gui.add_slider("Frame", 1, last, 1, min(last, settings.frame + 1))
            self._on(self._frame, lambda s, value: replace(s, frame=int(value) - 1))
            self._alpha = self._gui.add_slider(
                "α (eq. 5)",
                LEAST_ALPHA,
                MOST_ALPHA,
                ALPHA_STEP,
                settings.alpha,
                hint="Standard deviations beyond which the model is not trusted.",
            )
            self._on(self._alpha, lambda s, value: replace(s, alpha=float(value)))
            self._agreement = self._gui.add_markdown("")
            self._legend = self._gui.add_html(words.legend(None))
            self._uncertainty = self._gui.add_markdown("")

    def _add_switches(self, settings: Settings) -> None:
        """What is drawn, and one key for the measurement alone."""
        with self._gui.add_folder("Show"):
            for label, name in (
                ("Model", "model"),
                ("Measurement", "measurement"),
                ("Picture", "hybrid"),
                ("Go along", "along"),
            ):
                box = self._gui.add_checkbox(label, getattr(settings, name), hint=HINTS[name])
                self._on(box, lambda s, value, name=name: replace(s, **{name: bool(value)}))
            self._raw = self._gui.add_checkbox("Raw only (R)", settings.raw)
            self._on(self._raw, lambda s, value: replace(s, raw=bool(value)))
        key = self._gui.add_command("Raw measurement on or off", hotkey="R")

        @key.on_trigger
        def _(_: Any) -> None:
            self._raw.value = not self._raw.value

    def _add_objects(self, result: Result, settings: Settings, can_decide: bool) -> None:
        """The proposals, and the evidence about one object."""
        with self._gui.add_folder("Objects"):
            self._proposals = self._gui.add_markdown("")
            names = object_names(result) or ("",)
            self._object = self._gui.add_dropdown(
                "Object", names, initial_value=settings.selected, hint="Or click it in the scene."
            )
            self._on(self._object, lambda s, value: replace(s, selected=str(value)))
            self._evidence = self._gui.add_markdown("")
            self._accept = self._gui.add_button("Accept", color="green", visible=can_decide)
            self._reject = self._gui.add_button("Reject", color="red", visible=can_decide)
            self._accept.on_click(lambda _: self._decide(True))
            self._reject.on_click(lambda _: self._decide(False))

    def _on(
        self, handle: GuiInputHandle[Any], changed: Callable[[Settings, Any], Settings]
    ) -> None:
        """Passes on what a person does to a control."""

        @handle.on_update
        def _(_: Any) -> None:
            self._change(lambda settings: changed(settings, handle.value))

    def select(self, name: str) -> None:
        """Chooses an object, as the list does."""
        self._object.value = name

    def show_frame(self, index: int) -> None:
        """Chooses a frame, as the slider does."""
        self._frame.value = index + 1

    def tell_result(self, result: Result) -> None:
        """What is proposed and decided, and how many frames there are."""
        self._headline.content = words.headline(result)
        self._proposals.content = words.proposal_list(result.transaction)
        self._frame.max = max(1, len(result.frames))

    def tell_object(self, result: Result, name: str) -> None:
        """The evidence about one object; only proposals can be decided."""
        self._evidence.content = words.object_words(name, result.transaction) if name else ""
        known = name in result.transaction.decisions
        self._accept.disabled = self._reject.disabled = not known

    def tell_frame(self, result: Result, settings: Settings, comparison: FrameComparison) -> None:
        """How much of a frame agrees, and how sure the sensor's place is."""
        self._agreement.content = words.frame_words(comparison, settings.alpha)
        self._legend.content = words.legend(comparison)
        self._uncertainty.content = words.uncertainty_words(result.frames[settings.frame])

    def draw_picture(self, picture: np.ndarray) -> None:
        """Shows a picture beside the scene."""
        self._picture.image = picture

    def show_picture(self, visible: bool) -> None:
        """Shows or hides the picture."""
        self._picture.visible = visible

    def complain(self, message: str) -> None:
        """Tells everyone that something did not work."""
        self._evidence.content = f"**Not done.** {message}"
