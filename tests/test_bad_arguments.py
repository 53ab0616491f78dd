"""Every public call rejects a wrong argument by an error that names it, and reads arrays in any memory alike.

Valid calls are made from signatures: each function of a group gets the values of its own parameters by name. One value
at a time is then replaced.
"""

import inspect
import re
import types
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from random_problems import random_bodies_and_contacts, random_contact_problem

import lavender as lv
from lavender import io, report, suite


@dataclass(frozen=True)
class Call:
    """A valid call of a public function."""

    function: Callable[..., Any]
    arguments: dict[str, Any]
    accepts_nan: bool = False  # measures and batches report NaN in their results
    any_length: tuple[
        str, ...
    ] = ()  # arguments whose length (or number of dimensions) is not fixed
    names: dict[str, str] = field(
        default_factory=dict
    )  # argument -> pattern of its name in messages, if another

    def __call__(self, **changed: Any) -> Any:
        return self.function(**self.arguments | changed)


#: Patterns of names in messages, if they differ from the names of the arguments.
NAMES = {
    "jac": "J|jac",
    "mass": "M|mass",
    "matrix": "A",
    "i": "index of worlds|block|i",
    "given": "impulse",
    "keys": "keys?",
    "solution": "solution|impulse",
    "solutions": "solutions?",
    "reference": "reference|solver",
    "text": "set",
    "dof_names": "names of velocities",
    "points": "points?",
    "normals": "normals?",
    "tangents": "tangents?",
    "spec": "SolverSpec",
    "impulses": "impulses?",
    "sources": "sources|cases",
    "name": "name|solver|scene",
    "n": "n|solver_iterations",
    "flag": "flag|warm_start",
    "body": "body|a|b",
    "part": "contacts?",
    "xs": "impulses?",
    "a": "a|body",
    "b": "b|body",
    "kind": "kind|joint",
}
#: Values that some argument accepts after all.
ACCEPTS = {
    "name": ("an object", "an ellipsis", "bytes"),
    "threads": ("very large",),
    "seed": ("very large",),
    "lower": ("infinite",),
    "sequences": ("None",),
    "count_mu": ("True",),
}
CALLS: dict[str, Call] = {}


def name_call(function):
    """Return the name of a function, or of a method with that of its class."""
    owner = getattr(function, "__self__", None)
    owner = owner if owner is None or inspect.isclass(owner) else type(owner)
    return function.__name__ if owner is None else f"{owner.__name__}.{function.__name__}"


def add(values, *functions, **options):
    """Add calls of functions, or of pairs (name, function), with the values of their own parameters."""
    for function in functions:
        name, function = (
            function if isinstance(function, tuple) else (name_call(function), function)
        )
        parameters = inspect.signature(function).parameters
        given = {k: values[k] for k in values if k in parameters or "changes" in parameters}
        CALLS[name if name not in CALLS else f"{name}, {len(CALLS)}"] = Call(
            function, given, **options
        )


def builder_of(method, **arguments):
    """Call a method of a new builder of two bodies in space; return the problem that it makes."""
    builder = lv.RowBuilder(ONES, np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 6)), 0.01, PLACES)
    getattr(builder, method)(**arguments)
    return builder.problem()


def read_builder(method, **arguments):
    """Call a method that reads from a builder with one contact."""
    builder = lv.RowBuilder(ONES, ONES, np.zeros((2, 3)), 0.01, PLACES[:, :2])
    builder.contact(0, 1, AT[:2], AXIS[:2] / 0.6)
    arguments = (
        {"problem": builder.problem()} | arguments if method == "velocity_after" else arguments
    )
    return getattr(builder, method)(**arguments)


def on_scene(method, **arguments):
    """Call a method of a new scene with one sphere, which a rejected call leaves as it was."""
    scene = lv.Scene()
    scene.add_sphere()
    try:
        return getattr(scene, method)(**arguments)
    except lv.LavenderError:
        assert (scene.n_bodies, scene.n_joints) == (1, 0)
        raise


def like(owner, method, call):
    """Return (name, function) of a call that has the signature of a method without self."""
    function = partial(call, method)
    parameters = list(inspect.signature(getattr(owner, method)).parameters.values())[1:]
    function.__signature__ = inspect.Signature(
        [p.replace(kind=p.KEYWORD_ONLY) for p in parameters if p.kind != p.VAR_KEYWORD]
    )
    return f"{owner.__name__}.{method}", function


