"""Which proposed changes of the model a person accepts, and the model that follows (2.5)."""

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any

import torch

from torchcal.calibrate.result import Change, Proposal, Update
from torchcal.errors import TorchcalError, choices
from torchcal.model.world import World, WorldObject

EVERY = "all"
"""In the place of a name: every proposal that is not named, unless an object has this name."""

PROVENANCE = "torchcal"
"""The key of an object's extras under which every change of it is listed, the latest last."""


class Decision(StrEnum):
    """What a person says of a proposal; the model holds every change that is not rejected."""

    PROPOSED = "proposed"
    """Nobody has decided."""
    ACCEPTED = "accepted"
    REJECTED = "rejected"


@dataclass(frozen=True, kw_only=True, slots=True)
class Transaction:
    """A model, the changes that are proposed, and what was decided about each."""

    source: str
    """The job that the changes come from."""
    world: World | None
    """As the job has it; None without one."""
    update: Update
    decisions: Mapping[str, Decision]
    """By the names of ``update.proposals``."""

    @staticmethod
    def undecided(source: str, world: World | None, update: Update) -> "Transaction":
        """Every change is proposed."""
        decisions = {proposal.name: Decision.PROPOSED for proposal in update.proposals}
        return Transaction(source=source, world=world, update=update, decisions=decisions)

    def decided(
        self, *, accept: Collection[str] = (), reject: Collection[str] = ()
    ) -> "Transaction":
        """The same with some changes accepted and others rejected.

        Args:
            accept: Names of proposals, or ``EVERY``.
            reject: Likewise.

        Raises:
            TorchcalError: If there is no such proposal, one is to be both, or a name was given
                where names are expected.
        """
        accepted, rejected = self._named(accept), self._named(reject)
        _refuse_both(accepted & rejected, accept, reject)
        others = set(self.decisions) - accepted - rejected
        if EVERY not in self.decisions:
            accepted |= others if EVERY in accepted else set()
            rejected |= others if EVERY in rejected else set()
        fresh = dict.fromkeys(accepted, Decision.ACCEPTED)
        fresh |= dict.fromkeys(rejected, Decision.REJECTED)
        decisions = {name: fresh.get(name, old) for name, old in self.decisions.items()}
        return replace(self, decisions=decisions)

    def corrected(self) -> World:
        """The model with every change that is not rejected; each is noted in the object's extras.

        With every change rejected it is the job's model, object by object.
        """
        changes = {proposal.name: proposal for proposal in self.update.proposals}
        changes = {k: v for k, v in changes.items() if self.decisions[k] != Decision.REJECTED}
        old = () if self.world is None else self.world.objects
        objects = [self._changed(item, changes.get(item.name)) for item in old]
        eye = torch.eye(4, dtype=torch.float64)
        added = [
            WorldObject(
                name=item.name,
                mesh=item.mesh,
                T_world_object=eye,
                extras=self._noted({}, changes[item.name]),
            )
            for item in self.update.added
            if item.name in changes
        ]
        return World(
            objects=(*(item for item in objects if item is not None), *added),
            complete=self.world is not None and self.world.complete,
        )

    def _named(self, names: Collection[str]) -> set[str]:
        """The names, if there are such proposals."""
        if isinstance(names, str):
            raise TorchcalError(f"found the text {names!r}; expected a list of names: [{names!r}]")
        unknown = sorted(set(names) - set(self.decisions) - {EVERY})
        if unknown:
            found = ", ".join(repr(name) for name in unknown)
            raise TorchcalError(f"found no proposal {found}; expected {choices(self.decisions)}")
        return set(names)

    def _changed(self, item: WorldObject, change: Proposal | None) -> WorldObject | None:
        """An object of the old model where the change puts it; None if it is gone."""
        if change is None:
            return item
        T = self.update.verdicts[item.name].T_world_object
        if change.change == Change.REMOVE or T is None:
            return None
        extras = self._noted(item.extras, change)
        return replace(item, T_world_object=T, extras=extras)

    def _noted(self, extras: Mapping[str, Any], proposal: Proposal) -> dict[str, Any]:
        """Extras that say where a change comes from."""
        note = {
            "change": proposal.change.value,
            "decision": self.decisions[proposal.name].value,
            "source": self.source,
            "evidence": asdict(proposal.evidence),
            "frames": list(proposal.frames),
        }
        return {**extras, PROVENANCE: [*extras.get(PROVENANCE, ()), note]}


def _refuse_both(both: set[str], accept: Collection[str], reject: Collection[str]) -> None:
    if both:
        raise TorchcalError(
            f"found {', '.join(sorted(both))} both among those to accept ({', '.join(accept)}) and "
            f"those to reject ({', '.join(reject)}); expected each name in one of them"
        )
