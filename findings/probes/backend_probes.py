"""Small programs with known solutions, run by backends without this package: the measurements in `backends.json`.

    python findings/probes/backend_probes.py [BACKEND ...]

prints the observed behaviour of each installed backend, for the table of `lavender/programs/backends.py`.
"""

import contextlib
import io
import math
import os
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy as np
import scipy.sparse as sp

TOLERANCE = 1e-2  # Default tolerances of backends are 1e-3 to 1e-8.
FAR_BOUNDS = [10.0**k for k in range(3, 20)]
SMALL_SIZES = [10.0**-k for k in range(1, 11)]
DENSE_ONLY = (
    "daqp",
    "ecos",
    "quadprog",
    "jaxopt_osqp",
    "qpax",
    "pyqpmad",
    "hpipm",
    "nppro",
    "qpoases",
    "qpswift",
)


def run_alone(name, *arguments, **arrays):
    """Solve a program by qpsolvers, by default with default settings; return the solution or the exception."""
    with be_quiet():
        return call_qpsolvers(name, *arguments, **arrays)


@contextlib.contextmanager
def be_quiet():
    """Discard warnings and standard output, for all threads of the process."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def call_qpsolvers(name, P, q, sparse=None, settings=(), **arrays):
    """Call qpsolvers as `run_alone` does, with the output of the backend."""
    import qpsolvers

    if "qpax" in name or "jax" in name:
        import jax

        jax.config.update("jax_enable_x64", True)
    sparse = name not in DENSE_ONLY if sparse is None else sparse
    arrays = {k: np.array(v, float) for k, v in {"P": P, "q": q, **arrays}.items()}
    arrays = {k: sp.csc_matrix(v) if sparse and v.ndim == 2 else v for k, v in arrays.items()}
    try:
        return qpsolvers.solve_problem(qpsolvers.Problem(**arrays), name, **dict(settings))
    except Exception as error:  # Backends raise their own exceptions.
        return error


def give_verdict(result, *solutions):
    """Return "right", "wrong", "not found" or "raises"; without solutions, each answer is wrong."""
    if isinstance(result, Exception):
        return "raises"
    if not result.found or result.x is None:
        return "not found"
    x = np.ravel(result.x)
    return "right" if any(is_near(x, np.array(s)) for s in solutions) else "wrong"


def is_near(x, solution):
    """Return whether x is within `TOLERANCE` of the solution, relative to its largest entry."""
    return bool(np.max(np.abs(x - solution)) <= TOLERANCE * np.max(np.abs(solution)))


def find_triangle(name, sparse=None):
    found = [
        run_alone(name, P, [-1, -1], sparse, lb=[-9, -9], ub=[9, 9])
        for P in ([[2, 1], [0, 2]], [[2, 0], [1, 2]])
    ]
    if any(isinstance(f, Exception) for f in found):
        return "none"
    sizes = {"both": [1 / 3] * 2, "one": [0.5] * 2, "mean": [0.4] * 2}
    seen = [
        next((k for k, v in sizes.items() if is_near(np.ravel(f.x), np.array(v))), "other")
        for f in found
    ]
    words = {("both", "one"): "upper", ("one", "both"): "lower", ("mean", "mean"): "mean"}
    return words.get(tuple(seen), "all")


def find_linear_term(name):
    found = run_alone(name, np.diag([1, 0]), [0, -1e-7], lb=[0, 0], ub=[1, 1])
    return round_entry(found, 1)


def find_small_part(name):
    pair = [[2, 1], [1, 2]]
    found = run_alone(name, np.kron(np.eye(2), pair), [-3e6, -3e6, -1, 1], lb=[0] * 4)
    return round_entry(found, 2)


def round_entry(found, i):
    """Return x[i] rounded to one digit; None without an answer."""
    has_none = isinstance(found, Exception) or not found.found
    return None if has_none else float(f"{np.ravel(found.x)[i]:.1g}")


def find_infeasible_x(name):
    found = run_alone(name, np.eye(2), [0, 0], G=[[1, 0], [-1, 0]], h=[-1, -1])
    if isinstance(found, Exception):
        return "raises"
    return "none" if found.x is None else f"{abs(np.round(np.ravel(found.x)[0], 9)):.10g}"


def find_smallest(name):
    for e in SMALL_SIZES:
        found = run_alone(name, np.eye(2), [-e, -2 * e], lb=[-1, -1], ub=[1, 1])
        if give_verdict(found, [e, 2 * e]) != "right":
            return e
    return 0.0


def find_far_bound(name):
    for far in FAR_BOUNDS:
        found = run_alone(
            name, [[2, 0.5], [0.5, 1]], [-1, -1], G=[[1, 1]], h=[1], lb=[-far, -far], ub=[far, far]
        )
        if give_verdict(found, [0.25, 0.75]) != "right":
            return far
    return math.inf


def find_fixed_multiplier(name):
    found = run_alone(name, np.eye(2), [0, 0], lb=[1, -2], ub=[1, -2])
    return float(np.round(np.ravel(found.z_box)[0], 1))


def find_conflict(name):
    for d in [1.0, *SMALL_SIZES]:
        found = run_alone(name, np.eye(2), [0, 0], A=[[1, 1], [1, 1]], b=[1, 1 + d])
        if not isinstance(found, Exception) and found.found:
            return d
    return 0.0


def find_offset(name):
    far = 1e8
    found = run_alone(name, np.eye(2), [-far - 0.3] * 2, lb=[far] * 2, ub=[far + 1] * 2)
    return (
        None
        if isinstance(found, Exception) or not found.found
        else float(f"{np.ravel(found.x)[0] - far:.1g}")
    )


def find_dependent(name):
    """Return the most frequent verdict on programs whose equalities depend on each other up to rounding."""
    rng = np.random.default_rng(0)
    verdicts = []
    for _ in range(20):
        rows = rng.normal(size=(10, 20))
        A = rng.normal(size=(15, 10)) @ rows
        x = rng.normal(size=20)
        found = run_alone(name, np.eye(20), np.zeros(20), A=A, b=A @ x)
        verdicts.append(give_verdict(found, np.linalg.pinv(rows) @ (rows @ x)))
    return max(set(verdicts), key=verdicts.count)


SADDLE = np.diag([1, -1])
#: Field of an observed behaviour -> function of a backend's name.
BEHAVIOUR_PROBES = {
    "triangle": find_triangle,
    "repeated": lambda n: give_verdict(
        run_alone(n, np.eye(2), [0, 0], A=[[0.3, 0.7], [0.3, 0.7]], b=[1, 1]),
        [0.3 / 0.58, 0.7 / 0.58],
    ),
    "dependent": find_dependent,
    "contradictory": lambda n: give_verdict(
        run_alone(n, np.eye(2), [0, 0], A=[[1, 1], [1, 1]], b=[1, 2])
    ),
    "singular": lambda n: give_verdict(
        run_alone(n, np.diag([1, 0]), [0, -1], lb=[-5, 0], ub=[5, 1]), [0, 1]
    ),
    "convex_on_rows": lambda n: give_verdict(
        run_alone(n, SADDLE, [0, 0], A=[[0, 1]], b=[0.5], lb=[-9, -9], ub=[9, 9]), [0, 0.5]
    ),
    "saddle": lambda n: give_verdict(run_alone(n, SADDLE, [0, 0], lb=[-1, -1], ub=[1, 2]), [0, 2]),
    "unbounded": lambda n: give_verdict(
        run_alone(n, np.diag([1, 0]), [0, -1], lb=[0, 0], ub=[np.inf, np.inf])
    ),
    "infeasible_x": find_infeasible_x,
    "linear_term": find_linear_term,
    "small_part": find_small_part,
    "fixed_multiplier": find_fixed_multiplier,
    "conflict": find_conflict,
    "offset": find_offset,
    "smallest": find_smallest,
    "far_bound": find_far_bound,
}


# -- notes: functions that return whether an observation of one backend still holds ------------------------------------


def make_osqp(P, q, A, low, high, **settings):
    import osqp

    solver = osqp.OSQP()
    solver.setup(sp.csc_matrix(P), q, sp.csc_matrix(A), low, high, verbose=False, **settings)
    return solver


def draw_bounded_program(n=30, m=20):
    """Draw min x.P x/2 + q.x with |A x| <= 1 and a P whose entries differ in size from A, so that step sizes adapt."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(n, n))
    P = 50.0 * root @ root.T + 0.01 * np.eye(n)
    return (P + P.T) / 2.0, 10.0 * rng.normal(size=n), rng.normal(size=(m, n))


