"""Decisions about a result: in its model, and in its report, whose one section they change."""

from collections.abc import Collection
from functools import partial
from pathlib import Path

from torchcal.calibrate import result_folder
from torchcal.calibrate.decisions import Decision, Transaction
from torchcal.calibrate.result import Status
from torchcal.display.report_rows import AGAINST, FOR, changes
from torchcal.display.templates import filled
from torchcal.model.replaced_file import replace_file

REPORT = "report.html"
BEGIN, END = "<!-- what the model should change -->", "<!-- that was it -->"
"""Around the section; no name can hold them, since every name is escaped."""

DECIDED: dict[Decision, str] = {
    Decision.PROPOSED: "not decided",
    Decision.ACCEPTED: "✔ accepted",
    Decision.REJECTED: "✘ rejected",
}


def decide(
    folder: Path | str, *, accept: Collection[str] = (), reject: Collection[str] = ()
) -> Transaction:
    """Accepts and rejects proposals of a result; its ``world.glb`` and ``report.html`` follow.

    Stopped at any moment, the folder holds the old model and decisions, or the new ones. The report
    comes after the model, so that it says nothing that is not done.

    Args:
        folder: What ``torchcal calibrate`` wrote.
        accept: Names of proposals, or ``all`` for those that are not named.
        reject: Likewise.

    Raises:
        TorchcalError: If the folder holds no such result, or a part of it cannot be read; and if
            there is no such proposal, or one is to be both.
    """
    tell = partial(renew_report, Path(folder))
    return result_folder.decide(folder, accept=accept, reject=reject, then=tell)


def renew_report(folder: Path, transaction: Transaction) -> None:
    """Lets the report of a result say what is decided; one that cannot be read stays as it is."""
    file = folder / REPORT
    try:
        page = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):  # the decision is in the model and stands without it
        return
    before, begun, rest = page.partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not begun or not ended:
        return
    status, _ = result_folder.read_status(folder)
    renewed = before + changes_section(transaction, status) + after
    replace_file(file, renewed.encode("utf-8"))


def changes_section(transaction: Transaction, status: Status) -> str:
    """Every proposed change with its evidence and what was decided, as a part of the report.

    Args:
        transaction: The model and its changes.
        status: Whether the calibration behind them can be used.
    """
    section = filled(
        "report_changes.html.j2",
        changes=changes(transaction),
        tally=tally(transaction),
        usable=status == Status.CONVERGED,
        decided=DECIDED,
        supporting=FOR,
        contradicting=AGAINST,
    )
    return f"{BEGIN}\n{section}{END}"


def tally(transaction: Transaction) -> str:
    """How many changes are accepted, rejected and left to decide, in words."""
    made = list(transaction.decisions.values())
    parts = (
        (made.count(Decision.ACCEPTED), "accepted"),
        (made.count(Decision.REJECTED), "rejected"),
    )
    words = [f"{count} {word}" for count, word in parts if count]
    left = made.count(Decision.PROPOSED)
    if not words:
        return f"{left} proposed, nothing is decided yet"
    return ", ".join([*words, f"{left} not decided" if left else "nothing left to decide"])