A = np.array([[2.0, 1.0], [1.0, 2.0]])
B = np.array([1.0, -1.0])
ONES = np.ones(2)
EYE = np.eye(2)
PLACES = np.array([(0.0, 0.0, 0.0), (1.0, 0.5, 0.2)])
AT = np.array([0.5, 0.2, 0.1])
AXIS = np.array([0.0, 0.6, 0.8])
LCP = lv.Problem.lcp(A, B, key=np.array([3, 4]))
CONTACT = random_contact_problem(3)
ROWS = random_bodies_and_contacts(np.random.default_rng(0))
ROW_ARRAYS = {f.name: getattr(ROWS, f.name) for f in fields(ROWS) if f.name != "copy"}
GENERAL = lv.Problem.from_jacobian(EYE, A, B, cones=lv.Cones.bounded([0.0, 0.0], [1.0, 1.0]))
EXACT = lv.solve(GENERAL, tol=1e-12)
SLIDING = lv.Cones.contacts(0.5, tangents=1)
STEP = lv.Problem.from_jacobian(
    np.eye(3)[[2, 0, 1]], np.eye(3), [0.5, 0.0, -1.0], cones=lv.Cones.contacts(0.2)
)
WORLDS = {
    "J": np.array([EYE] * 2),
    "M": np.array([A] * 2),
    "v_free": np.ones((2, 2)),
    "cones": SLIDING,
    "target": np.ones((2, 2)),
    "compliance": np.ones((2, 2)),
    "mu": np.full((2, 1), 0.5),
    "friction": "coulomb",
}
BATCH = lv.Batch(**{k: WORLDS[k] for k in ("J", "M", "v_free", "cones")})
N_CONTACTS = len(ROWS.normal)
N_ROWS = len(ROWS.jac) + 5 * len(ROWS.normal)
LIMITS = {"tol": 1e-6, "max_iter": 100, "time_limit": 1.0}
OF_LCP = LIMITS | {
    "problem": LCP,
    "solver": "pgs",
    "impulse": B,
    "history": True,
    "A": A,
    "b": B,
    "lower": -ONES,
    "upper": ONES,
    "guess": B,
    "row": 1,
    "block": 1,
    "previous": (LCP, B),
    "keys": np.array([4, 5]),
    "law": "lcp",
    "reference": B,
    "solvers": ["pgs"],
    "before": LCP,
}

add(
    OF_LCP,
    lv.Problem.linear,
    lv.Problem.lcp,
    LCP.block_of,
    LCP.row_name,
    LCP.row_unit,
    LCP.block_name,
    LCP.carry,
    LCP.make_start,
    LCP.slack,
    LCP.updated,
    lv.solve,
    lv.prepare,
    lv.explain,
    lv.known,
    lv.available,
    lv.get("pgs").refuses,
    lv.get("gauss_seidel").standing_in,
    lv.redundancy,
    lv.motion_error,
    lv.solve(LCP, tol=1e-12).motion_error,
    report.carry_impulses,
    report.classify_structure,
)
add(LIMITS | {"problem": LCP, "impulse": B}, ("solve", lv.solve), lv.prepare(LCP, "pgs").solve)
add(LIMITS | {"problem": LCP, "solvers": ["pgs"], "reference": "direct"}, lv.cross_check)
add({"problem": GENERAL, "velocity": B}, io.reconstruct)
add({"b": B}, lv.prepare(LCP, "pgs").solve)
add({"v_free": B}, lv.prepare(GENERAL).solve)
add(
    {"problem": LCP, "impulse": B, "precision": "float32", "threshold": 1e-6},
    lv.residual,
    accepts_nan=True,
)
add({"name": "pgs"}, lv.get)
add({"against": "time"}, lv.solve(LCP, "pgs", history=True).history.plot)
add({"rows": 5}, lv.solve(LCP).plot)
add({"i": 0}, lv.solve(LCP).state)
add({"spec": lv.get("pgs"), "replace": True}, lv.register)
for _name, _option, _value in (
    ("jacobi", "omega", 0.5),
    ("sor", "omega", 1.5),
    ("anderson", "memory", 3),
):
    _problem = lv.Problem.linear(A, B) if _name == "sor" else LCP
    CALLS[f"solve, {_name}"] = Call(partial(lv.solve, _problem, _name), {_option: _value})
