"""Problems that kernels are timed on, and the same as records of the bare loops."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.kernels import microbenchmarks
from lavender.lab.suite.families import at_least
from lavender.problem import Problem
from lavender.problem.rows import Rows

__all__ = ["bare_contacts", "lattice_pile", "raw_bytes", "tridiagonal"]


def lattice_pile(contacts: int, *, shuffle: bool = False, seed: int = 0) -> Problem:
    """About `contacts` contacts of spheres on a cubic lattice that stands on the ground, normals tilted a little.

    Parameters
    ----------
    contacts : int
    shuffle : bool, default False
        Number bodies and contacts at random, as a scene that was not built in space order.
    seed : int

    Raises
    ------
    InputError
        Fewer than 1 contact.
    """
    at_least(1, contacts=contacts)
    rng = np.random.default_rng(seed)
    k = max(1, round((contacts / 3) ** (1 / 3)))
    index = np.arange(k**3, dtype=np.int32).reshape(k, k, k)
    below = [np.full(k * k, -1, np.int32)]
    above = [index[:, :, 0].ravel()]
    axis = [np.full(k * k, 2)]
    for d in range(3):
        line = np.moveaxis(index, d, 0)
        below.append(line[:-1].ravel())
        above.append(line[1:].ravel())
        axis.append(np.full(line[1:].size, d))
    body = np.stack([np.concatenate(below), np.concatenate(above)], axis=1)
    along = np.concatenate(axis)
    order = (
        rng.permutation(len(body))
        if shuffle
        else np.argsort(np.where(body[:, 0] < 0, body[:, 1], body[:, 0]), kind="stable")
    )
    body, along = body[order], along[order]
    if shuffle:
        body = np.append(rng.permutation(k**3), -1).astype(np.int32)[body]
    c, n = len(body), k**3
    normal = 0.4 * (rng.random((c, 3)) - 0.5)
    normal[np.arange(c), along] += 1.0
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross(normal, np.eye(3)[(along + 1) % 3])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    inertia = np.zeros((n, 3, 3))
    inertia[:, [0, 1, 2], [0, 1, 2]] = 10.0  # 1/(kg m^2): 1 kg, radius 0.5 m
    v_free = np.zeros((n, 6))
    v_free[:, :3] = rng.normal(scale=0.1, size=(n, 3)) - [0.0, 0.0, 0.1]
    rows = Rows(
        np.ones(n), inertia, v_free, normal=normal, tangent=tangent,
        arm_a=np.where(body[:, :1] >= 0, 0.5 * normal, 0.0), arm_b=-0.5 * normal, contact_body=body, copy=False,
    )  # fmt: skip
    return Problem.from_rows(rows, mu=0.5, tangents=2, name=f"lattice pile of {c} contacts")


def tridiagonal(m: int) -> Problem:
    """A stack of m unit masses, frictionless: 2 on the diagonal, -1 beside it."""
    import scipy.sparse as sp

    a = sp.diags_array([np.full(m - 1, -1.0), np.full(m, 2.0), np.full(m - 1, -1.0)], offsets=[-1, 0, 1])
    return Problem.lcp(sp.csr_array(a), np.full(m, 0.1))


# -- bare loops --------------------------------------------------------------------------------------


def bare_contacts(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Contacts and bodies of `problem` (two tangents each, no joints) as the records of `microbenchmarks.contact`."""
    rows, data = problem.rows, problem.data
    assert rows is not None
    contacts, bodies = (
        np.zeros(rows.n_contacts, microbenchmarks.CONTACT),
        np.zeros(rows.n_bodies + 1, microbenchmarks.BODY),
    )
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
    """An array of records as the bytes that a microbenchmark reads."""
    return array.view(np.uint8).reshape(-1)
