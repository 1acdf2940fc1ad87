"""Answers as text on a terminal."""

import math
from collections.abc import Iterator, Sequence

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from torchcal.calibrate.check_result import (
    FrameCheck,
    JobCheck,
    ParameterCheck,
)
from torchcal.calibrate.observability import sentences
from torchcal.calibrate.result import (
    Calibration,
    Status,
    UnobservableDirection,
    Verdict,
)
from torchcal.display.figures import class_counts
from torchcal.display.report import agreement, headline_of
from torchcal.display.report_rows import verdict_words
from torchcal.display.summary import (
    SHOWN_UNITS,
    Correction,
    corrections,
    decimals,
    distance_words,
    next_view_words,
    size_words,
)

STYLES: dict[Verdict, str] = {
    Verdict.AGREES: "green",
    Verdict.UNSEEN: "dim",
    Verdict.MOVED: "yellow",
    Verdict.REMOVED: "red",
}


def calibration_view(calibration: Calibration) -> Group:
    """The answer on one screen: status, corrections, frames, objects."""
    estimate = calibration.estimate
    style = "bold green" if estimate.status == Status.CONVERGED else "bold red"
    parts: list[RenderableType] = [
        Text(headline_of(estimate.status, estimated=estimate.estimated), style=style),
        Text(estimate.message),
        *(part for pose in corrections(calibration) for part in _correction(pose)),
        *_doubts(calibration),
        _frame_table(calibration),
    ]
    if calibration.update.verdicts or calibration.update.added:
        parts.append(_object_table(calibration))
    return Group(*parts, *_warnings(calibration.warnings))


def check_view(check: JobCheck) -> Group:
    """What a job holds and what can be found out from it."""
    parts: list[RenderableType] = [_frame_check_table(check.frames)]
    if check.parameters:
        parts.append(_parameter_table(check.parameters))
    parts += _open_ends(check.unobservable)
    of_frames = [f"{frame.name}: {words}" for frame in check.frames for words in frame.warnings]
    return Group(*parts, *_warnings([*check.warnings, *of_frames]))


def _table(title: str, *headings: str) -> Table:
    """An empty table; all columns but the first are numbers."""
    table = Table(title=title, title_justify="left", title_style="bold")
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="left" if index == 0 else "right")
    return table


def _correction(pose: Correction) -> tuple[RenderableType, ...]:
    """What was corrected, and how to read it."""
    return _correction_table(pose), *(Text(note, style="dim") for note in pose.notes)


def _correction_table(pose: Correction) -> Table:
    table = _table(escape(pose.title), "axis", "correction", "± 1σ now", "± 1σ before", "")
    for row in pose.axes:
        if row.held:
            table.add_row(row.axis, "held", "–", "–", "")
        else:
            digits = decimals(row.sigma)
            numbers = f"{row.change:+.{digits}f}", f"{row.sigma:.{digits}f}", f"{row.prior:.4g}"
            told = "from the prior" if row.from_prior else ""
            table.add_row(row.axis, *(f"{number} {row.unit}" for number in numbers), told)
    return table


def _doubts(calibration: Calibration) -> Iterator[Text]:
    """What could not be known."""
    estimate = calibration.estimate
    yield from _open_ends(estimate.unobservable)
    for other in estimate.alternatives:
        place = distance_words(estimate.Ts_world_sensor[0], other.Ts_world_sensor[0])
        words = f"another pose explains the images nearly as well: {place}"
        yield Text(f"{words} (cost {other.score:.3f} against {estimate.score:.3f})", style="yellow")
    if estimate.unobservable and calibration.next_view is not None:
        words = f"one more image would tell most from: {next_view_words(calibration.next_view)}"
        yield Text(words, style="yellow")


def _open_ends(directions: Sequence[UnobservableDirection]) -> list[Text]:
    return [Text(words, style="yellow") for words in sentences(directions)]


def _frame_table(calibration: Calibration) -> Table:
    headings = ("agree", "nearer", "farther", "unmodelled", "missing", "agreement")
    table = _table("Pixels of each frame", "frame", *headings)
    for comparison in calibration.comparisons:
        counts = class_counts(comparison)
        numbers = {member.name.lower(): f"{count:,}" for member, count in counts.items()}
        cells = [numbers[heading] for heading in ("agrees", *headings[1:5])]
        table.add_row(escape(comparison.name), *cells, f"{100.0 * agreement(counts):.1f} %")
    return table


def _object_table(calibration: Calibration) -> Table:
    headings = ("verdict", "agree", "seen through", "hidden")
    table = _table("Objects of the world", "object", *headings)
    for name, found in calibration.update.verdicts.items():
        numbers = (f"{count:,}" for count in (found.agree, found.seen_through, found.hidden))
        table.add_row(
            escape(name), Text(verdict_words(found), style=STYLES[found.verdict]), *numbers
        )
    for item in calibration.update.added:
        size = size_words(item.mesh.extents)
        table.add_row(escape(item.name), Text("added", style="cyan"), size, "–", "–")
    return table


def _frame_check_table(frames: tuple[FrameCheck, ...]) -> Table:
    headings = ("measured", "usable", "shows the model", "median", "model's median")
    table = _table("Frames at the nominal pose", "frame", *headings)
    for frame in frames:
        shares = (frame.measured_fraction, frame.usable_fraction, frame.model_fraction)
        ranges = (frame.median_range_m, frame.predicted_median_range_m)
        percents = (f"{100.0 * share:.1f} %" for share in shares)
        table.add_row(escape(frame.name), *percents, *(_metres(value) for value in ranges))
    return table


def _metres(value: float) -> str:
    return f"{value:.3f} m" if math.isfinite(value) else "–"


def _parameter_table(parameters: tuple[ParameterCheck, ...]) -> Table:
    table = _table("Unknowns: one standard deviation", "unknown", "before", "expected after")
    for each in parameters:
        scale, unit = SHOWN_UNITS[each.unit]
        sigmas = (each.prior_sigma, each.expected_sigma)
        table.add_row(escape(each.name), *(f"{scale * sigma:.3g} {unit}" for sigma in sigmas))
    return table


def _warnings(warnings: Sequence[str]) -> list[Text]:
    return [Text(f"warning: {words}", style="yellow") for words in warnings]
