"""One list of values that are no numbers, at every public door that takes numbers: each is refused by its name."""

from dataclasses import fields, replace

import numpy as np
import pytest
from random_problems import random_contact_problem, random_rows

import lavender as lv
from lavender import bench, suite

A = np.array([[2.0, 1.0], [1.0, 2.0]])
LCP = lv.Problem.lcp(A, [1.0, -1.0])
CONTACT = random_contact_problem(3)
ROWS = random_rows(np.random.default_rng(0))
GENERAL = lv.Problem.from_jacobian(np.eye(2), A, [1.0, -1.0], cones=lv.Cones.bounded([0.0, 0.0], [1.0, 1.0]))
PARTS = {f.name: getattr(ROWS, f.name) for f in fields(ROWS) if f.name != "copy"}
DISKS, NINE = np.eye(6), {"A": np.eye(8), "b": np.ones(8)}
FINDEX = {
    "A": np.eye(3),
    "b": np.ones(3),
    "lower": [0.0, -1.0, -1.0],
    "upper": [np.inf, 1.0, 1.0],
    "findex": [-1, 0, 0],
}
BATCH = {
    "J": np.array([np.eye(2)] * 2),
    "M": np.array([A] * 2),
    "v_free": np.ones((2, 2)),
    "target": np.ones((2, 2)),
    "compliance": np.ones((2, 2)),
    "mu": np.full((2, 1), 0.5),
}
SLIDING = lv.Cones.contacts(0.5, tangents=1)


def batch_with(x, field):
    return lv.solve_many(lv.Batch(**BATCH | {field: x}, cones=SLIDING))


def wrong_arrays(x, free):
    """Of a good one, (n,) or more; `free`: dimensions whose length is the caller's to choose."""
    flat, text = x.reshape(-1), x.astype(str)
    first = np.arange(x.size).reshape(x.shape) == 0
    yield "NaN", np.where(first, np.nan, x)
    yield "a column", x[..., None]
    yield "ragged", [flat.tolist(), flat[:-1].tolist()]
    yield "text", text
    yield "lists of text", text.tolist()
    yield "complex", x + 0j
    yield "dates", np.zeros(x.shape, "m8[s]")
    yield "objects", np.full(x.shape, None)
    yield "masked", np.ma.array(x, mask=first)
    if not free:
        yield "longer", np.concatenate([x, x[:1]])
        yield "shorter", x[:-1]


WRONG_NUMBERS = {"NaN": np.nan, "text": "1", "complex": 1j, "True": True, "a list": [1.0, 2.0], "masked": np.ma.masked,
                 "a date": np.timedelta64(1, "s"), "infinite": -np.inf}  # fmt: skip
WRONG_COUNTS = {**WRONG_NUMBERS, "a half": 2.5, "negative": -3, "very large": 2**70}
WRONG_FLAGS = {"text": "no", "a number": 1, "None": None, "a list": [], "an array": np.zeros(2)}


def scene(name, **more):
    """A call of a method of a scene that has a body."""

    def call(x, field):
        made = lv.Scene()
        made.add_sphere()
        try:
            return getattr(made, name)(**{**more, field: x})
        except lv.InputError:
            assert (made.n_bodies, made.n_joints) == (1, 0)
            raise

    return call


def rows_with(x, field):
    return lv.Rows(**{**PARTS, field: x})


