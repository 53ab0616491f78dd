"""Motion errors: the bound against a truth in long double, distances that mean what they say, several motions."""

import re
import warnings
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from kkt_truth import HAS_WIDE, Exact, Wide, matrix_in, solution_in
from motion_truth import draw, truth
from random_problems import (
    as_matrix,
    dragged,
    random_contact_problem,
    random_generalized_problem,
    random_lcp,
    seeds,
)

import lavender as lv
from lavender import suite
from lavender.lab.motion.modes import enumerate_modes
from lavender.lab.motion.multiple_solutions import measure_motion_distance, search_solutions

LAWS = ("linear", "lcp", "cone")


def problems(law, seed):
    """One factored problem of a convex law."""
    if law == "linear":
        p = random_contact_problem(seed, contacts=0, joints=3)
        return lv.Problem.from_rows(p.rows, 0.1)
    return random_contact_problem(
        seed, friction="cone", tangents=0 if law == "lcp" else 2, spin=law == "cone"
    )


# -- the bound -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("numbers, draws", [(Wide, 60), (Exact, 20)])
def test_no_bound_is_broken(numbers, draws):
    """In rational numbers no rounding decides: exact where cones are polyhedral, to 2^-240 where a disk slides."""
    if numbers is Wide and not HAS_WIDE:
        pytest.skip("no long double beyond float64 here: there is no truth to hold it beside")

    @settings(max_examples=draws)
    @given(seed=seeds)
    def holds(seed):
        found = draw(np.random.default_rng(seed))
        held = None if found is None else truth(found, numbers)
        assert held is None or not held.broken

    holds()


@pytest.mark.slow
@pytest.mark.skipif(not HAS_WIDE, reason="no long double beyond float64 here")
def test_the_bound_is_not_loose_and_draws_have_a_truth():
    """The median is 1.0 where the witness is at the floor; 100 draws with a fixed seed, nearly all settled."""
    rng = np.random.default_rng(5)
    draws = [found for found in (draw(rng) for _ in range(100)) if found is not None]
    held = [(found, truth(found)) for found in draws]
    ratios = [f.bound / t.energy for f, t in held if t is not None and f.good and t.energy > 0.0]
    assert sum(t is not None for _, t in held) >= 99
    assert len(ratios) > 40
    assert np.median(ratios) <= 1.5


def test_a_bound_that_is_too_small_would_be_found():
    """Rational numbers tell where nine tenths of the bound, or a tenth of what targets move by, is too little."""
    rng = np.random.default_rng(6)
    draws = [found for found in (draw(rng) for _ in range(30)) if found is not None]
    assert any(truth(found._replace(bound=0.9 * found.bound), Exact).broken for found in draws)
    assert any(
        truth(found._replace(moved=0.1 * found.moved), Exact).broken for found in draws if not found.good
    )


@pytest.mark.parametrize("kind", [*LAWS, "J and M"])
@pytest.mark.skipif(not HAS_WIDE, reason="no long double beyond float64 here")
def test_public_bounds_hold_for_every_body(kind):
    rng = np.random.default_rng(3)
    checked = 0
    for seed in range(12):
        p = (
            random_generalized_problem(seed, spin=seed % 2 == 1)
            if kind == "J and M"
            else problems(kind, seed)
        )
        start = lv.motion_error(p, np.zeros(p.m))
        reference = start.reference.impulse
        a, moving = matrix_in(p, Wide)
        shift = start.reference.witness.shift.astype(np.longdouble)
        truth = solution_in(p, a, p.b.astype(np.longdouble) + shift, Wide)
        if truth is None:
            continue
        for scale in (1e-13, 1e-12, 1e-7, 1e-6, 1e-1):
            x = reference * (1.0 + scale * rng.normal(size=p.m))
            e, delta = lv.motion_error(p, x), x - truth[0]
            # 1e-14: the shift is stored in float64.
            assert max(np.sqrt(delta @ of @ delta / 2) for of in (a, moving)) <= e.bound * (1 + 1e-14)
            assert e.energy <= e.bound
            checked += 1
            if p.generalized is not None:
                continue
            v = p.velocity(delta.astype(float)) - p.rows.v_free
            # 1e-13: the truth's own rounding where it becomes float64.
            slack = 1e-13 * np.abs(p.velocity(reference)).max()
            assert np.linalg.norm(v[:, :3], axis=1).max() <= e.bound_speed + slack
            assert np.linalg.norm(v[:, 3:], axis=1).max() <= e.bound_spin + slack
    assert checked >= 20