def osqp_keeps_its_step_size():
    P, q, A = draw_bounded_program()
    one = np.ones(len(A))
    solver = make_osqp(P, q, A, -one, one, warm_starting=False, eps_abs=1e-8, eps_rel=0.0)
    first = solver.solve(raise_error=False).info
    return first.rho_updates > 0 and solver.solve(raise_error=False).info.iter != first.iter


def osqp_keeps_y():
    P, q, A = draw_bounded_program()
    one = np.ones(len(A))
    solver = make_osqp(P, q, A, -one, one, eps_abs=1e-8, eps_rel=0.0)
    x = solver.solve(raise_error=False).x.copy()
    solver.warm_start(x=x)
    kept = solver.solve(raise_error=False).info.iter
    solver.warm_start(x=x, y=0.0 * one)
    return kept < solver.solve(raise_error=False).info.iter


def solve_with_scs(solver=None, **start):
    import scs

    P, q, A = draw_bounded_program()
    data = {
        "P": sp.csc_matrix(np.triu(P)),
        "c": q,
        "A": sp.csc_matrix(np.vstack([A, -A])),
        "b": np.ones(40),
    }
    solver = solver or scs.SCS(data, {"l": 40}, verbose=False, eps_abs=1e-8, eps_rel=0.0)
    return solver, solver.solve(**start)


