"""Answers made in float32: what rounding explains, what stopped early, and data that are widened exactly."""

import dataclasses
import io
import json
import pickle

import numpy as np
import pytest
import scipy.sparse as sp
from click.testing import CliRunner
from hypothesis import given, settings
from random_problems import random_contact_problem, random_lcp, seeds
from random_trees import random_tree, tree_mass

import lavender as lv
from benchmarks.float32 import CUT, FLOOR, exchange, newton, planted, table
from lavender.cli.entry import cli
from lavender.judge.residuals import UNIT32, rounded
from lavender.lab.bench import resolve
from lavender.lab.bench.cases import describe
from lavender.lab.bench.record import from_json, to_json
from lavender.lab.bench.store import Records
from lavender.lab.report.contents import engine_table
from lavender.lab.report.engine import contestants


def robot(seed, m=12, n=10, soft=True, number=np.float64):
    """Bounded rows on a random forest, as soft as those of engines (2 to 20 % of the diagonal of A)."""
    rng = np.random.default_rng(seed)
    mass = tree_mass(rng, random_tree(rng, n))
    jac = rng.normal(size=(m, n)) * (rng.random((m, n)) < 0.6)
    jac[:, 0] += 0.3
    compliance = rng.uniform(0.02, 0.2, m) * np.einsum("ij,ij->i", jac, np.linalg.solve(mass, jac.T).T)
    upper = np.where(rng.random(m) < 0.3, rng.uniform(0.05, 0.5, m), np.inf)
    return lv.Problem.from_jacobian(
        jac.astype(number), mass.astype(number), rng.normal(size=n).astype(number), target=rng.uniform(-0.1, 0.1, m),
        cones=lv.Cones.bounded(np.zeros(m), upper), compliance=compliance if soft else None, name=f"robot {seed}",
    )  # fmt: skip


# -- the floor --------------------------------------------------------------------------------------


def dense_parts(p):
    """A, J, M^-1, M, v*: dense, whatever the problem holds."""
    if p.rows is not None:
        inverse = p.rows.inverse_mass_matrix().toarray()
        return p.dense(), p.jacobian.toarray(), inverse, None, p.rows.v_free.ravel()
    g = p.generalized
    mass = g.mass.toarray()
    return p.dense(), g.jac.toarray(), np.linalg.inv(mass), mass, g.v_free


@pytest.mark.parametrize("form", ["rows", "matrix", "generalized"])
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_the_parts_of_the_floor_are_the_formulas_written_densely(form, seed):
    p = (
        random_contact_problem(seed)
        if form == "rows"
        else robot(seed)
        if form == "generalized"
        else random_lcp(seed)
    )
    lam = lv.solve(p, max_iter=50).impulse
    if form == "matrix":
        a = p.dense()
        own, data, velocities = a**2 @ lam**2, a**2 @ lam**2 + p.b**2, 0.0 * p.b
    else:
        a, jac, inverse, mass, free = dense_parts(p)
        x, pushed = inverse @ jac.T @ lam, jac.T**2 @ lam**2
        through = (jac @ inverse) ** 2
        rounded_mass = jac**2 @ inverse**2 @ (jac.T @ lam) ** 2 if mass is None else through @ mass**2 @ x**2
        own, b2 = a**2 @ lam**2, (p.b + jac @ free) ** 2 + 2 * jac**2 @ free**2
        data = jac**2 @ x**2 + through @ pushed + rounded_mass + p.compliance**2 * lam**2 + b2
        velocities = 0.0 * p.b
        if form == "generalized":
            acts = (lam != p.cones.lower) & (lam != p.cones.upper) & (lam != 0.0)
            seen = jac**2 @ x**2 + p.b**2 + p.compliance**2 * lam**2
            velocities = a**2 @ np.where(acts, seen / p.compliance**2, 0.0)
    for got, want in zip(rounded(p, lam), (own, data, velocities), strict=True):
        np.testing.assert_allclose(got, UNIT32**2 * want, rtol=1e-9, atol=1e-30)


@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_a_solution_rounded_to_float32_is_at_its_floor_and_one_further_off_is_not(seed):
    p = random_lcp(seed)
    exact = lv.solve(p, "direct" if p.is_symmetric else "auto", tol=1e-12, max_iter=100_000)
    if not exact.residual.relative < 1e-10:
        return
    there = lv.residual(p, exact.impulse.astype(np.float32), precision="float32")
    assert there.verdict == "at its floor", there
    assert there.relative <= 4.0 * there.floor
    off = lv.residual(p, 0.99 * exact.impulse, precision="float32")
    if off.relative > 1e-4:  # of what 1 % less does; rounding is below that here
        assert off.verdict == "stopped early"
        assert off.excess == off.relative / off.floor > 4.0
        assert f"stopped early, {off.excess:.2g} times its floor" in str(off)


