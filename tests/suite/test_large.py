"""The set @large: problems with friction of 3,000 and 20,000 rows, judged by a second computation of the residual."""

import numpy as np
import pytest
from scipy import sparse

import lavender as lv
from lavender import suite

TOL = 1e-6
#: `auto` solves these in less than a second each.
SOLVED = (
    "granularF(n=6)",
    "granularF(n=6, sliding=0.5)",
    "wall(n=10)",
    "wall(n=10, sliding=0.5)",
    "pyramidF(k=16)",
    "pyramidF(k=16, sliding=0.5)",
)
#: `auto` solves these in 0.1 to 3 seconds each.
SOLVED_NIGHTLY = (
    "granularF(n=6, sliding=2, seed=4)",
    "granularF(n=11)",
    "wall(n=25)",
    "wall(n=25, sliding=0.1)",
    "pyramidF(k=40)",
)


def compute_residual(problem, impulse):
    """Return the relative residual under Coulomb's law, from the arrays of bodies and contacts alone.

    All contacts have two tangents and the targets 0. The definitions are those of docs/residual.md: the largest
    E/E0 and V/V0 of all islands.
    """
    rows = problem.rows
    count, bodies = len(rows.normal), len(rows.inv_mass)
    axes = np.stack(
        [rows.normal, rows.tangent, np.cross(rows.normal, rows.tangent)], 1
    )  # (c, 3, 3)
    inverse = np.zeros((bodies, 6, 6))
    inverse[:, [0, 1, 2], [0, 1, 2]] = rows.inv_mass[:, None]
    inverse[:, 3:, 3:] = rows.inv_inertia
    sides = []  # of each contact: body, Jacobian (c, 3, 6) with respect to its velocity
    for sign, arm, body in (
        (-1, rows.arm_a, rows.contact_body[:, 0]),
        (1, rows.arm_b, rows.contact_body[:, 1]),
    ):
        jac = sign * np.concatenate([axes, np.cross(arm[:, None], axes)], 2)
        sides.append((np.maximum(body, 0), jac * (body >= 0)[:, None, None]))
    diagonal = sum(
        np.einsum("cri,cij,crj->cr", jac, inverse[body], jac) for body, jac in sides
    )  # (c, 3)
    diagonal[:, 1:] = diagonal[:, 1:].mean(1, keepdims=True)

    moving = rows.inv_mass > 0
    a, b = rows.contact_body.T
    both = (a >= 0) & (b >= 0) & moving[a] & moving[b]
    links = sparse.coo_matrix((np.ones(both.sum()), (a[both], b[both])), shape=(bodies, bodies))
    island = sparse.csgraph.connected_components(links, directed=False)[1][
        np.where((a >= 0) & moving[a], a, b)
    ]

    def compute_norms(lam):
        change = np.zeros((bodies, 6))
        for body, jac in sides:
            np.add.at(change, body, np.einsum("cri,cr->ci", jac, lam))
        velocity = rows.v_free + np.einsum("bij,bj->bi", inverse, change)
        slack = sum(np.einsum("cri,ci->cr", jac, velocity[body]) for body, jac in sides)
        step = lam - slack / diagonal
        bound = problem.cones.mu * np.maximum(lam[:, 0], 0)
        size = np.hypot(step[:, 1], step[:, 2])
        shrink = np.where(size > bound, bound / np.where(size > 0, size, 1), 1)
        error = lam - np.column_stack([np.maximum(step[:, 0], 0), shrink[:, None] * step[:, 1:]])
        error[:, 1] = np.hypot(error[:, 1], error[:, 2])
        energy = np.zeros(island.max() + 1)
        speed = np.zeros(island.max() + 1)
        np.add.at(energy, island, (diagonal[:, :2] * error[:, :2] ** 2).sum(1))
        np.maximum.at(speed, island, (diagonal[:, :2] * np.abs(error[:, :2])).max(1))
        return np.sqrt(energy), speed

    (energy, speed), (energy_at_zero, speed_at_zero) = map(
        compute_norms, (impulse.reshape(count, 3), np.zeros((count, 3)))
    )
    return max((energy / energy_at_zero).max(), (speed / speed_at_zero).max())


def test_large_set_has_about_3000_or_20000_rows_under_coulomb_law():
    names = suite.SETS["large"]
    assert {*SOLVED, *SOLVED_NIGHTLY} < set(names)
    assert not set(names) & {*suite.SETS["default"], *suite.SETS["hard"]}
    for case in suite.cases("@large"):
        assert case.problem.law == "coulomb"
        assert 2_900 <= case.problem.m <= 3_300 or 18_000 <= case.problem.m <= 22_000, case.name


@pytest.mark.parametrize(
    "name", [*SOLVED, *(pytest.param(name, marks=pytest.mark.nightly) for name in SOLVED_NIGHTLY)]
)
def test_auto_on_large_case_meets_tolerance_by_second_residual(name):
    problem = suite.case(name).problem
    solution = lv.solve(problem, "auto", tol=TOL)
    assert solution.success
    computed = compute_residual(problem, solution.impulse)
    assert computed <= TOL
    # Slacks of 1e-8 of the speeds from which they are differences keep eight digits.
    assert computed == pytest.approx(solution.residual.relative, rel=1e-4)


@pytest.mark.parametrize("name", suite.SETS["large"])
def test_judge_of_unconverged_large_case_equals_second_residual(name):
    problem = suite.case(name).problem
    solution = lv.solve(problem, "anderson", tol=0, max_iter=20)
    assert solution.residual.relative > TOL
    # Sums of 20,000 rounded squares
    assert compute_residual(problem, solution.impulse) == pytest.approx(
        solution.residual.relative, rel=1e-10
    )