CALLS["solve, random order"] = Call(partial(lv.solve, LCP, "pgs", order="random"), {"seed": 7})
add(
    {
        "ptr": np.array([0, 1, 4]),
        "kind": np.array([lv.ROW, lv.CONTACT]),
        "lower": np.array([0.0] + 3 * [-np.inf]),
        "upper": np.full(4, np.inf),
        "mu": np.array([0.0, 0.5]),
        "patch_radius": np.zeros(2),
        "rolling": np.zeros(2),
    },
    lv.Cones,
)
add(
    {
        "mu": np.array([0.5, 0.2]),
        "tangents": 2,
        "patch_radius": ONES,
        "rolling": ONES,
        "shape": "disk",
    },
    lv.Cones.contacts,
)
add(
    {"lower": -ONES, "upper": ONES, "m": 3, "shape": "box"},
    lv.Cones.bounded,
    lv.Cones.free,
    lv.Cones.contacts(0.5, count=2).shaped,
)
add({"blocks": np.array([1, 0])}, CONTACT.cones.select, any_length=("blocks",))
add(
    {"J": EYE, "M": A, "v_free": B, "target": B, "lower": B, "upper": B},
    lv.derivative(GENERAL, EXACT).jvp,
)
add({"velocity": B, "impulse": B, "slack": B}, lv.derivative(GENERAL, EXACT).vjp)
add(
    {
        "problem": GENERAL,
        "solution": EXACT.impulse,
        "problems": [GENERAL],
        "solutions": [EXACT.impulse],
    },
    lv.derivative,
    lv.derivatives,
)
add(
    {k: np.ones((2, 2)) for k in ("velocity", "impulse", "slack")},
    lv.derivatives([GENERAL] * 2, lv.solve_many([GENERAL] * 2, tol=1e-12)).vjp,
)
add({"jac": EYE, "mass": A, "v_free": B, "names": ["x", "y"]}, lv.Generalized, any_length=("jac",))
add({"jac": sp.csr_array(EYE), "mass": sp.csr_array(A), "v_free": B}, lv.Generalized)
add(
    dict.fromkeys(("target", "impulse", "v"), B),
    *(
        getattr(GENERAL.generalized, k)
        for k in ("bias", "change", "force", "momentum_of", "velocity_of")
    ),
    accepts_nan=True,
)
add(
    {"x": B, "i": 1, "jac": A, "v_free": B},
    *(getattr(GENERAL.generalized, k) for k in ("solve", "velocity_name", "with_jacobian")),
    any_length=("jac",),
)
add(
    {
        "b": B,
        "cones": lv.Cones.free(2),
        "matrix": A,
        "friction": "coulomb",
        "guess": B,
        "key": np.array([1, 2]),
        "names": ["x", "y"],
        "name": "two",
        "precision": "float64",
    },
    lv.Problem,
)
add({"b": B, "cones": lv.Cones.free(2), "matrix": sp.csr_array(A)}, lv.Problem)
CALLS["Problem, not copied"] = Call(
    partial(lv.Problem, copy=False), {"b": B, "cones": lv.Cones.free(2), "matrix": A}
)
add(
    {"A": np.eye(8), "b": np.ones(8), "mu": np.array([0.5, 0.2]), "patch_radius": ONES},
    lv.Problem.contact,
)
add(
    {"A": np.eye(10), "b": np.ones(10), "mu": np.array([0.5, 0.2]), "rolling": ONES},
    lv.Problem.contact,
)
add(
    {
        "A": np.eye(3),
        "b": np.ones(3),
        "lower": np.array([0.0, -0.5, -0.5]),
        "upper": np.array([np.inf, 0.5, 0.5]),
        "findex": np.array([-1, 0, 0]),
    },
    lv.Problem.from_findex,
)
add(
    {"findex": np.array([-1, 0, 0])},
    ("Problem.findex_order", lv.Problem.findex_order),
    any_length=("findex",),
)
add(
    {
        "rows": ROWS,
        "target": np.zeros(N_ROWS),
        "lower": -np.ones(len(ROWS.jac)),
        "upper": np.ones(len(ROWS.jac)),
        "mu": np.full(N_CONTACTS, 0.5),
        "tangents": np.full(N_CONTACTS, 2),
        "rolling": np.ones(N_CONTACTS),
        "shape": "disk",
    },
    lv.Problem.from_rows,
)
add(
    {
        "J": EYE,
        "M": A,
        "v_free": B,
        "target": B,
        "cones": lv.Cones.free(2),
        "compliance": ONES,
        "friction": "cone",
        "names": ["x", "y"],
        "dof_names": ["u", "v"],
        "guess": B,
        "impulse": B,
    },
    lv.Problem.from_jacobian,
    GENERAL.updated,
    GENERAL.velocity,
    GENERAL.energy_change,
)
add(
    {"J": sp.csr_array(EYE), "M": [np.eye(1)] * 2, "v_free": B, "cones": lv.Cones.free(2)},
    lv.Problem.from_jacobian,
)
add(
    {
        "P": A,
        "q": B,
        "G": A,
        "h": ONES,
        "A": np.ones((1, 2)),
        "b": np.ones(1),
        "lb": np.zeros(2),
        "ub": ONES,
        "solver": "auto",
        "tol": 1e-9,
        "time_limit": 1.0,
    },
    lv.Problem.from_qp,
    lv.solve_qp,
)
add(
    {"normal_impulse": np.ones(N_CONTACTS), "friction": "cone", "cones": CONTACT.cones},
    CONTACT.boxed,
    CONTACT.relaxed,
    CONTACT.rows.jacobian,
)
add(ROW_ARRAYS, lv.Rows)
add(WORLDS, lv.Batch, accepts_nan=True)
CALLS["Batch, solved"] = Call(lambda **more: lv.solve_many(lv.Batch(**more)), WORLDS)
add(
    {k: WORLDS[k] for k in ("J", "M", "v_free")}
    | {"cones": lv.Cones.free(3), "count": np.array([1, 2])},
    lv.Batch,
    accepts_nan=True,
)
add(
    {
        "J": np.ones(6),
        "M": np.array([2.0, 0.0, 0.0, 2.0, 1.0]),
        "v_free": np.ones(3),
        "cones": lv.Cones.free(4),
        "row_ptr": np.array([0, 2, 4]),
        "velocity_ptr": np.array([0, 2, 3]),
    },
    lv.Batch,
    accepts_nan=True,
    any_length=("J", "M", "v_free"),
)
TRIANGLES = WORLDS | {"M": (np.ones((2, 2)), np.array([0, 1]), np.array([0, 1, 2]))}
add(
    {k: TRIANGLES[k] for k in ("J", "M", "v_free", "cones")},
    ("Batch, triangles", lv.Batch),
    accepts_nan=True,
)
add(
    {"i": np.array([0, 1])},
    BATCH.__getitem__,
    lv.solve_many(BATCH).__getitem__,
    lv.residual_many(BATCH, np.ones((2, 2))).__getitem__,
    any_length=("i",),
)
CALLS["Batch.flatten_impulses"] = Call(
    lambda given: BATCH.flatten_impulses("impulse", given),
    {"given": np.ones((2, 2))},
    accepts_nan=True,
)
CALLS["Batch.make_start"] = Call(
    lambda given: BATCH.make_start((BATCH, given)), {"given": np.ones((2, 2))}, accepts_nan=True
)
add(
    {
        "problems": BATCH,
        "impulses": np.ones((2, 2)),
        "precision": "float32",
        "threshold": 1e-6,
        "threads": 2,
        "errors": "raise",
    },
    lv.residual_many,
    accepts_nan=True,
)
add({"problems": [LCP, LCP], "impulses": [B, B]}, lv.residual_many)
add(
    {
        "problems": BATCH,
        "solver": "auto",
        "impulse": np.ones((2, 2)),
        "threads": 2,
        "errors": "raise",
    }
    | LIMITS,
    lv.solve_many,
)
add({"problems": [LCP, LCP], "impulses": [B, None]} | LIMITS, lv.solve_many)
CALLS["solve_many, one start"] = Call(
    lambda xs: lv.solve_many([LCP] * 2, "pgs", impulses=[xs, None]), {"xs": B}
)
CALLS["solve_many, nothing"] = Call(lambda **more: lv.solve_many([], **more), LIMITS)
add(
    {
        "inv_mass": ONES,
        "inv_inertia": np.tile(np.eye(3), (2, 1, 1)),
        "velocity": np.zeros((2, 6)),
        "dt": 0.01,
        "position": PLACES,
        "baumgarte": 0.2,
        "slop": 0.001,
    },
    lv.RowBuilder,
)
add(
    {
        "inv_mass": ONES,
        "inv_inertia": ONES,
        "velocity": np.zeros((2, 3)),
        "dt": 0.01,
        "position": PLACES[:, :2],
    },
    lv.RowBuilder,
)
OF_BLOCK = {
    "a": 0,
    "b": 1,
    "feature": 3,
    "anchor": AT,
    "anchor_b": AT + 0.1,
    "axis": AXIS,
    "anchor_a": AT,
    "length": 0.5,
    "stiffness": 10.0,
    "damping": 1.0,
    "ratio": 2.0,
    "axis_a": AXIS,
    "point": AT,
    "normal": AXIS,
    "gap": 0.1,
    "mu": 0.5,
    "restitution": 0.5,
    "restitution_threshold": 0.1,
    "tangent": np.array([1.0, 0.0, 0.0]),
}
add(
    OF_BLOCK,
    *(
        like(lv.RowBuilder, k, builder_of)
        for k in ("ball", "hinge", "weld", "slider", "distance", "spring", "gear", "contact")
    ),
)
PAIR = {"a": 0, "b": 1, "feature": 3, "axis": AXIS}
add(PAIR | {"speed": 1.0, "max_torque": 2.0}, like(lv.RowBuilder, "motor", builder_of))
add(PAIR | {"speed": 1.0, "max_force": 2.0, "anchor": AT}, like(lv.RowBuilder, "motor", builder_of))
add(
    PAIR | {"value": 0.5, "lower": 0.0, "upper": 1.0, "anchor": AT},
    like(lv.RowBuilder, "limit", builder_of),
)
add(
    {
        "bodies": [(-1, 0), (0, 1)],
        "points": PLACES,
        "normals": np.tile(AXIS, (2, 1)),
        "gap": 0.1 * ONES,
        "mu": ONES,
        "restitution": 0.5 * ONES,
        "restitution_threshold": ONES,
        "tangents": np.eye(2, 3),
        "feature": [1, 2],
        "names": ["one", "two"],
    },
    like(lv.RowBuilder, "contacts", builder_of),
)
CALLS["RowBuilder.joints"] = Call(
    partial(builder_of, "joints"),
    {
        "block_type": "hinge",
        "bodies": [(-1, 0), (0, 1)],
        "anchor": PLACES,
        "axis": np.tile(AXIS, (2, 1)),
        "feature": [1, 2],
        "names": ["one", "two"],
    },
)
add(
    {
        "friction": "coulomb",
        "shape": "disk",
        "name": "one",
        "key": (9 << 60) + (1 << 38) + (2 << 16),
        "impulse": np.ones(1),
    },
    *(like(lv.RowBuilder, k, read_builder) for k in ("problem", "rows_of", "velocity_after")),
)

