"""What the tables of the report say: proposed changes, objects, the next view, all at a glance."""

import math
from dataclasses import dataclass

from torchcal.calibrate.decisions import Decision, Transaction
from torchcal.calibrate.parameters import parameter_unit
from torchcal.calibrate.result import (
    AddedObject,
    Calibration,
    Change,
    Evidence,
    ObjectVerdict,
    Verdict,
)
from torchcal.display.summary import (
    MILLI,
    SHOWN_UNITS,
    centre_pose,
    decimals,
    distance_words,
    size_words,
)

MOST_LEFT = 8
"""Parameters of the next view that are listed: those that it would tell most about."""

FOR: dict[Change, str] = {
    Change.REMOVE: "see through the place where it should be",
    Change.MOVE: "show it at its new place",
    Change.ADJUST: "show it where it was estimated",
    Change.ADD: "show it",
}
"""What the pixels that speak for a change do."""

AGAINST: dict[Change, str] = {
    Change.REMOVE: "show it where the model has it",
    Change.MOVE: "see through its new place",
    Change.ADJUST: "see through it there",
    Change.ADD: "see through it",
}
"""What the pixels that speak against a change do."""

VERDICTS = (Verdict.REMOVED, Verdict.MOVED, Verdict.AGREES, Verdict.UNSEEN)
"""In the order of the report: first what asks for a decision."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangeRow:
    """One proposed change of the model with its evidence in words."""

    change: Change
    name: str
    decision: Decision
    evidence: Evidence
    share: float
    """Percent of the pixels that say anything which speak for it."""
    details: str
    """Where it is, how large, how far it moved."""
    frames: tuple[str, ...]
    """Those that speak for it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SigmaRow:
    """What one more image would do for a parameter; in ``unit``."""

    name: str
    unit: str
    now: float
    then: float


def changes(transaction: Transaction) -> list[ChangeRow]:
    """Every proposed change of the model, and what was decided."""
    update = transaction.update
    added = {item.name: item for item in update.added}
    rows = []
    for proposal in update.proposals:
        if proposal.change == Change.ADD:
            details = added_words(added[proposal.name])
        else:
            details = _moved_words(transaction, proposal.name)
        told = proposal.evidence.supporting + proposal.evidence.contradicting
        rows.append(
            ChangeRow(
                change=proposal.change,
                name=proposal.name,
                decision=transaction.decisions[proposal.name],
                evidence=proposal.evidence,
                share=100.0 * proposal.evidence.supporting / max(1, told),
                details=details,
                frames=proposal.frames,
            )
        )
    return rows


def objects(calibration: Calibration) -> list[tuple[str, ObjectVerdict]]:
    """All objects of the model, those that differ first."""
    return sorted(
        calibration.update.verdicts.items(),
        key=lambda item: (VERDICTS.index(item[1].verdict), item[0]),
    )


def verdict_words(verdict: ObjectVerdict) -> str:
    """A verdict as a person reads it: what was seen a little is not called unseen."""
    seen = verdict.agree + verdict.seen_through
    return (
        "hardly seen" if verdict.verdict is Verdict.UNSEEN and seen > 0 else verdict.verdict.value
    )


def added_words(item: AddedObject) -> str:
    """Size and place of an added object."""
    centre = ", ".join(f"{value:.3f}" for value in item.mesh.bounds.mean(axis=0))
    size = size_words(item.mesh.extents)
    return f"{size} along the world’s axes, centre ({centre}) m"


def glance(calibration: Calibration) -> list[tuple[str, str]]:
    """The answer in a few figures, each with what it is a figure of."""
    found = calibration.update.proposals
    counts = [sum(each.change == change for each in found) for change in Change]
    words = [f"{n} to {change.value}" for n, change in zip(counts, Change, strict=True) if n]
    open_ends = len(calibration.estimate.unobservable)
    return [
        (_worst_pose(calibration), "σ of the sensor’s pose, in the frame where it is least sure"),
        (", ".join(words) or "none", "changes of the model that are proposed"),
        (str(open_ends) if open_ends else "none", "directions that the images leave open"),
    ]


def next_view_rows(calibration: Calibration) -> list[SigmaRow]:
    """What the next view would leave of the sigmas that it would shrink most."""
    view, estimate = calibration.next_view, calibration.estimate
    if view is None:
        return []
    variances = estimate.covariance.diagonal().clamp(min=0.0).tolist()
    rows = []
    for name, variance in zip(estimate.names, variances, strict=True):
        if name in view.sigma and variance > 0.0:
            scale, unit = SHOWN_UNITS[parameter_unit(name, calibration.job)]
            now, then = scale * math.sqrt(variance), scale * view.sigma[name]
            rows.append(SigmaRow(name=name, unit=unit, now=now, then=then))
    return sorted(rows, key=lambda row: row.then / row.now)[:MOST_LEFT]


def chance_words(alpha: float) -> str:
    """The share of pixels that differ by chance alone where the model is right."""
    return f"{100.0 * math.erfc(alpha / math.sqrt(2.0)):.2g} %"


def pose_sigma(calibration: Calibration, index: int) -> tuple[float, float]:
    """How sure the pose of a frame is (mm, mrad): the roots of the summed variances."""
    variances = calibration.estimate.pose_covariances[index].diagonal().clamp(min=0.0)
    metres, radians = (float(part.sum().sqrt()) for part in (variances[:3], variances[3:]))
    return MILLI * metres, MILLI * radians


def sigma_words(sigma: tuple[float, float]) -> str:
    """Standard deviations (mm, mrad) with their units."""
    metres, radians = (f"{each:.{decimals(each)}f}" for each in sigma)
    return f"{metres} mm, {radians} mrad"


def _worst_pose(calibration: Calibration) -> str:
    """The largest sigmas of all frames."""
    sigmas = [pose_sigma(calibration, index) for index in range(len(calibration.comparisons))]
    return sigma_words((max(each[0] for each in sigmas), max(each[1] for each in sigmas)))


def _moved_words(transaction: Transaction, name: str) -> str:
    """How far an object is from where the model has it; empty for one that is gone."""
    world, now = transaction.world, transaction.update.verdicts[name].T_world_object
    if now is None or world is None:
        return ""
    (item,) = (each for each in world.objects if each.name == name)
    at, before = centre_pose(item.mesh).to(now), item.T_world_object.to(now)
    return f"{distance_words(before @ at, now @ at)} from where the model has it"
