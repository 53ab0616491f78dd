"""Verdicts on stored answers of float32 engines, in records and reports."""

import dataclasses
import json

import numpy as np
import pytest
from random_trees import random_tree, tree_mass

import lavender as lv
from benchmarks.float32 import CUT, FLOOR, exchange, newton, planted, table
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