# -- what measures -----------------------------------------------------------------------------------------------------

add(
    {
        "problem": CONTACT,
        "impulse": np.zeros(CONTACT.m),
        "velocity": CONTACT.rows.v_free,
        "gap": np.zeros(N_CONTACTS),
    }
    | {"gap": np.zeros(len(CONTACT.rows.normal)), "dt": 0.01},
    lv.diagnose,
)
add({"problem": STEP, "impulse": np.zeros(3)}, lv.explain_slip)
CONTACT_SOLUTION = lv.solve(CONTACT, tol=1e-12).impulse
add(
    {"problem": CONTACT, "impulse": np.zeros(CONTACT.m), "dt": 0.01, "reference": CONTACT_SOLUTION},
    lv.contact_forces,
)
add(
    {
        "tolerances": (1e-3,),
        "budgets": (4,),
        "repeats": 1,
        "time_limit": 1.0,
        "sequence_time_limit": 1.0,
        "warm": True,
        "campaign": True,
    },
    report.Plan,
)
add(
    {
        "sources": ["stack(n=2)"],
        "sequences": False,
        "problems": [LCP],
        "name": "walk",
        "scene": "pyramid",
        "at": 3,
        "text": "@hard",
        "case": "stack",
        "n": 3,
        "mass_ratio": 2.0,
        "friction": "none",
        "sliding": 0.5,
    },
    report.resolve_sources,
    report.make_sequence,
    suite.stack,
    suite.engine_step,
    suite.get_case_names_of_set,
)