def test_our_solvers_are_held_to_the_floor_of_float64_whatever_the_data_were():
    rng = np.random.default_rng(0)
    b = rng.normal(size=(40, 40))
    p = lv.Problem.lcp(b @ b.T / 40 + 0.3 * np.eye(40), rng.normal(size=40) + 1.0, precision="float32")
    exact = lv.solve(p, tol=1e-13)
    early = lv.solve(p, "pgs", tol=1e-13, impulse=exact.impulse.astype(np.float32), max_iter=1)
    assert lv.residual(p, early.impulse).at_floor  # of an answer made in float32
    assert early.status is lv.Status.MAX_ITERATIONS
    assert not early.residual.at_floor
    assert not lv.motion.adopt(p, early.impulse).accepted
    for solution in (exact, lv.solve(p, max_iter=1000)):  # by a compiled call, and step by step
        assert solution.residual.precision == "float64"


def test_an_answer_that_is_no_better_than_none_is_wrong():
    p = robot(3)
    exact = lv.solve(p, tol=1e-10).impulse
    for impulse in (-exact, np.full(p.m, np.nan), np.full(p.m, 1e30), p.start()):
        assert lv.residual(p, impulse, precision="float32").verdict == "wrong"
    assert lv.residual(p, exact, precision="float32").verdict == "at its floor"


def test_where_there_is_nothing_to_do_rounding_is_no_mistake():
    p = lv.Problem.lcp(np.eye(2), [-1.0, -1e-12])  # both separate
    assert lv.residual(p, np.zeros(2)).nothing_to_do
    assert lv.residual(p, np.zeros(2), precision="float32").verdict == "at its floor"
    assert lv.residual(p, np.full(2, 1e30), precision="float32").verdict == "wrong"


def test_the_error_does_not_depend_on_the_precision_and_the_floor_does():
    p = robot(5)
    impulse = lv.solve(p, tol=1e-5).impulse
    one, two = lv.residual(p, impulse), lv.residual(p, impulse, precision="float32")
    assert (one.relative, one.energy, one.velocity) == (two.relative, two.energy, two.velocity)
    assert one.rounding is None
    assert one.precision == "float64"
    assert two.floor > 1e6 * one.floor
    parts = (two.rounding.impulse, two.rounding.data, two.rounding.velocities)
    # Norms of sums of squares: between the largest part and all of them.
    assert max(parts) <= two.floor * (1 + 1e-12)
    assert two.floor <= sum(parts) * (1 + 1e-12)


def test_a_row_that_is_rigid_reads_no_impulse_off_velocities():
    p = robot(5, m=6, soft=False)
    assert lv.residual(p, lv.solve(p).impulse, precision="float32").rounding.velocities == 0.0


@pytest.mark.parametrize("word", ["float16", "single", 32])
def test_another_precision_is_told(word):
    p = random_lcp(1)
    with pytest.raises(lv.InputError, match=r"precision is .*'float64' or 'float32'"):
        lv.residual(p, p.start(), precision=word)
    with pytest.raises(lv.InputError, match=r"precision is .*'float64' or 'float32'"):
        lv.Problem.lcp(np.eye(1), [1.0], precision=word)


# -- early stops, planted -----------------------------------------------------------------------------


def test_early_stops_are_found_and_no_answer_at_its_floor_is_called_early():
    rng = np.random.default_rng(0)
    stops = [stop for seed in range(60) for stop in planted(robot(seed), rng)]
    for method in ("velocities", "impulses"):
        ended = [s for s in stops if s.kind == f"{method}: {FLOOR}"]
        cut = [s for s in stops if s.kind == f"{method}: {CUT}"]
        assert len(ended) == 60
        assert len(cut) > 50
        assert all(s.verdict == "at its floor" for s in ended)
        assert sum(s.verdict != "at its floor" for s in cut) >= 0.95 * len(cut)
    assert table(stops).count("\n") == 1 + len({s.kind for s in stops})


