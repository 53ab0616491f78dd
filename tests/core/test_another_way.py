"""Another way to the same result gives the same bits: one property, two lists of ways, problems drawn from axes.

`WAYS` are ways to solve one problem, `BATCHES` ways to solve worlds of one batch. Each is compared with a fresh single
solve in everything that a solution says but its times. Problems are those of `make_problems_of_every_kind` (every law,
kind of block and form of A), of `draw_few_rows` (which a compiled call solves at once), and of `drawn_worlds` (units,
condition, ranges, structure and precision; unlike worlds beside each other in one batch).
"""

import functools
import itertools
import pickle
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from calls import SHORT, SINGLE, facts, is_same, list_arrays
from drawn_worlds import LAYOUTS, draw_worlds, lay_out
from random_problems import FEW_ROWS, draw_few_rows, make_problems_of_every_kind

import lavender as lv
from benchmarks.core_problems import fresh
from lavender import registry
from lavender.batch.data import Batch

SOLVERS = lv.available(external=False)
LAWS = ("lcp", "coulomb", "cone")
SEEDS = range(48)
STARTS = ("none", "none", "near", "far")


# -- problems ----------------------------------------------------------------------------------------------------------


@functools.cache
def list_examples():
    """Return problems of every law and kind of block, each in every form."""
    kinds = make_problems_of_every_kind().items()
    return [p for (_, kind), (forms, _) in kinds if not kind.startswith("round") for p in forms]


@functools.cache
def list_calls(name):
    """Return (problem, options, facts of its fresh solve) of the problems that a solver accepts, with any start."""
    calls = []
    for i, problem in enumerate(list_examples()):
        options = {"tol": 1e-7, "max_iter": 60 if registry.get(name).resumable else None}
        calls.append(
            (problem, options | ({"impulse": np.full(problem.m, 10.0)} if i % 4 == 3 else {}))
        )
    for i, kind in enumerate(FEW_ROWS if name in SHORT else ()):
        for seed in range(5):
            problem, tol = (
                draw_few_rows(kind, 31 * i + seed),
                (1e-3, 1e-6, 1e-9, 1e-13, 0.9)[(i + seed) % 5],
            )
            calls.append((problem, {"tol": tol}))
            if registry.get(name).refuses(problem) is None and seed < 3:
                found = lv.solve(fresh(problem), name, tol=tol).impulse
                near = found * (1.0 + 1e-4 * np.random.default_rng(seed).normal(size=problem.m))
                start = (found, near, np.zeros(problem.m))[seed]
                calls.append((problem, {"tol": tol, "impulse": start}))
    accepted = [(p, options) for p, options in calls if registry.get(name).refuses(p) is None]
    return [(p, options, facts(lv.solve(fresh(p), name, **options))) for p, options in accepted]


