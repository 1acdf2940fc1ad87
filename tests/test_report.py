"""The report: whole, escaped, with the bad news first, and legible on a phone."""

import base64
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from display_scene import calibration
from PIL import Image

from torchcal.calibrate.kept_result import kept
from torchcal.calibrate.result import Calibration, Evidence, ObjectVerdict, Status, Verdict
from torchcal.display import report as reports
from torchcal.display.report import FramePictures, pictured_frames, report
from torchcal.display.report_rows import (
    chance_words,
    changes,
    next_view_rows,
    objects,
)
from torchcal.display.summary import decimals
from torchcal.geometry import se3

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SWATCHES = 6
HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>"


def drawn(found: Calibration) -> str:
    picture = Image.new("RGB", (800, 600), "white")
    one = FramePictures(hybrid=picture, comparison=picture)
    return report(found, dict.fromkeys(pictured_frames(found.comparisons), one))


def rendered(names: tuple[str, ...] = ("0001", "0002"), status: Status = Status.CONVERGED) -> str:
    return drawn(calibration(names, status))


def moved() -> Calibration:
    """The crate is 3 cm farther and 0.1 rad turned."""
    found = calibration()
    twist = torch.tensor([0.03, 0.0, 0.0, 0.0, 0.0, 0.1], dtype=torch.float64)
    verdict = ObjectVerdict(
        verdict=Verdict.MOVED, agree=1234, seen_through=56, hidden=7, T_world_object=se3.exp(twist)
    )
    verdicts = found.update.verdicts | {"crate": verdict}
    return replace(found, update=replace(found.update, verdicts=verdicts))


