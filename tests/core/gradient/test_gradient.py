"""Derivatives of solutions: against differences, against their own adjoint, where they do not exist, and refusals."""

import pickle
import sys

import numpy as np
import pytest
from gradient_problems import KINDS, combinations, directions, drawn, moved, named, table

import lavender as lv

H = 1e-5  # of differences: 1e-10 of curvature, 1e-9 of solutions to 1e-14
CLOSE = 1e-6


def solved(problem):
    solution = lv.solve(problem, tol=1e-14)
    assert solution.residual.relative < 1e-11 or solution.residual.at_floor, str(solution)
    return solution


PROBLEMS = [pytest.param(*given, id="-".join(given)) for given in combinations()]


@pytest.mark.parametrize("kind, law, operator", PROBLEMS)
def test_derivative_jvp_agrees_with_differences_of_solutions(kind, law, operator):
    for seed in range(3):
        p = drawn(seed, kind, law, operator)
        solution = solved(p)
        d = lv.derivative(p, solution)
        if d.distance.min() < 1e-3:
            continue
        assert d.exists
        for name, change in directions(p, np.random.default_rng(seed)).items():
            found = d.jvp(**named(name, change))
            ends = [solved(moved(p, name, change, h)) for h in (-H, H)]
            wanted = (ends[1].impulse - ends[0].impulse) / (2.0 * H)
            size = 1.0 + np.abs(wanted).max()
            assert np.abs(found.impulse - wanted).max() <= CLOSE * size, (seed, name)
            wanted = (ends[1].slack - ends[0].slack) / (2.0 * H)
            assert np.abs(found.slack - wanted).max() <= CLOSE * size, (seed, name)
            if p.matrix is None:
                ends = [
                    moved(p, name, change, h).velocity(x.impulse)
                    for h, x in zip((-H, H), ends, strict=True)
                ]
                wanted = (ends[1] - ends[0]) / (2.0 * H)
                assert np.abs(found.velocity - wanted).max() <= CLOSE * size, (seed, name)
        return
    pytest.fail("a switch is near in each of them")


@pytest.mark.parametrize("kind, law, operator", PROBLEMS)
def test_derivative_vjp_is_the_adjoint_of_jvp(kind, law, operator):
    # to rounding: both are the same linear map, read from its two ends
    p = drawn(0, kind, law, operator)
    d = lv.derivative(p, solved(p))
    rng = np.random.default_rng(1)
    weights = {"impulse": rng.standard_normal(p.m), "slack": rng.standard_normal(p.m)}
    if p.matrix is None:
        weights["velocity"] = rng.standard_normal(p.velocity(np.zeros(p.m)).shape)
    g = d.vjp(**weights)
    for name, change in directions(p, rng).items():
        found = d.jvp(**named(name, change))
        wanted = sum(float(np.sum(w * getattr(found, key))) for key, w in weights.items())
        if name == "mu of each tangent":
            two = np.isin(p.cones.kind, (lv.CONTACT_BOX, lv.CONTACT_ELLIPSE))
            pairs = [(g.coefficients, np.where(two[:, None], change, [[1.0, 0.0]] * change))]
        elif name in "AJM":
            pairs = [(g.full(name), change)]
        else:
            pairs = [(getattr(g, key), x) for key, x in named(name, change).items()]
        told = sum(float(np.sum(a * b)) for a, b in pairs)
        assert told == pytest.approx(wanted, rel=1e-9, abs=1e-9), name