# -- io ----------------------------------------------------------------------------------------------------------------

EFC = {
    "efc_J": np.random.default_rng(0).standard_normal((2, 7, 4)),
    "efc_D": np.ones((2, 7)),
    "efc_aref": np.ones((2, 7)),
    "efc_type": np.array([[0, 1, 7, 7, 7, 3, 0]] * 2),
    "M": np.array([np.eye(4)] * 2),
    "qvel": np.ones((2, 4)),
    "qacc_smooth": np.zeros((2, 4)),
    "timestep": 0.01,
    "efc_frictionloss": np.ones((2, 7)),
    "nefc": np.array([6, 7]),
    "contacts": ([0, 1], [2, 2], [3, 3], np.full((2, 5), 0.5)),
    "efc_force": np.ones((2, 7)),
    "qfrc_smooth": np.zeros((2, 4)),
}
add(EFC, io.from_efc, accepts_nan=True)
for _k, _name in enumerate(("world", "efc_address", "dim", "friction")):
    CALLS[f"from_efc, {_name} of contacts"] = Call(
        lambda part, k=_k: io.from_efc(
            **EFC | {"contacts": (*EFC["contacts"][:k], part, *EFC["contacts"][k + 1 :])}
        ),
        {"part": np.array(EFC["contacts"][_k])},
        any_length=("part",) if _k == 0 else (),
    )

# -- scenes ------------------------------------------------------------------------------------------------------------

