"""Problems for benchmarks and tests that need only the core package.

Piles on a lattice, columns of cubes, and conversions of a problem to another operator form.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

import lavender as lv
from lavender.base.errors import InputError
from lavender.problem import Problem
from lavender.problem.rows import Rows


def stacks(
    count: int, height: int, mu: float | None, equal: bool, corners: int = 4, seed: int = 0
) -> Problem:
    """Return columns of unit cubes on the ground with `corners` contacts per face and random masses, 0.5 to 2 kg."""
    rng = np.random.default_rng(seed)
    n = count * height
    mass = rng.uniform(0.5, 2.0, (1 if equal else count, height))
    inv_mass = 1.0 / np.broadcast_to(mass, (count, height)).ravel()
    spots = 0.4 * np.array([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8], [0.0, 0.2]])[:corners]
    above = np.repeat(np.arange(n), corners)
    below = np.where(above % height > 0, above - 1, -1)
    arm = np.column_stack([np.tile(spots, (n, 1)), np.full(corners * n, 0.5)])
    v = np.zeros((n, 6))
    v[:, 2] = -9.81 / 60.0
    rows = lv.Rows(
        inv_mass,
        6.0 * inv_mass[:, None, None] * np.eye(3),
        v,
        normal=np.tile([0.0, 0.0, 1.0], (corners * n, 1)),
        tangent=np.tile([1.0, 0.0, 0.0], (corners * n, 1)),
        arm_a=arm,
        arm_b=arm * [1.0, 1.0, -1.0],
        contact_body=np.column_stack([below, above]).astype(np.int32),
    )
    return Problem.from_rows(rows, mu=0.0 if mu is None else mu)


def forms(problem: Problem) -> dict[str, Problem]:
    """Return the problem given by bodies, by A, and by J and M."""
    rows = problem.rows
    assert rows is not None
    inertia = np.linalg.inv(rows.inv_inertia)
    blocks = np.zeros((rows.n_bodies, 6, 6))
    blocks[:, :3, :3] = np.eye(3) / rows.inv_mass[:, None, None]
    blocks[:, 3:, 3:] = inertia
    mass = sp.block_diag(list(map(sp.coo_array, blocks)), format="csr")
    general = lv.Generalized(rows.jacobian(problem.cones), mass, rows.v_free.ravel())
    return {
        "bodies": problem,
        "matrix": Problem(problem.b, problem.cones, problem.csr, friction=problem.friction),
        "J and M": Problem(
            problem.b,
            problem.cones,
            generalized=general,
            compliance=problem.compliance,
            friction=problem.friction,
        ),
    }


def fresh(problem: Problem) -> Problem:
    """Return a copy without derived data."""
    more = {"compliance": problem.compliance, "friction": problem.friction, "copy": False}
    return Problem(
        problem.b,
        problem.cones,
        problem.matrix,
        rows=problem.rows,
        generalized=problem.generalized,
        **more,
    )


def lattice_pile(contacts: int, *, shuffle: bool = False, seed: int = 0) -> Problem:
    """Return a cubic lattice of spheres on the ground with about `contacts` contacts and slightly tilted normals.

    Parameters
    ----------
    contacts : int
    shuffle : bool, default False
        Number bodies and contacts at random, as in a scene that was not built in spatial order.
    seed : int

    Raises
    ------
    InputError
        Fewer than 1 contact.
    """
    if contacts < 1:
        raise InputError(f"contacts is {contacts}; at least 1 is needed")
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
    c = len(body)
    n = k**3
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
        np.ones(n),
        inertia,
        v_free,
        normal=normal,
        tangent=tangent,
        arm_a=np.where(body[:, :1] >= 0, 0.5 * normal, 0.0),
        arm_b=-0.5 * normal,
        contact_body=body,
        copy=False,
    )
    return Problem.from_rows(rows, mu=0.5, tangents=2, name=f"lattice pile of {c} contacts")
