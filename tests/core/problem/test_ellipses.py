"""Two coefficients of a disk: an ellipse, with the bits of a disk where they are equal, and in its own rows."""

from dataclasses import replace

import numpy as np
import pytest
from calls import LAWS, free, on_rows
from random_problems import as_matrix

import lavender as lv
from lavender import registry

OURS = [n for n in lv.available() if registry.specs()[n].own and not registry.specs()[n].external]
TAKES = [n for n in (*OURS, "clarabel_cone") if registry.specs()[n].laws & {"coulomb", "cone"}]


FORMS = {"generalized": free, "matrix": lambda *a, **k: as_matrix(free(*a, **k)), "rows": on_rows}


def takes(problem, name):
    return registry.specs()[name].refuses(problem) is None


# -- blocks ------------------------------------------------------------------------------------------------------------


def test_coefficients_come_back_and_equal_ones_are_a_disk():
    mu = np.array([[0.5, 0.2], [0.02, 0.8], [0.3, 0.3], [0.0, 0.0]])
    cones = lv.Cones.contacts(mu)
    assert cones.has_ellipse
    assert not cones.is_polyhedral
    np.testing.assert_allclose(cones.coefficients, mu, rtol=1e-15)
    np.testing.assert_allclose(cones.reach.reshape(-1, 3)[:, 1:], mu, rtol=1e-15)
    np.testing.assert_allclose(cones.stretch.reshape(-1, 3)[:2], [[1, 1, 0.4], [1, 0.025, 1]], rtol=1e-15)
    assert lv.Cones.contacts([(0.5, 0.5), (0.0, 0.0)]) == lv.Cones.contacts([0.5, 0.0])
    assert (lv.Cones.free(2) + cones).has_ellipse
    assert lv.Problem.contact(np.eye(3), np.ones(3), [(0.5, 0.5)]).disk.cones.kind.tolist() == [lv.CONTACT]
    x = np.array([1.0, 3.0, 4.0, 1.0, 0.0, 0.1, 1.0, 0.3, 0.0, -1.0, 1.0, 1.0])
    t = lv.cones.project(cones, x).reshape(-1, 3)
    np.testing.assert_allclose(np.hypot(*(t[0, 1:] / mu[0])), 1.0)
    np.testing.assert_allclose(t[1:, 1:], [[0, 0.1], [0.3, 0.0], [0, 0]], atol=1e-15)


# -- the twin ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", TAKES)
def test_an_ellipse_with_equal_coefficients_has_the_bits_of_the_disk(name, law):
    for form in (free, FORMS["matrix"]):
        disk = form(5, friction=law, mu=np.full((3, 2), 0.4))
        c = disk.cones
        cones = replace(c, kind=np.full(3, lv.CONTACT_ELLIPSE), patch_radius=np.ones(3))
        ellipse = replace(disk, cones=cones)
        assert ellipse.cones.has_ellipse
        assert not c.has_ellipse
        if takes(disk, name):
            one, two = (lv.solve(p, name, tol=0.0, max_iter=30) for p in (disk, ellipse))
            assert one.impulse.tobytes() == two.impulse.tobytes()
            assert one.slack.tobytes() == two.slack.tobytes()
            assert one.residual.relative == two.residual.relative


# -- the judge ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_what_comes_back_is_in_the_rows_of_the_problem(form):
    problem = FORMS[form](3, friction="cone")
    s, calls = problem.cones.stretch, []
    found = lv.solve(
        problem, "anderson", tol=1e-6, max_iter=5, callback=lambda n, x, r: calls.append((x, r)) and None
    )
    r = lv.residual(problem, found.impulse)
    np.testing.assert_allclose(
        found.slack, problem.dense() @ found.impulse - problem.b, rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(found.residual.error, r.error, rtol=1e-9, atol=1e-12)
    assert found.residual.relative == pytest.approx(r.relative, rel=1e-9)
    for x, at in calls:
        np.testing.assert_allclose(at.slack, problem.dense() @ x - problem.b, rtol=1e-9, atol=1e-12)
    single = np.float32(lv.solve(problem, tol=1e-9).impulse)
    assert lv.residual(problem, single, "float32").verdict == "at its floor"
    assert lv.residual(problem, 1.001 * single, "float32").verdict == "stopped early"
    pairs = [int(i) for i in problem.cones.ptr[:-1][problem.cones.kind == lv.CONTACT_ELLIPSE]]
    rows = r.velocity_by_row.copy()
    for n in pairs:
        rows[n + 1] = np.hypot(rows[n + 1], rows[n + 2])
    assert rows.max() == pytest.approx(r.velocity, rel=1e-12)
    p = problem.disk
    assert not p.cones.has_ellipse
    assert p.disk is p
    assert lv.residual(p, problem.on_disk(found.impulse)).relative == pytest.approx(r.relative, rel=1e-12)
    np.testing.assert_allclose(p.dense(), s[:, None] * problem.dense() * s, rtol=1e-12)
    assert problem.row_name(r.worst_row) == r.worst_name == p.row_name(r.worst_row)
