"""Malformed arguments of every public function and method end in an error of the package, never of NumPy or Python.

`CALLS` has a valid call of each. What is public and takes arguments must be there, or in `NOT_CALLED` with a reason.
"""

import inspect
import types
from dataclasses import fields

import numpy as np
import pytest
import scipy.sparse as sp
from random_problems import random_contact_problem, random_rows

import lavender as lv
from lavender import bench, io, motion, phenomena, suite

RNG = np.random.default_rng(0)
A, B = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0])
LCP = lv.Problem.lcp(A, B, key=np.array([3, 4]))
SOLVED = lv.solve(LCP, tol=1e-12)
CONTACT = random_contact_problem(3)
ROWS = random_rows(RNG)
PARTS = {f.name: getattr(ROWS, f.name) for f in fields(ROWS) if f.name != "copy"}
SLIDING = lv.Cones.contacts(0.5, tangents=1)
GENERAL = lv.Problem.from_jacobian(np.eye(2), A, B, cones=lv.Cones.bounded([0.0, 0.0], [1.0, 1.0]))
JAC, MASS, FREE = np.array([np.eye(2)] * 2), np.array([A] * 2), np.ones((2, 2))
BATCH = lv.Batch(JAC, MASS, FREE, cones=SLIDING)
BATCH_SOLUTION = lv.solve_many(BATCH)
PROGRAM = lv.Problem.from_qp(A, B, lb=np.zeros(2))
EXACT = lv.solve(GENERAL, tol=1e-12)
DERIVATIVE = lv.derivative(GENERAL, EXACT)
EFC = {
    "efc_J": RNG.standard_normal((2, 7, 4)), "efc_D": np.ones((2, 7)), "efc_aref": np.ones((2, 7)),
    "efc_type": np.array([[0, 1, 7, 7, 7, 3, 0]] * 2), "M": np.array([np.eye(4)] * 2), "qvel": np.ones((2, 4)),
    "qacc_smooth": np.zeros((2, 4)), "timestep": 0.01, "efc_frictionloss": np.ones((2, 7)), "nefc": np.array([6, 7]),
    "contacts": ([0, 1], [2, 2], [3, 3], np.full((2, 5), 0.5)), "efc_force": np.ones((2, 7)),
    "qfrc_smooth": np.zeros((2, 4)),
}  # fmt: skip


def scene():
    made = lv.Scene()
    made.add_sphere()
    return made


def on(make, name):
    """A method of an object that is made anew at each call."""
    return lambda **more: getattr(make(), name)(**more)