def test_a_good_reference_moves_targets_by_rounding_alone():
    for name in suite.SETS["default"]:
        p = suite.case(name).problem
        if p.law == "coulomb" or p.m > 1000:
            continue
        e = lv.motion_error(p, p.start())
        assert e.reference.is_accepted, name
        # The floor adds rounding as it may fall, the bound as it must not exceed: some hundred sums of it.
        assert e.moved <= 300 * e.reference.residual.roundoff_floor * np.abs(p.b).max(), name
        assert e.bound == pytest.approx(e.energy, rel=1e-6), name


# -- the estimate --------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["rows", "J and M"])
@given(seed=seeds)
@settings(max_examples=30)
def test_kinetic_is_the_energy_of_the_velocities(form, seed):
    p = random_contact_problem(seed, friction="cone") if form == "rows" else random_generalized_problem(seed)
    x = np.random.default_rng(seed).normal(size=p.m)
    e = lv.motion_error(p, x)
    if not e.reference.is_accepted:
        return
    delta = x - e.reference.impulse
    if form == "rows":
        dv = p.velocity(x) - p.velocity(e.reference.impulse)
        mass, speeds = (
            np.linalg.inv(p.rows.inverse_mass_matrix().toarray()),
            np.linalg.norm(dv[:, :3], axis=1),
        )
        assert e.spin == pytest.approx(np.linalg.norm(dv[:, 3:], axis=1).max(), rel=1e-9)
        assert e.body_name == f"body {speeds.argmax()}"
    else:
        dv, mass = p.generalized.change(delta), p.generalized.mass.toarray()
        speeds = np.abs(dv)
        assert e.spin is None and e.body_name == p.generalized.velocity_name(int(speeds.argmax()))
    assert e.kinetic == pytest.approx(np.sqrt(0.5 * dv.ravel() @ mass @ dv.ravel()), rel=1e-9)
    assert e.speed == pytest.approx(speeds.max(), rel=1e-9)
    assert e.rows == pytest.approx(np.abs(p.slack(x) - p.slack(e.reference.impulse)).max(), rel=1e-9)
    assert e.energy == pytest.approx(np.sqrt(0.5 * delta @ p.dense() @ delta), rel=1e-9)
    assert e.kinetic <= e.energy * (1 + 1e-12)


@pytest.mark.parametrize(
    ("problem", "none", "some", "word"),
    [
        (random_lcp(4), ("kinetic", "speed", "bound_speed"), ("energy", "rows", "bound"), ""),
        (
            lv.Problem.lcp([[2.0, 0.5], [0.0, 2.0]], [1.0, -1.0]),
            ("energy", "bound", "relative"),
            (),
            "not symmetric",
        ),
        (
            lv.Problem.lcp(np.diag([1.0, -1.0]), [1.0, -1.0], 0.0, 1.0),
            ("energy", "bound"),
            (),
            "semidefinite",
        ),
        # Infeasible: the problem that has this solution is another one, and it is said how much.
        (
            lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0]),
            ("energy", "speed", "rows"),
            ("moved",),
            "no estimate",
        ),
    ],
)
def test_what_a_problem_does_not_have_is_none_and_told(problem, none, some, word):
    e = lv.motion_error(problem, np.zeros(problem.m))
    assert [getattr(e, name) for name in none] == [None] * len(none)
    assert all(getattr(e, name) > 0.1 for name in some) and (e.bound is None) == ("bound" in none)
    assert word in e.note and (word in str(e) or e.bound is not None)
    assert e.reference.is_accepted == ("moved" not in some)


def test_the_reference_is_solved_once_and_a_given_one_is_used():
    p = problems("cone", 5)
    first = lv.motion.get_reference(p)
    assert lv.motion.get_reference(p) is first
    assert first.solver.startswith("auto: ")
    own = lv.solve(p, "newton", tol=1e-12)
    e = lv.motion_error(p, p.start(), reference=own)
    assert e.reference.solver == "newton"
    assert lv.motion.get_reference(p) is first
    given = lv.motion_error(p, p.start(), reference=own.impulse)
    assert given.energy == e.energy
    rough = lv.motion_error(p, p.start(), reference=0.5 * own.impulse)
    assert not rough.reference.is_accepted
    assert rough.energy is None
    assert lv.solve(p, "newton").motion_error().relative < 1e-3


