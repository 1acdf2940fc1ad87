"""The transaction: which changes of the model hold, and that every one can be taken back."""

from dataclasses import replace

import pytest
import torch
from display_scene import MOVED, transaction_of_all_kinds

from torchcal.calibrate.decisions import PROVENANCE, Decision, Transaction
from torchcal.calibrate.result import Evidence
from torchcal.errors import TorchcalError
from torchcal.model.world import World


@pytest.fixture
def transaction() -> Transaction:
    return transaction_of_all_kinds()


def names(world: World) -> list[str]:
    return [item.name for item in world.objects]


def test_every_change_holds_until_a_person_rejects_it(transaction):
    assert set(transaction.decisions.values()) == {Decision.PROPOSED}
    world = transaction.corrected()
    assert names(world) == ["wall", "added-1"]
    torch.testing.assert_close(world.objects[0].T_world_object, MOVED, rtol=0.0, atol=0.0)
    assert transaction.decided(accept=["all"]).corrected().objects[0].T_world_object is MOVED


def test_with_everything_rejected_the_world_is_the_jobs_own(transaction):
    undone = transaction.decided(accept=["all"]).decided(reject=["all"]).corrected()
    assert undone == transaction.world


def test_each_change_can_be_taken_back_alone(transaction):
    kept = {name: transaction.decided(reject=[name]).corrected() for name in transaction.decisions}
    assert {name: names(world) for name, world in kept.items()} == {
        "wall": ["wall", "added-1"],
        "crate": ["wall", "crate", "added-1"],
        "added-1": ["wall"],
    }
    assert kept["wall"].objects[0] is transaction.world.objects[0]


def test_all_means_those_that_are_not_named(transaction):
    decided = transaction.decided(accept=["crate"], reject=["all"])
    assert decided.decisions == {
        "wall": Decision.REJECTED,
        "crate": Decision.ACCEPTED,
        "added-1": Decision.REJECTED,
    }


def test_an_object_that_is_called_all_is_meant_by_its_name(transaction):
    added = (replace(transaction.update.added[0], name="all"),)
    update = replace(transaction.update, added=added)
    named = Transaction.undecided("job.toml", transaction.world, update).decided(reject=["all"])
    assert [name for name, what in named.decisions.items() if what == Decision.REJECTED] == ["all"]


def test_decisions_that_are_not_named_stay(transaction):
    decided = transaction.decided(accept=["wall"]).decided(reject=["crate"])
    assert decided.decisions == {
        "wall": Decision.ACCEPTED,
        "crate": Decision.REJECTED,
        "added-1": Decision.PROPOSED,
    }


@pytest.mark.parametrize(
    ("accept", "reject", "words"),
    [
        (["drum"], [], r"no proposal 'drum'; expected one of added-1, crate, wall"),
        (["wall"], ["wall", "crate"], r"found wall both"),
        (["all"], ["all"], r"found all both"),
        ("wall", [], r"found the text 'wall'; expected a list of names: \['wall'\]"),
        ([], "all", r"found the text 'all'; expected a list"),
    ],
)
def test_wrong_names_are_refused(transaction, accept, reject, words):
    with pytest.raises(TorchcalError, match=words):
        transaction.decided(accept=accept, reject=reject)


def test_changed_objects_say_where_the_change_comes_from(transaction):
    wall, added = transaction.decided(accept=["wall"]).corrected().objects
    (note,) = wall.extras[PROVENANCE]
    assert (note["change"], note["decision"], note["source"]) == ("move", "accepted", "job.toml")
    (note,) = added.extras[PROVENANCE]
    assert (note["change"], note["decision"]) == ("add", "proposed")
    assert note["frames"] == ["0001"]
    assert Evidence(**note["evidence"]) == transaction.update.added[0].evidence


def test_earlier_changes_of_an_object_stay_noted(transaction):
    first = transaction.decided(accept=["all"]).corrected()
    update = replace(transaction.update, added=())
    again = Transaction.undecided("next.toml", first, update).corrected()
    notes = again.objects[0].extras[PROVENANCE]
    assert [note["source"] for note in notes] == ["job.toml", "next.toml"]