def scs_needs_x_y_and_s():
    solution = solve_with_scs()[1]
    count = {
        k: solve_with_scs(**{n: solution[n] for n in k})[1]["info"]["iter"]
        for k in ("x", "xy", "xs", "xys")
    }
    return count.pop("xys") == 0 and min(count.values()) > 0


def scs_keeps_its_scale():
    solver, first = solve_with_scs(warm_start=False)
    return solve_with_scs(solver, warm_start=False)[1]["info"]["iter"] != first["info"]["iter"]


def piqp_fails_with_unsorted_indices():
    import qpsolvers

    P = sp.csc_matrix((np.array([1.0, 2.0, 2.0, 1.0]), np.array([1, 0, 1, 0]), np.array([0, 2, 4])))
    arrays = {"lb": np.full(2, -9.0), "ub": np.full(2, 9.0)}
    found = [
        qpsolvers.solve_problem(qpsolvers.Problem(M, -np.ones(2), **arrays), "piqp")
        for M in (P, P.toarray())
    ]
    return not found[0].found and give_verdict(found[1], [1 / 3, 1 / 3]) == "right"


def piqp_solves_dense_arrays_only():
    sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))
    from backend_truth import draw_program

    program = draw_program(285)
    tight = {"eps_abs": 1e-6, "eps_rel": 0.0, "check_duality_gap": True}
    tight |= {"eps_duality_gap_abs": 1e-6, "eps_duality_gap_rel": 0.0}
    sparse, dense = (run_alone("piqp", sparse=x, settings=tight, **program) for x in (True, False))
    return dense.found and not sparse.found


def proxqp_finds_a_program_infeasible():
    program = {"P": np.diag([1, 0]), "q": [2, -1], "G": [[0, 1]], "h": [1], "A": [[1, 0]], "b": [0]}
    program |= {"lb": [-5, -5], "ub": [5, 5]}
    found = run_alone("proxqp", **program)
    weighted = run_alone("proxqp", **program, settings={"rho": 0.1, "eps_abs": 1e-9})
    return "PRIMAL_INFEASIBLE" in str(found.extras["info"].status) and is_near(
        weighted.x, np.array([0, 1])
    )


def highs_returns_zeros():
    def solve(e, **rows):
        return np.ravel(
            run_alone("highs", np.eye(2), [-e, -2 * e], lb=[0, 0], ub=[np.inf] * 2, **rows).x
        )

    zeros = solve(1e-5, G=[[1, 1]], h=[np.inf])
    return not zeros.any() and is_near(solve(1024e-5), np.array([1024e-5, 2048e-5]))


def daqp_flags_what_qpsolvers_finds():
    import daqp

    A = np.ones((2, 2))
    b = np.array([1.0, 2.0])
    flag = daqp.solve(np.eye(2), np.zeros(2), A, b, b, np.full(2, 5, np.int32))[2]
    return flag == -6 and run_alone("daqp", np.eye(2), [0, 0], A=A, b=b).found