def test_a_worse_reference_is_not_adopted():
    p = problems("cone", 6)
    good = lv.solve(p, "newton", tol=1e-12).impulse
    assert lv.motion.store_reference_if_better(p, good, "mine").solver == "mine"
    assert lv.motion.store_reference_if_better(p, 0.9 * good, "worse").solver == "mine"


def test_a_reference_beside_a_file_is_judged_before_it_is_used(tmp_path, monkeypatch):
    p = problems("cone", 5)
    path = tmp_path / "pile.npz"
    lv.io.save(p, path)
    written = lv.motion.save_reference(p, path)
    assert written.name == "pile.npz.reference"
    again = lv.io.load(path)
    monkeypatch.setattr(
        import_module("lavender.lab.motion.reference"), "solve", None
    )  # nobody solves any more
    found = lv.motion.load_reference(again, path)
    assert found.impulse.tobytes() == lv.motion.get_reference(p).impulse.tobytes()
    assert found.solver == lv.motion.get_reference(p).solver
    assert lv.motion.get_reference(again) is found
    assert lv.motion_error(again, again.start()).relative == pytest.approx(1.0)
    other = problems("cone", 6)
    assert lv.motion.load_reference(other, path) is None  # the judge finds that it solves another problem
    assert lv.motion.load_reference(other, tmp_path / "none.npz") is None
    written.write_bytes(b"no reference")
    with pytest.raises(lv.InputError, match="holds no reference"):
        lv.motion.load_reference(again, path)
    infeasible = lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0])
    monkeypatch.undo()
    with pytest.raises(lv.InputError, match="no solver reached the round-off floor"):
        lv.motion.save_reference(infeasible, path)


def test_an_empty_problem_has_no_error():
    p = lv.Problem.lcp(np.zeros((0, 0)), [])
    e = lv.motion_error(p, [])
    assert e.energy == 0.0
    assert e.bound == 0.0
    assert e.row_name == ""


# -- several motions -----------------------------------------------------------------------------------


def test_coulombs_law_leaves_several_motions():
    """Two solutions by the judge's word, at the floor, decimetres per second apart."""
    p = suite.case("granularF(n=3, sliding=0.5)").problem
    found = lv.find_solutions(p, n=6)
    assert len(found) >= 2
    assert found.spread > 0.1
    assert not found.unique
    for motion in found:
        assert lv.residual(p, motion.impulse).relative <= 1e-10
        assert motion.separation_speed < 1e-9  # Coulomb's law lifts nothing that presses
    one, two = found[0], found[1]
    dv = np.linalg.norm((p.velocity(one.impulse) - p.velocity(two.impulse))[:, :3], axis=1).max()
    assert dv == pytest.approx(found.spread, rel=1e-6)
    e = lv.motion_error(p, two.impulse)
    assert e.energy == 0.0  # the nearest, not the first
    assert e.count == len(found)
    assert e.spread_speed == found.spread
    assert "no bound" in e.note


def test_a_rod_that_can_stay_slide_or_leave_has_its_three_motions_by_default():
    """A_nn < mu A_nt: with b = (-1, c), lambda = 0, (1, 1) and A^-1 b all solve where c >= 3, worked out by hand."""
    rod = np.array([[1.0, -2.0], [-2.0, 5.0]])
    for c in np.linspace(3.5, 9.0, 18):
        found = lv.find_solutions(lv.Problem.contact(rod, [-1.0, c], mu=[1.0]))
        exact = [np.zeros(2), np.ones(2), np.linalg.solve(rod, [-1.0, c])]
        assert found.all
        assert "3 motions, no others exist" in str(found)
        for x in exact:
            assert min(np.abs(one.impulse - x).max() for one in found) < 1e-12
    three = lv.find_solutions(lv.Problem.contact(np.kron(np.eye(3), rod), [-1.0, 4.0] * 3, mu=[1.0] * 3))
    assert (len(three), three.all) == (27, True)


