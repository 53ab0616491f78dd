"""Any sequence of calls on one prepared solver and one problem has the bits of fresh ones.

`Calls` draws sequences of solves with new right-hand sides, velocities, bounds and problems of other kinds and sizes,
of starts that are carried by keys, of copies, and of calls that fail or are interrupted. The model is what the last
calls have given; nothing that was derived before may show.
"""

import copy
import functools
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from calls import facts
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    precondition,
    rule,
    run_state_machine_as_test,
)
from random_problems import (
    CONTACTS,
    add_compliance,
    as_matrix,
    make_problem_with_other_numbers,
    random_contact_problem,
)

import lavender as lv
from lavender import registry
from lavender.judge.certificates import check_certificate

SOLVERS = [name for name in lv.available(external=False) if name not in ("gauss_seidel", "sor")]
#: Multiples of 1/256 of a small size: products and sums of these are exact, so that b + J v* has one value.
numbers = st.integers(-300, 300).map(lambda n: n / 256.0)
seeds = st.integers(0, 9)
WAYS_TO_COPY = st.sampled_from([copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])


def rounded(x):
    return np.round(256.0 * np.asarray(x)) / 256.0


def on_exact_velocities(problem):
    """Return the same contacts over M = 1, with J, v* and targets that are multiples of 1/256."""
    jac = rounded(problem.jacobian.toarray())
    rng = np.random.default_rng(problem.m)
    free = rounded(rng.normal(size=jac.shape[1]))
    target = rounded(rng.normal(size=problem.m))
    return lv.Problem.from_jacobian(
        jac,
        np.eye(jac.shape[1]),
        free,
        target=target,
        cones=problem.cones,
        compliance=problem.compliance,
        friction=problem.friction,
    )


@functools.cache
def problems_of(solver):
    """Return keyed problems of every kind, form and a few sizes that a solver accepts; their keys overlap."""
    drawn = [
        random_contact_problem(31, contacts=0, joints=4),
        random_contact_problem(32, tangents=0, spin=False),
    ]
    for law in ("coulomb", "cone"):
        for i, draw in enumerate(CONTACTS.values()):
            drawn.append(draw(40 + i, law, bodies=3, joints=i % 3, contacts=1 + i))
    found = []
    for seed, base in enumerate(drawn):
        soft = add_compliance(base, 0.25)
        for form in (soft, as_matrix(soft), on_exact_velocities(soft)):
            key = np.random.default_rng(seed).permutation(form.n_blocks + 2)[: form.n_blocks]
            if registry.get(solver).refuses(form) is None:
                found.append(replace(form, key=key))
    return found


def fresh(problem):
    """Return a problem of the same numbers without anything that was derived."""
    return pickle.loads(pickle.dumps(replace(problem, copy=False)))


def carry_by_keys(before, impulse, problem):
    """Return the start that `Problem.carry` documents, block by block."""
    start = problem.start()
    for i, key in enumerate(problem.key):
        for j in np.flatnonzero(before.key == key):
            to, of = (slice(*c.ptr[k : k + 2]) for c, k in ((problem.cones, i), (before.cones, j)))
            if (
                problem.cones.kind[i] == before.cones.kind[j]
                and to.stop - to.start == of.stop - of.start
            ):
                start[to] = impulse[of]
    return start


