"""The report: whole, escaped, and with the bad news first."""

import re
from html.parser import HTMLParser

import pytest
from display_scene import calibration
from PIL import Image

from torchcal.calibrate.result import Status
from torchcal.display import report as reports
from torchcal.display.report import FramePictures, report


def rendered(names: tuple[str, ...] = ("0001", "0002"), status: Status = Status.CONVERGED) -> str:
    picture = Image.new("RGB", (80, 60), "white")
    pictures = [FramePictures(hybrid=picture, comparison=picture) for _ in names]
    return report(calibration(names, status), pictures)


class Outside(HTMLParser):
    """Collects every address that a page loads."""

    def __init__(self):
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]


def test_report_loads_nothing_from_outside():
    page = Outside()
    page.feed(rendered())
    assert len(page.addresses) == 4
    assert all(address.startswith("data:image/jpeg;base64,") for address in page.addresses)


def test_status_and_message_stand_before_everything_else():
    page = rendered(status=Status.AMBIGUOUS)
    headline, message = page.index("more than one pose"), page.index("do not fix the height")
    assert headline < message < page.index("<h2>")


@pytest.mark.parametrize("status", list(Status))
def test_every_status_has_its_headline(status):
    assert reports.HEADLINES[status] in rendered(status=status)


def test_words_from_outside_are_escaped():
    assert "height &lt;z&gt; &amp; more" in rendered(status=Status.FAILED)


def test_corrections_carry_units_and_sigmas():
    page = rendered()
    assert "+10.000 mm" in page
    assert "2.000 mm" in page
    assert "held: the job takes it for exact" in page


def test_what_could_not_be_known_is_listed():
    page = rendered(status=Status.UNOBSERVABLE)
    assert "Movement along the wall" in page
    assert "Another pose explains" in page


def test_objects_and_additions_are_listed():
    page = rendered()
    assert re.search(r"crate</td><td class=\"words verdict removed\">removed", page)
    assert "0.200 × 0.300 × 0.400" in page


def test_pictures_of_many_frames_are_limited():
    names = tuple(f"{index:04d}" for index in range(reports.MOST_PICTURES + 2))
    page = rendered(names)
    assert page.count("<img") == 2 * reports.MOST_PICTURES
    assert "frames that agree least" in page


def test_page_fits_a_phone():
    assert '<meta name="viewport" content="width=device-width' in rendered()