def test_every_mode_holds_what_a_search_finds_and_beyond_them_there_are_at_least_so_many():
    rng = np.random.default_rng(4)
    several = 0
    for _ in range(20):
        k = int(rng.integers(1, 3))
        x = 0.3 * rng.normal(size=(2 * k, 2 * k))
        a = np.kron(np.eye(k), [[1.0, -2.0], [-2.0, 5.0]]) + x @ x.T
        problem = lv.Problem.contact(a, [-1.0, 4.0] * k + rng.normal(size=2 * k), mu=rng.uniform(0.5, 1.5, k))
        found = lv.find_solutions(problem)
        assert found.all
        several += len(found) > 1
        for label, end in search_solutions(problem, found[0].reference, 6, 1):
            if lv.residual(problem, end).relative < 1e-9:
                assert (
                    min(measure_motion_distance(problem, end, one.impulse).relative_distance for one in found)
                    < 1e-6
                ), label
    assert several > 3  # else the draw asks for nothing
    rods = np.kron(np.eye(9), [[1.0, -2.0], [-2.0, 5.0]])
    nine = lv.find_solutions(lv.Problem.contact(rods, [-1.0, 4.0] * 9, mu=[1.0] * 9))
    assert not nine.all
    assert "at least" in str(nine)


def test_a_box_without_a_unique_impulse_has_its_motion_by_all_modes():
    # a plane box on two corners: four rows, three velocities
    jac = [[0, 1, x] if normal else [1, 0, 0.5] for x in (-0.5, 0.5) for normal in (True, False)]
    cones = lv.Cones.contacts([0.5, 0.5], tangents=1)
    problem = lv.Problem.from_jacobian(
        np.array(jac, float), np.diag([1, 1, 1 / 6]), [0.3, -0.16, 0.0], cones=cones
    )
    impulses, whole = enumerate_modes(problem)
    assert whole
    assert impulses
    assert all(lv.residual(problem, x).relative < 1e-7 for x in impulses)


def test_equal_seeds_find_equal_motions():
    p = suite.case("box_stackF(n=4)").problem
    one, two = (lv.find_solutions(p, n=8, seed=3) for _ in range(2))
    assert [m.impulse.tobytes() for m in one] == [m.impulse.tobytes() for m in two]
    assert [m.count for m in one] == [m.count for m in two]


def test_choices_have_names_and_are_motions():
    p = suite.case("granularF(n=2, sliding=0.5)").problem
    found = lv.find_solutions(p, n=6)
    most = found.select("dissipation")
    assert most.dissipation == max(m.dissipation for m in found)
    for motion in found:
        assert found.select("nearest", motion.impulse) is motion
    assert found.select("compliant") in found
    with pytest.raises(lv.InputError, match="choice is"):
        found.select("best")
    with pytest.raises(lv.LavenderError, match=r"problem\.disk"):
        lv.find_solutions(dragged(0, 3))  # ellipses
    picks = found.picks(["anderson", "admm", "jacobi"], max_iter=1000)
    assert picks["jacobi"] is None  # 1000 sweeps end before it gets there
    assert picks["anderson"].motion != picks["admm"].motion


def test_the_cone_law_has_one_motion_and_shows_its_lift():
    p = suite.case("pyramidF(k=6, sliding=0.5)").problem.relaxed("cone")
    found = lv.find_solutions(p)
    assert len(found) == 1
    assert found.unique == "the law is convex"
    assert found[0].separation_speed > 1e-3


def one_contact(a, mu, b=(1.0, 0.5, -0.3)):
    return lv.Problem.contact(a, b, [mu])


def test_uniqueness_names_its_criterion():
    sphere = np.diag([1.0, 3.5, 3.5])
    assert "normals feel no friction" in lv.find_solutions(one_contact(sphere, 5.0)).unique
    coupled = sphere + 0.3 * (np.eye(3)[:, [0]] @ np.eye(3)[[1]] + np.eye(3)[:, [1]] @ np.eye(3)[[0]])
    small = lv.motion.prove_uniqueness(one_contact(coupled, 0.1))
    assert small
    assert "friction is small" in small.reason
    assert 0.0 < small.kappa < 1.0
    large = lv.motion.prove_uniqueness(one_contact(coupled, 5.0, coupled @ [1.0, 6.0, 0.0]))  # it slides
    assert not large
    assert large.kappa > 1.0
    assert "no contact has friction" in lv.motion.prove_uniqueness(one_contact(coupled, 0.0)).reason
    asymmetric = coupled.copy()
    asymmetric[0, 1] += 0.1
    assert "not symmetric" in lv.motion.prove_uniqueness(one_contact(asymmetric, 0.1)).reason


