"""Fields that are computed when they are read belong to the arrays as they were at the call.

Each case makes a result from arrays of the caller, twice: the fields of one result are read at once, those of the other
after the caller has overwritten every array.
"""

import numpy as np
import pytest
from random_problems import random_bodies_and_contacts, spd

import lavender as lv


def draw(seed=0, m=12, nv=15):
    """Return arrays of a problem of J and M with contacts, and of a start."""
    rng = np.random.default_rng(seed)
    return {
        "jac": rng.standard_normal((m, nv)),
        "mass": spd(nv, seed)[0],
        "free": rng.standard_normal(nv),
        "target": 0.1 * rng.standard_normal(m),
        "compliance": rng.uniform(0.01, 0.1, m),
        "mu": rng.uniform(0.2, 0.8, m // 3),
        "start": np.abs(rng.standard_normal(m)),
    }


def make_problem(x):
    return lv.Problem.from_jacobian(
        x["jac"], x["mass"], x["free"], target=x["target"], compliance=x["compliance"],
        cones=lv.Cones.contacts(x["mu"]),
    )  # fmt: skip


def make_batch(x):
    return lv.Batch(
        x["jac"][None].copy(),
        x["mass"][None].copy(),
        x["free"][None].copy(),
        cones=lv.Cones.contacts(x["mu"].copy()),
    )


def draw_matrix(seed=1, m=9):
    a, b = spd(m, seed)
    rng = np.random.default_rng(seed)
    return {
        "a": a,
        "b": b,
        "low": np.zeros(m),
        "high": rng.uniform(0.1, 2.0, m),
        "start": np.full(m, 0.3),
    }


def make_lcp(x):
    return lv.Problem.lcp(x["a"], x["b"], x["low"], x["high"])


def draw_program(seed=2, n=6):
    rng = np.random.default_rng(seed)
    return {
        "P": spd(n, seed)[0], "q": rng.standard_normal(n), "G": rng.standard_normal((4, n)), "h": rng.random(4),
        "lb": np.full(n, -1.0), "ub": np.full(n, 1.0), "initvals": np.zeros(n),
    }  # fmt: skip


def draw_bodies(seed=3):
    rows = random_bodies_and_contacts(np.random.default_rng(seed), joints=2, contacts=5)
    names = (
        "inv_mass", "inv_inertia", "v_free", "jac", "joint_ptr", "joint_body", "normal", "tangent", "arm_a", "arm_b",
        "contact_body",
    )  # fmt: skip
    arrays = {name: np.array(getattr(rows, name)) for name in names}
    return arrays | {"mu": np.full(5, 0.4), "start": np.full(len(rows.jac) + 15, 0.1)}


def make_bodies(x):
    rows = lv.Rows(**{name: value for name, value in x.items() if name not in ("mu", "start")})
    return lv.Problem.from_rows(rows, mu=x["mu"])


def solve_prepared(x):
    prepared = lv.prepare(make_lcp(x), "newton")
    prepared.solve(b=x["b"], impulse=x["start"], max_iter=1)
    return prepared.solve(b=x["b"], impulse=x["start"])


def solve_carried(x):
    problem = make_lcp(x)
    keyed = lv.Problem(problem.b, problem.cones, problem.matrix, key=np.arange(9))
    return lv.solve(keyed, impulse=(keyed, x["start"]))


def solve_from_solution(x):
    """From a start that is a solution nothing is computed, and the fields are those of the start."""
    solved = lv.solve(make_problem(x), tol=1e-10).impulse
    x["start"][:] = solved
    return lv.solve(make_problem(x), impulse=x["start"], tol=1e-6)


#: Name -> function that draws arrays, function that makes a result of them.
CASES = {
    **{f"solve by {name}": (draw, lambda x, name=name: lv.solve(make_problem(x), name, impulse=x["start"], tol=1e-8))
       for name in ("auto", "pgs", "newton", "anderson", "admm")},
    **{f"rows of A by {name}": (draw_matrix, lambda x, name=name: lv.solve(make_lcp(x), name, impulse=x["start"]))
       for name in ("auto", "direct", "lemke", "pgs", "newton")},
    **{f"bodies by {name}": (draw_bodies, lambda x, name=name: lv.solve(make_bodies(x), name, impulse=x["start"]))
       for name in ("auto", "sequential_impulses", "newton")},
    "a start that is a solution": (draw, solve_from_solution),
    "a limit": (draw, lambda x: lv.solve(make_problem(x), "pgs", impulse=x["start"], time_limit=1e-9)),
    "a history": (draw, lambda x: lv.solve(make_problem(x), "pgs", impulse=x["start"], history=True, max_iter=9)),
    "prepared": (draw_matrix, solve_prepared),
    "carried": (draw_matrix, solve_carried),
    "many problems": (draw, lambda x: lv.solve_many([make_problem(x)], impulses=[x["start"]])),
    "one of many": (draw, lambda x: lv.solve_many([make_problem(x)] * 2, impulses=[x["start"]] * 2)[1]),
    "a batch": (draw, lambda x: lv.solve_many(make_batch(x), impulse=x["start"][None])),
    "a world of a batch": (draw, lambda x: lv.solve_many(make_batch(x), impulse=x["start"][None])[0]),
    "a world by sweeps": (draw, lambda x: lv.solve_many(make_batch(x), "pgs", impulse=x["start"][None])[0]),
    "residual": (draw, lambda x: lv.residual(make_problem(x), x["start"])),
    "residual in float32": (draw, lambda x: lv.residual(make_problem(x), x["start"], "float32")),
    "residual of bodies": (draw_bodies, lambda x: lv.residual(make_bodies(x), x["start"])),
    "residuals": (draw, lambda x: lv.residual_many([make_problem(x)], [x["start"]])),
    "residual of one of many": (draw, lambda x: lv.residual_many([make_problem(x)], [x["start"]])[0]),
    "residual of a world": (draw, lambda x: lv.residual_many(make_batch(x), x["start"][None])[0]),
    "a problem of J and M": (draw, make_problem),
    "a problem of A": (draw_matrix, make_lcp),
    "a problem of bodies": (draw_bodies, make_bodies),
    "an update": (draw_matrix, lambda x: make_lcp(x).updated(b=x["start"], guess=x["b"])),
    **{f"a program by {name}": (draw_program, lambda x, name=name: lv.solve_qp(**x, solver=name, tol=1e-8))
       for name in ("auto", "admm", "newton")},
    "derivative": (draw, lambda x: lv.derivative(make_problem(x), lv.solve(make_problem(x), tol=1e-10))),
}  # fmt: skip
#: Times differ in each call.
SKIPPED = {"setup_time", "solve_time", "carry_time", "time"}


def read(thing, depth=2):
    """Return words for all public fields, early and late, and those of results among them."""
    found = {}
    for name in dir(type(thing)):
        if name.startswith("_") or name in SKIPPED or callable(getattr(type(thing), name)):
            continue
        try:
            value = getattr(thing, name)
        except lv.LavenderError as error:
            value = str(error)
        found |= write(name, value, depth)
    for name, value in getattr(thing, "__dict__", {}).items():
        if not name.startswith("_") and name not in SKIPPED:
            found |= write(name, value, depth)
    return found


def write(name, value, depth):
    if isinstance(value, np.ndarray):
        return {
            name: (
                value.dtype.str,
                value.shape,
                value.tobytes() if value.dtype != object else str(value),
            )
        }
    if type(value).__module__.startswith("lavender") and not callable(value):
        return {f"{name}.{key}": x for key, x in read(value, depth - 1).items()} if depth else {}
    if isinstance(value, str | int | float | tuple | None.__class__):
        return {name: repr(value)} if " ms" not in repr(value) and " us" not in repr(value) else {}
    return {}


@pytest.mark.parametrize("case", CASES)
def test_late_fields_are_those_of_the_arrays_at_the_call(case):
    draw_arrays, make = CASES[case]
    expected = read(make(draw_arrays()))
    arrays = draw_arrays()
    result = make(arrays)
    for array in arrays.values():
        array[...] = 0 if array.dtype.kind in "iu" else 1e6
    found = read(result)
    assert expected.keys() == found.keys() and len(found) > 5
    assert [name for name in found if found[name] != expected[name]] == []