class Page(HTMLParser):
    """Collects what a browser would load, run and show of a page."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.handlers: list[str] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        self.handlers += [name for name, _ in attrs if name.startswith("on")]

    def handle_data(self, data):
        self.words += data


def test_report_loads_nothing_from_outside():
    page = Page(rendered())
    assert len(page.addresses) == 4 + SWATCHES
    assert all(address.startswith("data:image/") for address in page.addresses)
    assert "url(" not in rendered()
    assert "@import" not in rendered()


def test_status_and_message_stand_before_everything_else():
    page = rendered(status=Status.AMBIGUOUS)
    headline, message = page.index("more than one pose"), page.index("do not fix the height")
    assert headline < message < page.index("<h2>")


@pytest.mark.parametrize("status", list(Status))
def test_every_status_has_its_headline(status):
    assert reports.HEADLINES[status] in rendered(status=status)


def test_words_from_outside_are_escaped():
    assert "height &lt;z&gt; &amp; more" in rendered(status=Status.FAILED)


def test_names_are_shown_and_never_run():
    found = calibration((HOSTILE, "0002"))
    verdicts = found.update.verdicts | {HOSTILE: found.update.verdicts["crate"]}
    added = (replace(found.update.added[0], name=HOSTILE),)
    found = replace(
        found,
        update=replace(found.update, verdicts=verdicts, added=added),
        job=replace(found.job, file=Path(HOSTILE), link=HOSTILE),
        timing={HOSTILE: 1.0},
    )
    page = Page(drawn(found))
    assert "script" not in page.tags
    assert page.handlers == []
    assert all(address.startswith("data:image/") for address in page.addresses)
    # Two proposals and a row of the table of objects; a frame's row and headline; a stage.
    assert page.words.count(HOSTILE) >= 6


def test_corrections_carry_units_and_as_many_digits_as_their_sigmas_deserve():
    page = rendered()
    assert "+10.0 mm" in page
    assert "1.0 mm" in page
    assert "held: the job takes it for exact" in page
    assert [decimals(sigma) for sigma in (0.00034, 0.027, 1.0, 60.0, 0.0)] == [5, 3, 1, 0, 3]


def test_a_correction_beyond_three_sigmas_of_the_prior_is_marked():
    assert "(!)</td>" not in rendered()
    found = calibration()
    assert found.job.base is not None
    sure = replace(found.job.base, sigma=0.01 * found.job.base.sigma)
    page = drawn(replace(found, job=replace(found.job, base=sure)))
    assert re.search(r'class="warn">\+10\.0 mm \(!\)</td>', page)


def test_what_could_not_be_known_is_listed():
    page = rendered(status=Status.UNOBSERVABLE)
    assert "Movement along the wall" in page
    assert "Another pose explains" in page


def test_every_proposal_stands_with_its_evidence_in_words():
    words = " ".join(Page(rendered()).words.split())
    assert "remove crate" in words
    assert "256 pixels see through the place where it should be, 0 show it where" in words
    assert "add added-1" in words
    assert "120 pixels show it, 0 see through it; in 0 something nearer hides it" in words
    assert "0.200 × 0.300 × 0.400 m along the world’s axes, centre (1.000, 0.000, 0.000)" in words


def test_proposals_of_a_result_that_cannot_be_used_come_with_a_warning():
    warning = "cannot be relied on"
    assert warning in rendered(status=Status.FAILED)
    assert warning not in rendered()


def test_the_report_says_how_to_decide():
    assert "torchcal update DIR --accept NAME --reject NAME" in rendered()
    assert "torchcal view DIR" in rendered()


def test_a_moved_object_says_how_far_and_what_speaks_against_it():
    (row,) = [each for each in changes(kept(moved()).transaction) if each.name == "crate"]
    assert row.evidence == Evidence(supporting=1234, contradicting=56, hidden=7)
    assert row.details == "30.0 mm and 5.73° away from where the model has it"
    assert row.share == pytest.approx(100 * 1234 / 1290)
    assert row.details[1:] in drawn(moved())


def test_objects_that_ask_for_a_decision_come_first():
    assert [name for name, _ in objects(calibration())] == ["crate", "wall"]
    assert re.search(r'class="name">crate</td><td class="words removed">removed', rendered())


def test_proposals_name_the_frames_that_speak_for_them():
    words = " ".join(Page(rendered()).words.split())
    assert words.count("What speaks for it is in 0001.") == 2


def test_the_next_view_says_what_would_be_left_of_the_sigmas():
    found = calibration()
    assert found.next_view is not None
    shrunk = {"base.x": 0.0005, "base.rx": 0.00015}
    rows = next_view_rows(
        replace(found, next_view=replace(found.next_view, sigma=shrunk | {"base.y": 0.002}))
    )
    assert [row.name for row in rows] == ["base.x", "base.rx", "base.y"]
    assert (rows[0].now, rows[0].then, rows[0].unit) == pytest.approx((1.0, 0.5, "mm"))
    assert (rows[1].now, rows[1].unit) == (pytest.approx(0.0171887, rel=1e-5), "°")


def test_chance_is_that_of_a_normal_error():
    assert chance_words(3.0) == "0.27 %"
    assert chance_words(1.0) == "32 %"


def test_settings_name_the_seed_where_it_is_known():
    assert "Seed" not in rendered()
    assert re.search(r"Seed of.*>77</td>", drawn(replace(calibration(), seed=77)))


def test_pictures_of_many_frames_are_limited():
    names = tuple(f"{index:04d}" for index in range(reports.MOST_PICTURES + 2))
    page = rendered(names)
    assert page.count("<img") == 2 * reports.MOST_PICTURES + SWATCHES
    assert "frames that agree least" in page


def test_every_frame_shows_its_hybrid_view_once():
    page = rendered(("a", "b", "c"))
    assert sorted(re.findall(r'alt="(Hybrid view of frame .)"', page)) == [
        f"Hybrid view of frame {name}" for name in "abc"
    ]


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium to lay the page out")
@pytest.mark.parametrize("width", [320, 390, 1200])
def test_page_never_scrolls_sideways(width: int, tmp_path: Path):
    """In a frame of the phone's width: the browser's own window may not be as narrow."""
    page = drawn(calibration(("a" * 100, "b"), Status.UNOBSERVABLE))
    inner = base64.b64encode(page.encode()).decode()
    (tmp_path / "outer.html").write_text(
        f"<iframe id=f width={width} height=800 frameborder=0></iframe><script>"
        "f.onload = () => { const p = f.contentDocument.documentElement;"
        "document.title = p.clientWidth + ' ' + p.scrollWidth; };"
        f"f.srcdoc = new TextDecoder().decode(Uint8Array.from(atob('{inner}'),"
        " c => c.charCodeAt(0)));</script>"
    )
    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    profile = f"--user-data-dir={tmp_path / 'profile'}"
    command += ["--virtual-time-budget=2000", profile, (tmp_path / "outer.html").as_uri()]
    told = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    sizes = re.search(r"<title>(\d+) (\d+)</title>", told)
    assert sizes is not None, told[:300]
    assert int(sizes[1]) <= width
    assert int(sizes[2]) <= int(sizes[1])
