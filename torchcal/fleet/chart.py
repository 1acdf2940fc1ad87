"""Where the marks of a drift chart stand: numbers over time, in the units of an SVG's view box."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

WIDTH, HEIGHT = 360.0, 190.0
LEFT, RIGHT, TOP, BOTTOM = 44.0, 12.0, 8.0, 24.0
"""Room for the axes."""
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#7a5c00", "#3a3a3a", "#56b4e9", "#e69f00")
"""Told apart by colour-blind eyes; the first three also in a grey print, with their dashes."""
DASHES = ("", "6 3", "2 3")
DAY = 86_400.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Point:
    """One value with its sigma."""

    time: datetime
    value: float
    sigma: float
    usable: bool
    words: str
    """What a reader is told who points at it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Mark:
    """A point in the view box."""

    x: float
    y: float
    low: float
    high: float
    """Ends of one sigma."""
    usable: bool
    words: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Line:
    """One parameter over time."""

    label: str
    colour: str
    dash: str
    marks: tuple[Mark, ...]

    @property
    def path(self) -> str:
        """Through the marks that can be used."""
        return " ".join(f"{mark.x:.1f},{mark.y:.1f}" for mark in self.marks if mark.usable)


@dataclass(frozen=True, kw_only=True, slots=True)
class Chart:
    """Parameters of one kind over time."""

    title: str
    unit: str
    lines: tuple[Line, ...]
    x_ticks: tuple[tuple[float, str, str], ...]
    """Place, words, anchor."""
    y_ticks: tuple[tuple[float, str], ...]


def chart(title: str, unit: str, series: Mapping[str, Sequence[Point]]) -> Chart:
    """Lays out a chart.

    Args:
        title: Above it.
        unit: Of the values.
        series: By label; none is empty. Those that can be used decide on the scale.
    """
    points = [point for each in series.values() for point in each]
    scaling = [point for point in points if point.usable] or points
    ticks = _ticks([end for point in scaling for end in _ends(point)])
    low, high = ticks[0], ticks[-1]
    times = [point.time for point in points]
    first, last = min(times), max(times)

    def across(time: datetime) -> float:
        share = (time - first) / (last - first) if last > first else 0.5
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def down(value: float) -> float:
        return TOP + (high - min(max(value, low), high)) / (high - low) * (HEIGHT - TOP - BOTTOM)

    def mark(point: Point) -> Mark:
        below, above = _ends(point)
        return Mark(
            x=across(point.time),
            y=down(point.value),
            low=down(below),
            high=down(above),
            usable=point.usable,
            words=point.words,
        )

    lines = (
        Line(
            label=label,
            colour=COLOURS[place % len(COLOURS)],
            dash=DASHES[place % len(DASHES)],
            marks=tuple(mark(point) for point in each),
        )
        for place, (label, each) in enumerate(series.items())
    )
    return Chart(
        title=title,
        unit=unit,
        lines=tuple(lines),
        x_ticks=_dates(first, last),
        y_ticks=tuple((down(tick), f"{tick:.12g}") for tick in ticks),
    )


def _ends(point: Point) -> tuple[float, float]:
    return point.value - point.sigma, point.value + point.sigma


def _ticks(values: Sequence[float]) -> list[float]:
    """Four to eight round numbers from below the least value to above the greatest; 0 is one."""
    low, high = min(0.0, *values), max(0.0, *values)
    span = (high - low) or 1.0
    scale = 10.0 ** math.floor(math.log10(span / 4.0))
    step = scale * next(each for each in (1.0, 2.0, 5.0, 10.0) if each * scale >= span / 4.0)
    first, last = math.floor(low / step), max(math.ceil(high / step), math.floor(low / step) + 1)
    return [step * count for count in range(first, last + 1)]


def _dates(first: datetime, last: datetime) -> tuple[tuple[float, str, str], ...]:
    """Words below the axis: its ends, or its only time."""
    seconds = (last - first).total_seconds()
    form = "%Y-%m-%d" if seconds == 0.0 or seconds > 3.0 * DAY else "%Y-%m-%d %H:%M"
    if seconds == 0.0:
        middle = (LEFT + WIDTH - RIGHT) / 2.0
        return ((middle, first.strftime(form), "middle"),)
    return (
        (LEFT, first.strftime(form), "start"),
        (WIDTH - RIGHT, last.strftime(form), "end"),
    )