def test_the_newtons_of_the_benchmark_solve_in_float64_what_lavender_solves():
    p = robot(11)
    want = lv.solve(p, tol=1e-11).impulse
    np.testing.assert_allclose(newton(p, np.float64)[-1][1], want, rtol=0, atol=1e-8 * abs(want).max())
    np.testing.assert_allclose(exchange(p)[-1], want, rtol=0, atol=1e-4 * abs(want).max())
    assert newton(p, np.float32)[-1][1].dtype == np.float32


# -- data in float32 ----------------------------------------------------------------------------------


def test_j_and_m_in_float32_are_widened_exactly_and_say_so():
    p = robot(7, number=np.float32)
    assert p.precision == "float32"
    rng = np.random.default_rng(7)
    mass = tree_mass(rng, random_tree(rng, 10)).astype(np.float32)
    assert np.array_equal(np.tril(p.generalized.mass.toarray()), np.tril(mass.astype(np.float64)))
    assert np.array_equal(p.generalized.v_free, p.generalized.v_free.astype(np.float32))
    assert lv.residual(p, p.start()).precision == "float32"  # the judge takes the problem's
    assert lv.residual(p, p.start(), precision="float64").precision == "float64"
    assert lv.solve(p).residual.precision == "float64"  # our solvers work in float64
    jac, mass = sp.csr_array(p.generalized.jac), p.generalized.mass.toarray()
    v = p.generalized.v_free
    for j, m, free, precision in (
        (jac.astype(np.float32), sp.csr_array(mass.astype(np.float32)), v.astype(np.float32), "float32"),
        (jac.astype(np.float32), [mass.astype(np.float32)], v.astype(np.float32), "float32"),
        (jac, mass.astype(np.float32), v.astype(np.float32), "float64"),
        (jac.astype(np.float32), mass.astype(np.float32), v.tolist(), "float64"),
    ):
        made = lv.Problem.from_jacobian(j, m, free, cones=p.cones)
        assert made.precision == precision
    forced = lv.Problem.from_jacobian(jac, mass, v, cones=p.cones, precision="float32")
    assert forced.precision == "float32"


def test_a_mass_matrix_summed_in_float32_need_not_be_symmetric_to_the_last_bit():
    mass = np.array([[2.0, 0.3], [0.3, 1.0]], np.float32)
    mass[0, 1] = np.nextafter(mass[0, 1], np.float32(1))
    jac, v = np.eye(2, dtype=np.float32), np.zeros(2, np.float32)
    made = lv.Problem.from_jacobian(jac, mass, v, cones=lv.Cones.free(2))
    assert made.generalized.mass.toarray()[1, 0] == mass[1, 0]
    with pytest.raises(lv.InputError, match="M is not symmetric"):
        lv.Problem.from_jacobian(jac, mass.astype(float), v, cones=lv.Cones.free(2))
    mass[0, 1] = 0.4
    with pytest.raises(lv.InputError, match="M is not symmetric"):
        lv.Problem.from_jacobian(jac, mass, v, cones=lv.Cones.free(2))


def boxes(number):
    """One box on four corners, turned."""
    c, s = np.cos(0.3), np.sin(0.3)
    given = {
        "inv_mass": [0.5], "inv_inertia": [0.7 * np.eye(3)], "v_free": [[0.1, 0.0, -0.2, 0.0, 0.3, 0.0]],
        "normal": np.tile([s, 0.0, c], (4, 1)), "tangent": np.tile([c, 0.0, -s], (4, 1)),
        "arm_a": np.zeros((4, 3)),
        "arm_b": [(x, y, -0.5) for x in (-0.5, 0.5) for y in (-0.5, 0.5)],
    }  # fmt: skip
    given = {name: np.asarray(x, number) for name, x in given.items()}
    return lv.Rows(contact_body=np.tile([-1, 0], (4, 1)), **given)


def test_rows_in_float32_keep_their_precision_in_their_problem_and_its_file(tmp_path):
    rows = boxes(np.float32)
    assert rows.precision == "float32"
    assert boxes(np.float64).precision == "float64"
    assert np.array_equal(rows.arm_b, rows.arm_b.astype(np.float32))
    problem = lv.Problem.from_rows(rows, mu=0.5)
    assert problem.precision == "float32"
    assert lv.residual(problem, problem.start()).precision == "float32"
    problem.save(tmp_path / "p.npz")
    for again in (lv.load(tmp_path / "p.npz"), pickle.loads(pickle.dumps(problem))):
        assert again == problem
        assert again.precision == "float32"
    assert problem.boxed(1.0).precision == problem.relaxed().precision == "float32"
    assert lv.Problem.from_rows(boxes(np.float64), mu=0.5).precision == "float64"