def test_derivative_states_of_rows_and_components_are_documented_ones():
    p = lv.Problem.lcp(np.eye(4), [1.0, -1.0, 3.0, 0.0], [0.0, 0.0, 0.0, 0.0], [2.0, 2.0, 2.0, 2.0])
    solution = lv.solve(p, tol=1e-12)
    assert solution.states.names == ("free", "at a bound", "at a bound", "at a bound")
    assert [s.margin for s in solution.states[:3]] == pytest.approx([1.0, 1.0, 1.0])
    assert (
        solution.state(3).margin == 0.0
        and str(solution.state(0)) == "free, 1 N s from another state"
    )
    with pytest.raises(IndexError, match="block 4 does not exist; there are 4"):
        solution.state(4)
    spin = lv.Problem(np.array([10.0, 9.0, 0.0, 0.5]), lv.Cones.contacts(0.5, 2, 1.0), np.eye(4))
    state = lv.solve(spin, tol=1e-12).state(0)
    assert (state.name, state.rows) == ("slides", ("closed", "slides", "slides", "sticks"))
    assert len(lv.solve(lv.Problem.linear(np.zeros((0, 0)), [])).states) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_derivative_states_fit_impulse_and_slack(kind):
    # the definition, in NumPy: what is open has no impulse, what sticks no slack, what slides is on its rim
    law = "cone" if kind == "round" else "coulomb"
    p = drawn(1, kind, law, "generalized")
    solution = solved(p)
    near = 1e-8
    lam, w, c = solution.impulse, solution.slack, p.cones
    for i, state in enumerate(solution.states):
        rows = np.arange(c.ptr[i], c.ptr[i + 1])
        for j, name in zip(rows, state.rows, strict=True):
            if name in ("sticks", "free") or (name == "closed" and law == "coulomb"):
                assert abs(w[j]) < near
            elif name == "open":
                assert abs(lam[j]) < near
            elif name == "at a bound":
                assert min(abs(lam[j] - c.lower[j]), abs(lam[j] - c.upper[j])) < near
        if state.name == "slides" and len(rows) == 3 and "box" not in kind:
            reach = np.where(
                c.friction_coefficient[rows[1:]] > 0.0, c.friction_coefficient[rows[1:]], 1.0
            )
            share = np.linalg.norm(lam[rows[1:]] / reach) / lam[rows[0]]
            assert (
                share == pytest.approx(0.0 if kind == "smooth" and i < 4 else 1.0, abs=1e-6)
                or kind == "smooth"
            )


def test_derivative_of_dependent_rows_gives_velocities_and_rejects_impulses():
    p = table()
    d = lv.derivative(p, lv.solve(p, tol=1e-12))
    assert not d.unique.impulse.any() and d.unique.slack.all() and d.unique.velocity
    assert not d.unique.target.any() and not d.exists
    g = d.vjp(velocity=[1.0, 2.0, 3.0])
    assert np.abs(g.v_free).max() < 1e-9  # it stays at rest whatever pushes it a little
    total = d.vjp(impulse=np.ones(4))  # their sum is unique: the weight
    assert total.v_free == pytest.approx([-1.0, 0.0, 0.0], abs=1e-9)
    with pytest.raises(
        lv.CapabilityError,
        match=r"gradient is not unique: impulse: not of 4 rows \(row 0, row 1, row 2, ...",
    ):
        d.vjp(impulse=[1.0, 0.0, 0.0, 0.0])
    t = d.jvp(v_free=[0.3, 0.2, 0.1])
    assert np.abs(t.velocity).max() < 1e-9 and np.abs(t.slack).max() < 1e-9
    with pytest.raises(lv.CapabilityError, match="impulses of this problem are not unique"):
        _ = t.impulse


def test_derivative_near_a_switch_is_flagged():
    a = np.array([[2.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]])
    edge = np.array([10.0, 5.0, 0.0])  # N s, on the rim, about to slide

    def push(x):
        return lv.Problem.contact(a, a @ edge + [0.0, x, 0.0], mu=[0.5])

    for gap, told in ((1e-3, ()), (1e-15, (0,)), (-1e-15, (0,)), (0.0, (0,))):
        p = push(gap)
        d = lv.derivative(p, lv.solve(p, tol=1e-13))
        assert d.switching == told and d.exists == (not told), gap
    # it slides by 1e-9 m/s: an exact answer sees it, one that is off by as much does not
    p = push(1e-9)
    assert lv.derivative(p, lv.solve(p, tol=1e-14)).switching == ()
    rough = lv.derivative(p, edge + np.array([3e-9, 2e-9, 0.0]))
    assert rough.switching == (0,) and "about to switch" in str(rough)
    assert rough.distance[0] < 1e-8 and rough.distance_in_errors[0] < 10.0


