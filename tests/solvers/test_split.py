"""Islands in one compiled call: each has the bits of its own problem, solved the way of few rows."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import as_matrix, random_contact_problem, random_lcp, seeds, spd
from random_trees import random_general

import lavender as lv
from lavender.ordering import block_order
from lavender.registry import FEW
from lavender.residuals import judged, reference
from lavender.solvers import _split
from lavender.solvers._accelerated import AcceleratedState
from lavender.solvers._few import WARM
from lavender.solvers._gates import GENERAL_GATE
from lavender.solvers._islands import restrict, rows_of
from lavender.solvers._log import SolveLog
from lavender.solvers._newton import general
from lavender.solvers._split import GATE
from lavender_ext.accelerate import accelerated
from lavender_ext.few.chain import Chain
from lavender_ext.few.islands import AT_START, BY_PIVOTS, LEFT, Islands
from lavender_ext.few.looks import sweeps_left
from lavender_ext.few.many import solve_first
from lavender_ext.judge.measure import velocity_change
from lavender_ext.judge.watch import RUNNING


def shuffled(cones, order):
    """Cones with their blocks in another order, and the rows in theirs."""
    rows = np.concatenate([np.arange(cones.ptr[i], cones.ptr[i + 1]) for i in order])
    size = np.diff(cones.ptr)[order]
    ptr = np.concatenate([[0], np.cumsum(size)]).astype(np.int32)
    taken = {n: getattr(cones, n)[order] for n in ("kind", "mu", "patch_radius")}
    return lv.Cones(ptr=ptr, lower=cones.lower[rows], upper=cones.upper[rows], **taken), rows


def joined(parts):
    cones = parts[0].cones
    for p in parts[1:]:
        cones = cones + p.cones
    return cones


def matrices(rng, parts):
    cones, rows = shuffled(joined(parts), rng.permutation(sum(p.n_blocks for p in parts)))
    a = sp.block_diag([p.csr for p in parts], format="csr")[rows][:, rows]
    b = np.concatenate([p.b for p in parts])[rows]
    return lv.Problem(b, cones, a, friction=parts[0].friction)


def bodies(rng, parts):
    """Blocks shuffled, joints before contacts; bodies shuffled, too."""
    k = [p.n_blocks for p in parts]
    whole = joined(parts)
    first = np.repeat(np.cumsum([0, *k[:-1]]), [p.rows.n_joints for p in parts])
    joint = np.concatenate([np.arange(p.rows.n_joints) for p in parts]) + first
    contact = np.setdiff1d(np.arange(sum(k)), joint)
    order = np.concatenate([rng.permutation(joint), rng.permutation(contact)]).astype(int)
    cones, rows = shuffled(whole, order)
    n = [p.rows.n_bodies for p in parts]
    place = rng.permutation(sum(n))
    back = np.argsort(place)
    names = ("inv_mass", "inv_inertia", "v_free")
    taken = {name: np.concatenate([getattr(p.rows, name) for p in parts])[back] for name in names}
    shift = np.cumsum([0, *n[:-1]])

    def moved(name):
        given = [
            np.where(getattr(p.rows, name) < 0, -1, getattr(p.rows, name) + s)
            for p, s in zip(parts, shift, strict=True)
        ]
        found = np.concatenate(given)
        return np.where(found < 0, -1, place[found]).astype(np.int32)

    of_joint = np.searchsorted(joint, order[: len(joint)])
    of_contact = np.searchsorted(contact, order[len(joint) :])
    for name in ("normal", "tangent", "arm_a", "arm_b"):
        taken[name] = np.concatenate([getattr(p.rows, name) for p in parts])[of_contact]
    jac = np.zeros((whole.n_rows, 12))
    for p, at in zip(parts, np.cumsum([0, *[p.m for p in parts[:-1]]]), strict=True):
        jac[at : at + len(p.rows.jac)] = p.rows.jac
    joint_rows = int(cones.ptr[len(joint)])
    made = lv.Rows(
        **taken, jac=jac[rows[:joint_rows]], joint_ptr=cones.ptr[: len(joint) + 1],
        joint_body=moved("joint_body")[of_joint], contact_body=moved("contact_body")[of_contact],
    )  # fmt: skip
    b, soft = (np.concatenate([getattr(p, name) for p in parts])[rows] for name in ("b", "compliance"))
    return lv.Problem(b, cones, rows=made, compliance=soft, friction=parts[0].friction)


def forests(rng, parts):
    """Blocks shuffled; velocities of the parts dealt into each other, parents before their children."""
    cones, rows = shuffled(joined(parts), rng.permutation(sum(p.n_blocks for p in parts)))
    deal = np.argsort(
        rng.permutation(np.repeat(np.arange(len(parts)), [p.generalized.nv for p in parts])), kind="stable"
    )
    place = np.argsort(deal)
    jac = sp.block_diag([p.generalized.jac for p in parts], format="csr")[rows][:, place]
    mass = sp.block_diag([p.generalized.mass for p in parts], format="csr")[place][:, place]
    b, soft = (np.concatenate([getattr(p, name) for p in parts])[rows] for name in ("b", "compliance"))
    made = lv.Generalized(jac, mass, np.zeros(len(place)))
    return lv.Problem(b, cones, generalized=made, compliance=soft, friction=parts[0].friction)


def draw(kind, seed):
    rng = np.random.default_rng(seed)
    word, _, law = kind.partition(" ")
    count = int(rng.integers(2, 7))
    if word == "lcp":
        parts = [
            random_lcp(seed + i, m=int(rng.integers(1, 12)), rank=None if rng.random() < 0.7 else 3)
            for i in range(count)
        ]
    elif word == "linear":
        parts = [lv.Problem.linear(*spd(int(rng.integers(1, 9)), seed % 1000 + i)) for i in range(count)]
    elif word == "one-sided":
        parts = []
        for _ in range(count):
            m = int(rng.integers(1, 9))
            parts.append(lv.Problem.lcp(rng.normal(size=(m, m)) + 6.0 * np.eye(m), rng.normal(size=m)))
    elif word == "forest":
        parts = [
            random_general(
                seed + i,
                law,
                n=int(rng.integers(2, 9)),
                compliance=seed % 3 > 0,
                contacts=int(rng.integers(0, 4)),
            )
            for i in range(count)
        ]
        return forests(rng, parts)
    else:
        spin, tangents = (False, 0) if law == "lcp" else (rng.random() < 0.5, None)
        joints = 0 if law == "lcp" else int(rng.integers(0, 3))
        parts = [
            random_contact_problem(
                seed + i, "cone" if law == "lcp" else law, tangents, spin, bodies=int(rng.integers(2, 5)),
                joints=joints, contacts=int(rng.integers(1, 6)),
            )
            for i in range(count)
        ]  # fmt: skip
        if word == "rows":
            return bodies(rng, parts)
    return matrices(rng, [p if p.rows is None else as_matrix(p) for p in parts])


KINDS = (
    "lcp", "linear", "one-sided", "rows lcp", "rows coulomb", "rows cone", "matrix lcp", "matrix coulomb",
    "matrix cone", "forest coulomb", "forest cone",
)  # fmt: skip


def share(log, part, options):
    """What the island is asked for, as in auto."""
    energy, velocity = options[1:3]
    e0, v0 = reference(part)
    tol = min(
        energy / e0 if e0 > 0.0 else np.inf,
        velocity / v0 if v0 > 0.0 else np.inf,
    )
    return min(tol, 1.0) if np.isfinite(tol) else log.tol


def swept(part, law, start, before, tol, options, least, hope):
    data = part.metric
    state = AcceleratedState(part, data, block_order(part, "given"), law == "cone", 0, 5)
    per = options[14] * data.work + options[15] * part.m
    first = options[16]
    lam = start.copy()
    given, o, step, total = before, state.order, first, 0
    if data.factored or data.is_general:
        velocity_change(data, lam, state.space[3])
    while True:
        status, last, *_ = accelerated.run(
            data, state.watch, lam, step, tol, 5, state.prepared, state.exact, 0, state.space, o.blocks, o.split,
            o.mode, o.rng,
        )  # fmt: skip
        total += last
        now = judged(part, lam.copy()).relative
        hopeless = sweeps_left(last, before, now, tol) * per > least and total * per > hope * least
        if now <= tol or status != RUNNING or hopeless or total * per > options[19] * least:
            return lam if now < given else start, now <= tol
        before, step = now, max(total // 2, first)


def alone(part, law, start, tol, options):
    """The island as a problem of its own: (impulse, did it end), by the solvers of few rows in Python's hands."""
    before = judged(part, start.copy()).relative
    if before <= tol:
        return start, True
    if part.generalized is not None:
        if law in ("lcp", "coulomb"):
            nv = part.generalized.nv
            _, row, factor, _, _, counts, *_ = GENERAL_GATE
            at = lv.problem.LAWS.index(part.law)
            one = row[at] * part.m + factor[at] * nv * float(nv * nv) / (
                3.0 if part.law == "coulomb" else 6.0
            )
            lam, ended = swept(part, law, start, before, tol, options, counts[at] * one, 0.0)
            if ended:
                return lam, True
        found = solve_first(part.derived.view, start, tol, GATE, general.ROOM)
        return (start, False) if not found else (found[0].impulse, True)
    data = part.metric
    if options[5] and part.is_symmetric:
        band = max(part.bandwidth)
        relative = data.start_relative
        chain = Chain(data, part._start, relative, matrix=part.csr_data, band=band, linear=law == "linear")
        found = chain.run(start, tol, True, WARM)
        if found is not None:
            return found[0].impulse, True
    if law == "linear" or not before < np.inf:
        return start, False
    lam, ended = swept(part, law, start, before, tol, options, options[17] * part.m, options[18])
    return lam, ended


