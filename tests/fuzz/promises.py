"""Claims of solvers that go on iteration by iteration: problems on which sweeps creep, rest or lose their way.

A spec names where its problem comes from (a seed says the rest), so that it stays small.
"""

import hypothesis.strategies as st
import numpy as np
from random_families import wild
from random_problems import nearly_singular, warmed
from strategies import plain
from worked import after

import lavender as lv
from lavender import suite
from lavender.lab.suite import hard

SCENES = (
    ("stack", {"n": (3, 6, 10)}),
    ("pyramid", {"base": (3, 4)}),
    ("card_house", {"levels": (2, 3)}),
    ("chain", {"n": (5, 20)}),
    ("bridge", {"n": (6, 12)}),
    ("heavy_on_light", {"ratio": (1.0, 10.0, 1e3)}),
    ("table", {"legs": (3, 4, 9)}),
    ("four_bar", {}),
    ("ramp", {"angle": (0.1, 0.35, 0.6)}),
    ("pile", {"n": (8, 16)}),
)


def promise_specs():
    """A problem, an iterative solver and a budget."""
    pick = st.sampled_from
    common = {
        "kind": st.just("promise"),
        "seed": st.integers(0, 10**6),
        "solver": pick(lv.available(external=False, resumable=True)),
        "tol": pick((1e-6, 1e-6, 1e-9, 1e-12)),
        "max_iter": pick((None, None, None, 200, 3000)),
    }

    def of(source, more):
        return st.tuples(st.fixed_dictionaries({"source": st.just(source), **common}), more).map(
            lambda x: x[0] | x[1]
        )

    nothing, text = st.just({}), st.fixed_dictionaries({"text": pick(hard.SET)})
    drawn = [of(source, nothing) for source in ("wild", "warm", "singular", "singular")]
    return st.one_of(of("scene", scenes()), of("scene", scenes()), *drawn, of("hard", text)).map(plain)


@st.composite
def scenes(draw):
    """A scene by name, after some steps."""
    name, choices = draw(st.sampled_from(SCENES))
    parameters = {key: draw(st.sampled_from(values)) for key, values in choices.items()}
    parameters["solver_iterations"] = draw(st.sampled_from((4, 8, 16, 32)))
    return {"scene": name, "parameters": parameters, "steps": draw(st.integers(1, 120))}


def build(spec):
    """The problem of a spec, with its warm start."""
    source = spec["source"]
    if source == "scene":
        return after(spec["steps"], spec["scene"], **spec["parameters"]).constraint_problem()
    if source == "hard":
        return suite.case(spec["text"]).problem
    if source == "singular":
        return nearly_singular(spec["seed"])
    problem = wild(seed=spec["seed"], rows=200).problem
    return problem if source == "wild" else warmed(problem, spec["seed"]) or problem


def check(spec, counts):
    """No claim is contradicted, and the number of sweeps per decade is a number."""
    problem, name = build(spec), spec["solver"]
    if problem.m == 0 or problem.m > 700 or lv.get(name).refuses(problem):
        counts["refused"] += 1
        return
    more = {} if spec["max_iter"] is None else {"max_iter": spec["max_iter"]}
    solution = lv.solve(problem, name, tol=spec["tol"], **more)
    if solution.claim_check != "confirmed":
        yield "contradicted", f"{name}: {solution.claim_check}, {solution.status_conflict}"
    slope = solution.sweeps_per_decade
    if not (np.isnan(slope) or 0.0 < slope < np.inf):
        yield "wrong number", f"{name}: sweeps_per_decade is {slope}"