#: Name of the argument, after what it belongs to: call with a value, a good value, and whether its length is free.
ARRAYS = {
    "lcp: A": (lambda x: lv.Problem.lcp(x, [1.0, -1.0]), A, False),
    "lcp: b": (lambda x: lv.Problem.lcp(A, x), [1.0, -1.0], True),
    "lcp: lower": (lambda x: lv.Problem.lcp(A, [1.0, -1.0], x), [0.0, -1.0], False),
    "lcp: upper": (lambda x: lv.Problem.lcp(A, [1.0, -1.0], 0.0, x), [1.0, 2.0], False),
    "lcp: guess": (lambda x: lv.Problem.lcp(A, [1.0, -1.0], guess=x), [0.0, 1.0], False),
    "contact: mu": (lambda x: lv.Problem.contact(DISKS, np.ones(6), x), [0.5, 0.2], True),
    "contact: patch_radius": (lambda x: lv.Problem.contact(**NINE, mu=0.5, patch_radius=x), [0.1, 0.2], False),
    "cones: mu": (lambda x: lv.Cones.contacts(x), [0.5, 0.2, 0.1], True),
    "cones: rolling": (lambda x: lv.Cones.contacts([0.5, 0.2], rolling=x), [0.1, 0.2], False),
    "cones: lower": (lambda x: lv.Cones.bounded(x, [3.0, 3.0]), [0.0, -1.0], True),
    "findex: b": (lambda x: lv.Problem.from_findex(**FINDEX | {"b": x}), np.ones(3), True),
    "findex: lower": (lambda x: lv.Problem.from_findex(**FINDEX | {"lower": x}), [0.0, -1.0, -1.0], False),
    "findex: findex": (lambda x: lv.Problem.from_findex(**FINDEX | {"findex": x}), [-1, 0, 0], False),
    "findex_order: findex": (lambda x: lv.Problem.findex_order(x), [-1, 0, 0], True),
    "from_rows: target": (lambda x: lv.Problem.from_rows(ROWS, x), np.zeros(len(ROWS.jac) + 8), False),
    "J": (lambda x: lv.Generalized(x, A, [1.0, 1.0]), np.eye(2), True),
    "M": (lambda x: lv.Generalized(np.eye(2), x, [1.0, 1.0]), A, False),
    "v_free": (lambda x: lv.Generalized(np.eye(2), A, x), [1.0, 1.0], False),
    "from_jacobian: target": (
        lambda x: lv.Problem.from_jacobian(A, A, [1.0, 1.0], target=x, cones=lv.Cones.free(2)), [1.0, 2.0], False
    ),
    **{f"products, {call}: {name}": (getattr(GENERAL.generalized, call), [0.5, 0.25], False) for call, name in {
        "velocity_of": "v", "momentum_of": "v", "bias": "target", "force": "impulse", "change": "impulse",
    }.items()},
    "updated: b": (lambda x: LCP.updated(b=x), [1.0, 2.0], False),
    "updated: guess": (lambda x: LCP.updated(guess=x), [1.0, 2.0], False),
    "updated: target": (lambda x: GENERAL.updated(target=x), [1.0, 2.0], False),
    "boxed: normal_impulse": (CONTACT.boxed, np.ones(8), False),
    **{f"rows: {name}": (lambda x, name=name: rows_with(x, name), getattr(ROWS, name), name in ("normal", "inv_mass"))
       for name in ("inv_mass", "inv_inertia", "v_free", "jac", "normal", "tangent", "arm_a", "contact_body")},
    **{f"{name}: impulse": (call, [0.5, 0.25], False) for name, call in {
        "solve": lambda x: lv.solve(LCP, "pgs", impulse=x),
        "solve by auto": lambda x: lv.solve(LCP, impulse=x),
        "prepared": lambda x: lv.prepare(LCP, "pgs").solve(impulse=x),
        "solve_many": lambda x: lv.solve_many([LCP, LCP], "pgs", impulses=[x, None]),
        "residual": lambda x: lv.residual(LCP, x),
        "residual in float32": lambda x: lv.residual(LCP, x, precision="float32"),
        "motion_error": lambda x: lv.motion_error(LCP, x),
        "diagnose": lambda x: lv.diagnose(LCP, x),
        "slack": LCP.slack,
        "velocity": GENERAL.velocity,
        "carry": lambda x: LCP.carry((LCP, x)),
    }.items()},
    **{f"batch: {name}": (lambda x, name=name: batch_with(x, name), good, name == "J") for name, good in BATCH.items()},
    "batch: A": (lambda x: lv.solve_many(lv.Batch.of_matrices(x, np.ones((2, 2)), cones=SLIDING)), [A, A], False),
    "batch: b": (lambda x: lv.solve_many(lv.Batch.of_matrices([A, A], x, cones=SLIDING)), np.ones((2, 2)), False),
    **{f"batch: {name}": (lambda x, name=name: lv.Batch.of_bodies({**PARTS, "v_free": [ROWS.v_free] * 2, name: x})[0],
                          [PARTS[name]] * 2, True) for name in ("inv_mass", "normal")},
    "motion_error: reference": (lambda x: lv.motion_error(LCP, [0.0, 0.0], reference=x), [0.5, 0.0], False),
    **{f"scene: {field}": (lambda x, field=field, call=call: call(x, field), good, False) for field, good, call in (
        ("position", [0.0, 0.0, 3.0], scene("add_body")),
        ("quaternion", [1.0, 0.0, 0.0, 0.0], scene("add_body")),
        ("velocity", [0.0, 0.0, 1.0], scene("add_body")),
        ("angular_velocity", [0.0, 0.0, 1.0], scene("add_box")),
        ("inertia", [1.0, 1.0, 1.0], scene("add_body")),
        ("size", [1.0, 2.0, 1.0], scene("add_box")),
        ("normal", [0.0, 0.0, 1.0], scene("add_plane")),
        ("anchor", [0.0, 0.0, 1.0], scene("add_joint", kind="ball", a=0, b=-1)),
        ("anchor_b", [0.0, 0.0, 1.0], scene("add_joint", kind="distance", a=0, b=-1, anchor_a=(0.0, 0.0, 0.0))),
        ("axis", [0.0, 0.0, 1.0], scene("add_joint", kind="hinge", a=0, b=-1, anchor=(0.0, 0.0, 0.0))),
    )},
    "scene: gravity": (lambda x: lv.Scene(gravity=x), [0.0, 0.0, -9.81], False),
}  # fmt: skip


