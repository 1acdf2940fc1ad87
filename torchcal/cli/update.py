"""``torchcal update``: the proposed changes of the model, and what a person decides about them."""

from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from torchcal.calibrate.decisions import Decision, Transaction
from torchcal.calibrate.result import Change, Status
from torchcal.calibrate.result_folder import NEW_WORLD, read_status, read_transaction
from torchcal.cli.commands import NOT_USABLE, USABLE, line, print_json
from torchcal.cli.options import Update
from torchcal.display.decided import decide

STYLES: dict[Decision, str] = {
    Decision.PROPOSED: "yellow",
    Decision.ACCEPTED: "green",
    Decision.REJECTED: "red",
}

SUPPORT: dict[Change, str] = {
    Change.REMOVE: "seen through",
    Change.MOVE: "seen there",
    Change.ADJUST: "seen there",
    Change.ADD: "measured",
}
"""What the pixels for a change show."""


def run_update(command: Update, out: Console, err: Console) -> int:
    """``torchcal update``; returns the exit status."""
    if command.accept or command.reject:
        transaction = decide(command.result, accept=command.accept, reject=command.reject)
    else:
        transaction = read_transaction(command.result)
    status, message = read_status(command.result)
    if command.options.json:
        print_json(transaction_dict(transaction), out)
    else:
        _tell(transaction, command, out)
        if status != Status.CONVERGED:
            line(out, f"The calibration is {status.value}, do not trust its proposals: {message}")
    return USABLE if status == Status.CONVERGED else NOT_USABLE


def transaction_dict(transaction: Transaction) -> dict[str, Any]:
    """Every proposal as plain data."""
    return {
        "world": NEW_WORLD,
        "proposals": [
            {
                "name": proposal.name,
                "change": proposal.change.value,
                "decision": transaction.decisions[proposal.name].value,
                "evidence": asdict(proposal.evidence),
                "frames": list(proposal.frames),
            }
            for proposal in transaction.update.proposals
        ],
    }


def proposal_table(transaction: Transaction) -> Table:
    """Every proposal with its evidence, in pixels of all frames, and its decision."""
    table = Table(title="Proposed changes of the model", title_justify="left", title_style="bold")
    for heading in ("object", "change", "decision"):
        table.add_column(heading)
    for heading in ("pixels for it", "against it", "hidden"):
        table.add_column(heading, justify="right")
    for proposal in transaction.update.proposals:
        evidence, decision = proposal.evidence, transaction.decisions[proposal.name]
        table.add_row(
            escape(proposal.name),
            proposal.change.value,
            Text(decision.value, style=STYLES[decision]),
            f"{evidence.supporting:,} {SUPPORT[proposal.change]}",
            f"{evidence.contradicting:,}",
            f"{evidence.hidden:,}",
        )
    return table


def _tell(transaction: Transaction, command: Update, out: Console) -> None:
    if not transaction.decisions:
        line(out, "No change of the model is proposed.")
        return
    out.print(proposal_table(transaction))
    world = command.result / NEW_WORLD
    line(out, f"{world} holds every change that is not rejected.")
    if Decision.PROPOSED in transaction.decisions.values():
        line(
            out,
            f"Decide with: torchcal update {command.result} --accept NAME ... --reject NAME ...",
        )
