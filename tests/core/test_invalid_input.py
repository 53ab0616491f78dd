"""Invalid input of the core: every public call rejects it by an error that names the argument."""

from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
import scipy.sparse as sp
from invalid_values import Call, check_float32, make_tests_of_calls
from random_problems import random_bodies_and_contacts, random_contact_problem

import lavender as lv

A, B = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0])
ONES = np.ones(2)
LCP = lv.Problem.lcp(A, B, key=np.array([3, 4]))
LINEAR = replace(LCP, cones=lv.Cones.free(2))
CONTACT = random_contact_problem(3)
ROWS = random_bodies_and_contacts(np.random.default_rng(0))
ROW_ARRAYS = {f.name: getattr(ROWS, f.name) for f in fields(ROWS) if f.name != "copy"}
N_JOINT_ROWS, N_CONTACTS = len(ROWS.jac), len(ROWS.normal)
SLIDING = lv.Cones.contacts(0.5, tangents=1)
GENERAL = lv.Problem.from_jacobian(np.eye(2), A, B, cones=lv.Cones.bounded([0.0, 0.0], [1.0, 1.0]))
JAC, MASS, FREE = np.array([np.eye(2)] * 2), np.array([A] * 2), np.ones((2, 2))
BATCH = lv.Batch(JAC, MASS, FREE, cones=SLIDING)
BATCH_SOLUTION = lv.solve_many(BATCH)
PROGRAM = lv.Problem.from_qp(A, B, lb=np.zeros(2))
EXACT = lv.solve(GENERAL, tol=1e-12)
DERIVATIVE = lv.derivative(GENERAL, EXACT)
BODIES = ROW_ARRAYS | {"v_free": np.array([ROWS.v_free] * 2)}
INDEX = {"i": "index of worlds"}
PLACES, AT, AXIS = (np.array([(0.0, 0.0, 0.0), (1.0, 0.5, 0.2)]), np.array([0.5, 0.2, 0.1]), np.array([0.0, 0.6, 0.8]))
PAIR = {"a": 0, "b": 1, "feature": 3}
LIMITS = {"tol": 1e-6, "max_iter": 100, "time_limit": 1.0}


def solve_batch(**arguments):
    return lv.solve_many(lv.Batch(**arguments))


def call_builder(method, **arguments):
    """Call a method of a new builder of two bodies in space; return the problem that it makes."""
    builder = lv.RowBuilder(ONES, np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 6)), 0.01, PLACES)
    getattr(builder, method)(**arguments)
    return builder.problem()


def read_builder(method, **arguments):
    """Call a method that reads from a builder with one contact."""
    builder = lv.RowBuilder(ONES, ONES, np.zeros((2, 3)), 0.01, PLACES[:, :2])
    builder.contact(0, 1, AT[:2], AXIS[:2] / 0.6)
    arguments = {"problem": builder.problem()} | arguments if method == "velocity_after" else arguments
    return getattr(builder, method)(**arguments)