@pytest.mark.parametrize("door", ARRAYS)
def test_an_array_that_is_none_of_numbers_is_refused_by_name(door):
    call, good, free = ARRAYS[door]
    good = np.array(good)
    call(good)
    call(good.tolist())
    for what, x in wrong_arrays(good, free):
        if what == "NaN" and door.startswith("residual"):
            assert call(x).relative == np.inf  # a number that measures an impulse that ran away, too
        elif what == "NaN" and door.startswith("products"):
            assert np.isnan(call(x)).any()
        else:
            refused(call, x, door, what)


def refused(call, x, door, what):
    """What came is told by the name of the argument."""
    print(what, x)  # shown where it is taken
    with pytest.raises(lv.InputError, match=door.rpartition(": ")[2]):
        call(x)


def of_options(x, name):
    return lv.solve(LCP, "pgs", **{name: x})


NUMBERS = {
    **{f"solve: {name}": (lambda x, name=name: of_options(x, name), 1e-3) for name in ("tol", "time_limit")},
    "auto: time_limit": (lambda x: lv.solve(LCP, time_limit=x), 1.0),
    "explain: tol": (lambda x: lv.explain(LCP, tol=x), 1e-6),
    "redundancy: tol": (lambda x: lv.redundancy(LCP, tol=x), 1e-12),
    "cross_check: tol": (lambda x: lv.cross_check(LCP, ["pgs"], "direct", tol=x), 1e-6),
    **{f"solve_many of {n}: {name}": (lambda x, name=name, n=n: lv.solve_many([LCP] * n, **{name: x}), 1e-6)
       for name in ("tol", "time_limit") for n in (0, 1)},
    "jacobi: omega": (lambda x: lv.solve(LCP, "jacobi", omega=x), 0.5),
    **{f"bench: {name}": (lambda x, name=name: bench.Plan(**{name: x}), 1.0) for name in ("time_limit", "pass_limit")},
    "bench: level": (lambda x: bench.Plan(levels=[x]), 1e-3),
    "suite: mass_ratio": (lambda x: suite.stack(mass_ratio=x), 2.0),
    "suite: sliding": (lambda x: suite.stack(sliding=x), 0.5),
    "omega": (lambda x: lv.solve(replace(LCP, cones=lv.Cones.free(2)), "sor", omega=x), 1.5),
    **{f"scene: {name}": (lambda x, name=name: lv.Scene("stack", **{name: x}), 0.25) for name in (
        "dt", "friction", "restitution", "patch_radius", "rolling_radius", "slop", "margin", "restitution_threshold",
        "max_substep", "mass", "size")},
    **{f"scene: {name}": (lambda x, name=name, call=call: call(x, name), 0.5) for name, call in (
        ("mass", scene("add_box")), ("radius", scene("add_sphere")), ("friction", scene("add_body")),
        ("restitution", scene("add_body")), ("patch_radius", scene("add_sphere")), ("offset", scene("add_plane")),
        ("hertz", scene("add_joint", kind="ball", a=0, b=-1, anchor=(0.0, 0.0, 0.0))),
        ("damping", scene("add_joint", kind="ball", a=0, b=-1, anchor=(0.0, 0.0, 0.0), hertz=1.0)),
        ("length", scene("add_joint", kind="distance", a=0, b=-1, anchor_a=(0.0, 0.0, 0.0), anchor_b=(0.0, 0.0, 1.0))),
    )},
}  # fmt: skip