@functools.cache
def draw_group(seed):
    """Return (worlds of one batch, options, starts or None): the law, options and kind of start go with the seed."""
    worlds = draw_worlds(seed, 16, LAWS[seed % 3])
    rng, start = np.random.default_rng(seed + 1), STARTS[seed // 3 % 4]
    solved = [lv.solve(w.make_problem(), tol=1e-6).impulse for w in worlds]
    factor = 1e-3 if start == "near" else 1e5
    starts = [x + factor * np.abs(x).max(initial=0.0) * rng.standard_normal(len(x)) for x in solved]
    return worlds, {"tol": (1e-6, 1e-9, 1e-12)[seed % 7 % 3]}, None if start == "none" else starts


def pair(worlds, starts):
    return zip(
        worlds, itertools.repeat(None) if starts is None else starts, strict=starts is not None
    )


@functools.cache
def expect(seed):
    worlds, options, starts = draw_group(seed)
    return [
        facts(lv.solve(w.make_problem(), impulse=x, **options)) for w, x in pair(worlds, starts)
    ]


# -- ways --------------------------------------------------------------------------------------------------------------


def at_once(function, n=8):
    """Return the results of n threads that begin together, and that are interrupted often."""
    gate, interval = threading.Barrier(n), sys.getswitchinterval()

    def run():
        gate.wait(600)
        return function()

    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(n) as pool:
            return [future.result() for future in [pool.submit(run) for _ in range(n)]]
    finally:
        sys.setswitchinterval(interval)


def solve_in_eight_threads(problem, name, **options):
    """Each property that is derived from the problem is computed by the thread that reads it first."""
    first, *others = at_once(lambda: lv.solve(problem, name, **options))
    assert all(facts(other) == facts(first) for other in others)
    return first


def solve_with_a_callback(problem, name, **options):
    if not registry.get(name).callback:
        return lv.solve(problem, name, **options)
    return lv.solve(problem, name, callback=lambda *_: None, **options)


def solve_after_a_residual(problem, name, **options):
    lv.residual(problem, np.ones(problem.m))
    return lv.solve(problem, name, **options)


def solve_prepared_after_other_data(problem, name, **options):
    """Neither the state of another b nor what a limit ended shows."""
    prepared = lv.prepare(problem.updated(b=-0.5 * problem.b), name)
    prepared.solve(tol=1e-3, max_iter=3 if registry.get(name).resumable else None)
    prepared.solve(b=2.0 * problem.b, time_limit=1e-9)
    return prepared.solve(problem, **options)


def solve_twice(problem, name, **options):
    lv.solve(problem, name, tol=1e-2)
    return lv.solve(problem, name, **options)


def solve_listed(problem, name, *, impulse=None, **options):
    more = {} if impulse is None else {"impulses": [None, impulse, impulse]}
    return lv.solve_many([problem] * 3, name, **more, **options)[1]


#: Ways to solve a problem of which nothing was derived before.
WAYS = {
    "a pickled problem": lambda p, name, **more: lv.solve(
        pickle.loads(pickle.dumps(p)), name, **more
    ),
    "judged before": solve_after_a_residual,
    "prepared": lambda p, name, **more: lv.prepare(p, name).solve(**more),
    "prepared and reused": solve_prepared_after_other_data,
    "solved before": solve_twice,
    "one of a list": solve_listed,
    "a list and two threads": functools.partial(solve_listed, threads=2),
    "a list and a time limit": functools.partial(solve_listed, time_limit=600.0),
    "eight threads": solve_in_eight_threads,
    "a time limit that does not bind": lambda p, name, **more: lv.solve(
        p, name, time_limit=600.0, **more
    ),
    "a callback": solve_with_a_callback,
}


@contextmanager
def limit_lanes(width):
    """Let workers take worlds in groups of a width up to that of this processor."""
    make = Batch.make_kernel_worlds

    def make_worlds(*arguments):
        worlds = make(*arguments)
        worlds.width = min(width, worlds.width)
        return worlds

    with patch.object(Batch, "make_kernel_worlds", make_worlds):
        yield


def solve_batch(worlds, starts, layout, width=None, order=1, **options):
    """Return solutions of a batch in which the worlds have another order, and check its arrays against them."""
    batch = lay_out(worlds[::order], layout)
    start = None
    if starts is not None:
        start = np.zeros(batch.shape).ravel()
        for i, x in enumerate(starts[::order]):
            start[batch.rows_of(i)] = x
        start = start.reshape(batch.shape)
    if width is None:
        many = lv.solve_many(batch, impulse=start, **options)
    else:
        with limit_lanes(width):
            many = lv.solve_many(batch, impulse=start, **options)
    check_arrays(many, batch)
    return [many[i] for i in range(len(worlds))][::order]


def check_arrays(many, batch):
    """Every array of a batch has the numbers of its solutions; impulses and velocities have their bits."""
    for name in list_arrays(many):
        expected = [SINGLE[name](s, s.residual) for s in many]
        assert all(map(is_same, getattr(many, name), expected)), name
    impulse, velocity = many.impulse.ravel(), many.velocity.ravel()
    nv = len(velocity) // len(many)
    for i, solution in enumerate(many):
        assert impulse[batch.rows_of(i)].tobytes() == solution.impulse.tobytes()
        found = velocity[nv * i : nv * (i + 1)]
        assert found.tobytes() == batch[i].velocity(solution.impulse).ravel().tobytes()


def solve_list(worlds, starts, **options):
    """Solve a list with problems of another law, without starts, between the worlds; return the worlds' solutions."""
    law = LAWS[LAWS.index(worlds[0].law) - 1]
    others = draw_worlds(len(worlds[0].free), len(worlds), law, nv=len(worlds[0].free))
    problems = [w.make_problem() for both in zip(worlds, others, strict=True) for w in both]
    impulses = [start for _, x in pair(worlds, starts) for start in (x, None)]
    many = lv.solve_many(problems, impulses=impulses, **options)
    return [many[i] for i in range(0, len(problems), 2)]


#: Ways to solve worlds of one batch or of a list.
BATCHES = {
    **{f"{name}, in lanes of {width}": functools.partial(solve_batch, layout=name, width=width, order=order)
       for (name, width, order) in (("rows", 1, 1), ("triangles", 2, -1), ("padded", 4, 1), ("rows", 8, -1))},
    **{f"{name}, two threads": functools.partial(solve_batch, layout=name, threads=2) for name in LAYOUTS},
    "rows and a time limit": functools.partial(solve_batch, layout="rows", time_limit=600.0),
    "a list": solve_list,
    "a list, two threads": functools.partial(solve_list, threads=2),
    "a list and a time limit": functools.partial(solve_list, time_limit=600.0),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", SOLVERS)
def test_solve_in_another_way_has_the_bits_of_a_fresh_solve(name, way):
    calls = list_calls(name)
    for problem, options, expected in calls[:9] if way == "eight threads" else calls:
        if way.startswith("prepared and") and problem.guess is not None:
            continue
        assert facts(WAYS[way](fresh(problem), name, **options)) == expected, problem


def solve_each(worlds, starts, way, **options):
    return [way(w.make_problem(), "auto", impulse=x, **options) for w, x in pair(worlds, starts)]


@pytest.mark.parametrize("seed", SEEDS)
def test_drawn_worlds_in_another_way_have_the_bits_of_fresh_solves(seed):
    worlds, options, starts = draw_group(seed)
    each = {
        name: functools.partial(solve_each, way=WAYS[name])
        for name in WAYS
        if "threads" not in name
    }
    for way, solve in list((BATCHES | each).items())[seed % 4 :: 4]:
        found = solve(worlds, starts, **options)
        for i, (solution, expected) in enumerate(zip(found, expect(seed), strict=True)):
            assert facts(solution) == expected, (way, i, worlds[i].choice)


@pytest.mark.parametrize("seed", SEEDS)
def test_judged_batch_has_the_bits_of_single_residuals(seed):
    """Near a solution, far from it, and float32 impulses; in the precision of the data and in others."""
    worlds, _, _ = draw_group(seed)
    batch = lay_out(worlds, LAYOUTS[seed % len(LAYOUTS)])
    rng = np.random.default_rng(seed)
    single = [w.make_problem() for w in worlds]
    solved = lv.solve_many(batch).impulse.ravel()
    factor = (1.0 + 1e-4 * rng.standard_normal(solved.shape), np.full(solved.shape, -1e6))[seed % 2]
    cases = (
        (solved * factor, None, 8),
        (np.float32(solved), "float32", 1),
        (np.float32(solved), "float64", 4),
    )
    for impulses, precision, width in cases:
        with limit_lanes(width):
            found = lv.residual_many(
                batch, impulses.reshape(batch.shape), precision=precision, threads=2
            )
        for i, problem in enumerate(single):
            assert batch[i] == problem and batch[i].precision == problem.precision
            one = lv.residual(problem, impulses[batch.rows_of(i)], precision=precision)
            for name in list_arrays(found):
                assert is_same(getattr(found, name)[i], SINGLE[name](None, one)), (
                    name,
                    worlds[i].choice,
                )
            assert list_words(found[i]) == list_words(one), worlds[i].choice
            assert precision is not None or is_same(
                one.islands.relative.max(initial=0.0), one.relative
            )


def list_words(residual):
    """Return all fields of a residual, arrays by their bits, and its sentence."""
    values = {f.name: getattr(residual, f.name) for f in fields(residual) if f.name != "_problem"}
    words = {k: v.tobytes() if isinstance(v, np.ndarray) else repr(v) for k, v in values.items()}
    return words | {"": str(residual), "verdict": residual.verdict, "rounding": residual.rounding}


PROCESS = """
import pickle, sys
sys.path[:0] = pickle.load(open(sys.argv[1], "rb"))
import lavender as lv
from calls import facts
calls = pickle.load(open(sys.argv[2], "rb"))
found = [repr(facts(lv.solve(problem, name, **options))) for problem, name, options in calls]
pickle.dump(found, open(sys.argv[3], "wb"))
"""


def test_another_process_has_the_bits_of_this_one(tmp_path):
    calls = [(fresh(p), name, o) for name in SOLVERS for p, o, _ in list_calls(name)[::7]]
    expected = [e for name in SOLVERS for *_, e in list_calls(name)[::7]]
    for seed in SEEDS[::4]:
        worlds, options, starts = draw_group(seed)
        calls += [
            (w.make_problem(), "auto", options | {"impulse": x}) for w, x in pair(worlds, starts)
        ]
        expected += expect(seed)
    paths = [tmp_path / name for name in ("paths", "calls", "found")]
    paths[0].write_bytes(pickle.dumps([*filter(None, sys.path), str(Path(__file__).parents[1])]))
    paths[1].write_bytes(pickle.dumps(calls))
    subprocess.run([sys.executable, "-c", PROCESS, *map(str, paths)], check=True, timeout=600)
    found = pickle.loads(paths[2].read_bytes())
    for call, one, other in zip(calls, found, expected, strict=True):
        assert one == repr(other), call