#: Name -> what is called, and its valid arguments.
CALLS = {
    "Batch": (
        lv.Batch,
        {
            "J": JAC,
            "M": MASS,
            "v_free": FREE,
            "target": FREE,
            "cones": SLIDING,
            "compliance": FREE,
            "mu": np.full((2, 1), 0.5),
            "friction": "coulomb",
        },
    ),
    "Batch, padded": (
        lv.Batch,
        {"J": JAC, "M": MASS, "v_free": FREE, "cones": lv.Cones.free(3), "count": np.array([1, 2])},
    ),
    "Batch, ragged": (
        lv.Batch,
        {
            "J": np.ones(6),
            "M": np.array([2.0, 0.0, 0.0, 2.0, 1.0]),
            "v_free": np.ones(3),
            "cones": lv.Cones.free(4),
            "row_ptr": np.array([0, 2, 4]),
            "velocity_ptr": np.array([0, 2, 3]),
        },
    ),
    "Batch, triangle of M": (
        lv.Batch,
        {
            "J": JAC,
            "M": (np.ones((2, 2)), np.array([0, 1]), np.array([0, 1, 2])),
            "v_free": FREE,
            "cones": SLIDING,
        },
    ),
    "Batch.of_matrices": (
        lv.Batch.of_matrices,
        {"A": MASS, "b": FREE, "cones": SLIDING, "mu": np.full((2, 1), 0.5), "friction": "cone"},
    ),
    "Batch.of_bodies": (
        lambda **parts: lv.Batch.of_bodies(parts),
        PARTS | {"v_free": np.array([ROWS.v_free] * 2)},
    ),
    "Batch.of_bodies, bounds": (
        lambda **more: lv.Batch.of_bodies(PARTS | {"v_free": np.array([ROWS.v_free] * 2)}, **more),
        {
            "target": np.zeros((2, len(ROWS.jac) + 2 * len(ROWS.normal))),
            "mu": np.zeros((2, len(ROWS.normal))),
            "tangents": 1,
            "friction": "coulomb",
            "lower": np.zeros(len(ROWS.jac)),
            "compliance": np.ones(len(ROWS.jac) + 2 * len(ROWS.normal)),
        },
    ),
    "Batch.impulses": (lambda given: BATCH.impulses("impulse", given), {"given": FREE}),
}
CALLS |= {
    "Batch.__getitem__": (BATCH.__getitem__, {"i": np.array([0, 1])}),
    "Solutions.__getitem__": (BATCH_SOLUTION.__getitem__, {"i": np.array([0, 1])}),
    "Residuals.__getitem__": (lv.residual_many(BATCH, FREE).__getitem__, {"i": np.array([True, False])}),
    "Cones": (
        lv.Cones,
        {"ptr": np.array([0, 1, 4]), "kind": np.array([lv.ROW, lv.CONTACT]), "lower": np.array([0.0] + 3 * [-np.inf]),
         "upper": np.full(4, np.inf), "mu": np.array([0.0, 0.5]), "patch_radius": np.zeros(2), "rolling": np.zeros(2)},
    ),
    "Cones.bounded": (lv.Cones.bounded, {"lower": -np.ones(2), "upper": np.ones(2)}),
    "Cones.contacts": (
        lv.Cones.contacts, {"mu": np.array([0.5, 0.2]), "tangents": 2, "patch_radius": np.ones(2),
                            "rolling": np.ones(2), "shape": "disk"},
    ),
    "Cones.contacts, one": (lv.Cones.contacts, {"mu": 0.5, "count": 3}),
    "Cones.free": (lv.Cones.free, {"m": 3}),
    "Cones.shaped": (lv.Cones.contacts(0.5, count=2).shaped, {"shape": "box"}),
    "Cones.take": (CONTACT.cones.take, {"blocks": np.array([1, 0])}),
    "Derivative.jvp": (DERIVATIVE.jvp, {"J": np.eye(2), "M": A, "v_free": B, "target": B, "lower": B, "upper": B}),
    "Derivative.jvp, b": (DERIVATIVE.jvp, {"b": B}),
    "Derivative.vjp": (DERIVATIVE.vjp, {"velocity": B, "impulse": B, "slack": B}),
    "Derivatives.vjp": (
        lv.derivatives([GENERAL, GENERAL], lv.solve_many([GENERAL, GENERAL], tol=1e-12)).vjp,
        {"velocity": FREE, "impulse": FREE, "slack": FREE},
    ),
    "Generalized": (lv.Generalized, {"jac": np.eye(2), "mass": A, "v_free": B, "names": ["x", "y"]}),
    "Generalized, sparse": (lv.Generalized, {"jac": sp.csr_array(np.eye(2)), "mass": sp.csr_array(A), "v_free": B}),
    **{f"Generalized.{name}": (getattr(GENERAL.generalized, name), {argument: B}) for name, argument in {
        "bias": "target", "change": "impulse", "force": "impulse", "momentum_of": "v", "solve": "x", "velocity_of": "v",
    }.items()},
    "Generalized.velocity_name": (GENERAL.generalized.velocity_name, {"i": 1}),
    "Generalized.with_jacobian": (GENERAL.generalized.with_jacobian, {"jac": A, "v_free": B}),
    "Motions.__getitem__": (lv.motions(LCP, n=1).__getitem__, {"i": 0}),
    "Motions.nearest": (lv.motions(LCP, n=1).nearest, {"impulse": B}),
    "Motions.picks": (lv.motions(LCP, n=1).picks, {"solvers": ["pgs"], "tol": 1e-6, "max_iter": 100}),
    "Motions.select": (lv.motions(LCP, n=1).select, {"choice": "nearest", "impulse": B}),
    "Problem": (
        lv.Problem, {"b": B, "cones": lv.Cones.free(2), "matrix": A, "friction": "coulomb", "guess": B,
                     "key": np.array([1, 2]), "names": ["x", "y"], "name": "two", "precision": "float64"},
    ),
    "Problem, sparse": (lv.Problem, {"b": B, "cones": lv.Cones.free(2), "matrix": sp.csr_array(A)}),
    "Problem.linear": (lv.Problem.linear, {"A": A, "b": B}),
    "Problem.lcp": (lv.Problem.lcp, {"A": A, "b": B, "lower": -np.ones(2), "upper": np.ones(2), "guess": B}),
    "Problem.contact": (lv.Problem.contact, {"A": np.eye(8), "b": np.ones(8), "mu": np.array([0.5, 0.2]),
                                             "patch_radius": np.ones(2)}),
    "Problem.contact, rolling": (lv.Problem.contact, {"A": np.eye(10), "b": np.ones(10), "mu": np.array([0.5, 0.2]),
                                                      "rolling": np.ones(2)}),
    "Problem.from_findex": (
        lv.Problem.from_findex, {"A": np.eye(3), "b": np.ones(3), "lower": np.array([0.0, -0.5, -0.5]),
                                 "upper": np.array([np.inf, 0.5, 0.5]), "findex": np.array([-1, 0, 0])},
    ),
    "Problem.findex_order": (lv.Problem.findex_order, {"findex": np.array([-1, 0, 0])}),
    "Problem.from_rows": (
        lv.Problem.from_rows,
        {"rows": ROWS, "target": np.zeros(len(ROWS.jac) + 5 * len(ROWS.normal)), "lower": -np.ones(len(ROWS.jac)),
         "upper": np.ones(len(ROWS.jac)), "mu": np.full(len(ROWS.normal), 0.5),
         "tangents": np.full(len(ROWS.normal), 2), "rolling": np.ones(len(ROWS.normal)), "shape": "disk",
         "compliance": np.ones(len(ROWS.jac) + 5 * len(ROWS.normal))},
    ),
    "Problem.from_jacobian": (
        lv.Problem.from_jacobian,
        {"J": np.eye(2), "M": A, "v_free": B, "target": B, "cones": lv.Cones.free(2), "compliance": np.ones(2),
         "friction": "cone", "names": ["x", "y"], "dof_names": ["u", "v"]},
    ),
    "Problem.from_jacobian, blocks": (
        lv.Problem.from_jacobian, {"J": sp.csr_array(np.eye(2)), "M": [np.eye(1), np.eye(1)], "v_free": B,
                                   "cones": lv.Cones.free(2)},
    ),
    "Problem.from_qp": (
        lv.Problem.from_qp, {"P": A, "q": B, "G": np.ones((1, 2)), "h": np.ones(1), "A": np.ones((1, 2)),
                             "b": np.ones(1), "lb": np.zeros(2), "ub": np.ones(2)},
    ),
    "Problem.block_of": (LCP.block_of, {"row": 1}),
    "Problem.row_name": (LCP.row_name, {"row": 1}),
    "Problem.block_name": (LCP.block_name, {"block": 1}),
    "Problem.boxed": (CONTACT.boxed, {"normal_impulse": np.ones(len(ROWS.normal))}),
    "Problem.carry": (LCP.carry, {"previous": (LCP, B), "keys": np.array([4, 5])}),
    "Problem.carry, impulse": (lambda impulse: LCP.carry((LCP, impulse)), {"impulse": B}),
    "Problem.impulse_array": (LCP.impulse_array, {"impulse": B}),
    "Problem.relaxed": (CONTACT.relaxed, {"friction": "cone"}),
    "Problem.slack": (LCP.slack, {"impulse": B}),
    "Problem.velocity": (GENERAL.velocity, {"impulse": B}),
    "Problem.updated": (GENERAL.updated, {"J": A, "M": A, "v_free": B, "target": B, "guess": B}),
    "Problem.updated, b": (LCP.updated, {"b": B}),
    "Rows": (lv.Rows, PARTS),
    "Rows.jacobian": (CONTACT.rows.jacobian, {"cones": CONTACT.cones}),
    "Scene": (lv.Scene, {"name": "stack", "n": 3, "gravity": np.array([0.0, 0.0, -9.81])}),
    "Scene.add_body": (
        on(scene, "add_body"), {"mass": 1.0, "inertia": np.ones(3), "position": np.ones(3),
                                "quaternion": np.array([1.0, 0.0, 0.0, 0.0]), "velocity": np.ones(3),
                                "angular_velocity": np.ones(3)},
    ),
    "Scene.add_box": (on(scene, "add_box"), {"size": np.ones(3), "mass": 1.0}),
    "Scene.add_plane": (on(scene, "add_plane"), {"normal": np.array([0.0, 0.0, 1.0]), "offset": 0.0}),
    "Scene.add_sphere": (on(scene, "add_sphere"), {"radius": 0.5, "mass": 1.0}),
    "Scene.add_joint": (on(scene, "add_joint"), {"kind": "hinge", "a": 0, "b": -1, "anchor": np.zeros(3),
                                                 "axis": np.array([0.0, 0.0, 1.0])}),
    "Scene.with_parameters": (lv.Scene("stack").with_parameters, {"dt": 0.01, "solver_iterations": 8}),
    "Simulation": (lv.Simulation, {"scene": "stack", "stepper": "impulses", "report_residual": True}),
    "Simulation.film": (on(lambda: lv.Simulation("stack"), "film"), {"steps": 1}),
    "Simulation.reset": (on(lambda: lv.Simulation("stack"), "reset"), {"seed": 1}),
    "Simulation.restore": (
        on(lambda: lv.Simulation("stack"), "restore"), {"snapshot": lv.Simulation("stack").snapshot()},
    ),
    "Simulation.set_solver_iterations": (on(lambda: lv.Simulation("stack"), "set_solver_iterations"), {"n": 8}),
    "Simulation.set_velocity": (
        on(lambda: lv.Simulation("stack"), "set_velocity"),
        {"body": 1, "velocity": np.ones(3), "angular_velocity": np.ones(3)},
    ),
    "Simulation.set_warm_start": (on(lambda: lv.Simulation("stack"), "set_warm_start"), {"flag": True}),
    "Simulation.step": (on(lambda: lv.Simulation("stack"), "step"), {"action": None}),
    "Solution.motion_error": (SOLVED.motion_error, {"reference": B}),
    "Solution.state": (SOLVED.state, {"i": 0}),
    "SolverSpec.refuses": (lv.get("pgs").refuses, {"problem": LCP}),
    "SolverSpec.standing_in": (lv.get("gauss_seidel").standing_in, {"problem": LCP}),
    "available": (lv.available, {"problem": LCP, "law": "lcp", "order": True}),
    "cross_check": (lv.cross_check, {"problem": LCP, "solvers": ["pgs"], "reference": "direct", "tol": 1e-6,
                                     "max_iter": 100, "time_limit": 1.0}),
    "derivative": (lv.derivative, {"problem": GENERAL, "solution": EXACT.impulse}),
    "derivatives": (lv.derivatives, {"problems": [GENERAL], "solutions": [EXACT.impulse]}),
    "diagnose": (lv.diagnose, {"problem": CONTACT, "impulse": np.zeros(CONTACT.m),
                               "velocity": CONTACT.rows.v_free, "gap": np.zeros(len(CONTACT.rows.normal)), "dt": 0.01}),
    "explain": (lv.explain, {"problem": LCP, "tol": 1e-6}),
    "get": (lv.get, {"name": "pgs"}),
    "known": (lv.known, {"problem": LCP}),
    "motion_error": (lv.motion_error, {"problem": LCP, "impulse": B, "reference": B}),
    "motions": (lv.motions, {"problem": LCP, "n": 1, "seed": 1, "always": True}),
    "prepare": (lv.prepare, {"problem": LCP, "solver": "pgs"}),
    "Prepared.solve": (lv.prepare(LCP, "pgs").solve, {"problem": LCP, "impulse": B, "tol": 1e-6, "max_iter": 100,
                                                      "time_limit": 1.0, "history": True}),
    "redundancy": (lv.redundancy, {"problem": LCP, "tol": 1e-12}),
    "register": (lv.register, {"spec": lv.get("pgs"), "replace": True}),
    "residual": (lv.residual, {"problem": LCP, "impulse": B, "precision": "float32", "threshold": 1e-6}),
    "residual_many": (lv.residual_many, {"problems": BATCH, "impulses": FREE, "precision": "float32",
                                         "threshold": 1e-6, "threads": 2, "errors": "raise"}),
    "residual_many, a list": (lv.residual_many, {"problems": [LCP, LCP], "impulses": [B, B]}),
    "solve": (lv.solve, {"problem": LCP, "solver": "pgs", "impulse": B, "tol": 1e-6, "max_iter": 100,
                         "time_limit": 1.0, "history": True}),
    "solve by auto": (lv.solve, {"problem": LCP, "impulse": B, "tol": 1e-6, "time_limit": 1.0}),
    "solve_many": (lv.solve_many, {"problems": BATCH, "solver": "auto", "impulse": FREE, "threads": 2, "tol": 1e-6,
                                   "max_iter": 100, "time_limit": 1.0, "errors": "raise"}),
    "solve_many, a list": (lv.solve_many, {"problems": [LCP, LCP], "impulses": [B, None]}),
    "solve_qp": (lv.solve_qp, {"problem": PROGRAM, "solver": "auto", "tol": 1e-9, "time_limit": 1.0}),
    "bench.Plan": (bench.Plan, {"levels": (1e-3,), "budgets": (4,), "repeats": 1, "time_limit": 1.0,
                                "orders": ("given",), "motion": False}),
    "bench.resolve": (bench.resolve, {"words": ["stack(n=2)"], "sequences": False}),
    "bench.sequence": (bench.sequence, {"problems": [LCP], "name": "walk"}),
    "bench.expand_seeds": (bench.expand_seeds, {"words": ["random_spd(n=3)"], "n": 2, "first": 0}),
    "bench.carry": (bench.carry, {"before": LCP, "impulse": B, "problem": LCP}),
    "bench.structure_of": (bench.structure_of, {"problem": LCP}),
    "phenomena.chosen": (phenomena.chosen, {"names": ["slide"]}),
    "suite.stack": (suite.stack, {"n": 3, "mass_ratio": 2.0, "friction": "none", "sliding": 0.5}),
    "suite.engine_step": (suite.engine_step, {"scene": "pyramid", "at": 3}),
    "suite.names": (suite.names, {"text": "@hard"}),
    "motion.adopt": (motion.adopt, {"problem": LCP, "impulse": B, "solver": "mine"}),
    "motion.branch": (motion.branch, {"problem": LCP, "impulse": B}),
    "motion.distance": (motion.distance, {"problem": LCP, "x": B, "y": B}),
    "motion.reference": (motion.reference, {"problem": LCP}),
    "motion.uniqueness": (motion.uniqueness, {"problem": LCP}),
    "io.from_efc": (io.from_efc, EFC),
    **{f"io.from_efc, {name} of contacts": (
        lambda part, k=k: io.from_efc(**EFC | {"contacts": tuple(part if i == k else x for i, x in
                                                                 enumerate(EFC["contacts"]))}),
        {"part": np.array(EFC["contacts"][k])},
    ) for k, name in enumerate(("world", "efc_address", "dim", "friction"))},
}  # fmt: skip


