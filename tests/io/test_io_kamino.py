"""`from_kamino` on recorded arrays, against the engine's own matrix and laws; test_readers.py asks the rest."""

from pathlib import Path

import numpy as np
import pytest
from recorded_engines import make_kamino

import lavender as lv

# Engine and data are float32: v+ of the impulses and the engine's own velocity differ by roundings of 1 m/s numbers.
VELOCITY_TOLERANCE = 1e-4


def engine_world(solver, i):
    """Return A, b, the impulses and numbers of rows of world i in the engine's order, from its D, v_f and P only."""
    problem = solver._solver_kamino.problem_fd.data
    size, start, first = (int(x.numpy()[i]) for x in (problem.dim, problem.mio, problem.vio))
    scale = problem.P.numpy()[first : first + size].astype(float)
    matrix = problem.D.numpy()[start : start + size**2].reshape(size, size).astype(float)
    sigma = float(solver._solver_kamino.solver_fd.data.state.sigma.numpy()[i][0])
    matrix = (matrix - sigma * np.eye(size)) / np.outer(scale, scale)
    b = -problem.v_f.numpy()[first : first + size] / scale
    lam = solver._solver_kamino.solver_fd.data.solution.lambdas.numpy()[
        first : first + size
    ].astype(float)
    counts = [int(x.numpy()[i]) for x in (problem.njc, problem.nbc, problem.nl, problem.nc)]
    return matrix, b, lam, counts


def normals_first(joints, bounded, limits, contacts):
    before = joints + bounded + limits
    return [*range(before), *(before + 3 * k + j for k in range(contacts) for j in (2, 0, 1))]


@pytest.mark.parametrize("model", ["mixed", "stacks", "dvi"])
def test_from_kamino_problems_equal_the_matrix_of_the_engine(model):
    solver = make_kamino(model)
    step = lv.io.from_kamino(solver, verify=True)
    assert step.claims.converged.shape == (len(step.batch),)
    for i in range(len(step.batch)):
        matrix, b, lam, counts = engine_world(solver, i)
        if not np.isfinite(b).all() or not len(b):
            continue
        problem = step.batch[i]
        order = normals_first(*counts)
        # float32 roundings of sums of up to 24 terms
        assert (
            np.abs(problem.dense() - matrix[np.ix_(order, order)]).max()
            <= 1e-6 * np.abs(matrix).max()
        )
        assert np.abs(problem.b - b[order]).max() <= 1e-6 * (np.abs(b).max() + 1.0)
        np.testing.assert_array_equal(step.impulse[step.batch.rows_of(i)], lam[order])
        # joints are free, each in one block; then bounded rows, limits, and contacts of three rows
        joints, bounded, limits, contacts = counts
        lower, upper = problem.cones.lower, problem.cones.upper
        assert np.isinf(lower[:joints]).all() and np.isinf(upper[:joints]).all()
        acts = slice(joints, joints + bounded)
        assert (lower[acts] < 0.0).all() and np.isfinite(lower[acts]).all()
        np.testing.assert_array_equal(
            lower[acts], -upper[acts]
        )  # the limits of the recorded motor are symmetrical
        assert (lower[joints + bounded : joints + bounded + limits] == 0.0).all()
        assert problem.cones.is_contact.sum() == contacts
        assert (problem.cones.mu[problem.cones.is_contact] > 0.0).all()
        assert len(problem.names) == problem.cones.n_blocks
        linear = problem.jacobian[
            :, np.arange(problem.generalized.nv) % 6 < 3
        ]  # Velocities of bodies.
        is_angular = [problem.row_unit(k) == "rad/s" for k in range(problem.m)]
        assert is_angular == [not x.any() for x in linear.toarray()]


