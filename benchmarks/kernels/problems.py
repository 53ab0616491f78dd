"""Problems of the kernel benchmarks, and their data as records for the bare loops."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.kernels import microbenchmarks
from lavender.problem import Problem


def tridiagonal(m: int) -> Problem:
    """Return a frictionless stack of m unit masses: 2 on the diagonal of A, -1 next to it."""
    import scipy.sparse as sp

    a = sp.diags_array(
        [np.full(m - 1, -1.0), np.full(m, 2.0), np.full(m - 1, -1.0)], offsets=[-1, 0, 1]
    )
    return Problem.lcp(sp.csr_array(a), np.full(m, 0.1))


# -- bare loops --------------------------------------------------------------------------------------


def bare_contacts(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return contacts (two tangents) and bodies of a problem without joints as `microbenchmarks.contact` records."""
    rows, data = problem.rows, problem.data
    assert rows is not None
    contacts = np.zeros(rows.n_contacts, microbenchmarks.CONTACT)
    bodies = np.zeros(rows.n_bodies + 1, microbenchmarks.BODY)
    contacts["body"] = rows.contact_body + 1
    for name in ("normal", "tangent", "arm_a", "arm_b"):
        contacts[name] = getattr(rows, name)
    step = data.step.reshape(-1, 3)
    contacts["step"] = step[:, :2]
    contacts["rhs"] = problem.b.reshape(-1, 3)
    contacts["mu"] = problem.cones.mu
    bodies["inv_mass"][1:] = rows.inv_mass
    bodies["inv_inertia"][1:] = rows.inv_inertia.reshape(-1, 9)
    t2 = np.cross(rows.normal, rows.tangent)
    for side, arm in enumerate((rows.arm_a, rows.arm_b)):
        body = rows.contact_body[:, side]
        inertia = np.where((body >= 0)[:, None, None], rows.inv_inertia[body], 0.0)
        swing = np.einsum("cij,cj->ci", inertia, np.cross(arm, rows.normal))
        for i, t in enumerate((rows.tangent, t2)):
            contacts["coupling"][:, i] += np.einsum("ci,ci->c", np.cross(arm, t), swing)
    return contacts, bodies


def raw_bytes(array: np.ndarray) -> Any:
    """Return an array of records as bytes for a microbenchmark."""
    return array.view(np.uint8).reshape(-1)
