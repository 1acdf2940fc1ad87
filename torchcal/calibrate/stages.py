"""How far a calibration is, and how long its stages took."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from torchcal.calibrate.clock import Clock

Progress = Callable[[str, float], None]
"""Told the name of a stage and the share of it that is done, 0 to 1."""

Tick = Callable[[], None]
"""Called whenever one image was predicted or compared: a stage goes on."""

ROUNDS = 10
"""So often a stage looks at every image, more or less: how often only its fit finds out."""


ONCE = 0.1
"""For a stage that looks at every image once: the last one brings it to nine tenths."""


def quiet() -> None:
    """Tells nobody."""


class Stages:
    """Tells about stages and keeps their times.

    Args:
        progress: Told at the beginning and the end of each stage, and with each image between
            them. How many will be needed is not known before: there the share is a guess that
            grows with every image and does not reach 1.
        images: Of the job.
    """

    def __init__(self, progress: Progress | None, images: int):
        self._clock = Clock()
        self._progress = progress
        self._images = images
        self._stage = ""
        self._done = 0
        self._expected = 0.0

    @property
    def timing(self) -> dict[str, float]:
        """Seconds of each stage."""
        return self._clock.seconds

    @contextmanager
    def stage(self, name: str, rounds: float = ROUNDS) -> Iterator[None]:
        """A stage for as long as the context lasts, and how often it looks at every image."""
        self._stage, self._done, self._expected = name, 0, rounds * self._images
        self._tell(0.0)
        with self._clock.measured(name):
            yield
        self._tell(1.0)

    def tick(self) -> None:
        """One more image of the present stage is done."""
        self._done += 1
        self._tell(self._done / (self._done + self._expected))

    def _tell(self, share: float) -> None:
        if self._progress is not None:
            self._progress(self._stage, share)