def daqp_reads_a_slice_as_contiguous():
    import daqp

    whole = np.zeros((3, 3))
    bound = np.full(2, 9.0)
    whole[:2, :2] = [[2.0, 1.0], [1.0, 2.0]]
    arguments = -np.ones(2), np.zeros((0, 2)), bound, -bound, np.zeros(2, np.int32)
    found, right = (daqp.solve(P, *arguments) for P in (whole[:2, :2], whole[:2, :2].copy()))
    return (
        found[2] == right[2] == 1
        and is_near(right[0], np.full(2, 1 / 3))
        and not is_near(found[0], right[0])
    )


def qpoases_reads_columns_as_rows():
    import qpsolvers

    G = np.array([[1.0, 0.0], [5.0, 1.0], [0.0, 1.0]])
    h = np.array([-1.0, 9.0, 2.0])
    found = [
        qpsolvers.solve_problem(qpsolvers.Problem(np.eye(2), np.zeros(2), M, h), "qpoases")
        for M in (G, np.asfortranarray(G))
    ]
    return give_verdict(found[0], [-1, 0]) == "right" and give_verdict(found[1], [-1, 0]) == "wrong"


def cvxopt_ends_at_1e10(name):
    found = run_alone(name, np.diag([1, 0]), [0, -1], lb=[0, 0], ub=[np.inf, np.inf])
    return found.found and is_near(np.ravel(found.x)[1:], np.array([1e10]))


def pyqpmad_overwrites_columns():
    import qpsolvers

    P = np.asfortranarray([[2.0, 1.0], [1.0, 2.0]])
    qpsolvers.solve_problem(
        qpsolvers.Problem(P, -np.ones(2), np.ones((1, 2)), np.ones(1)), "pyqpmad"
    )
    return not np.array_equal(P, [[2.0, 1.0], [1.0, 2.0]])


def proxqp_accepts_crossed_bounds():
    return run_alone("proxqp", np.eye(2), [0, 0], lb=[1, 0], ub=[-1, 0]).found


def qpax_finds_nan():
    found = run_alone("qpax", np.eye(2), [0, 0], A=[[0.3, 0.7], [0.3, 0.7]], b=[1, 1])
    return bool(found.found) and bool(np.isnan(found.x).all())


#: (backend, key of its note) -> function that returns whether the observation holds.
NOTE_PROBES = {
    ("osqp", "memory"): osqp_keeps_its_step_size,
    ("osqp", "kept_y"): osqp_keeps_y,
    ("scs", "start"): scs_needs_x_y_and_s,
    ("scs", "memory"): scs_keeps_its_scale,
    ("piqp", "sparse"): piqp_solves_dense_arrays_only,
    ("piqp", "unsorted"): piqp_fails_with_unsorted_indices,
    ("proxqp", "false_infeasible"): proxqp_finds_a_program_infeasible,
    ("proxqp", "dense_triangle"): lambda: find_triangle("proxqp", False) == "lower",
    ("proxqp", "crossed_bounds"): proxqp_accepts_crossed_bounds,
    ("highs", "free_row"): highs_returns_zeros,
    ("daqp", "flag"): daqp_flags_what_qpsolvers_finds,
    ("daqp", "slice"): daqp_reads_a_slice_as_contiguous,
    ("qpoases", "columns"): qpoases_reads_columns_as_rows,
    ("cvxopt", "infinite"): lambda: cvxopt_ends_at_1e10("cvxopt"),
    ("kvxopt", "infinite"): lambda: cvxopt_ends_at_1e10("kvxopt"),
    ("pyqpmad", "in_place"): pyqpmad_overwrites_columns,
    ("qpax", "nan"): qpax_finds_nan,
}


def main():
    """Print the observed behaviour of the backends named on the command line, by default of all."""
    import qpsolvers

    from lavender.programs.backends import BACKENDS

    packages = {b.name: b.modules[-1] for b in BACKENDS}
    for name in sys.argv[1:] or qpsolvers.available_solvers:
        print(
            f"{name} {version(packages[name])}",
            {k: probe(name) for k, probe in BEHAVIOUR_PROBES.items()},
        )
        sys.stdout.flush()


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
