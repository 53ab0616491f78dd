"""Count the contacts of a problem, also those that are written as edges of pyramids."""

from __future__ import annotations

import re

import numpy as np

from lavender.problem import Problem

# Importers name the edges of a pyramidal contact "contact 3 (floor, box), edge 0".
CONTACT_PREFIX = "contact "
EDGE_SUFFIX = re.compile(r", edge \d+$")


def count_contacts(problem: Problem) -> int:
    """Return the number of contacts: blocks with friction or named as contacts; edges of one pyramid count once."""
    names = problem.names or [""] * problem.n_blocks
    is_named = np.array([name.startswith(CONTACT_PREFIX) for name in names], bool)
    named = {EDGE_SUFFIX.sub("", name) for name in names if name.startswith(CONTACT_PREFIX)}
    return len(named) + int(np.count_nonzero(problem.cones.is_contact & ~is_named))
