"""Which frames carry the evidence about an object: through images, files and proposals."""

import json
from dataclasses import replace

import pytest
import torch
from display_scene import calibration, comparison

from torchcal.calibrate.regions import Region, RegionKind
from torchcal.calibrate.result import FrameComparison
from torchcal.calibrate.result_folder import read_result
from torchcal.calibrate.update import object_verdict
from torchcal.cli.main import main
from torchcal.cli.result_files import write_results

CRATE = 1


def frame_of(name: str, *, farther: bool, shown: bool) -> tuple[FrameComparison, list[Region]]:
    """The crate fills the right half of the image, if it is shown."""
    whole = comparison(name)
    half = torch.zeros_like(whole.usable)
    half[:40, 32:] = True
    body = torch.where(half, CRATE if shown else 0, 0).int()
    frame = replace(whole, body=body, label=torch.ones_like(whole.label))
    region = Region(
        kind=RegionKind.FARTHER, mask=half, pixels=int(half.sum()), significance=9.0, bodies={}
    )
    return frame, [region] if farther else []


@pytest.mark.parametrize(
    ("farther", "verdict", "expected"),
    [
        ((True, False, True), "removed", ("a", "c")),
        ((False, False, False), "agrees", ("a", "b", "c")),
        ((False, True, False), "agrees", ("a", "c")),
    ],
)
def test_a_verdict_names_the_frames_that_say_so(farther, verdict, expected):
    made = [frame_of(n, farther=f, shown=True) for n, f in zip("abc", farther, strict=True)]
    made.append(frame_of("elsewhere", farther=False, shown=False))
    frames, regions = zip(*made, strict=True)
    found = object_verdict(CRATE, frames, regions, 1)
    assert (found.verdict, found.frames) == (verdict, expected)


def test_frames_of_a_removed_object_are_written_read_and_listed(tmp_path, capsys):
    write_results(calibration(), tmp_path / "out")
    written = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert written["objects"]["crate"]["frames"] == ["0001"]
    proposals = read_result(tmp_path / "out").transaction.update.proposals
    assert {each.name: each.frames for each in proposals}["crate"] == ("0001",)
    assert main(["update", str(tmp_path / "out"), "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["proposals"]
    assert {each["name"]: each["frames"] for each in listed} == {
        "crate": ["0001"],
        "added-1": ["0001"],
    }