CALLS = {
    "Batch": Call(
        lv.Batch,
        {"J": JAC, "M": MASS, "v_free": FREE, "target": FREE, "cones": SLIDING, "compliance": FREE,
         "mu": np.full((2, 1), 0.5), "friction": "coulomb"},
        accepts_nan=True,
    ),
    "Batch, solved": Call(
        solve_batch,
        {"J": JAC, "M": MASS, "v_free": FREE, "target": FREE, "cones": SLIDING, "compliance": FREE,
         "mu": np.full((2, 1), 0.5)},
    ),
    "Batch, padded": Call(
        lv.Batch, {"J": JAC, "M": MASS, "v_free": FREE, "cones": lv.Cones.free(3), "count": np.array([1, 2])},
        accepts_nan=True,
    ),
    "Batch, ragged": Call(
        lv.Batch,
        {"J": np.ones(6), "M": np.array([2.0, 0.0, 0.0, 2.0, 1.0]), "v_free": np.ones(3), "cones": lv.Cones.free(4),
         "row_ptr": np.array([0, 2, 4]), "velocity_ptr": np.array([0, 2, 3])},
        accepts_nan=True, any_length={"J", "M", "v_free"},
    ),
    "Batch, triangle of M": Call(
        lv.Batch,
        {"J": JAC, "M": (np.ones((2, 2)), np.array([0, 1]), np.array([0, 1, 2])), "v_free": FREE, "cones": SLIDING},
        accepts_nan=True,
    ),
    "Batch.flatten_impulses": Call(
        lambda given: BATCH.flatten_impulses("impulse", given), {"given": FREE}, {"given": "impulse"}, accepts_nan=True
    ),
    "Batch.__getitem__": Call(BATCH.__getitem__, {"i": np.array([0, 1])}, INDEX, any_length={"i"}),
    "Solutions.__getitem__": Call(BATCH_SOLUTION.__getitem__, {"i": np.array([0, 1])}, INDEX, any_length={"i"}),
    "Solutions.__getitem__, of a list": Call(lv.solve_many([LCP] * 2).__getitem__, {"i": [0, -1]}, INDEX),
    "Residuals.__getitem__": Call(lv.residual_many(BATCH, FREE).__getitem__, {"i": np.array([True, False])}, INDEX),
    "Cones": Call(
        lv.Cones,
        {"ptr": np.array([0, 1, 4]), "kind": np.array([lv.ROW, lv.CONTACT]), "lower": np.array([0.0] + 3 * [-np.inf]),
         "upper": np.full(4, np.inf), "mu": np.array([0.0, 0.5]), "patch_radius": np.zeros(2), "rolling": np.zeros(2)},
    ),
    "Cones.bounded": Call(lv.Cones.bounded, {"lower": -ONES, "upper": ONES}),
    "Cones.contacts": Call(
        lv.Cones.contacts,
        {"mu": np.array([0.5, 0.2]), "tangents": 2, "patch_radius": ONES, "rolling": ONES, "shape": "disk"},
    ),
    "Cones.contacts, one": Call(lv.Cones.contacts, {"mu": 0.5, "count": 3}, accepts={"mu": ("True",)}),
    "Cones.free": Call(lv.Cones.free, {"m": 3}),
    "Cones.shaped": Call(lv.Cones.contacts(0.5, count=2).shaped, {"shape": "box"}),
    "Cones.select": Call(CONTACT.cones.select, {"blocks": np.array([1, 0])}, any_length={"blocks"}),
    "Derivative.jvp": Call(
        DERIVATIVE.jvp, {"J": np.eye(2), "M": A, "v_free": B, "target": B, "lower": B, "upper": B}
    ),
    "Derivative.jvp, b": Call(DERIVATIVE.jvp, {"b": B}),
    "Derivative.vjp": Call(DERIVATIVE.vjp, {"velocity": B, "impulse": B, "slack": B}),
    "Derivatives.vjp": Call(
        lv.derivatives([GENERAL, GENERAL], lv.solve_many([GENERAL, GENERAL], tol=1e-12)).vjp,
        {"velocity": FREE, "impulse": FREE, "slack": FREE},
    ),
    "Generalized": Call(
        lv.Generalized, {"jac": np.eye(2), "mass": A, "v_free": B, "names": ["x", "y"]}, {"jac": "J", "mass": "M"},
        any_length={"jac"},
    ),
    "Generalized, sparse": Call(
        lv.Generalized, {"jac": sp.csr_array(np.eye(2)), "mass": sp.csr_array(A), "v_free": B},
        {"jac": "J", "mass": "M"},
    ),
    **{f"Generalized.{name}": Call(getattr(GENERAL.generalized, name), {argument: B}, accepts_nan=name != "solve")
       for name, argument in {"bias": "target", "change": "impulse", "force": "impulse", "momentum_of": "v",
                              "solve": "x", "velocity_of": "v"}.items()},
    "Generalized.velocity_name": Call(GENERAL.generalized.velocity_name, {"i": 1}),
    "Generalized.with_jacobian": Call(
        GENERAL.generalized.with_jacobian, {"jac": A, "v_free": B}, {"jac": "J"}, any_length={"jac"}
    ),
    "Problem": Call(
        lv.Problem,
        {"b": B, "cones": lv.Cones.free(2), "matrix": A, "friction": "coulomb", "guess": B, "key": np.array([1, 2]),
         "names": ["x", "y"], "name": "two", "precision": "float64"},
        {"matrix": "A"}, accepts={"name": ("an object", "an ellipsis", "bytes")},
    ),
    "Problem, not copied": Call(
        partial(lv.Problem, copy=False), {"b": B, "cones": lv.Cones.free(2), "matrix": A}, {"matrix": "A"}
    ),
    "Problem, sparse": Call(
        lv.Problem, {"b": B, "cones": lv.Cones.free(2), "matrix": sp.csr_array(A)}, {"matrix": "A"}
    ),
    "Problem.linear": Call(lv.Problem.linear, {"A": A, "b": B}),
    "Problem.lcp": Call(lv.Problem.lcp, {"A": A, "b": B, "lower": -ONES, "upper": ONES, "guess": B}),
    "Problem.contact": Call(
        lv.Problem.contact,
        {"A": np.eye(8), "b": np.ones(8), "mu": np.array([0.5, 0.2]), "patch_radius": ONES},
    ),
    "Problem.contact, rolling": Call(
        lv.Problem.contact,
        {"A": np.eye(10), "b": np.ones(10), "mu": np.array([0.5, 0.2]), "rolling": ONES},
    ),
    "Problem.from_findex": Call(
        lv.Problem.from_findex,
        {"A": np.eye(3), "b": np.ones(3), "lower": np.array([0.0, -0.5, -0.5]),
         "upper": np.array([np.inf, 0.5, 0.5]), "findex": np.array([-1, 0, 0])},
    ),
    "Problem.findex_order": Call(
        lv.Problem.findex_order, {"findex": np.array([-1, 0, 0])}, any_length={"findex"}
    ),
    "Problem.from_rows": Call(
        lv.Problem.from_rows,
        {"rows": ROWS, "target": np.zeros(N_JOINT_ROWS + 5 * N_CONTACTS), "lower": -np.ones(N_JOINT_ROWS),
         "upper": np.ones(N_JOINT_ROWS), "mu": np.full(N_CONTACTS, 0.5), "tangents": np.full(N_CONTACTS, 2),
         "rolling": np.ones(N_CONTACTS), "shape": "disk", "compliance": np.ones(N_JOINT_ROWS + 5 * N_CONTACTS)},
    ),
    "Problem.from_jacobian": Call(
        lv.Problem.from_jacobian,
        {"J": np.eye(2), "M": A, "v_free": B, "target": B, "cones": lv.Cones.free(2), "compliance": ONES,
         "friction": "cone", "names": ["x", "y"], "dof_names": ["u", "v"]},
        {"dof_names": "names of velocities"},
    ),
    "Problem.from_jacobian, blocks": Call(
        lv.Problem.from_jacobian,
        {"J": sp.csr_array(np.eye(2)), "M": [np.eye(1), np.eye(1)], "v_free": B, "cones": lv.Cones.free(2)},
    ),
    "Problem.from_qp": Call(
        lv.Problem.from_qp,
        {"P": A, "q": B, "G": np.ones((1, 2)), "h": np.ones(1), "A": np.ones((1, 2)), "b": np.ones(1),
         "lb": np.zeros(2), "ub": ONES},
    ),
    "Problem.block_of": Call(LCP.block_of, {"row": 1}),
    "Problem.row_name": Call(LCP.row_name, {"row": 1}),
    "Problem.block_name": Call(LCP.block_name, {"block": 1}),
    "Problem.boxed": Call(CONTACT.boxed, {"normal_impulse": np.ones(N_CONTACTS)}),
    "Problem.carry": Call(LCP.carry, {"previous": (LCP, B), "keys": np.array([4, 5])}, {"keys": "key"}),
    "Problem.carry, impulse": Call(lambda impulse: LCP.carry((LCP, impulse)), {"impulse": B}),
    "Problem.impulse_array": Call(LCP.impulse_array, {"impulse": B}),
    "Problem.relaxed": Call(CONTACT.relaxed, {"friction": "cone"}),
    "Problem.slack": Call(LCP.slack, {"impulse": B}),
    "Problem.velocity": Call(GENERAL.velocity, {"impulse": B}),
    "Problem.updated": Call(GENERAL.updated, {"J": A, "M": A, "v_free": B, "target": B, "guess": B}),
    "Problem.updated, b": Call(LCP.updated, {"b": B, "guess": B}),
    "RowBuilder": Call(
        lv.RowBuilder,
        {"inv_mass": ONES, "inv_inertia": np.tile(np.eye(3), (2, 1, 1)), "velocity": np.zeros((2, 6)), "dt": 0.01,
         "position": PLACES, "baumgarte": 0.2, "slop": 0.001},
    ),
    "RowBuilder, planar": Call(
        lv.RowBuilder,
        {"inv_mass": ONES, "inv_inertia": ONES, "velocity": np.zeros((2, 3)), "dt": 0.01, "position": PLACES[:, :2]},
    ),
    **{f"RowBuilder.{method}": Call(partial(call_builder, method), PAIR | arguments, accepts=accepts)
       for method, arguments, accepts in (
           ("ball", {"anchor": AT, "anchor_b": AT + 0.1}, {}),
           ("hinge", {"anchor": AT, "axis": AXIS, "anchor_b": AT, "axis_b": AXIS}, {}),
           ("weld", {"anchor": AT, "anchor_b": AT, "angle_error": 0.1 * AXIS}, {}),
           ("slider", {"anchor": AT, "axis": AXIS, "anchor_b": AT, "angle_error": 0.1 * AXIS}, {}),
           ("distance", {"anchor_a": AT, "anchor_b": AT + 1.0, "length": 0.5}, {}),
           ("spring", {"anchor_a": AT, "anchor_b": AT + 1.0, "length": 0.5, "stiffness": 10.0, "damping": 1.0}, {}),
           ("motor", {"axis": AXIS, "speed": 1.0, "max_torque": 2.0}, {}),
           ("limit", {"axis": AXIS, "value": 0.5, "lower": 0.0, "upper": 1.0, "anchor": AT},
            {"lower": ("infinite",)}),
           ("gear", {"axis_a": AXIS, "axis_b": AXIS, "ratio": 2.0, "angle_error": 0.1}, {}),
           ("contact", {"point": AT, "normal": AXIS, "gap": 0.1, "mu": 0.5, "restitution": 0.5,
                        "restitution_threshold": 0.1, "tangent": np.array([1.0, 0.0, 0.0])}, {}),
       )},
    "RowBuilder.contacts": Call(
        partial(call_builder, "contacts"),
        {"bodies": [(-1, 0), (0, 1)], "points": PLACES, "normals": np.tile(AXIS, (2, 1)), "gap": 0.1 * ONES,
         "mu": ONES, "restitution": 0.5 * ONES, "restitution_threshold": ONES, "tangents": np.eye(2, 3),
         "feature": [1, 2], "names": ["one", "two"]},
        {"points": "point", "normals": "normal", "tangents": "tangent"},
    ),
    "RowBuilder.joints": Call(
        partial(call_builder, "joints"),
        {"block_type": "hinge", "bodies": [(-1, 0), (0, 1)], "anchor": PLACES, "axis": np.tile(AXIS, (2, 1)),
         "feature": [1, 2], "names": ["one", "two"]},
    ),
    "RowBuilder.motor, linear": Call(
        partial(call_builder, "motor"), PAIR | {"axis": AXIS, "speed": 1.0, "max_force": 2.0, "anchor": AT}
    ),
    "RowBuilder.problem": Call(
        partial(read_builder, "problem"), {"friction": "coulomb", "shape": "disk", "name": "one"},
        accepts={"name": ("an object", "an ellipsis", "bytes")},
    ),
    "RowBuilder.rows_of": Call(partial(read_builder, "rows_of"), {"key": (9 << 60) + (1 << 38) + (2 << 16)}),
    "RowBuilder.velocity_after": Call(partial(read_builder, "velocity_after"), {"impulse": np.ones(1)}),
    "RowBuilder.velocity_after, the problem": Call(
        lambda problem: read_builder("velocity_after", problem=problem, impulse=[]),
        {"problem": lv.RowBuilder(ONES, ONES, np.zeros((2, 3)), 0.01, PLACES[:, :2]).problem()},
    ),
    "Rows": Call(lv.Rows, ROW_ARRAYS),
    "Rows.jacobian": Call(CONTACT.rows.jacobian, {"cones": CONTACT.cones}),
    "Solution.state": Call(lv.solve(LCP).state, {"i": 0}, {"i": "block"}),
    "SolverSpec.refuses": Call(lv.get("pgs").refuses, {"problem": LCP}),
    "SolverSpec.standing_in": Call(lv.get("gauss_seidel").standing_in, {"problem": LCP}),
    "available": Call(lv.available, {"problem": LCP, "law": "lcp", "order": True}),
    "derivative": Call(
        lv.derivative, {"problem": GENERAL, "solution": EXACT.impulse}, {"solution": "impulse"}
    ),
    "derivatives": Call(lv.derivatives, {"problems": [GENERAL], "solutions": [EXACT.impulse]}),
    "explain": Call(lv.explain, {"problem": LCP, "tol": 1e-6}),
    "get": Call(lv.get, {"name": "pgs"}, {"name": "solver"}),
    "known": Call(lv.known, {"problem": LCP}),
    "prepare": Call(lv.prepare, {"problem": LCP, "solver": "pgs"}),
    "History.plot": Call(lv.solve(LCP, "pgs", history=True).history.plot, {"against": "time"}),
    "Solution.plot": Call(lv.solve(LCP).plot, {"rows": 5}),
    "Prepared.solve": Call(
        lv.prepare(LCP, "pgs").solve, {"problem": LCP, "impulse": B, "history": True} | LIMITS
    ),
    "Prepared.solve, b": Call(lv.prepare(LCP, "pgs").solve, {"b": B}),
    "Prepared.solve, v_free": Call(lv.prepare(GENERAL).solve, {"v_free": GENERAL.generalized.v_free}),
    "register": Call(lv.register, {"spec": lv.get("pgs"), "replace": True}, {"spec": "SolverSpec"}),
    "residual": Call(
        lv.residual, {"problem": LCP, "impulse": B, "precision": "float32", "threshold": 1e-6}, accepts_nan=True
    ),
    "residual_many": Call(
        lv.residual_many,
        {"problems": BATCH, "impulses": FREE, "precision": "float32", "threshold": 1e-6, "threads": 2,
         "errors": "raise"},
        accepts_nan=True, accepts={"threads": ("very large",)},
    ),
    "residual_many, a list": Call(lv.residual_many, {"problems": [LCP, LCP], "impulses": [B, B]}),
    "solve": Call(lv.solve, {"problem": LCP, "solver": "pgs", "impulse": B, "history": True} | LIMITS),
    "solve by auto": Call(lv.solve, {"problem": LCP, "impulse": B} | LIMITS),
    "solve, in random order": Call(
        lambda seed: lv.solve(LCP, "pgs", order="random", seed=seed), {"seed": 7}, accepts={"seed": ("very large",)}
    ),
    "solve, by jacobi": Call(lambda omega: lv.solve(LCP, "jacobi", omega=omega), {"omega": 0.5}),
    "solve, by sor": Call(lambda omega: lv.solve(LINEAR, "sor", omega=omega), {"omega": 1.5}),
    "solve, by anderson": Call(lambda memory: lv.solve(LCP, "anderson", memory=memory), {"memory": 3}),
    "solve_many": Call(
        lv.solve_many,
        {"problems": BATCH, "solver": "auto", "impulse": FREE, "threads": 2, "errors": "raise"} | LIMITS,
        accepts={"threads": ("very large",)},
    ),
    "solve_many, a list": Call(lv.solve_many, {"problems": [LCP, LCP], "impulses": [B, None]} | LIMITS),
    "solve_many, one start": Call(
        lambda impulse: lv.solve_many([LCP, LCP], "pgs", impulses=[impulse, None]), {"impulse": B},
        {"impulse": "impulses?"},
    ),
    "solve_many, an empty list": Call(lambda **more: lv.solve_many([], **more), LIMITS),
    "solve_qp": Call(
        lv.solve_qp,
        {"P": A, "q": B, "G": A, "h": ONES, "lb": -ONES, "ub": ONES, "solver": "auto", "tol": 1e-9, "time_limit": 1.0},
    ),
    "solve_qp, a problem": Call(
        partial(lv.solve_qp, PROGRAM), {"q": B, "solver": "auto", "tol": 1e-9, "time_limit": 1.0}
    ),
}  # fmt: skip

