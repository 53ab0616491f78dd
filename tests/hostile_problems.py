"""Problems for nightly properties: scales over many decades, repeated rows, ties, b = 0, bodies that do not move.

The same seed gives the same problem on every machine.
"""

from dataclasses import replace

import numpy as np
from random_problems import as_matrix, random_contact_problem

import lavender as lv

FAR_BOUNDS = (0.0, 1e-60, 1e-50, 1e-9, 0.1, 1.0, 1e6, 1e30, 1e59, np.inf)


def draw_bounds(rng, m):
    """Draw bounds (m,) of rows: free, fixed, one- and two-sided, near and far, with and without 0 between."""
    a, b = (rng.choice(FAR_BOUNDS, m) * rng.choice([-1.0, 1.0], m) for _ in range(2))
    lower, upper = np.minimum(a, b), np.maximum(a, b)
    kind = rng.integers(0, 6, m)
    lower = np.where(kind < 2, 0.0, lower)
    upper = np.where(kind == 0, np.inf, np.where(kind == 1, np.abs(upper), upper))
    upper = np.where((kind == 2) & (np.abs(lower) < 1e30), lower, upper)
    lower = np.where(kind == 3, -np.inf, lower)
    upper = np.where(kind == 3, np.inf, upper)
    return np.where(lower == np.inf, 0.0, lower), np.where(upper == -np.inf, 0.0, upper)


def draw_rows(rng, m, n):
    """Draw J (m, n): whole numbers, which tie, or normal ones; rows are repeated, summed, or scaled by decades."""
    jac = (
        rng.integers(-2, 3, (m, n)).astype(float)
        if rng.random() < 0.5
        else rng.standard_normal((m, n))
    )
    jac *= rng.random((m, n)) < rng.choice([0.2, 0.5, 1.0])
    for _ in range(int(rng.integers(0, m + 1))):
        i, j, k = rng.integers(0, m, 3)
        jac[i] = rng.choice([1.0, -1.0, 2.0]) * jac[j] + rng.choice([0.0, 0.0, 1.0, 1e-9]) * jac[k]
    if rng.random() < 0.3:
        jac *= 10.0 ** rng.integers(-6, 7, (m, 1))
    return jac


def draw_rhs(rng, m):
    """Draw b (m,): normal, whole numbers, tiny, or 0."""
    size = rng.choice([1.0, 1.0, 1.0, 1e-12, 1e-18, 0.0])
    return size * (rng.standard_normal(m) if rng.random() < 0.6 else rng.integers(-2, 3, m))


def draw_row_problem(seed, max_rows=24):
    """Draw bounded rows and contacts over J and M, or over their A."""
    rng = np.random.default_rng([118, seed])
    contacts = int(rng.integers(0, 4)) * int(rng.random() < 0.6)
    rows = int(rng.integers(1, max_rows - 8))
    cones = lv.Cones.bounded(*draw_bounds(rng, rows))
    if contacts:
        cones = cones + lv.Cones.contacts(rng.choice([0.0, 0.5, 1.0, 1e-6, 1e6], contacts))
    m = len(cones.lower)
    n = int(rng.integers(1, 2 * m))
    jac = draw_rows(rng, m, n)
    b = draw_rhs(rng, m)
    mass = np.diag(10.0 ** (rng.integers(-6, 7, n) if rng.random() < 0.3 else np.zeros(n)))
    if rng.random() < 0.5:
        half = rng.standard_normal((n, n)) * np.sqrt(np.diag(mass))[:, None]
        mass = mass + half @ half.T
    compliance = np.where(rng.random(m) < 0.2, 10.0 ** rng.integers(-9, 1, m), 0.0)
    law = str(rng.choice(["cone", "coulomb"]))
    # Beside J v* of 1 m/s, the float64 of a tiny b is rounding.
    free = rng.choice([0.0, 1.0, 1e3]) * (np.abs(b).max() > 1e-6) * rng.standard_normal(n)
    problem = lv.Problem.from_jacobian(
        jac, mass, free, target=b + jac @ free, compliance=compliance, cones=cones, friction=law
    )
    return as_matrix(problem) if rng.random() < 0.4 else problem


def draw_body_problem(seed):
    """Draw bodies with joints and contacts; some bodies do not move, at rest or at a given velocity."""
    rng = np.random.default_rng([811, seed])
    problem = random_contact_problem(
        seed, str(rng.choice(["cone", "coulomb"])), 2, spin=False, bodies=5, joints=3, contacts=4
    )
    rows = problem.rows
    stands = rng.random(5) < rng.choice([0.0, 0.3, 0.7])
    scale = 10.0 ** (rng.integers(-6, 7, 5) if rng.random() < 0.3 else np.zeros(5)) * ~stands
    free = rows.v_free * rng.choice([0.0, 1.0, 1e3], 5)[:, None]
    rows = replace(
        rows,
        inv_mass=rows.inv_mass * scale,
        inv_inertia=rows.inv_inertia * scale[:, None, None],
        v_free=free,
    )
    target = draw_rhs(rng, problem.m) if rng.random() < 0.5 else np.zeros(problem.m)
    problem = lv.Problem.from_rows(
        rows,
        target=target,
        lower=problem.cones.lower[: len(rows.jac)],
        upper=problem.cones.upper[: len(rows.jac)],
        mu=0.5,
        tangents=2,
        friction=problem.friction,
        compliance=np.where(rng.random(len(target)) < 0.1, 0.01, 0.0),
    )
    return problem


def draw_problem(seed):
    """Draw one problem of any of these kinds."""
    return draw_body_problem(seed) if seed % 4 == 0 else draw_row_problem(seed)
