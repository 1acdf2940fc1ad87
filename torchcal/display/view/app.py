"""The view as a program: controls change settings, settings are drawn, the source is watched."""

import threading
import time
from collections.abc import Callable, Hashable

import viser

from torchcal.calibrate.compare import reclassified
from torchcal.calibrate.kept_result import Result
from torchcal.calibrate.result import FrameComparison
from torchcal.display.arrays import as_array
from torchcal.display.view.panel import Panel
from torchcal.display.view.pictures import hybrid_picture, raw_picture
from torchcal.display.view.settings import Settings, shoulder_look
from torchcal.display.view.shapes import class_points, range_points
from torchcal.display.view.source import Source
from torchcal.display.view.stage import Stage
from torchcal.errors import TorchcalError

WATCHED = 0.5
"""Seconds between two looks at the source."""


class View:
    """A result in a browser.

    Args:
        source: What is shown.
        host: The address to listen on.
        port: The port; if it is taken, the next free one.

    Raises:
        TorchcalError: If the source cannot be read.
    """

    def __init__(self, source: Source, *, host: str, port: int):
        self._source = source
        self._result = source.latest(None)
        self._settings = Settings.of(self._result)
        self._changing, self._drawing = threading.Lock(), threading.Lock()
        self._drawn: dict[str, Hashable] = {}
        self._compared: tuple[int, FrameComparison] | None = None
        self._server = viser.ViserServer(host=host, port=port, label="torchcal", verbose=False)
        self._stage = Stage(scene=self._server.scene, clicked=self._clicked)
        self._panel = Panel(
            self._server.gui,
            self._result,
            self._settings,
            change=self._change,
            decide=self._decide,
            can_decide=source.can_decide,
        )
        self._stage.open(self._result)
        self._draw()

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    @property
    def settings(self) -> Settings:
        """How the controls stand."""
        return self._settings

    def watch(self) -> None:
        """Follows what becomes of the source until the program is interrupted."""
        while True:
            time.sleep(WATCHED)
            self.refresh()

    def refresh(self) -> None:
        """Shows the source as it is now; where it cannot be read the old state stays."""
        try:
            latest = self._source.latest(self._result)
        except (TorchcalError, OSError) as error:
            self._panel.complain(str(error))
            return
        if latest is self._result:
            return
        before, self._result = len(self._result.frames), latest
        if len(latest.frames) < before:
            self._forget()
        self._draw()
        if len(latest.frames) != before:
            self._panel.show_frame(len(latest.frames) - 1)

    def stop(self) -> None:
        """Ends the server."""
        self._server.stop()

    def _change(self, changed: Callable[[Settings], Settings]) -> None:
        with self._changing:
            self._settings = changed(self._settings)
        self._draw()

    def _clicked(self, name: str) -> None:
        self._panel.select(name)

    def _decide(self, accepted: bool) -> None:
        names = (self._settings.selected,)
        try:
            self._source.decide(accept=names if accepted else (), reject=() if accepted else names)
        except TorchcalError as error:
            self._panel.complain(str(error))
            return
        self.refresh()

    def _forget(self) -> None:
        """Another recording has begun: frames are other frames."""
        with self._drawing:
            self._compared = None
            for part in ("place", "points", "pixels"):
                self._drawn.pop(part, None)

    def _look(self, index: int) -> None:
        """Looks over the sensor's shoulder, in every browser and those to come."""
        T = as_array(self._result.frames[index].T_world_sensor)
        eye, target = shoulder_look(T, self._comparison(index))
        for camera in (
            self._server.initial_camera,
            *(client.camera for client in self._server.get_clients().values()),
        ):
            camera.position, camera.look_at = eye, target

    def _comparison(self, index: int) -> FrameComparison:
        """A frame's comparison; the last one is kept."""
        if self._compared is None or self._compared[0] != index:
            self._compared = index, self._result.comparisons[index]
        return self._compared[1]

    def _draw(self) -> None:
        """Draws what has changed; changes that came in the meantime are drawn together."""
        with self._drawing:
            result, settings = self._result, self._settings
            decisions = tuple(result.transaction.decisions.items())
            told = (decisions, result.message, len(result.frames))
            self._if_new("switches", (settings.shows_model, settings.shows_points), self._switch)
            self._if_new("picture shown", settings.hybrid, self._switch)
            self._if_new("result", told, lambda: self._panel.tell_result(result))
            self._if_new("objects", decisions, lambda: self._stage.draw_objects(result))
            about = (decisions, settings.selected)
            self._if_new("about", about, lambda: self._panel.tell_object(result, settings.selected))
            if settings.frame < len(result.frames):
                self._draw_frame(result, settings)

    def _draw_frame(self, result: Result, settings: Settings) -> None:
        index, raw = settings.frame, settings.raw
        self._if_new("place", index, lambda: self._stage.place(result.frames[index]))
        if settings.along:
            self._if_new("look", index, lambda: self._look(index))
        key = (index, settings.alpha, raw)
        if self._drawn.get("pixels") == key:
            return
        comparison = reclassified(self._comparison(index), settings.alpha)
        points = (range_points if raw else class_points)(comparison, result.projection)
        if self._drawn.get("points") == (index, raw):
            self._stage.recolour(points.colours)
        else:
            self._stage.draw_points(points)
        self._drawn |= {"points": (index, raw), "pixels": key}
        self._panel.tell_frame(result, settings, comparison)
        self._panel.draw_picture((raw_picture if raw else hybrid_picture)(comparison))

    def _switch(self) -> None:
        self._stage.show(self._settings)
        self._panel.show_picture(self._settings.hybrid)

    def _if_new(self, part: str, key: Hashable, draw: Callable[[], None]) -> None:
        if self._drawn.get(part) != key:
            draw()
            self._drawn[part] = key