#: Public calls that are not in the table, and why.
NOT_CALLED = {
    **dict.fromkeys(
        ("Claim", "Derivative", "History", "Plan", "QPSolution", "Residual", "Residuals", "Solution", "Solutions",
         "SolverStage"),
        "a result: the package makes it",
    ),
    **dict.fromkeys(
        ("Batch.make_kernel_worlds", "Generalized.from_compressed_rows", "Generalized.from_operator",
         "Generalized.from_validated",
         "Generalized.restrict_to_rows_and_velocities", "Generalized.with_diagonal_shift",
         "Generalized.with_scaled_rows", "Batch.start", "Solutions.store_late_world", "Problem.on_disk",
         "Problem.compute_velocity_change", "Residuals.store_residual", "Solution.with_late_fields",
         "Solution.from_fields", "Solution.with_fields", "Solution.convert_from_disk", "Solutions.store_solution",
         "Solutions.get_start", "Batch.rows_of"),
        "for the package's own use, with arrays that it has checked",
    ),
    **dict.fromkeys(("Batch.count", "Batch.index", "Solutions.count", "Solutions.index"), "a sequence of Python"),
    "Problem.save": "a file: test_invalid_files.py of tests/cli",
    "Solution.motion_error": "tests/diagnostics",
    "SolverSpec": "tests/core/solvers/test_registry.py",
    "Status": "an enumeration",
}  # fmt: skip