@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds, tol=st.sampled_from([1e-3, 1e-6, 1e-9, 1e-12]), warm=st.booleans())
@settings(max_examples=25)
def test_an_island_has_the_bits_of_its_own_problem(kind, seed, tol, warm):
    problem = draw(kind, seed)
    rng = np.random.default_rng(seed + 1)
    log = SolveLog(problem, tol, 10**6)
    log.offer(rng.normal(size=problem.m) * 0.1 if warm else problem.start())
    count, label = log.islands
    if len(problem.metric.empty) or count == 1:
        return
    options = _split.asked(log, log.wrong_islands()[2], 10_000, rng.uniform(0.0, 1e4))
    start, found = log.impulse.copy(), log.impulse.copy()
    matrix = problem.csr_data if options[5] and problem.rows is not None else None
    prepared = _split.gauss_seidel.prepare(problem.metric) if problem.law == "cone" else None
    work = Islands(problem.metric, matrix, label, np.ones(count, np.int32), start, prepared)
    while work.run(options, GATE, general.ROOM, 3e3, found):  # cut anywhere
        pass
    report = work.report()
    for i in range(count):
        blocks = np.flatnonzero(label == i)
        rows = rows_of(problem, blocks)
        assert report[i, 7] == len(rows) <= FEW
        part = restrict(problem, blocks, rows)
        expected, ended = alone(part, problem.law, start[rows], share(log, part, options), options)
        assert (report[i, 0] != LEFT) == ended
        assert found[rows].tobytes() == expected.tobytes()
        assert (report[i, 0] == AT_START) == (
            judged(part, start[rows].copy()).relative <= share(log, part, options)
        )