def test_derivative_of_equal_bounds_moves_them_together():
    p = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, 1.0], [0.25, 0.0], [0.25, np.inf])
    d = lv.derivative(p, lv.solve(p, tol=1e-13))
    assert d.exists and d.distance[0] == np.inf
    t = d.jvp(lower=[1.0, 0.0], upper=[1.0, 0.0])
    assert t.impulse == pytest.approx([1.0, -0.5])
    g = d.vjp(impulse=[0.0, 1.0])
    assert g.lower == pytest.approx([-0.25, 0.0]) and g.upper == pytest.approx([-0.25, 0.0])
    for name in ("lower", "upper"):  # one of them: half of it, both ways
        assert d.jvp(**{name: [1.0, 0.0]}).impulse == pytest.approx([0.5, -0.25])


def test_derivatives_of_a_batch_equal_single_gradients():
    # one after the other, of what the compiled call takes and of what goes alone: a matrix, a singular system
    rng = np.random.default_rng(0)
    problems = [drawn(seed, "disk", "cone", "generalized") for seed in range(3)]
    twice = lv.Problem.from_jacobian(
        np.ones((2, 1)), np.eye(1), [-1.0], cones=lv.Cones.bounded(np.zeros(2), np.inf)
    )
    for given in (problems, [*problems, twice, drawn(3, "ellipse", "cone", "generalized")]):
        solutions = lv.solve_many(given, tol=1e-12)
        weights = [rng.standard_normal(p.generalized.nv) for p in given]
        for answers in (
            solutions,
            [s.impulse for s in solutions],
            [s.impulse.tolist() for s in solutions],
        ):
            d = lv.derivatives(given, answers)
            found = d.vjp(velocity=weights)
            each = [
                lv.derivative(p, s).vjp(velocity=y)
                for p, s, y in zip(given, solutions, weights, strict=True)
            ]
            assert np.array_equal(found.v_free, np.concatenate([g.v_free for g in each]))
            assert np.array_equal(pickle.loads(pickle.dumps(found)).v_free, found.v_free)
            assert np.array_equal(found.mu, np.concatenate([g.mu for g in each]))
            assert np.array_equal(found[-1].v_free, each[-1].v_free) and len(found[:2]) == 2
        if twice in given:
            with pytest.raises(lv.CapabilityError, match="share a load"):
                found.b  # noqa: B018 - read
        else:
            assert np.array_equal(found.b, np.concatenate([g.b for g in each]))
            lists = d.vjp(velocity=[y.tolist() for y in weights])
            assert np.array_equal(lists.b, found.b)


def test_derivatives_of_a_stacked_batch_equal_single_ones_and_reject_other_solutions():
    rng = np.random.default_rng(0)
    batch = lv.Batch(
        rng.standard_normal((3, 6, 7)),
        np.tile(np.eye(7), (3, 1, 1)),
        rng.standard_normal((3, 7)),
        cones=lv.Cones.contacts(0.5, 2, count=5),
        count=[6, 3, 6],  # the second has room for three rows more
        friction="cone",
    )
    solutions = lv.solve_many(batch, tol=1e-12)
    found = lv.derivatives(batch, solutions).vjp(velocity=np.ones((3, 7)))
    for i, g in enumerate(found):
        alone = lv.derivative(batch[i], solutions[i]).vjp(velocity=np.ones(7))
        assert np.array_equal(g.b, alone.b) and np.array_equal(found.v_free[i], alone.v_free)
        assert np.array_equal(found.b[i, : len(g.b)], alone.b)
    with pytest.raises(lv.InputError, match="problem 0: the impulse is not a solution"):
        lv.derivatives(batch[::-1], solutions)
    with pytest.raises(lv.InputError, match="world 0: the impulse is not a solution"):
        lv.derivatives(batch, 0.9 * solutions.impulse).vjp(velocity=np.ones((3, 7)))
    assert (
        len(lv.derivatives([], [])) == 0 and lv.derivatives([], []).vjp(impulse=[]).b.tolist() == []
    )