@pytest.mark.parametrize("model", ["mixed", "dvi"])
def test_from_kamino_verdicts_agree_with_complementarity_by_numpy(model):
    """The judge's velocity error against complementarity, cone and momentum computed here from the engine's D."""
    solver = make_kamino(model)
    step = lv.io.from_kamino(solver)
    judged = lv.residual_many(step.batch, step.impulse).velocity_error
    for i in range(len(step.batch)):
        matrix, b, lam, (joints, bounded, limits, contacts) = engine_world(solver, i)
        w = matrix @ lam - b
        d = np.diag(matrix)
        mu = step.batch[i].cones.mu[step.batch[i].cones.is_contact]
        worst = np.abs(w[:joints]).max(initial=0.0)
        for k in range(contacts):
            t = slice(joints + bounded + limits + 3 * k, joints + bounded + limits + 3 * k + 2)
            n = t.stop
            e = lam[n] - max(0.0, lam[n] - w[n] / d[n])
            d_t = d[t].mean()  # With one d, w_t opposite to lambda_t stays on the edge of the disk.
            free = lam[t] - w[t] / d_t
            bound = mu[k] * max(0.0, lam[n])
            e_t = lam[t] - free * min(1.0, bound / max(np.linalg.norm(free), 1e-300))
            worst = max(worst, abs(d[n] * e), *(d_t * np.abs(e_t)))
        # The judge uses one d for both tangents and weights the error of a block: within a factor of 2 of this one.
        assert 0.5 * judged[i] - 1e-6 <= worst <= 2.0 * judged[i] + 1e-6, (i, worst, judged[i])


def test_from_kamino_immovable_bodies_keep_their_velocity():
    def fix(array):
        array[1::2] = 0.0  # the upper box of each stack
        return array

    solver = make_kamino("stacks", inv_m_i=fix, inv_I_i=fix)
    engine = solver._solver_kamino
    problem, jacobians = engine.problem_fd.data, engine._jacobians.data
    for i, m in enumerate(
        problem.dim.numpy()
    ):  # The engine's D, had it known that these bodies cannot move.
        m = int(m)
        nv = 12
        jac = jacobians.J_cts_data.numpy()[jacobians.J_cts_offsets.numpy()[i] :][: m * nv].reshape(
            m, nv
        )
        inv_mass = np.zeros((nv, nv))
        inv_mass[:3, :3] = np.eye(3) * engine._model.bodies.inv_m_i.numpy()[2 * i]
        inv_mass[3:6, 3:6] = engine.data.bodies.inv_I_i.numpy()[2 * i]
        scale = problem.P.numpy()[problem.vio.numpy()[i] :][:m]
        sigma = engine.solver_fd.data.state.sigma.numpy()[i][0]
        matrix = np.outer(scale, scale) * (jac @ inv_mass @ jac.T) + sigma * np.eye(m)
        problem.D.numpy()[problem.mio.numpy()[i] :][: m * m] = matrix.ravel()
    own = lv.io.from_kamino(solver, verify=True).batch[0]
    jac = own.jacobian.toarray()
    assert not jac[:, 6:].any() and jac[:, :6].any()
    pushed, free = own.velocity(np.ones(own.m)), own.velocity(np.zeros(own.m))
    np.testing.assert_array_equal(pushed[6:], free[6:])
    assert np.abs(pushed[:6] - free[:6]).max() > 0.1


@pytest.mark.parametrize(
    "config",
    [
        {},
        {"sparse_jacobian": True},
        {"dynamics_solver": "dvi"},
        {"dynamics_solver": "dvi", "sparse_jacobian": False},
    ],
)
def test_from_kamino_of_the_installed_engine_gives_the_matrix_of_j_m_and_compliance(
    config, monkeypatch
):
    pytest.importorskip("newton")
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "findings" / "probes")
    from record_kamino import step_worlds

    from newton.tests.utils import basics  # isort: skip

    solver, after = step_worlds([basics.build_boxes_hinged()] * 2, False, **config)
    step = lv.io.from_kamino(solver, verify=True)
    assert (lv.residual_many(step.batch, step.impulse).velocity_error < 1e-4).all()
    velocity = np.concatenate(
        [step.batch[i].velocity(step.impulse[step.batch.rows_of(i)]) for i in range(2)]
    )
    assert np.abs(velocity - after.ravel()).max() <= VELOCITY_TOLERANCE