UP = np.array([0.0, 0.0, 1.0])
OF_BODY = {
    "mass": 1.0,
    "friction": 0.5,
    "restitution": 0.5,
    "patch_radius": 0.1,
    "position": np.ones(3),
    "velocity": np.ones(3),
    "quaternion": np.array([1.0, 0.0, 0.0, 0.0]),
    "angular_velocity": np.ones(3),
    "inertia": np.ones(3),
    "radius": 0.5,
    "size": np.ones(3),
    "normal": UP,
    "offset": 0.5,
}
add(
    OF_BODY,
    *(like(lv.Scene, k, on_scene) for k in ("add_body", "add_box", "add_plane", "add_sphere")),
)
add(
    {
        "kind": "hinge",
        "a": 0,
        "b": -1,
        "anchor": np.zeros(3),
        "axis": UP,
        "hertz": 0.5,
        "damping": 1.0,
        "collide": True,
    },
    like(lv.Scene, "add_joint", on_scene),
)
add(
    {"kind": "distance", "a": 0, "b": -1, "anchor_a": np.zeros(3), "anchor_b": UP, "length": 0.5},
    like(lv.Scene, "add_joint", on_scene),
)
CALLS["Scene"] = Call(
    lv.Scene,
    {"name": "stack", "n": 3, "gravity": np.array([0.0, 0.0, -9.81]), "warm_start": False}
    | dict.fromkeys(
        (
            "dt",
            "friction",
            "restitution",
            "patch_radius",
            "rolling_radius",
            "slop",
            "margin",
            "restitution_threshold",
            "max_substep",
            "mass",
            "size",
        ),
        0.25,
    )
    | dict.fromkeys(("substeps", "solver_iterations", "position_iterations", "seed"), 4),
)
CALLS["Scene.with_parameters"] = Call(
    lv.Scene("stack").with_parameters, {"dt": 0.01, "solver_iterations": 8}
)
add({"scene": "stack", "report_residual": True, "report_motion": True}, lv.Simulation)
add(
    {
        "seed": 1,
        "snapshot": lv.Simulation("stack").snapshot(),
        "n": 8,
        "body": 1,
        "velocity": np.ones(3),
        "flag": True,
        "angular_velocity": np.ones(3),
        "action": None,
    },
    *(
        like(lv.Simulation, k, lambda k, **more: getattr(lv.Simulation("stack"), k)(**more))
        for k in (
            "reset",
            "restore",
            "run",
            "set_solver_iterations",
            "set_velocity",
            "set_warm_start",
            "step",
        )
    ),
)

#: Public calls that are not in the table: results of the package, its own use of checked arrays, files, servers.
NOT_CALLED = [
    "Claim",
    "Derivative",
    "History",
    "Plan",
    "QPSolution",
    "QPSolution.is_optimal",
    "Residual",
    "Residuals",
    "Solution",
    "Solutions",
    "SolverStage",
    "Snapshot",
    "SolverSpec",
    "Status",
    "CrossCheck",
    "Comparison",
    "Comparison.list_causes",
    "Comparison.list_quantities",
    "Comparison.rank",
    "StepRecord",
    "StepRecord.velocity_of",
    "compare",
    "load_step",
    "permute_velocities",
    "save_step",
    "step_from_mujoco",
    "step_from_newton_mujoco",
    "step_from_genesis",
    "step_from_mjx",
    "step_from_warp",
    "align_step",
    "MotionError",
    "SlipExplanation",
    "Redundancy",
    "ContactForces",
    "Diagnostic",
    "Recording",
    "Stored",
    "Claims",
    "EngineStep",
    "StepVerdict",
    "Recorder",
    "Reconstruction",
    "Batch.make_kernel_worlds",
    "Batch.get_world",
    "SlipExplanation.draw_slip",
    "Batch.rows_of",
    "Batch.count",
    "Batch.index",
    "Solutions.count",
    "Solutions.index",
    "Generalized.from_compressed_rows",
    "Generalized.from_operator",
    "Generalized.from_validated",
    "Generalized.with_diagonal_shift",
    "Generalized.restrict_to_rows_and_velocities",
    "Generalized.with_scaled_rows",
    "Solutions.store_late_world",
    "Problem.on_disk",
    "Problem.has_operator_of",
    "Problem.save",
    "Problem.compute_velocity_change",
    "Residuals.store_residual",
    "Solution.from_fields",
    "Solution.with_fields",
    "Solutions.store_solution",
    "Solutions.get_start",
    "CrossCheck.__getitem__",
    "Simulation.write_problem",
    "Simulation.load",
    "Simulation.record",
    "Simulation.save",
    "Simulation.view",
    "Snapshot.load",
    "Snapshot.save",
    "Recorder.add",
    "Recorder.close",
    "Recorder.leave_out",
    "Recorder.write_step",
    "read_recorded_state",
    "load",
    "load_solution",
    "read",
    "record",
    "save",
    "from_drake",
    "from_genesis",
    "from_kamino",
    "from_mujoco",
    "from_mujoco_many",
    "from_newton_mujoco",
    "from_pinocchio",
    "MujocoScratch",
    "MujocoScratch.keep_data",
]

# -- what is wrong -----------------------------------------------------------------------------------------------------


def wrong_values(good):
    """Yield (description, value) that no call accepts in place of `good`."""
    if isinstance(good, np.ndarray):
        first = np.arange(good.size).reshape(good.shape) == 0
        flat = good.ravel().tolist()
        yield "NaN", np.where(first, np.nan, good)
        yield "ragged", [flat, flat[:-1]]
        yield "text", good.astype(str)
        yield "lists of text", good.astype(str).tolist()
        yield "complex", good + 0j
        yield "dates", np.zeros(good.shape, "m8[s]")
        yield "objects", np.full(good.shape, None)
        yield "masked", np.ma.array(good, mask=first)
    elif isinstance(good, bool):
        yield from {
            "text": "no",
            "a number": 1,
            "None": None,
            "a list": [],
            "an array": np.zeros(2),
        }.items()
    elif isinstance(good, int | float):
        yield from {
            "NaN": np.nan,
            "text": "1",
            "complex": 1j,
            "True": True,
            "a list": [1.0, 2.0],
            "masked": np.ma.masked,
            "a date": np.timedelta64(1, "s"),
            "infinite": -np.inf,
        }.items()
        if isinstance(good, int):
            yield from {"a half": 2.5, "negative": -3, "very large": 2**70}.items()
    else:
        yield from {"an object": object(), "an ellipsis": ..., "bytes": b"x"}.items()


