"""Names of files and objects that must not collide."""

from collections.abc import Sequence


def unique_names(names: Sequence[str]) -> list[str]:
    """The names, with a number after each that came before (letter case does not count)."""
    taken: set[str] = set()
    unique = []
    for name in names:
        candidate, count = name, 1
        while candidate.casefold() in taken:
            count += 1
            candidate = f"{name}-{count}"
        taken.add(candidate.casefold())
        unique.append(candidate)
    return unique
