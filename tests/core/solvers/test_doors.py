"""The same keyword gives the same answer through every door, and it changes the answer.

`SOLVE_DOORS` and `PROGRAM_DOORS` are calls that solve one problem; `JUDGE_DOORS` are calls and commands that judge one
impulse. A keyword that one of them ignores, or whose default differs, makes that door's answer another one.
"""

import inspect
import json

import numpy as np
import pytest
from calls import facts, over_velocities
from click.testing import CliRunner
from random_problems import (
    add_compliance,
    as_matrix,
    make_well_posed_problems,
    random_contact_problem,
)
from test_options import LISTED, NEEDED, SPECS, get_values

import lavender as lv
from lavender.cli import cli
from lavender.io.recorder import describe_answer
from lavender.report.cases import resolve_item
from lavender.report.store import make_lines
from lavender.report.tables import read_engine_answers
from lavender.solving.prepared import Prepared

# -- solves ------------------------------------------------------------------------------------------------------------


def solve_in_a_batch(problem, solver, impulse=None, **more):
    general = problem.generalized
    batch = lv.Batch(
        general.jac.toarray()[None], general.mass.toarray()[None], general.v_free[None],
        target=(problem.b + general.jac @ general.v_free)[None], cones=problem.cones,
        compliance=problem.compliance[None], friction=problem.friction,
    )  # fmt: skip
    return lv.solve_many(batch, solver, impulse=None if impulse is None else impulse[None], **more)[
        0
    ]


def solve_listed(problem, solver, impulse=None, **more):
    return lv.solve_many(
        [problem], solver, impulses=None if impulse is None else [impulse], **more
    )[0]


def solve_prepared(problem, solver, **more):
    options = {name: more.pop(name) for name in list(more) if name in SPECS[solver].accepts}
    return lv.prepare(problem, solver, **options).solve(**more)


def solve_prepared_twice(problem, solver, **more):
    """A keyword of an earlier call is not kept."""
    options = {name: more.pop(name) for name in list(more) if name in SPECS[solver].accepts}
    prepared = lv.prepare(problem, solver, **options)
    prepared.solve(tol=0.5, impulse=np.ones(problem.m))
    prepared.solve(velocity_tol=1e3, max_iter=1)
    return prepared.solve(**more)


SOLVE_DOORS = {
    "a list": solve_listed, "prepared": solve_prepared, "prepared twice": solve_prepared_twice,
    "a batch": solve_in_a_batch,
}  # fmt: skip
#: Solver, keyword and value; the answer without the keyword is another one.
KEYWORDS = [
    ("auto", "tol", 1e-2), ("auto", "tol", 1e-13), ("auto", "tol", 0.0), ("pgs", "tol", 1e-2), ("newton", "tol", 1e-13),
    ("pgs", "max_iter", 3), ("newton", "max_iter", 1), ("pgs", "velocity_tol", 0.1), ("newton", "velocity_tol", 0.1),
    ("pgs", "time_limit", 1e-9),  ("pgs", "impulse", None), ("auto", "impulse", None),
]  # fmt: skip


@pytest.mark.parametrize("door", SOLVE_DOORS)
@pytest.mark.parametrize(("solver", "keyword", "value"), KEYWORDS)
def test_keyword_of_a_solve_has_one_meaning_through_every_door(solver, keyword, value, door):
    problem = over_velocities(24, 18, seed=3, compliance=0.05)
    value = 0.4 * np.ones(problem.m) if keyword == "impulse" else value
    plain = {"max_iter": 25} if solver == "pgs" and keyword != "max_iter" else {}
    expected = facts(lv.solve(problem, solver, **plain, **{keyword: value}))
    assert expected != facts(lv.solve(problem, solver, **plain)), (
        "the keyword changes nothing: nothing is tested"
    )
    found = facts(SOLVE_DOORS[door](problem, solver, **plain, **{keyword: value}))
    if keyword in ("velocity_tol", "time_limit"):  # One tol of all worlds; other words on a limit.
        names = "impulse", "status"
        assert [found[name] for name in names] == [expected[name] for name in names]
    else:
        assert found == expected


@pytest.mark.parametrize(("name", "option"), LISTED)
def test_option_of_a_solver_has_one_meaning_through_every_door(name, option):
    soft = add_compliance(
        random_contact_problem(5, tangents=2, spin=False, joints=6, contacts=30, bodies=12), 0.01
    )
    problems = [soft, as_matrix(soft), *make_well_posed_problems(SPECS[name])]
    problem = next(p for p in problems if SPECS[name].refuses(p) is None)
    for value in get_values(name, option):
        more = {option: value, "tol": 0.0, "max_iter": 9} | NEEDED.get(option, {})
        try:
            expected = facts(lv.solve(problem, name, **more))
        except (lv.CapabilityError, lv.InputError) as error:
            for door in (solve_listed, solve_prepared):
                with pytest.raises(type(error)):
                    door(problem, name, **more)
            continue
        assert facts(solve_listed(problem, name, **more)) == expected, value
        assert facts(solve_prepared(problem, name, **more)) == expected, value


@pytest.mark.parametrize("solver", ["pgs", "anderson"])
def test_history_and_callback_are_the_same_through_every_door(solver):
    problem = over_velocities(24, 18, seed=3, compliance=0.05)
    found = []
    for door in (lv.solve, solve_listed, solve_prepared):
        seen = []

        def watch(k, impulse, residual, seen=seen):
            seen.append((k, impulse.tobytes(), residual.relative))

        history = door(problem, solver, tol=1e-9, max_iter=40, history=True, callback=watch).history
        columns = (history.iterations, history.relative, history.energy, history.velocity)
        found.append((seen, [x.tolist() for x in columns]))
    assert found[0] == found[1] == found[2] and len(found[0][0]) > 1


