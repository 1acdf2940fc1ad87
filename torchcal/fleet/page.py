"""The page that a person opens first: which jobs need a look, and how each robot drifts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from torchcal.fleet import chart
from torchcal.fleet.chart import Chart, Point
from torchcal.fleet.table import NO_ROBOT, RobotBy, Row, robot_of, time_of

SHOWN = {"m": (1000.0, "mm"), "rad": (1000.0, "mrad"), "1": (100.0, "%")}
"""Factor and name of the unit that a person reads."""
TURNS = ("rx", "ry", "rz")
BLOCKS = {
    "base": "Base",
    "mount": "Sensor mount",
    "joints": "Zero positions of the joints",
    "range": "Range of the sensor",
}
MOST_ROWS = 200
"""Of a list of jobs on the page; the table has all."""
NOTABLE = 3.0
"""Standard deviations beyond which a change is marked."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Change:
    """A parameter between a robot's first and last usable job; in ``unit``."""

    name: str
    unit: str
    first: float
    last: float
    sigma: float
    """Of the difference."""

    @property
    def sigmas(self) -> float:
        """How many standard deviations it changed by."""
        return abs(self.last - self.first) / self.sigma if self.sigma > 0.0 else 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Listed:
    """A job as the page lists it."""

    row: Row
    time: str
    link: str
    """To its report; empty where there is none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Robot:
    """One robot over time, or all jobs of which nobody knows whether they are of one."""

    name: str
    known: bool
    """False: jobs that name no robot, which are not compared with each other."""
    jobs: int
    usable: int
    last: str
    """When its last job was recorded."""
    changes: tuple[Change, ...]
    """The most certain one first."""
    charts: tuple[Chart, ...]
    listed: tuple[Listed, ...]
    """The latest first."""

    @property
    def most(self) -> Change | None:
        """What changed most, in its sigmas; None where nothing can be compared."""
        return self.changes[0] if self.changes else None


def page(rows: Sequence[Row], by: RobotBy | None) -> str:
    """The whole page as HTML, with its charts inside it."""
    environment = Environment(
        loader=PackageLoader("torchcal.fleet", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    robots: dict[str, list[Row]] = {}
    for row in rows:
        robots.setdefault(robot_of(row, by), []).append(row)
    listed = [_robot(name, found) for name, found in sorted(robots.items())]
    doubtful = [_listed(row) for row in rows if not row.usable]
    return environment.get_template("page.html.j2").render(
        total=len(rows),
        usable=sum(row.usable for row in rows),
        doubtful=doubtful[:MOST_ROWS],
        left_out=max(0, len(doubtful) - MOST_ROWS),
        robots=listed,
        known=sum(robot.known for robot in listed),
        notable=NOTABLE,
        most_rows=MOST_ROWS,
        size=chart,
    )


def _robot(name: str, rows: Sequence[Row]) -> Robot:
    dated = sorted(
        ((time, row) for row in rows if (time := time_of(row)) is not None),
        key=lambda each: (each[0], each[1].job),
    )
    undated = [row for row in rows if time_of(row) is None]
    known = name != NO_ROBOT
    changes = _changes([row for _, row in dated if row.usable and known])
    ordered = [*(row for _, row in reversed(dated)), *undated]
    return Robot(
        name=name,
        known=known,
        jobs=len(rows),
        usable=sum(row.usable for row in rows),
        last=_words(dated[-1][0]) if dated else "–",
        changes=tuple(sorted(changes, key=lambda each: -each.sigmas)),
        charts=tuple(_charts(dated if known else ())),
        listed=tuple(_listed(row) for row in ordered[:MOST_ROWS]),
    )


def _listed(row: Row) -> Listed:
    time = time_of(row)
    return Listed(
        row=row,
        time="–" if time is None else _words(time),
        link=f"{quote(row.job)}/report.html" if row.record else "",
    )


def _words(time: datetime) -> str:
    return time.strftime("%Y-%m-%d %H:%M")


def _changes(rows: Sequence[Row]) -> list[Change]:
    """Every parameter that at least two jobs tell of: its last value against its first."""
    found: dict[str, list] = {}
    for row in rows:
        for name, correction in row.record.corrections.items() if row.record else ():
            found.setdefault(name, []).append(correction)
    changes = []
    for name, each in found.items():
        if len(each) > 1:
            first, last = each[0], each[-1]
            factor, unit = SHOWN[last.unit]
            changes.append(
                Change(
                    name=name,
                    unit=unit,
                    first=factor * first.value,
                    last=factor * last.value,
                    sigma=factor * math.hypot(first.sigma, last.sigma),
                )
            )
    return changes


def _charts(dated: Sequence[tuple[datetime, Row]]) -> list[Chart]:
    """A chart for each kind of parameter that any job of a robot tells of."""
    series: dict[tuple[str, str], dict[str, list[Point]]] = {}
    for time, row in dated:
        for name, found in row.record.corrections.items() if row.record else ():
            factor, unit = SHOWN[found.unit]
            title, label = _place(name)
            value, sigma = factor * found.value, factor * found.sigma
            words = f"{row.job}: {name} {value:+.3f} ± {sigma:.3f} {unit} ({row.status})"
            point = Point(time=time, value=value, sigma=sigma, usable=row.usable, words=words)
            series.setdefault((title, unit), {}).setdefault(label, []).append(point)
    return [chart.chart(title, unit, found) for (title, unit), found in series.items()]


def _place(name: str) -> tuple[str, str]:
    """The title of the chart that shows a parameter, and its label there."""
    block, _, rest = name.partition(".")
    if block == "joints":
        return BLOCKS[block], rest
    above, _, axis = rest.rpartition(".")
    title = BLOCKS.get(block) or f"{block.removesuffix('s').capitalize()} {above}"
    if block == "range":
        return f"{title}: {axis}", axis
    return f"{title}: {'rotation' if axis in TURNS else 'position'}", axis