(
    test_every_public_call_of_the_core_is_in_the_table,
    test_malformed_arguments_are_rejected_by_name,
    test_arrays_in_any_memory_layout_give_the_same_result,
) = make_tests_of_calls("core", CALLS, NOT_CALLED)


@pytest.mark.parametrize("name", ["Batch", "Batch, triangle of M", "Problem.from_jacobian", "Rows"])
def test_float32_of_either_byte_order_is_single_precision(name):
    check_float32(CALLS[name])


def test_the_residual_of_a_nan_is_infinite_and_products_keep_it():
    nan = [np.nan, 0.0]
    assert lv.residual(LCP, nan).relative == lv.residual(LCP, nan, precision="float32").relative == np.inf
    assert np.isnan(GENERAL.generalized.force(nan)).any()


@pytest.mark.parametrize(
    ("solver", "option"), [(name, option) for name in lv.available(external=False) for option in lv.get(name).options]
)
def test_every_option_of_every_solver_is_validated(solver, option):
    spec = lv.get(solver)
    problem = next(p for p in (LCP, LINEAR, CONTACT) if spec.refuses(p) is None)
    for value in ("no such word", np.nan, 1j, {1: 2}):
        with pytest.raises(lv.LavenderError, match=option):
            lv.solve(problem, solver, **{option: value})
