"""Accelerated sweeps over packed blocks give the bits of one block after the other, in every fixed order."""

import numpy as np
import pytest
from random_problems import random_contact_problem

import lavender as lv
from benchmarks.made import lattice_pile
from lavender_ext.accelerate import accelerated


def swept(problem, name, counts, *, packs=True, tol=0.0, **options):
    """Impulse and velocities after runs of those many iterations each, and how many pairs there were."""
    with pytest.MonkeyPatch.context() as patch:
        if not packs:
            patch.setattr(accelerated, "may_pack", lambda data: False)
        prepared = lv.prepare(problem, name, **options)
    solver, state = prepared.solver, prepared.state
    rng = np.random.default_rng(problem.m)
    lam = 0.05 * np.abs(rng.normal(size=problem.m))
    for n in counts:
        solver.run(state, lam, n, tol)
    return lam, state.sweeps.velocity[: problem.rows.n_bodies], state.sweeps.pairs[0]


ORDERS = ["given", "reverse", "symmetric", "bottom_up", "colored", "array"]
SOLVERS = [("nncg", {}), ("nncg", {"restart": "against"}), ("nncg", {"convex": 20}), ("anderson", {})]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("name", "options"), SOLVERS)
@pytest.mark.parametrize(
    ("contacts", "joints", "tangents", "spin"),
    [(24, 0, 2, False), (300, 0, 2, False), (301, 40, 2, True), (300, 40, None, False), (40, 300, 0, False)],
)
def test_pairs_change_no_bit(order, name, options, contacts, joints, tangents, spin):
    problem = random_contact_problem(
        contacts,
        tangents=tangents,
        spin=spin,
        bodies=(contacts + joints) // 2,
        joints=joints,
        contacts=contacts,
    )
    if order == "array":
        rng = np.random.default_rng(contacts)
        order = np.concatenate([rng.permutation(joints), joints + rng.permutation(contacts)])
    for counts in ([1, 3, 20, 5, 70], [40, 1, 30], [7]):
        lam, v, pairs = swept(problem, name, counts, order=order, **options)
        one, v_one, none = swept(problem, name, counts, packs=False, order=order, **options)
        np.testing.assert_array_equal(lam.view(np.uint8), one.view(np.uint8))
        np.testing.assert_array_equal(v.view(np.uint8), v_one.view(np.uint8))
        assert none == 0
        assert pairs == 0 or sum(counts) >= 16
        assert pairs > 0 or problem.n_blocks < 300 or not isinstance(order, str) or sum(counts) < 16
        assert pairs <= problem.n_blocks


@pytest.mark.parametrize(("name", "order"), [("nncg", "symmetric"), ("anderson", "given")])
def test_checks_see_the_same(name, order):
    pile = lattice_pile(300)
    ends = [swept(pile, name, [500], packs=packs, tol=1e-6, order=order) for packs in (True, False)]
    assert ends[0][2] > 0
    np.testing.assert_array_equal(ends[0][0].view(np.uint8), ends[1][0].view(np.uint8))


@pytest.mark.parametrize("options", [{"order": "random"}, {"sweep": "blocks"}])
def test_what_is_not_packed(options):
    assert swept(lattice_pile(300), "nncg", [40], **options)[2] == 0


def test_hostile_numbers_do_no_harm():
    problem = lattice_pile(300)
    prepared = lv.prepare(problem, "nncg", order="symmetric")
    for bad in (np.nan, np.inf, 1e300, -1e300):
        lam = np.full(problem.m, bad)
        prepared.solver.run(prepared.state, lam, 40, 0.0)