def malformed(good):
    """(What it is, value) of values that stand in the place of a good one."""
    yield from {
        "None": None, "a text": "no such word", "bytes": b"x", "an object": object(), "NaN": np.nan, "-1": -1,
        "very large": 2**70, "a half": 0.5, "True": True, "an empty list": [], "a mapping": {1: 2}, "complex": 1j,
        "masked": np.ma.masked, "a date": np.timedelta64(1, "s"), "ragged": [[1.0, 2.0], [3.0]], "a set": {1.0},
        "an iterator": iter([1.0, 2.0]), "a function": len, "a class": int, "no dimension": np.array(1.0),
        "an empty array": np.zeros(0), "three dimensions": np.zeros((2, 2, 2)), "a Problem": LCP,
        "lists of text": [["a", "b"], ["c", "d"]], "objects": np.full((2, 2), None), "a sparse array": sp.eye_array(3),
        "a structured array": np.zeros(2, [("x", float)]), "a slice": slice(0, 1), "a list of None": [None, None],
    }.items()  # fmt: skip
    if sp.issparse(good):
        dense = good.toarray()
        yield from {
            "NaN in it": sp.csr_array(np.where(dense != 0.0, np.nan, 0.0)), "longer": sp.csr_array(np.eye(5)),
            "complex": good.astype(complex), "COO": good.tocoo(), "a dense array": dense,
            "of integers": good.astype(int),
        }.items()  # fmt: skip
    if isinstance(good, np.ndarray):
        first = np.arange(good.size).reshape(good.shape) == 0
        yield from {
            "NaN first": np.where(first, np.nan, good), "infinite first": np.where(first, np.inf, good),
            "a column": good[..., None], "longer": np.concatenate([good, good[:1]]), "shorter": good[:-1],
            "of text": good.astype(str), "of objects": good.astype(object), "of None": np.full(good.shape, None),
            "of complex": good + 0j, "of dates": np.zeros(good.shape, "m8[s]"),
            "of masks": np.ma.array(good, mask=first),
            "negative": -1 - np.abs(good), "huge": np.full(good.shape, 1e300), "halves": good + 0.5,
            "transposed": good.T, "flat": good.ravel(), "of bool": good > 0, "of few bits": good.astype(np.float16),
            "of many bits": good.astype(np.longdouble),
            "a scalar of it": good.flat[0] if good.size else 0.0,
            "unsigned": np.nan_to_num(np.abs(good)).clip(0, 9).astype(np.uint8),
        }.items()  # fmt: skip