#: Keywords of doors that a test of this file gives them; the others choose the solver, problem or worlds.
TESTED = {name for _, name, _ in KEYWORDS} | {"history", "callback", "precision", "threshold"}
OTHERS = {"solver", "problem", "b", "v_free", "errors", "threads", "like", "impulses"}
DOORS = (lv.solve, lv.solve_many, Prepared.solve,
         lv.residual, lv.residual_many)  # fmt: skip


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__qualname__)
def test_every_keyword_of_a_door_is_tested_and_has_the_default_of_the_others(door):
    defaults = {}
    for other in DOORS:
        for name, keyword in inspect.signature(other).parameters.items():
            if keyword.default is not inspect.Parameter.empty:
                defaults.setdefault(name, keyword.default)
    for name, keyword in inspect.signature(door).parameters.items():
        if keyword.default is not inspect.Parameter.empty:
            assert keyword.default == defaults[name], name
            assert name in TESTED | OTHERS, f"{name}: add a line to KEYWORDS"


# -- programs ----------------------------------------------------------------------------------------------------------


def make_program():
    rng = np.random.default_rng(4)
    n, half = 8, rng.normal(size=(8, 8))
    return {
        "P": half @ half.T + 0.1 * np.eye(n), "q": rng.normal(size=n), "G": rng.normal(size=(6, n)),
        "h": rng.uniform(0.1, 1.0, 6), "A": rng.normal(size=(2, n)), "b": rng.normal(size=2),
        "lb": np.full(n, -2.0), "ub": np.full(n, 2.0),
    }  # fmt: skip


#: Doors that return the package's answer.
PROGRAM_DOORS = {
    "arrays by position": lambda p, **more: lv.solve_qp(*p.values(), **more),
    "a problem": lambda p, **more: lv.solve_qp(lv.Problem.from_qp(**p), **more),
    "lavender.qp.solve_problem": lambda p, **more: lv.qp.solve_problem(
        lv.Problem.from_qp(**p), more.pop("solver", "auto"), **more
    ).extras["answer"],
}


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"tol": 1e-3},
        {"tol": 1e-11},
        {"max_iter": 4},
        {"solver": "admm"},
        {"solver": "admm", "max_iter": 3},
        {"time_limit": 1e-9},
    ],
)
def test_keyword_of_a_program_has_one_meaning_through_every_door(more):
    """The doors of qpsolvers have another default of tol, and their `solve_qp` returns x alone, or None."""
    arrays, more = make_program(), {"tol": 1e-7} | more
    expected = lv.solve_qp(**arrays, **more)
    answers = {name: door(arrays, **more) for name, door in PROGRAM_DOORS.items()}
    for name, answer in answers.items():
        assert (answer.found, answer.solution.status) == (
            expected.found,
            expected.solution.status,
        ), name
        if "time_limit" not in more:  # What a limit cuts off depends on the clock.
            for part in ("x", "y", "z", "z_box"):
                assert getattr(answer, part).tobytes() == getattr(expected, part).tobytes(), (
                    name,
                    part,
                )
            assert answer.error == expected.error, name
            assert answer.solution.iterations == expected.solution.iterations, name
    x = lv.qp.solve_qp(**arrays, **({"solver": "auto"} | more))
    assert (x is not None) == expected.found and (x is None or x.tobytes() == expected.x.tobytes())


# -- judges ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", [None, "float32", "float64"])
@pytest.mark.parametrize("threshold", [1e-9, 1e-3, 1e3])
def test_threshold_and_precision_have_one_meaning_through_every_judge(
    tmp_path, threshold, precision
):
    """The call, many worlds, a stored answer and its command, and a recorded answer in a report."""
    problem = over_velocities(12, 15, seed=1)
    impulse = lv.solve(problem, tol=1e-12).impulse * (
        1.0 + 1e-5 * np.random.default_rng(0).normal(size=problem.m)
    )
    expected = lv.residual(problem, impulse, precision, threshold)
    many = lv.residual_many([problem], [impulse], precision=precision, threshold=threshold)
    assert (many.verdict[0], many[0].verdict) == (expected.verdict, expected.verdict)
    assert many[0].roundoff_floor == expected.roundoff_floor == many.roundoff_floor[0]
    path = tmp_path / "step_00000.npz"
    lv.io.save(problem, path, impulse=impulse)
    stored = resolve_item(str(path), path.stem).judge_stored_answer(precision, threshold)
    assert (stored.verdict, stored.roundoff_floor) == (expected.verdict, expected.roundoff_floor)
    arguments = ["check", str(path), "--threshold", str(threshold)]
    done = CliRunner().invoke(cli, [*arguments, *(["--precision", precision] if precision else [])])
    is_good = expected.verdict in ("at its floor", "close enough")
    assert done.exit_code == (0 if is_good else 1), done.output
    if precision is None:
        line = {"file": path.name} | describe_answer(problem, impulse, threshold)
        assert line["verdict"] == expected.verdict
        (tmp_path / "engine.jsonl").write_text(
            json.dumps(line | {"verdict": "", "relative": 0.0}) + "\n"
        )
        answers = read_engine_answers([str(tmp_path)], make_lines([]))
        assert answers["verdict"].tolist() == [expected.verdict]
        assert answers["relative"].tolist() == [expected.relative]


def test_thresholds_change_the_verdict():
    problem = over_velocities(12, 15, seed=1)
    impulse = lv.solve(problem, tol=1e-12).impulse * (
        1.0 + 1e-5 * np.random.default_rng(0).normal(size=problem.m)
    )
    assert len({lv.residual(problem, impulse, threshold=t).verdict for t in (1e-9, 1e3)}) == 2