def wrong_shapes(good):
    """Yield arrays of a shape that a call rejects, perhaps by the name of another argument."""
    yield "a column", good[..., None]
    yield "longer", np.concatenate([good, good[:1]])
    yield "shorter", good[:-1]


def odd_values(good):
    """Yield values that a call may accept, or else rejects with an error of the package."""
    yield from {
        "None": None,
        "text": "no such word",
        "-1": -1,
        "very large": 2**70,
        "a half": 0.5,
        "True": True,
        "an empty list": [],
        "a mapping": {1: 2},
        "a set": {1.0},
        "an iterator": iter([1.0, 2.0]),
        "a function": len,
        "a class": int,
        "no dimension": np.array(1.0),
        "an empty array": np.zeros(0),
        "three dimensions": np.zeros((2, 2, 2)),
        "ragged": [[1.0, 2.0], [3.0]],
        "complex": 1j,
        "masked": np.ma.masked,
        "a Problem": lv.Problem.lcp(np.eye(2), np.ones(2)),
        "objects": np.full((2, 2), None),
        "NaN": np.nan,
        "a sparse array": sp.eye_array(3),
        "a structured array": np.zeros(2, [("x", float)]),
        "a slice": slice(0, 1),
        "a list of None": [None, None],
        "a date": np.timedelta64(1, "s"),
    }.items()
    if sp.issparse(good):
        dense = good.toarray()
        yield from {
            "NaN in it": sp.csr_array(np.where(dense != 0.0, np.nan, 0.0)),
            "longer": sp.csr_array(np.eye(5)),
            "complex": good.astype(complex),
            "COO": good.tocoo(),
            "dense": dense,
            "integers": good.astype(int),
        }.items()
    if isinstance(good, np.ndarray):
        first = np.arange(good.size).reshape(good.shape) == 0
        yield from {
            "infinite": np.where(first, np.inf, good),
            "numbers as objects": good.astype(object),
            "negative": -1 - np.abs(good),
            "huge": np.full(good.shape, 1e300),
            "halves": good + 0.5,
            "transposed": good.T,
            "flat": good.ravel(),
            "booleans": good > 0,
            "float16": good.astype(np.float16),
            "long double": good.astype(np.longdouble),
            "a scalar": good.flat[0] if good.size else 0.0,
            "unsigned": np.nan_to_num(np.abs(good)).clip(0, 9).astype(np.uint8),
        }.items()


def data_of(values):
    """Return the bytes of every array in the arguments, to be compared."""
    return {name: x.tobytes() for name, x in values.items() if isinstance(x, np.ndarray)}


def list_public_calls(module):
    """Return the names of public functions, classes and their methods that take arguments."""
    kinds = types.FunctionType, classmethod, staticmethod
    for name in module.__all__:
        x = getattr(module, name)
        if not callable(x) or (inspect.isclass(x) and issubclass(x, BaseException)):
            continue
        methods = (
            [k for k in dir(x) if k == "__getitem__" or k[0] != "_"] if inspect.isclass(x) else []
        )
        for key, function in [(name, x), *((f"{name}.{k}", getattr(x, k)) for k in methods)]:
            if function is not x and not isinstance(
                inspect.getattr_static(x, key.partition(".")[2]), kinds
            ):
                continue
            try:
                parameters = inspect.signature(function).parameters
            except (TypeError, ValueError):
                continue
            if any(p not in ("self", "cls") for p in parameters):
                yield key


#: Methods of a problem with arguments of these names need no entry above.
for _key in list_public_calls(lv):
    _owner, _, _method = _key.partition(".")
    if _owner == "Problem" and _method and _key not in {*CALLS, *NOT_CALLED}:
        _function = getattr(LCP, _method)
        if set(inspect.signature(_function).parameters) <= OF_LCP.keys():
            add(OF_LCP, _function)


@pytest.mark.parametrize("module", [lv, io])
def test_table_of_calls_has_every_public_call(module):
    called = {name.partition(",")[0] for name in CALLS}
    assert set(list_public_calls(module)) - called - set(NOT_CALLED) == set()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CALLS)
