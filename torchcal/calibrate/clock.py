"""How long the stages of an estimate take."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True, slots=True)
class Clock:
    """Adds up the seconds of named stages."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def measured(self, stage: str) -> Iterator[None]:
        """Counts what runs within as part of a stage."""
        begin = time.perf_counter()
        yield
        passed = time.perf_counter() - begin
        self.seconds[stage] = self.seconds.get(stage, 0.0) + passed