class Calls(RuleBasedStateMachine):
    solutions = Bundle("solutions")
    solver = ""

    @property
    def pool(self):
        return problems_of(self.solver)

    def __init__(self):
        super().__init__()
        self.problem = self.pool[-1]
        self.prepared = lv.prepare(self.problem, self.solver)

    def compare(self, given, start=None, own=None, **options):
        """Solve by the prepared solver as `given`, and the model's problem by a fresh one."""
        budget = {"max_iter": 40} if registry.get(self.solver).resumable else {}
        options = {"tol": 1e-6} | budget | options
        expected = lv.solve(fresh(self.problem), self.solver, impulse=start, **options)
        found = self.prepared.solve(**given, impulse=start if own is None else own, **options)
        assert facts(found) == facts(expected)
        return self.problem, found

    @rule(
        target=solutions,
        more=st.sampled_from(
            [
                {},
                {"tol": 1e-3},
                {"tol": 1e-10},
                {"velocity_tol": 1e-3},
                {"time_limit": 600.0},
                {"max_iter": 1},
                {"max_iter": 5},
            ]
        ),
    )
    def solve_again(self, more):
        return self.compare({}, **more)

    @rule(target=solutions, i=st.integers(0, 99), same_form=st.booleans())
    def solve_another_problem(self, i, same_form):
        chosen = [p for p in self.pool if not same_form or p.operator == self.problem.operator]
        self.problem = chosen[i % len(chosen)]
        return self.compare({"problem": self.problem})

    @rule(target=solutions)
    def solve_with_other_bounds(self):
        other = make_problem_with_other_numbers(self.problem)
        self.problem = replace(other, b=rounded(other.b))  # so that b + J v* has one value again
        return self.compare({"problem": self.problem})

    @rule(target=solutions, value=numbers, row=st.integers(0, 99))
    def give_b(self, value, row):
        b = rounded(self.problem.b)
        b[row % len(b)] = value
        self.problem = replace(self.problem, b=b, guess=None)
        return self.compare({"b": b})

    @precondition(lambda self: self.problem.generalized is not None)
    @rule(target=solutions, value=numbers, entry=st.integers(0, 99), with_b=st.booleans())
    def give_v_free(self, value, entry, with_b):
        general, jac = self.problem.generalized, self.problem.jacobian
        free = general.v_free.copy()
        b = rounded(0.5 * self.problem.b)
        target = self.problem.b + jac @ free  # It stays where b is not given.
        free[entry % len(free)] = value
        b = b if with_b else target - jac @ free
        self.problem = replace(
            self.problem, b=b, generalized=type(general)(jac, general.mass, free), guess=None
        )
        return self.compare({"v_free": free} | ({"b": b} if with_b else {}))

    @rule(target=solutions, before=solutions, i=st.integers(0, 99), pair=st.booleans())
    def carry_to_another_problem(self, before, i, pair):
        self.problem = self.pool[i % len(self.pool)]
        (old, solution) = before
        if not registry.get(self.solver).impulse:
            return self.compare({"problem": self.problem})
        start = carry_by_keys(old, solution.impulse, self.problem)
        return self.compare(
            {"problem": self.problem}, start, (old, solution.impulse) if pair else solution
        )

    @rule(
        bad=st.sampled_from([{"b": [np.nan]}, {"tol": -1.0}, {"no_such": 1}, {"problem": 1}]),
        i=st.integers(0, 99),
    )
    def call_with_a_mistake(self, bad, i):
        with pytest.raises(lv.LavenderError):
            self.prepared.solve(**{"problem": self.pool[i % len(self.pool)]} | bad)

    @rule(ends=st.sampled_from(["callback", "limit"]), b=st.booleans())
    def interrupt(self, ends, b):
        if b:
            self.problem = replace(self.problem, b=2.0 * self.problem.b)
        given = {"b": self.problem.b} if b else {}
        if ends == "limit":
            self.prepared.solve(**given, tol=1e-12, time_limit=1e-9)
        elif registry.get(self.solver).callback:
            with pytest.raises(ZeroDivisionError):
                self.prepared.solve(**given, tol=0.0, callback=lambda *_: 1 // 0)
        else:
            self.prepared.solve(**given)

    @rule(way=WAYS_TO_COPY)
    def copy_what_is_prepared(self, way):
        self.prepared = way(self.prepared)

    @rule()
    def solve_in_threads(self):
        calls = [self.prepared.solve, *[functools.partial(lv.solve, self.problem, self.solver)] * 2]
        with ThreadPoolExecutor(3) as pool:
            found = [
                facts(future.result()) for future in [pool.submit(call, tol=1e-6) for call in calls]
            ]
        assert found == [facts(lv.solve(fresh(self.problem), self.solver, tol=1e-6))] * 3

    @rule(seed=seeds, tol=st.sampled_from([0.0, 1e-9, 0.3]))
    def judge_and_prove(self, seed, tol):
        """What a problem stores of one answer, or for one tolerance, is no answer for another."""
        x = np.random.default_rng(seed).normal(size=self.problem.m)
        for judge in (check_certificate, lambda p, y, _: lv.residual(p, y).error.tobytes()):
            assert judge(self.problem, x, tol) == judge(fresh(self.problem), x, tol)


@pytest.mark.parametrize("solver", SOLVERS)
def test_any_sequence_of_calls_of_a_prepared_solver_has_the_bits_of_fresh_solves(solver):
    run_state_machine_as_test(type("CallsOf", (Calls,), {"solver": solver}))
