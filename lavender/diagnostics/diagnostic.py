"""The class `Diagnostic`: one possible mistake in a problem's data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.problem import Problem


@dataclass(frozen=True)
class Diagnostic:
    """One possible mistake in a problem's data; `str()` is one line.

    Parameters
    ----------
    kind : str
        Short name of the kind of mistake.
    reason : str
        Observation, and the data to look at.
    blocks : tuple of int
        Blocks concerned; empty if the whole problem is.
    names : tuple of str
        Names of these blocks, up to 100.
    data : dict
        Numbers that led to the diagnostic.
    """

    kind: str
    reason: str
    blocks: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    data: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        names = ", ".join(self.names[:3]) + (
            f", {len(self.names) - 3} more" if len(self.names) > 3 else ""
        )
        return f"{self.kind}: {self.reason}" + (f" ({names})" if names else "")

    def __repr__(self) -> str:
        """Return the line in angle brackets, so that the tuple that `diagnose` returns can be read."""
        return f"<{type(self).__name__} {self}>"


def make_diagnostic(
    problem: Problem, kind: str, reason: str, blocks: Any = (), **data: Any
) -> Diagnostic:
    """Build a diagnostic with the names of the first 100 of these blocks; no block means the whole problem."""
    at = tuple(int(i) for i in np.unique(np.asarray(blocks, int)))
    names = tuple(problem.row_name(int(problem.cones.ptr[i])).rsplit(", ", 1)[0] for i in at[:100])
    return Diagnostic(kind, reason, at, names, data)
