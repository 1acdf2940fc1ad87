"""What the view says beside its pictures, in Markdown."""

import html

import numpy as np

from torchcal.calibrate.decisions import Transaction
from torchcal.calibrate.kept_result import FramePlace, Result
from torchcal.calibrate.result import Change, FrameComparison, PixelClass, Proposal, Status
from torchcal.display.colours import CLASS_COLOURS, CLASS_WORDS
from torchcal.display.figures import SHOWN_AS, class_counts
from torchcal.display.report import agreement, headline_of
from torchcal.display.report_rows import verdict_words
from torchcal.display.view.shapes import SIGMAS, ellipsoid

VISIBLE = 0.01
"""m: a smaller ellipsoid is a dot in a scene of metres."""

CHANGES: dict[Change, str] = {
    Change.REMOVE: "remove it: the sensor saw through it",
    Change.MOVE: "move it: the images show it elsewhere",
    Change.ADJUST: "adjust it: its pose was unknown and was estimated here",
    Change.ADD: "add it: it was measured and is not in the model",
}

SUPPORT: dict[Change, str] = {
    Change.REMOVE: "see through it",
    Change.MOVE: "show it where it was found",
    Change.ADJUST: "show it where it was estimated",
    Change.ADD: "show it",
}

AGAINST: dict[Change, str] = {
    Change.REMOVE: "show it where the model has it",
    Change.MOVE: "see through it there",
    Change.ADJUST: "see through it there",
    Change.ADD: "see through it",
}


def headline(result: Result) -> str:
    """Whether the answer can be used, and why not; of what is no answer, what it is."""
    if not result.estimated:
        return f"**{_plain(result.message)}**"
    mark = "✔" if result.status == Status.CONVERGED else "✘"
    return f"**{mark} {headline_of(result.status, estimated=True)}.** {_plain(result.message)}"


def proposal_list(transaction: Transaction) -> str:
    """Every proposal in a line with what was decided."""
    if not transaction.decisions:
        return "No change of the model is proposed."
    rows = [
        f"| {_plain(proposal.name)} | {proposal.change.value} | "
        f"**{transaction.decisions[proposal.name].value}** |"
        for proposal in transaction.update.proposals
    ]
    return "\n".join(["| object | change | decision |", "| --- | --- | --- |", *rows])


def object_words(name: str, transaction: Transaction) -> str:
    """What the images say of one object, and what is proposed."""
    proposals = {proposal.name: proposal for proposal in transaction.update.proposals}
    if name in proposals:
        return _proposal_words(proposals[name], transaction)
    verdict = transaction.update.verdicts.get(name)
    if verdict is None:
        whose = "part of the robot" if name.startswith("robot/") else "nothing is said of it here"
        return f"**{_plain(name)}**: {whose}."
    return (
        f"**{_plain(name)}**: {verdict_words(verdict)}. {verdict.agree:,} pixels agree, "
        f"{verdict.seen_through:,} see through it, in {verdict.hidden:,} something hides it."
    )


def frame_words(comparison: FrameComparison, alpha: float) -> str:
    """How much of a frame agrees with the model at an alpha."""
    share = 100.0 * agreement(class_counts(comparison))
    return f"**{share:.1f} %** of the pixels agree with the model within {alpha:g} σ′."


def uncertainty_words(place: FramePlace) -> str:
    """The size of the position's ellipsoid, and the rotation's standard deviations."""
    radii = 1000.0 * ellipsoid(place.pose_covariance).radii
    sizes = " × ".join(_short(radius) for radius in radii)
    turned = SIGMAS * np.rad2deg(
        float(place.pose_covariance.diagonal()[3:].clamp(min=0).sum()) ** 0.5
    )
    seen = "" if radii.max() >= 1000.0 * VISIBLE else " It is drawn true to size: too small to see."
    return (
        f"Where the sensor is: ± {sizes} mm along the axes of its ellipsoid, "
        f"± {_short(turned)}° ({SIGMAS:g} σ).{seen}"
    )


def legend(comparison: FrameComparison | None) -> str:
    """The classes in their colours, with what the hybrid image shows of each."""
    counts = class_counts(comparison) if comparison is not None else {}
    total = max(1, sum(counts.values()))
    rows = [
        f'<div style="display:flex;gap:.5em;align-items:center;font-size:.8em;line-height:1.5">'
        f'<span style="background:{CLASS_COLOURS[member]};width:1em;height:1em;flex:none;'
        f'border-radius:2px"></span><span style="flex:1">{CLASS_WORDS[member]}</span>'
        f"<span>{100.0 * counts.get(member, 0) / total:.1f} %</span></div>"
        for member in SHOWN_AS
        if member != PixelClass.NOT_COMPARED
    ]
    return f'<div style="padding:0 .8em .6em">{"".join(rows)}</div>'


def _proposal_words(proposal: Proposal, transaction: Transaction) -> str:
    evidence, change = proposal.evidence, proposal.change
    frames = ", ".join(map(_plain, proposal.frames))
    seen = f" What speaks for it is in {frames}." if frames else ""
    return (
        f"**{_plain(proposal.name)}**: {CHANGES[change]}. {evidence.supporting:,} pixels "
        f"{SUPPORT[change]}, {evidence.contradicting:,} {AGAINST[change]}, in "
        f"{evidence.hidden:,} something hides it.{seen} "
        f"Decision: **{transaction.decisions[proposal.name].value}**."
    )


def _short(value: float) -> str:
    """A number with two digits or more, without an exponent."""
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"


def _plain(text: str) -> str:
    """Text that Markdown leaves as it is."""
    escaped = html.escape(text)
    return "".join(f"\\{letter}" if letter in "\\`*_[]|#" else letter for letter in escaped)