def test_a_matrix_in_float32_already_has_no_rounding_of_data():
    a, b = [[2.0, 1.0], [1.0, 2.0]], [1.0, 0.3]
    single = lv.Problem.lcp(np.float32(a), np.float32(b), precision="float32")
    impulse = lv.solve(single).impulse
    assert lv.residual(single, impulse).rounding.data == 0.0
    other = lv.Problem.lcp(a, b)
    assert lv.residual(other, impulse, precision="float32").rounding.data > 0.0


def test_a_file_with_another_precision_is_told(tmp_path):
    path = tmp_path / "p.npz"
    lv.Problem.lcp(np.eye(1), [1.0], precision="float32").save(path)
    with np.load(path) as held:
        entries = {name: held[name] for name in held}
    entries["meta"] = np.frombuffer(entries["meta"].tobytes().replace(b'"float32"', b'"float16"'), np.uint8)
    raw = io.BytesIO()
    np.savez(raw, **entries)
    path.write_bytes(raw.getvalue())
    with pytest.raises(lv.InputError, match=r"precision in it is float64 or float32"):
        lv.load(path)


def test_check_judges_a_stored_answer_for_the_precision_it_was_made_in(tmp_path):
    problem = robot(2)
    exact = lv.solve(problem, tol=1e-11).impulse
    for name, impulse in (("done", exact.astype(np.float32)), ("early", 0.9 * exact)):
        lv.io.save(problem, tmp_path / f"{name}.npz", impulse=impulse)
    told = ["--solvers", "pgs", "--precision", "float32"]
    done = CliRunner().invoke(cli, ["check", str(tmp_path / "done.npz"), *told])
    assert done.exit_code == 0, done.output
    assert "stored answer: at its floor of float32" in " ".join(done.output.split())
    early = CliRunner().invoke(cli, ["check", str(tmp_path / "early.npz"), *told])
    assert early.exit_code == 1
    assert "stored answer: stopped early, " in early.output
    # Without the option the precision is the problem's, and the exit code that of the claims.
    assert CliRunner().invoke(cli, ["check", str(tmp_path / "early.npz"), *told[:2]]).exit_code == 0
    lv.io.save(problem, tmp_path / "none.npz")
    none = CliRunner().invoke(cli, ["check", str(tmp_path / "none.npz"), *told])
    assert isinstance(none.exception, lv.InputError)
    assert "no file holds an answer" in str(none.exception)
    other = CliRunner().invoke(cli, ["check", str(tmp_path / "done.npz"), "--precision", "half"])
    assert other.exit_code == 2
    assert "'half' is not one of 'float64', 'float32'" in other.output


def test_a_report_shows_the_verdict_of_a_stored_answer_in_float32(tmp_path):
    problem = dataclasses.replace(robot(2), precision="float32")
    lv.io.save(problem, tmp_path / "early.npz", impulse=0.9 * lv.solve(problem, tol=1e-11).impulse)
    (item,) = resolve([tmp_path / "early.npz"])
    info = describe(item, "run")
    assert info.stored_verdict.startswith("stopped early, ")
    assert from_json(to_json(info)) == info


def test_a_recording_of_a_float32_engine_counts_its_early_answers(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option solver="CG" tolerance="1e-5"/><worldbody>
        <geom type="plane" size="5 5 .1"/>
        <body pos="0 0 .09"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
        <body pos=".05 0 .28" euler="5 9 20"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
        </worldbody></mujoco>"""
    )
    found = lv.io.record(model, mujoco.MjData(model), tmp_path, 6, precision="float32")
    assert lv.load(tmp_path / found.files[0]).precision == "float32"
    lines = [json.loads(line) for line in (tmp_path / "engine.jsonl").read_text().splitlines()]
    early = sum(line["verdict"] != "at its floor" for line in lines)
    assert all(line["precision"] == "float32" and line["floor"] > 1e-9 for line in lines)
    assert early > 0  # at its tolerance, far above the floor
    (engine,) = contestants([str(tmp_path)], Records())
    assert engine.early == early
    (row,) = engine_table([engine]).texts
    assert str(early) in row
    with pytest.raises(lv.InputError, match="precision is 'half'"):
        lv.io.record(model, mujoco.MjData(model), tmp_path / "other", 1, precision="half")