def taken_apart(problem, tol=1e-6, wanted=None):
    """(report, impulse) of every island, or of those wanted."""
    log = SolveLog(problem, tol, 10**6)
    log.offer(problem.start())
    count, label = log.islands
    options = _split.asked(log, log.wrong_islands()[2], 10_000, 1e4)
    found = log.impulse.copy()
    matrix = problem.csr_data if options[5] and problem.rows is not None else None
    prepared = _split.gauss_seidel.prepare(problem.metric) if problem.law == "cone" else None
    chosen = np.ones(count, np.int32) if wanted is None else wanted
    work = Islands(problem.metric, matrix, label, chosen, log.impulse, prepared)
    work.run(options, GATE, general.ROOM, np.inf, found)
    return work.report(), found


@pytest.mark.parametrize("kind", KINDS)
def test_most_islands_do_end_there(kind):
    ends = np.concatenate([taken_apart(draw(kind, seed))[0][:, 0] for seed in range(12)])
    assert (ends > AT_START).mean() > 0.5  # what leaves everything to the caller would pass the test above


@pytest.mark.parametrize("kind", ["matrix coulomb", "rows cone", "forest coulomb", "lcp"])
@given(seed=seeds)
@settings(max_examples=10)
def test_equal_islands_are_solved_once(kind, seed):
    part = draw(kind, seed)
    join = {"rows": bodies, "forest": forests}.get(kind.partition(" ")[0], matrices)

    class Still:  # nothing is shuffled
        permutation = staticmethod(lambda n: np.arange(n) if np.isscalar(n) else np.asarray(n))

    once, alone_there = taken_apart(part)
    problem = join(Still(), [part, part, part])
    report, found = taken_apart(problem)
    if kind.startswith("rows"):
        return  # joints of all stand first: found by the count alone
    assert np.array_equal(found[: part.m], found[part.m : 2 * part.m])
    assert np.array_equal(found[: part.m], found[2 * part.m :])
    assert report[len(once) :, 8].all()
    assert len(alone_there) == part.m