#: What is public and takes arguments, and is not called here: why.
NOT_CALLED = {
    **dict.fromkeys(
        ("Claim", "CrossCheck", "Derivative", "Enclosure", "MotionError", "Motions", "Plan", "QPSolution", "Redundancy",
         "Residual", "Residuals", "Snapshot", "Solution", "Solutions", "Suspicion", "Turn", "io.Recording",
         "io.Stored"),
        "a result: the package makes it",
    ),
    **dict.fromkeys(
        ("Batch.worlds", "Generalized.compressed", "Generalized.laid_out", "Generalized.restrict",
         "Generalized.shifted", "Generalized.with_scaled_rows", "Batch.start", "Solutions.mark_late",
         "Problem.on_disk", "Residuals.keep", "Simulation.end_film", "Simulation.write_problem", "Solution.late",
         "Solution.of", "Solution.unstretched", "Solutions.keep", "Solutions.late", "Solutions.start", "Batch.rows_of"),
        "for the package's own use, with arrays that it has checked",
    ),
    **dict.fromkeys(
        ("Problem.save", "Simulation.frames", "Simulation.load", "Simulation.record", "Simulation.save",
         "Snapshot.load",
         "Snapshot.save", "io.load", "io.load_solution", "io.read", "io.record", "io.save", "load"),
        "a file: tests/io and tests/cli/test_writing.py",
    ),
    **dict.fromkeys(
        ("io.from_drake", "io.from_mujoco", "io.from_mujoco_many", "io.from_pinocchio"),
        "another simulator's objects: tests/io",
    ),
    **dict.fromkeys(("Batch.count", "Batch.index", "Solutions.count", "Solutions.index"), "a sequence of Python"),
    "CrossCheck.__getitem__": "a mapping by the names of solvers",
    "Simulation.view": "a server",
    "SolverSpec": "tests/core/solvers/test_registry.py",
    "Status": "an enumeration",
    "prove": "needs python-flint: tests/lab/motion/test_proof.py",
}  # fmt: skip