def test_call_with_a_wrong_argument_raises_an_error_that_names_it(name):
    """One argument at a time is replaced; arguments stay unchanged."""
    call = CALLS[name]
    call()
    before = data_of(call.arguments)
    wrong = []
    index = (IndexError,) if "__getitem__" in name else ()  # as of any sequence
    elsewhere = [*call.arguments, *NAMES.values(), "worlds", "rows"]
    for argument, good in call.arguments.items():
        values = [(what, x, [NAMES.get(argument, argument)]) for what, x in wrong_values(good)]
        if isinstance(good, np.ndarray) and argument not in call.any_length:
            values += [(what, x, elsewhere) for what, x in wrong_shapes(good)]
        values += [(what, x, None) for what, x in odd_values(good)]
        for what, x, names in values:
            accepted = names is None or (
                what == "NaN" and call.accepts_nan and isinstance(good, np.ndarray)
            )
            accepted = accepted or what in ACCEPTS.get(argument, ())
            accepted = accepted or (
                what == "a column" and name in ("Problem.from_qp", "solve_qp")
            )  # as in qpsolvers
            try:
                call(**{argument: x})
            except lv.LavenderError as error:
                message = str(error)
                if names is not None and not any(
                    re.search(rf"\b(?:{word})\b", message) for word in names
                ):
                    wrong.append(f"{argument}: {what}: not named in {message!r}")
                elif names is not None and not isinstance(error, lv.InputError | lv.UnknownName):
                    wrong.append(f"{argument}: {what}: {type(error).__name__}")
                elif not message.strip():
                    wrong.append(f"{argument}: {what}: an empty message")
            except index:
                pass
            except Exception as error:
                wrong.append(f"{argument}: {what}: {type(error).__name__}: {error}"[:200])
            else:
                if not accepted:
                    wrong.append(f"{argument}: {what}: accepted")
    assert not wrong, "\n".join(wrong)
    assert data_of(call.arguments) == before


def strided(x):
    """Copy an array into every other entry of a wider one."""
    wide = np.zeros((*x.shape[:-1], 2 * x.shape[-1]), x.dtype)
    wide[..., ::2] = x
    return wide[..., ::2]


def read_only(x):
    x = x.copy()
    x.setflags(write=False)
    return x


#: The same numbers in other memory.
LAYOUTS = {
    "other byte order": lambda x: x.astype(x.dtype.newbyteorder()),
    "every other entry": strided,
    "columns first": np.asfortranarray,
    "reversed": lambda x: x[::-1].copy()[::-1],
    "read-only": read_only,
    "at an odd byte": lambda x: (
        np.frombuffer(b" " + x.tobytes(), np.uint8)[1:].view(x.dtype).reshape(x.shape)
    ),
    "lists": np.ndarray.tolist,
}


def comparable(result):
    """Return the numbers of a result; None if it has none that can be compared."""
    if isinstance(result, lv.Batch):
        return [*result]
    if isinstance(result, tuple) and hasattr(result, "batch"):
        # J v is summed in another order if J has another layout.
        rounded = [p.b.round(12).tolist() for p in result.batch]
        return rounded, [p.cones for p in result.batch], result.impulse.tolist()
    if isinstance(result, np.ndarray):
        return result.tolist()
    return result if isinstance(result, lv.Problem) else None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CALLS)
def test_call_with_arrays_in_any_memory_layout_has_the_same_result(name):
    call = CALLS[name]
    expected = comparable(call())
    for argument, value in call.arguments.items():
        if isinstance(value, np.ndarray):
            for layout, convert in LAYOUTS.items():
                assert comparable(call(**{argument: convert(value)})) == expected, (
                    argument,
                    layout,
                )


def convert_to_float32(x, order):
    """Return float arrays, and the first of a tuple, in single precision of a byte order."""
    if isinstance(x, tuple) and isinstance(x[0], np.ndarray):
        return convert_to_float32(x[0], order), *x[1:]
    is_real = isinstance(x, np.ndarray) and x.dtype.kind == "f"
    return x.astype(np.float32).astype(np.dtype(np.float32).newbyteorder(order)) if is_real else x


@pytest.mark.parametrize(
    "name", ["Batch", "Batch, triangles", "Problem.from_jacobian", "Rows", "from_efc"]
)
@pytest.mark.parametrize("order", "<>")
def test_call_with_float32_of_either_byte_order_has_single_precision(name, order):
    result = CALLS[name](
        **{k: convert_to_float32(x, order) for k, x in CALLS[name].arguments.items()}
    )
    assert getattr(result, "batch", result).precision == "float32"


@pytest.mark.parametrize(
    ("solver", "option"),
    [(name, option) for name in lv.available(external=False) for option in lv.get(name).options],
)
def test_solve_with_a_wrong_option_of_any_solver_raises(solver, option):
    problem = next(
        p for p in (LCP, lv.Problem.linear(A, B), CONTACT) if lv.get(solver).refuses(p) is None
    )
    for value in ("no such word", np.nan, 1j, {1: 2}):
        with pytest.raises(lv.LavenderError, match=option):
            lv.solve(problem, solver, **{option: value})
