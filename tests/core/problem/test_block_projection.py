"""The projection of one block and its derivatives against a dense twin in long double and its finite differences."""

import numpy as np
import pytest
import scipy.sparse as sp
from judge_twin import ROUND, project_cone, spec_of
from judge_twin import Problem as Twin
from random_problems import CONES

import lavender as lv
from lavender.judge.states import judge_and_linearise_impulse

L = np.longdouble
H = L(1e-7)  # step of central differences: 1e-14 of truncation, 1e-12 of rounding in long double
KINDS = CONES | {
    "rows": lambda mu, arm: lv.Cones(
        3 * np.arange(len(mu) + 1),
        np.zeros(len(mu), int),
        -np.repeat(arm, 3),
        np.repeat(mu, 3),
        0.0 * mu,
        0.0 * mu,
    )
}


def project(law, y, components):
    """Pi(y) of a contact from its definition; components: (rows, coefficient)."""
    if law == "cone":
        return project_cone(y, np.ones(len(y), L), components)
    out = y.copy()
    out[0] = max(L(0.0), y[0])
    for rows, coefficient in components:
        size = np.sqrt(np.sum(y[rows] ** 2))
        bound = coefficient * out[0]
        if size > bound:
            out[rows] *= bound / size
    return out


def difference(function, x, i):
    """Central difference of function(x) by x[i]."""
    step = np.zeros(len(x), L)
    step[i] = H
    return (function(x + step) - function(x - step)) / (2 * H)


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("kind", KINDS)
def test_projection_and_its_derivatives_equal_a_dense_twin(kind, law):
    if (kind, law) == ("round", "coulomb"):
        return
    rng = np.random.default_rng(5)
    n = 100
    mu, arm = rng.uniform(0.05, 1.5, n), rng.uniform(0.05, 1.5, n)
    mu[::15] = 0.0
    cones = KINDS[kind](mu, arm)
    ptr, m = cones.ptr, cones.n_rows
    g = rng.standard_normal((n, 6, 6))
    blocks = [
        x[:k, :k] @ x[:k, :k].T + 0.1 * np.eye(k) for x, k in zip(g, np.diff(ptr), strict=True)
    ]
    problem = lv.Problem(
        rng.standard_normal(m), cones, sp.block_diag(blocks, format="csr"), friction=law
    )
    impulse = rng.standard_normal(m)
    impulse[ptr[:-1]] += 0.5
    linear = judge_and_linearise_impulse(problem, impulse)
    disk = problem.disk
    twin = Twin(spec_of(disk))
    root = linear.root.astype(L)
    z = root * linear.impulse
    s = linear.slack / root
    y = z - s
    if kind == "rows":
        low, high = root * disk.cones.lower, root * disk.cones.upper
        np.testing.assert_allclose(linear.residual.astype(L), z - np.clip(y, low, high), rtol=1e-13)
        np.testing.assert_array_equal(linear.p, (low < y) & (y < high))
        return
    states = set()
    at = 0
    for k in range(n):
        block = slice(ptr[k], ptr[k + 1])
        size = ptr[k + 1] - ptr[k]
        components = (
            [(list(range(1, size)), twin.mu[k])] if disk.cones.kind[k] == ROUND else twin.parts(k)
        )
        components = [(rows, a * root[block][rows[0]] / root[block][0]) for rows, a in components]
        states.add(tuple(linear.case[block]))
        p = linear.p[at : at + size**2].reshape(size, size)
        at = at + size**2
        expected = project(law, y[block], components)
        scale = np.abs(z[block]).max() + np.abs(s[block]).max()
        np.testing.assert_allclose(
            (z[block] - linear.residual[block]).astype(float),
            expected.astype(float),
            rtol=0,
            atol=1e-14 * scale,
        )
        if (linear.margin[block] * linear.root[block]).min() < 1e-3:
            continue  # near a kink, where differences do not converge
        derivative = np.stack(
            [
                difference(lambda x, c=components: project(law, x, c), y[block], i)
                for i in range(size)
            ],
            1,
        )
        np.testing.assert_allclose(p, derivative.astype(float), rtol=0, atol=1e-10)
        for rows, a in components:
            if a < 1e-3:
                continue  # at the lowest coefficient
            unit = np.zeros(m)
            unit[ptr[k] + rows[0]] = 1.0

            def by_coefficient(x, rows=rows, block=block, components=components):
                return project(
                    law, y[block], [(r, x[0] if r == rows else c) for r, c in components]
                )

            edge = linear.multiply_projection_derivative(unit, edge=True)[block] * (
                root[block][0] / root[block][rows[0]]
            )
            np.testing.assert_allclose(
                edge.astype(float),
                difference(by_coefficient, np.array([a], L), 0).astype(float),
                rtol=0,
                atol=1e-9,
            )
    cases = np.array(
        [(*case, -1, -1, -1, -1, -1)[:6] for case in states]
    )  # open, and closed with every component in both
    assert {0, 1} <= set(cases[:, 0])
    assert all({2, 3} <= set(cases[:, rows[0]]) for rows, _ in components)


@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_projection_of_nan_is_nan(law):
    cones = lv.Cones.contacts(np.full(1, 0.5))
    problem = lv.Problem(np.zeros(3), cones, np.eye(3), friction=law)
    linear = judge_and_linearise_impulse(problem, np.array([1.0, np.nan, 0.0]))
    assert np.isnan(linear.residual).any()