def public():
    """Names of all public functions, classes and methods that take an argument."""

    def takes_some(call):
        try:
            return any(p.name not in ("self", "cls") for p in inspect.signature(call).parameters.values())
        except (TypeError, ValueError):
            return False

    for module, prefix in ((lv, ""), (io, "io.")):
        for name in module.__all__:
            x = getattr(module, name)
            if inspect.isclass(x) and not issubclass(x, BaseException):
                names = [k for k in dir(x) if k == "__getitem__" or not k.startswith("_")]
                kinds = types.FunctionType, classmethod, staticmethod
                methods = {k for k in names if isinstance(inspect.getattr_static(x, k), kinds)}
                yield from (f"{prefix}{name}.{k}" for k in sorted(methods) if takes_some(getattr(x, k)))
            if callable(x) and not (inspect.isclass(x) and issubclass(x, BaseException)) and takes_some(x):
                yield f"{prefix}{name}"


def test_every_public_call_is_examined():
    called = {name.partition(",")[0].partition(" by ")[0] for name in CALLS}
    assert set(public()) - called - set(NOT_CALLED) == set()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CALLS)
def test_malformed_arguments_end_in_an_error_of_the_package(name):
    call, good = CALLS[name]
    call(**good)
    index = (IndexError,) if name.endswith("__getitem__") else ()  # as of any sequence
    wrong = []
    for argument, value in good.items():
        for what, x in malformed(value):
            try:
                call(**good | {argument: x})
            except lv.LavenderError as error:
                if not str(error).strip():
                    wrong.append(f"{argument}: {what}: no words")
            except index:
                pass
            except Exception as error:
                wrong.append(f"{argument}: {what}: {type(error).__name__}: {error}"[:200])
    assert not wrong, "\n".join(wrong)