@pytest.mark.parametrize("count", [3, 170])  # dense; sparse
@pytest.mark.parametrize("law", ["lcp", "cone"])
def test_derivative_of_contacts_given_twice_equals_that_of_given_once(law, count):
    rng = np.random.default_rng(count)
    each, size = (1, 0) if law == "lcp" else (3, 2)
    jac = np.zeros((each * count, 3 * count + 3))
    for i in range(count):  # a chain: each contact between neighbours
        jac[each * i : each * (i + 1), 3 * i : 3 * i + 6] = rng.standard_normal((each, 6))
    free = rng.standard_normal(jac.shape[1])
    made = []
    for times in (1, 2):
        rows = np.concatenate([jac] * times)
        cones = lv.Cones.contacts(np.full(count * times, 0.4), size)
        made.append(
            lv.Problem.from_jacobian(rows, np.eye(jac.shape[1]), free, cones=cones, friction="cone")
        )
    found = [lv.derivative(p, lv.solve(p, "newton", tol=1e-12)) for p in made]
    assert found[0].unique and not found[1].unique.impulse.all() and found[1].unique.slack.all()
    closed = [d.states.case[: each * count : each] != 0 for d in found]
    assert np.array_equal(*closed)
    assert np.array_equal(
        found[1].unique.impulse[: each * count : each], ~closed[1]
    )  # what is open is unique
    y, push = rng.standard_normal((2, jac.shape[1]))
    once, twice = (d.vjp(velocity=y).v_free for d in found)
    assert twice == pytest.approx(once, rel=1e-7, abs=1e-7)
    once, twice = (d.jvp(v_free=push).velocity for d in found)
    assert twice == pytest.approx(once, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("operator", ("csr", "asymmetric", "generalized", "bodies"))
@pytest.mark.parametrize("kind", ("disk", "normal"))
def test_every_factor_gives_the_same_gradients(kind, operator, monkeypatch):
    p = drawn(0, kind, "cone" if operator != "asymmetric" else "coulomb", operator, 30)
    solution = solved(p)
    rng = np.random.default_rng(0)
    weights = {"impulse": rng.standard_normal(p.m), "slack": rng.standard_normal(p.m)}
    if p.matrix is None:
        weights["velocity"] = rng.standard_normal(p.velocity(solution.impulse).shape)
    found = []
    # dense by the kernel, sparse by panels or SuperLU, and the adjoint of the kernel in Python
    for small, dense, few in ((64, 400, 0.4), (0, 0, 2.0), (0, 0, 0.0)):
        monkeypatch.setattr("lavender.gradient.system.MAX_KERNEL_ROWS", small)
        monkeypatch.setattr(sys.modules["lavender.gradient.derivative"], "MAX_KERNEL_ROWS", small)
        monkeypatch.setattr("lavender.gradient.system.MAX_DENSE_ROWS", dense)
        monkeypatch.setattr(
            "lavender.gradient.system.is_dense_factor_faster",
            lambda nnz, m, cones, few=few: few == 0.0,
        )
        d = lv.derivative(p, solution)
        found.append(d.vjp(**weights))
    names = ["b", "lower", "mu"] + (["v_free", "J", "compliance"] if p.matrix is None else ["A"])
    for name in names:
        one, *others = (getattr(g, name) for g in found)
        for other in others:
            size = abs(one).max()
            assert abs(one - other).max() <= 1e-9 * size, name


def test_gradient_with_reordered_mass_is_unchanged():
    # a hub that stands last fills in: M's factor has velocities in another order
    rng = np.random.default_rng(0)
    n = 60
    mass = 4.0 * np.eye(n)
    mass[-1, :-1] = mass[:-1, -1] = 0.2
    mass[-1, -1] = 10.0
    jac = rng.standard_normal((9, n))
    free = rng.standard_normal(n)
    given = {"cones": lv.Cones.contacts(np.full(3, 0.5)), "compliance": np.full(9, 0.1)}
    p = lv.Problem.from_jacobian(jac, mass, free, **given)
    turn = np.arange(n)[::-1]
    q = lv.Problem.from_jacobian(jac[:, turn], mass[turn][:, turn], free[turn], **given)
    assert p.generalized.order is not None and q.generalized.order is None
    y = rng.standard_normal(n)
    c = rng.standard_normal(9)
    one = lv.derivative(p, solved(p)).vjp(velocity=y, impulse=c)
    two = lv.derivative(q, solved(q)).vjp(velocity=y[turn], impulse=c)
    for name, back in (("v_free", turn), ("target", slice(None)), ("mu", slice(None))):
        assert getattr(one, name) == pytest.approx(getattr(two, name)[back], rel=1e-8, abs=1e-10)
    assert one.full("J") == pytest.approx(two.full("J")[:, turn], rel=1e-8, abs=1e-10)
    both = lv.derivatives([p], [solved(p)]).vjp(velocity=[y], impulse=[c])[0]
    assert np.array_equal(both.v_free, one.v_free)


def test_derivative_by_one_of_several_redundant_rows_raises():
    """A box that slides on four corners: raise one, and it stands on three; which ones depends on the sign."""
    at = [(x, y, -0.5) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    jac = np.array([np.r_[d, np.cross(r, d)] for r in at for d in np.eye(3)[[2, 0, 1]]])
    mass = np.diag([1.0, 1.0, 1.0, 1 / 6, 1 / 6, 1 / 6])
    free = [1.0, 0.3, -0.1, 0.0, 0.0, 0.0]
    p = lv.Problem.from_jacobian(jac, mass, free, cones=lv.Cones.contacts(0.5, count=4))
    d = lv.derivative(p, lv.solve(p, tol=1e-13))
    g = d.vjp(velocity=np.eye(6)[0])
    for name in ("b", "target", "J", "compliance"):
        with pytest.raises(lv.CapabilityError, match="share a load"):
            getattr(g, name)
    with pytest.raises(lv.CapabilityError, match="share a load"):
        d.jvp(target=np.eye(12)[0])
    # All corners together, the velocity, friction: these are told, and as adjoints.
    change = {"v_free": np.arange(6.0), "mu": np.ones(4), "target": np.tile([1.0, 0.0, 0.0], 4)}
    found = {name: d.jvp(**{name: x}).velocity[0] for name, x in change.items()}
    assert np.sum(g.v_free * change["v_free"]) == pytest.approx(found["v_free"])
    assert np.sum(g.mu * change["mu"]) == pytest.approx(found["mu"])
    # It is lifted by 1 m/s more: 1 N s of normal impulse more, which slows it down along w_t by half of that.
    assert found["target"] == pytest.approx(-0.5 * 1.0 / np.hypot(1.0, 0.3))
    # Under the cone law it slides off at mu |w_t|: of one corner alone that is a target, too.
    p = p.relaxed("cone")
    d = lv.derivative(p, lv.solve(p, tol=1e-13))
    for refused in (
        lambda: d.vjp(velocity=np.eye(6)[0]).mu,
        lambda: d.jvp(mu=[1.0, 0.0, 0.0, 0.0]),
    ):
        with pytest.raises(lv.CapabilityError, match="share a load"):
            refused()
    assert d.jvp(mu=np.ones(4)).velocity[0] < 0.0


def make_worlds(law, contacts, nv, twice=False, change=0.0):
    """Return eight stacked worlds; with `twice` a contact of world 1 is given twice, so that A is singular."""
    rng = np.random.default_rng(contacts)
    jac = rng.standard_normal((8, 3 * contacts, nv))
    if twice:
        jac[1, -3:] = jac[1, -6:-3]
    half = rng.standard_normal((8, nv, nv))
    return lv.Batch(
        jac,
        0.1 * half @ half.transpose(0, 2, 1) + np.eye(nv),
        rng.standard_normal((8, nv)) + change,
        target=0.1 * rng.standard_normal((8, 3 * contacts)),
        compliance=None if twice else rng.uniform(0.0, 0.1, (8, 3 * contacts)),
        mu=rng.uniform(0.2, 1.0, (8, contacts)),
        cones=lv.Cones.contacts(0.5, count=contacts),
        friction=law,
    )


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize(
    ("contacts", "nv", "twice"), [(1, 6, False), (4, 18, False), (10, 36, False), (3, 9, True)]
)
def test_gradients_of_worlds_equal_those_of_single_problems(law, contacts, nv, twice):
    batch = make_worlds(law, contacts, nv, twice)
    rng = np.random.default_rng(1)
    solutions = lv.solve_many(batch, tol=1e-12)
    shapes = {"velocity": batch.velocity_shape, "impulse": batch.shape, "slack": batch.shape}
    cotangents = {name: rng.standard_normal(shape) for name, shape in shapes.items()}
    if twice:
        cotangents = {"velocity": cotangents["velocity"]}
    found = lv.derivatives(batch, solutions).vjp(**cotangents)
    for i in range(8):
        own = {name: x[i] for name, x in cotangents.items()}
        alone = lv.derivative(batch[i], solutions[i]).vjp(**own)
        for name in ("v_free",) if twice else ("b", "target", "v_free", "mu", "compliance"):
            assert np.array_equal(getattr(found, name)[i], getattr(alone, name)), name
        for name in () if twice else ("J", "M"):
            # 1e-14: the order of the terms of an entry.
            np.testing.assert_allclose(
                getattr(found, name)[i], alone.full(name), rtol=1e-14, atol=1e-14
            )
        assert np.array_equal(found[i].v_free, alone.v_free)


def test_gradients_by_mu_of_worlds_with_unlike_patches_equal_those_of_single_problems():
    """Each world has contacts of its own patch radii and ratios of boxes, in any number."""
    rng = np.random.default_rng(4)
    counts = [2, 1, 3, 2, 4]
    cones = [
        lv.Cones.contacts(rng.uniform(0.3, 0.8, k), patch_radius=rng.uniform(0.05, 0.5, k))
        if k % 2 else lv.Cones.contacts(rng.uniform(0.3, 0.8, (k, 2)), shape="box")
        for k in counts
    ]  # fmt: skip
    ptr = np.cumsum([0, *(c.n_rows for c in cones)])
    batch = lv.Batch(
        rng.standard_normal((ptr[-1], 24)), np.array([np.eye(24)] * 5), rng.standard_normal((5, 24)),
        compliance=np.full(ptr[-1], 0.1), cones=cones, row_ptr=ptr,
    )  # fmt: skip
    solutions = lv.solve_many(batch, tol=1e-12)
    velocity = rng.standard_normal(batch.velocity_shape)
    found = lv.derivatives(batch, solutions).vjp(velocity=velocity).mu
    alone = [
        lv.derivative(batch[i], solutions[i]).vjp(velocity=np.reshape(velocity, (5, 24))[i]).mu
        for i in range(5)
    ]
    np.testing.assert_array_equal(found, np.concatenate(alone))
    assert np.abs(found).min() >= 0.0 and np.count_nonzero(found) > 5


def test_gradients_of_worlds_agree_with_differences():
    batch = make_worlds("coulomb", 2, 6)
    y = np.random.default_rng(2).standard_normal((8, 6))
    found = lv.derivatives(batch, lv.solve_many(batch, tol=1e-13)).vjp(velocity=y)
    step = 1e-6
    rng = np.random.default_rng(3)
    direction = rng.standard_normal((8, 6))
    total = []
    for sign in (1.0, -1.0):
        moved = make_worlds("coulomb", 2, 6, change=sign * step * direction)
        total.append((y * lv.solve_many(moved, tol=1e-13).velocity).sum(axis=1))
    differences = (total[0] - total[1]) / (2.0 * step)
    # 1e-6: the error of central differences, unless a contact changes its state between both ends.
    close = np.isclose((found.v_free * direction).sum(axis=1), differences, rtol=1e-6, atol=1e-7)
    assert close.sum() >= 7


def test_cotangents_of_worlds_are_checked():
    batch = make_worlds("cone", 1, 6)
    of = lv.derivatives(batch, lv.solve_many(batch, tol=1e-12))
    with pytest.raises(lv.InputError, match=r"velocity has shape \(8, 5\)"):
        of.vjp(velocity=np.ones((8, 5)))
    with pytest.raises(lv.InputError, match="None"):
        of.vjp()
    bad = np.ones((8, 6))
    bad[3, 2] = np.nan
    with pytest.raises(lv.InputError, match="world 3"):
        of.vjp(velocity=bad)