@given(seed=seeds)
@settings(max_examples=40)
def test_where_uniqueness_is_proved_every_start_ends_at_one_motion(seed):
    """The contraction number is a theorem: no start may find a second motion below it."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(6, 6))
    a = np.diag(rng.uniform(1.0, 2.0, 6)) + 0.05 * (g @ g.T)
    p = lv.Problem.contact(a, rng.normal(size=6), rng.uniform(0.05, 0.5, 2))
    proof = lv.motion.prove_uniqueness(p)
    if not proof:
        return
    ends = [
        lv.solve(p, "block_gauss_seidel", impulse=rng.normal(size=6) * s, tol=1e-12, max_iter=5000)
        for s in (0.0, 1.0, 10.0)
    ]
    done = [e.slack for e in ends if e.residual.relative <= 1e-11]
    for w in done[1:]:
        assert np.abs(w - done[0]).max() < 1e-7


@settings(max_examples=60)
@given(seed=seeds)
def test_where_nothing_slides_and_friction_is_left_over_no_search_finds_another(seed):
    """A solution with w = 0 inside its cones; where (3) of `lavender.motion.unique` holds it is the only one."""
    rng = np.random.default_rng(seed)
    k = int(rng.integers(1, 4))
    g = rng.normal(size=(3 * k, 3 * k))
    a = np.diag(rng.uniform(0.5, 2.0, 3 * k)) + rng.uniform(0.05, 1.0) * (g @ g.T)
    mu, used, angle = rng.uniform(0.1, 1.5, k), rng.uniform(0.0, 0.6, k), rng.uniform(0.0, 7.0, k)
    normal = rng.uniform(0.5, 2.0, k)
    tangent = used * mu * normal * np.array([np.cos(angle), np.sin(angle)])
    x = np.column_stack([normal, *tangent]).ravel()
    p = lv.Problem.contact(a, a @ x, mu)
    proof = lv.motion.prove_uniqueness(p)
    if proof:
        assert len(lv.find_solutions(p, 6, always=True)) == 1


def test_nothing_slides_proves_more_than_small_friction():
    coupled = np.diag([1.0, 3.5, 3.5]) + 0.8 * (
        np.eye(3)[:, [0]] @ np.eye(3)[[1]] + np.eye(3)[:, [1]] @ np.eye(3)[[0]]
    )
    rest = lv.Problem.contact(coupled, coupled @ [1.0, 0.0, 0.0], [0.6])
    proof = lv.motion.prove_uniqueness(rest)
    assert proof.kappa > 1.0
    assert "nothing slides" in proof.reason
    assert "nothing slides" in lv.find_solutions(rest).unique
    sliding = lv.Problem.contact(coupled, coupled @ [1.0, 0.0, 0.0] + [0.0, 5.0, 0.0], [0.6])
    assert not lv.motion.prove_uniqueness(sliding)
    rim = lv.Problem.contact(coupled, coupled @ [1.0, 0.599, 0.0], [0.6])  # hardly any friction left over
    assert not lv.motion.prove_uniqueness(rim)


# -- numbers at the end of float64 ---------------------------------------------------------------------

NUMBERS = (
    "kinetic", "energy", "speed", "spin", "rows", "bound", "bound_speed", "bound_spin", "moved", "spread",
    "spread_speed",
)  # fmt: skip


def forms(seed):
    rows = random_contact_problem(seed)
    return {
        "lcp": random_lcp(seed),
        "cone": rows.relaxed("cone"),
        "cone, matrix": as_matrix(rows.relaxed("cone")),
        "coulomb": rows,
    }


@pytest.mark.parametrize("form", forms(0))
@pytest.mark.parametrize("exponent", [420, -420])
def test_motion_errors_of_impulses_scale_with_them(form, exponent):
    """Powers of two scale every number but rounding of the target: x is far above all else, or it is nothing."""
    problem = forms(1)[form]
    scale = 2.0**exponent
    reference = lv.motion.get_reference(problem)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        far = lv.motion_error(problem, scale * np.ones(problem.m), reference)
        near = lv.motion_error(problem, 2.0**400 * np.ones(problem.m), reference)
        still = lv.motion_error(problem, np.zeros(problem.m), reference)
    assert far.relative is None or np.isfinite(far.relative)
    for name in NUMBERS:
        value = getattr(far, name)
        if value is None:
            assert name in far.note or getattr(near, name) is None
        elif exponent < 0:
            assert value == pytest.approx(getattr(still, name), rel=1e-9)
        elif name != "moved":
            assert value == pytest.approx(getattr(near, name) * 2.0 ** (exponent - 400), rel=1e-9)


# -- whose reference, which rows, at what size ----------------------------------------------------------


def test_a_reference_that_ctrl_c_ended_is_not_kept(monkeypatch):
    module = import_module("lavender.lab.motion.reference")
    p, real = problems("cone", 8), module.solve

    def interrupted(*args, **more):
        return replace(real(*args, **more), impulse=p.start(), status=lv.Status.INTERRUPTED)

    monkeypatch.setattr(module, "solve", interrupted)
    with pytest.raises(KeyboardInterrupt):
        lv.motion_error(p, p.start())
    monkeypatch.undo()
    assert lv.motion_error(p, p.start()).relative == pytest.approx(1.0)


def test_a_reference_of_another_problem_is_judged_anew():
    a = [[2.0, 1.0], [1.0, 2.0]]
    one, two = lv.Problem.lcp(a, [1.0, 0.5]), lv.Problem.lcp(a, [5.0, 5.0])
    other = lv.motion.get_reference(one)
    e = lv.motion_error(two, other.impulse, reference=other)
    assert not e.reference.is_accepted
    assert e.relative is None
    assert e.bound >= lv.motion_error(two, other.impulse).energy > 1.0
    assert lv.motion_error(one, other.impulse, reference=other).reference is other
    with pytest.raises(lv.InputError, match="reference"):
        lv.motion_error(lv.Problem.lcp([[1.0]], [1.0]), [1.0], reference=other)


@pytest.mark.parametrize("form", ["matrix", "bodies"])
def test_rows_of_ellipses_are_the_problems_own(form):
    p = lv.Problem.contact(np.eye(3), [10.0, 9.0, 9.0], mu=[(0.5, 0.005)], friction="cone")
    if form == "bodies":
        p = lv.Problem.from_jacobian(
            np.eye(3), np.eye(3), np.zeros(3), target=p.b, cones=p.cones, friction="cone"
        )
    x = lv.solve(p, tol=1e-13).impulse
    y = x.copy()
    y[2] *= 0.5
    e = lv.motion_error(p, y)
    assert e.rows == pytest.approx(np.abs(p.slack(y) - p.slack(x)).max(), rel=1e-6)
    assert e.row == 2
    assert e.row_name == p.row_name(2)
    near = lv.motion_error(p, x)
    assert near.rows < 1e-6 and near.bound < 1e-6 * e.bound and e.energy <= e.bound


@pytest.mark.parametrize(("slow", "light"), [(1.0, 1.0), (1e-11, 1e-22), (1e-10, 1e-24)])
def test_motions_of_a_heavy_body_are_told_beside_a_fast_one(slow, light):
    """The three of a slow, heavy body differ by 1e-11 of the fastest row, and by as much energy as there is."""
    p, fast = suite.case("painleve").problem, lv.Problem.contact(np.eye(2), [1.0, 0.1], [0.5])
    both = sp.block_diag([light * p.csr, fast.csr], format="csr")
    found = lv.find_solutions(lv.Problem(np.concatenate([slow * p.b, fast.b]), p.cones + fast.cones, both))
    assert len(found) == 3 and found.all


@pytest.mark.parametrize("size", [1e-50, 1e-10, 1e50])
def test_all_motions_are_all_at_every_size(size):
    p = suite.case("painleve").problem
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = lv.find_solutions(replace(p, b=p.b * size))
    assert (len(found), found.all) == (3, True)


def test_the_line_of_a_motion_error_has_names_and_units():
    bodies = random_contact_problem(3, contacts=6)
    error = lv.solve(bodies, "pgs", tol=0.0, max_iter=3).motion_error()
    text = str(error)
    for name, unit in (("relative", ""), ("kinetic", r" sqrt\(J\)"), ("speed", r" m/s \(body \d+\)"),
                       ("spin", r" rad/s \(body \d+\)"), ("rows", r" (m|rad)/s \(.+\)")):  # fmt: skip
        assert re.search(rf"\b{name} [\d.e-]+{unit}", text), text
    row = bodies.jacobian[[error.row]].toarray().reshape(-1, 6)
    assert (f"rows {error.rows:.2g} rad/s" in text) == (not row[:, :3].any())
    general = str(lv.solve(random_generalized_problem(3), tol=1e-2).motion_error())
    assert " m/s or rad/s (" in general and "compared with " in general