COUNTS = {
    "solve: max_iter": (lambda x: of_options(x, "max_iter"), 7),
    "auto: max_iter": (lambda x: lv.solve(LCP, max_iter=x), 7),
    "solve: seed": (lambda x: lv.solve(LCP, "pgs", order="random", seed=x), 2**70),
    **{f"solve_many of {n}: max_iter": (lambda x, n=n: lv.solve_many([LCP] * n, max_iter=x), 6) for n in (0, 1)},
    "solve_many: threads": (lambda x: lv.solve_many([LCP], threads=x), 2**70),
    "motions: n": (lambda x: lv.motions(LCP, n=x), 2),
    "motions: seed": (lambda x: lv.motions(LCP, n=1, seed=x), 2**70),
    "free cones: m": (lv.Cones.free, 2),
    "cones: count": (lambda x: lv.Cones.contacts(0.5, count=x), 2),
    "row_name: row": (LCP.row_name, 1),
    "anderson: memory": (lambda x: lv.solve(LCP, "anderson", memory=x), 3),
    "suite: n": (lambda x: suite.stack(n=x), 8),
    "bench: repeats": (lambda x: bench.Plan(repeats=x), 3),
    "bench: budget": (lambda x: bench.Plan(budgets=[x]), 3),
    "film: steps": (lambda x: lv.Simulation("stack").film(x), 1),
    "reset: seed": (lambda x: lv.Simulation("stack").reset(x), 1),
    "set_solver_iterations: iterations": (lambda x: lv.Simulation("stack").set_solver_iterations(x), 4),
    **{f"scene: {name}": (lambda x, name=name: lv.Scene("stack", **{name: x}), 4)
       for name in ("substeps", "solver_iterations", "position_iterations", "seed", "n")},
}  # fmt: skip


FLAGS = {
    "solve: history": (lambda x: of_options(x, "history"), True),
    "scene: static": (lambda x: scene("add_box")(x, "static"), True),
    "scene: collide": (
        lambda x: scene("add_joint", kind="ball", a=0, b=-1, anchor=(0.0, 0.0, 0.0))(x, "collide"), True
    ),
    "scene: warm_start": (lambda x: lv.Scene("stack", warm_start=x), False),
    "set_warm_start: warm_start": (lambda x: lv.Simulation("stack").set_warm_start(x), False),
    "simulation: report_residual": (lambda x: lv.Simulation("stack", report_residual=x), True),
    "simulation: report_motion": (lambda x: lv.Simulation("stack", report_motion=x), True),
    **{f"bench: {name}": (lambda x, name=name: bench.Plan(**{name: x}), True)
       for name in ("warm", "campaign", "motion")},
    "motions: always": (lambda x: lv.motions(LCP, n=1, always=x), True),
}  # fmt: skip


LISTS = {
    "cross_check: solvers": (lambda x: lv.cross_check(LCP, x, "direct"), ["pgs"]),
    "bench: solvers": (bench.solver_names, ["pgs"]),
    "bench: cases": (bench.resolve, [LCP]),
    "bench: case": (lambda x: bench.resolve([x]), LCP),
    **{f"bench: {name}": (lambda x, name=name: bench.Plan(**{name: x}), []) for name in ("levels", "orders", "times")},
    "suite: case": (suite.case, "stack"),
    "derivatives: problems": (lambda x: lv.derivatives(x, []), []),
    "batch: fields": (
        lv.Batch.of_bodies, {k: np.array([v] * 2) if k == "v_free" else v for k, v in PARTS.items() if v is not None}
    ),
    "many: index": (lambda x: lv.solve_many([LCP] * 2)[x], [0, -1]),
}  # fmt: skip


KINDS = {
    "list": (LISTS, {"object": object(), "ellipsis": ..., "bytes": b"x"}),
    "number": (NUMBERS, WRONG_NUMBERS),
    "whole number": (COUNTS, WRONG_COUNTS),
    "true or false": (FLAGS, WRONG_FLAGS),
}


@pytest.mark.parametrize(
    ("kind", "door"), [(kind, door) for kind, (doors, _) in KINDS.items() for door in doors]
)
def test_what_is_none_of_its_kind_is_refused_by_name(kind, door):
    doors, wrong = KINDS[kind]
    call, good = doors[door]
    call(good)
    for what, x in wrong.items():
        if repr(x) != repr(good):  # a seed may be very large
            refused(call, x, door, what)


@pytest.mark.parametrize(
    ("solver", "option"),
    [(name, option) for name in lv.available(external=False) for option in lv.get(name).options],
)
def test_every_option_of_every_solver_refuses_what_is_no_value_of_it(solver, option):
    spec = lv.get(solver)
    problem = next(p for p in (LCP, replace(LCP, cones=lv.Cones.free(2)), CONTACT) if spec.refuses(p) is None)
    for what, x in {"a word": "no such word", "NaN": np.nan, "complex": 1j, "a mapping": {1: 2}}.items():
        print(what)
        with pytest.raises(lv.LavenderError, match=option):
            lv.solve(problem, solver, **{option: x})