def test_singular_islands_are_shifted_and_it_is_told():
    parts = [random_lcp(seed, m=8, rank=3) for seed in range(12)]
    problem = matrices(np.random.default_rng(0), parts)
    report, _ = taken_apart(problem)
    shifted = report[:, 6] == 1
    assert shifted.any() and (report[shifted, 0] == BY_PIVOTS).all()
    log = SolveLog(problem, 1e-6, 10**6)
    log.offer(problem.start())
    _split.solve_together(log, 10_000, 1e4)
    assert log.work["shifts"] == shifted.sum()


def test_an_island_that_is_not_wanted_stays_as_it_is():
    problem = draw("matrix coulomb", 5)
    log = SolveLog(problem, 1e-6, 10**6)
    count, label = log.islands
    wanted = (np.arange(count) % 2 == 0).astype(np.int32)
    report, found = taken_apart(problem, wanted=wanted)
    still = wanted[np.repeat(label, np.diff(problem.cones.ptr))] == 0
    assert still.any() and np.array_equal(found[still], problem.start()[still])
    assert (report[wanted == 0, 0] == LEFT).all() and (report[wanted == 1, 0] != LEFT).any()


def crowd(count, kind="coulomb", seed=0):
    """Small islands that are all different."""
    parts = [
        random_contact_problem(seed + i, kind, 2, False, bodies=3, joints=0, contacts=3) for i in range(count)
    ]
    return bodies(np.random.default_rng(seed), parts)


@pytest.mark.parametrize("form", ["rows", "matrix"])
@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_a_crowd_goes_island_by_island_and_says_so(form, law):
    problem = crowd(400, law)
    problem = problem if form == "rows" else as_matrix(problem)
    solution = lv.solve(problem, "auto", tol=1e-7)
    assert solution.success
    if (form, law) == ("rows", "cone"):
        assert " islands " in solution.message and "anderson" in solution.message, solution.message
    again = lv.solve(problem, "auto", tol=1e-7)
    assert again.impulse.tobytes() == solution.impulse.tobytes()
    assert again.work == solution.work


def test_an_interrupt_and_a_deadline_keep_what_is_solved(monkeypatch):
    problem = crowd(400, "cone")
    calls = []

    class Slow:
        def __init__(self, *given):
            self.work = Islands(*given)
            self.report = self.work.report

        def run(self, options, gate, most, limit, impulse):
            calls.append(limit)
            if len(calls) == 3:
                raise KeyboardInterrupt
            return self.work.run(options, gate, most, 1e4, impulse)

    monkeypatch.setattr(_split, "Islands", Slow)
    solution = lv.solve(problem, "auto", tol=1e-7)
    assert solution.status is lv.Status.INTERRUPTED and len(calls) == 3
    assert " islands " in solution.message
    # The relative residual is the worst row's; the energy tells of every island.
    assert 0.0 < solution.residual.energy < solution.residual.energy_start
    calls.clear()
    late = lv.solve(problem, "auto", tol=1e-7, time_limit=1e-9)
    assert late.status is lv.Status.TIME_LIMIT
    assert len(calls) <= 1