def swapped(x):
    """The numbers in the byte order of the other kind of machine."""
    return x.astype(x.dtype.newbyteorder())


def strided(x):
    wide = np.zeros((*x.shape[:-1], 2 * x.shape[-1]), x.dtype)
    wide[..., ::2] = x
    return wide[..., ::2]


def frozen(x):
    x = x.copy()
    x.setflags(write=False)
    return x


WAYS = (swapped, strided, np.asfortranarray, lambda x: x[::-1].copy()[::-1], frozen, np.ndarray.tolist)


def numbers_of(result):
    """What a result says, to be compared; None of what has no numbers that can be."""
    if isinstance(result, lv.Batch):
        return [*result]
    if isinstance(result, tuple) and hasattr(result, "batch"):
        # J v is summed in another order where J lies otherwise in memory.
        rounded = [p.b.round(12).tolist() for p in result.batch]
        return rounded, [p.cones for p in result.batch], result.impulse.tolist()
    return (
        result.tolist()
        if isinstance(result, np.ndarray)
        else result
        if isinstance(result, lv.Problem)
        else None
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CALLS)
def test_the_same_numbers_in_other_memory_are_the_same_argument(name):
    call, good = CALLS[name]
    want = numbers_of(call(**good))
    for argument, value in good.items():
        if isinstance(value, np.ndarray):
            for way in WAYS:
                assert numbers_of(call(**good | {argument: way(value)})) == want


@pytest.mark.parametrize(
    "name",
    ["Batch", "Batch, triangle of M", "Batch.of_matrices", "Batch.of_bodies", "Problem.from_jacobian", "Rows",
     "io.from_efc"],
)  # fmt: skip
def test_single_precision_of_another_byte_order_is_single_precision(name):
    call, good = CALLS[name]

    def single(x, order):
        if isinstance(x, tuple) and isinstance(x[0], np.ndarray):
            return single(x[0], order), *x[1:]
        is_real = isinstance(x, np.ndarray) and x.dtype.kind == "f"
        return x.astype(np.float32).astype(np.dtype(np.float32).newbyteorder(order)) if is_real else x

    for order in "<>":
        made = call(**{argument: single(x, order) for argument, x in good.items()})
        assert getattr(made, "batch", made).precision == "float32"
