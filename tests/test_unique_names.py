"""Names of files and objects that must not collide."""

from torchcal.model.unique_names import unique_names


def test_names_become_unique_whatever_their_case():
    assert unique_names(["a", "A", "a-2", "b", "a"]) == ["a", "A-2", "a-2-2", "b", "a-3"]
