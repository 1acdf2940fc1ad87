"""The page of a fleet: nothing from elsewhere, drift where it is, marks in their places."""

import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser

import pytest
from test_fleet_table import record, row

from torchcal.fleet import chart
from torchcal.fleet.chart import Point
from torchcal.fleet.page import page
from torchcal.fleet.table import Row
from torchcal.fleet.task import Correction

NOON = datetime(2026, 11, 23, 12, tzinfo=UTC)


def correction(value: float) -> Correction:
    return Correction(value=value, sigma=0.0001, unit="m")


def fleet() -> list[Row]:
    """One robot whose base drifts by 1 mm a day, one that stands, one of which nothing is known."""
    rows = []
    for day in range(5):
        for robot, drift in (("drifting", 0.001), ("standing", 0.0)):
            moved = {"base.x": correction(drift * day), "joints.elbow": correction(0.0)}
            rows.append(row(f"{robot}/2026-11-0{day + 1}", record(corrections=moved)))
    return [*rows, row("unknown/<monday>", None)]


class Tags(HTMLParser):
    """Checks that tags close in the order in which they open."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.references += [value or "" for name, value in attrs if name in ("href", "src")]
        if tag not in ("meta", "br", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_well_formed_and_needs_nothing_from_elsewhere():
    text = page(fleet(), None)
    tags = Tags()
    tags.feed(text)
    assert tags.open == []
    assert all(not re.match(r"\w+:|//", reference) for reference in tags.references)
    assert "url(" not in text
    assert "&lt;monday&gt;" in text


def test_the_robot_that_drifts_is_marked_and_the_others_are_not():
    text = page(fleet(), None)
    summary = text[text.index("<h2>Robots</h2>") : text.index("<h2>Jobs that need a look</h2>")]
    marked = re.findall(
        r'#robot-\d">(\w+)</a>.*?<td class="words( notable)?">([^<]*)', summary, re.S
    )
    told = {name: (bool(mark), words.split("\n")[0]) for name, mark, words in marked}
    assert told["drifting"] == (True, "base.x by +4.000 mm")
    assert not told["standing"][0]
    assert told["unknown"] == (False, "nothing to compare yet")


def test_jobs_are_linked_to_their_reports_if_they_have_one():
    text = page(fleet(), None)
    assert 'href="drifting/2026-11-01/report.html"' in text
    assert "unknown/%3Cmonday%3E" not in text


def test_a_chart_for_each_kind_of_parameter():
    text = page(fleet(), None)
    titles = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    assert titles == ["Base: position (mm)", "Zero positions of the joints (mm)"] * 2


def test_jobs_without_a_robot_are_not_drawn_as_the_drift_of_one():
    moved = {"base.x": correction(0.001)}
    rows = [row(name, record(robot=None, corrections=moved)) for name in ("desk", "hall")]
    text = page(rows, None)
    assert "<figcaption>" not in text
    assert "From its first usable job" not in text
    assert "not compared" in text
    assert "0 robots" in text
    # In a folder of their own they are said to be of one sensor.
    together = [replace(each, job=f"tripod/{each.job}") for each in rows]
    assert "<figcaption>Base: position (mm)</figcaption>" in page(together, None)


def test_a_single_job_is_a_page_too():
    assert "1 of 1 answers can be used" in page([row("monday", record())], None)


def points(values: list[float], *, usable: bool = True) -> list[Point]:
    return [
        Point(time=NOON + timedelta(days=k), value=value, sigma=0.5, usable=usable, words="")
        for k, value in enumerate(values)
    ]


def test_marks_stand_where_the_ticks_say():
    drawn = chart.chart("any", "mm", {"x": points([0.0, 1.0, 4.0])})
    places = {float(words): y for y, words in drawn.y_ticks}
    marks = drawn.lines[0].marks
    assert marks[0].y == pytest.approx(places[0.0])
    assert marks[1].y == pytest.approx((places[0.0] + places[2.0]) / 2)
    assert marks[2].y == pytest.approx(places[4.0])
    assert [mark.x for mark in marks] == pytest.approx([44.0, (44.0 + 348.0) / 2, 348.0])
    assert marks[1].low - marks[1].high == pytest.approx((places[0.0] - places[2.0]) / 2)


@pytest.mark.parametrize("values", [[0.0], [1e-9, -3e-9], [1e6, 2e6], [-7.3, -7.2], [0.1 + 0.2]])
def test_ticks_are_few_and_hold_every_mark(values):
    drawn = chart.chart("any", "mm", {"x": points(values)})
    assert 2 <= len(drawn.y_ticks) <= 9
    assert any(float(words) == 0.0 for _, words in drawn.y_ticks)
    assert all(len(words) < 8 for _, words in drawn.y_ticks)
    for mark in drawn.lines[0].marks:
        assert chart.TOP <= mark.high <= mark.low <= chart.HEIGHT - chart.BOTTOM


def test_what_cannot_be_used_does_not_scale_the_chart_and_stays_in_it():
    bad = points([1000.0], usable=False)
    drawn = chart.chart("any", "mm", {"x": [*points([1.0, 2.0]), *bad]})
    assert max(float(words) for _, words in drawn.y_ticks) < 10.0
    assert drawn.lines[0].marks[2].y == pytest.approx(chart.TOP)
    assert drawn.lines[0].path.count(",") == 2


def test_jobs_of_one_moment_stand_in_the_middle():
    drawn = chart.chart("any", "mm", {"x": points([1.0])})
    assert drawn.x_ticks == ((196.0, "2026-11-23", "middle"),)
    assert drawn.lines[0].marks[0].x == pytest.approx(196.0)
