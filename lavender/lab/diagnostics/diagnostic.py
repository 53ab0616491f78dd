"""What a suspicion says."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.problem import Problem


@dataclass(frozen=True)
class Suspicion:
    """One thing that looks wrong; `str()` is a line."""

    kind: str  # in a few words, the same for the same mistake
    reason: str  # what was found, and what to look at
    blocks: tuple[int, ...] = ()  # blocks concerned; empty: the whole
    names: tuple[str, ...] = ()  # of these blocks
    data: dict[str, Any] = field(default_factory=dict)  # the numbers behind it

    def __str__(self) -> str:
        where = ", ".join(self.names[:3]) + (f", {len(self.names) - 3} more" if len(self.names) > 3 else "")
        return f"{self.kind}: {self.reason}" + (f" ({where})" if where else "")


def suspect(problem: Problem, kind: str, reason: str, blocks: Any = (), **data: Any) -> Suspicion:
    """A suspicion of these blocks (empty: of the whole), with their names."""
    at = tuple(int(i) for i in np.unique(np.asarray(blocks, int)))
    names = tuple(problem.row_name(int(problem.cones.ptr[i])).rsplit(", ", 1)[0] for i in at[:100])
    return Suspicion(kind, reason, at, names, data)
