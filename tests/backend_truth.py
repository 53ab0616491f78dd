"""Random quadratic programs and LCPs, their KKT errors in long double, and calls of backends without this package."""

import warnings

import numpy as np

import lavender as lv

TOL = 1e-6
KINDS = "definite", "singular", "repeated", "placeholder"
MAX_RATIO = (
    10.0  # An answer may be this many times as far from the KKT conditions as the backend's own.
)
# Settings of a backend called alone: the ones that its adapter passes, at the same tolerance.
INTERIOR = {"feastol": TOL, "abstol": TOL, "reltol": TOL}
PROXIMAL = {"eps_abs": TOL, "eps_rel": 0.0}
GAPS = {f"eps_duality_gap_{kind}": TOL for kind in ("abs", "rel")}
ALONE = {
    "osqp": {"eps_abs": TOL, "eps_rel": 0.0, "max_iter": 100_000, "polishing": True},
    "clarabel": {"tol_feas": TOL, "tol_gap_abs": TOL, "tol_gap_rel": TOL},
    "piqp": PROXIMAL | GAPS,
    "proxqp": PROXIMAL | GAPS | {"check_duality_gap": True},
    "qpalm": PROXIMAL,
    "daqp": {"primal_tol": TOL, "dual_tol": TOL},
    "highs": {f"{kind}_feasibility_tolerance": TOL for kind in ("primal", "dual")},
    "scs": PROXIMAL | {"max_iters": 100_000},
    "cvxopt": INTERIOR,
    "kvxopt": INTERIOR,
    "ecos": INTERIOR,
}


def draw_program(seed):
    """Draw a feasible convex program with 2 to 20 variables and up to 3 rows per variable, as arguments of `from_qp`.

    P is definite for even seeds, else singular. One program in three has repeated rows.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 21))
    rank = n if seed % 2 == 0 else int(rng.integers(0, n))
    root = rng.normal(size=(rank, n))
    P = root.T @ root + (0.1 * np.eye(n) if rank == n else 0.0)
    x, q = rng.normal(size=n), rng.normal(size=n)
    n_g = int(rng.integers(0, 3 * n + 1))
    n_a = int(rng.integers(0, max(1, n // 2)))
    G, A = rng.normal(size=(n_g, n)), rng.normal(size=(n_a, n))
    if seed % 3 == 0:
        G = np.vstack([G, *(G[:1] * [[1.0], [2.0]] if n_g else [])])
        A = np.vstack([A, A[:1]])
    h = G @ x + np.where(rng.random(len(G)) < 0.3, 0.0, rng.random(len(G)))
    program = {"P": (P + P.T) / 2.0, "q": q}
    program |= {"G": G, "h": h} if len(G) else {}
    program |= {"A": A, "b": A @ x} if len(A) else {}
    if rank < n or rng.random() < 0.5:
        program |= {"lb": x - 2.0 * rng.random(n), "ub": x + 2.0 * rng.random(n)}
        if rank == n:
            program["lb"][rng.random(n) < 0.5] = -np.inf
            program["ub"][rng.random(n) < 0.5] = np.inf
    return program


def draw_kind(seed):
    """Draw a program of one of four kinds in turn: definite, singular, with repeated rows, with placeholder bounds.

    Placeholder bounds are inactive bounds of 1e3 to 1e19, which users write for "no bound".
    """
    kind = KINDS[seed % len(KINDS)]
    turn = seed // len(KINDS) % 2
    # The seed of `draw_program` decides definiteness (even) and repeated rows (a multiple of 3).
    first = {"definite": 2, "singular": 1, "repeated": 3 * turn, "placeholder": 1 + turn}[kind]
    program = draw_program(6 * (1000 + seed) + first)
    if kind == "placeholder":
        rng = np.random.default_rng(seed)
        n = len(program["q"])
        far = np.full(n, 10.0 ** rng.integers(3, 20))
        # With this q, the objective has a minimum without bounds also if P is singular.
        program |= {"q": program["P"] @ rng.normal(size=n), "lb": -far, "ub": far}
    return kind, program


def draw_lcp(seed):
    """Draw a solvable LCP with a symmetric semidefinite A, as the program min 1/2 x.A x - b.x with x >= 0."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 21))
    root = rng.normal(size=(n, int(rng.integers(1, n + 1))))
    A = root @ root.T
    A = (A + A.T) / 2.0
    x = rng.random(n)
    active = rng.random(n) < 0.5
    return {"P": A, "q": -(A @ (x * active) - rng.random(n) * ~active), "lb": np.zeros(n)}


def compute_kkt_error(program, x, y=None, z=None, z_box=None):
    """Compute the largest violation of the KKT conditions in long double; infinite without an answer.

    Rows are relative to their largest term, stationarity to its largest term, and complementarity to the largest
    product of a term and a multiplier, all to at least 1. Numbers of the drawn programs are near 1.
    """
    n = len(program["q"])
    A, G = (program.get(name, np.zeros((0, n))).astype(np.longdouble) for name in "AG")
    parts = ([] if v is None else np.ravel(v) for v in (x, y, z, z_box))
    x, y, z, box = (np.array(part, np.longdouble) for part in parts)
    box = box if len(box) else np.zeros(n)
    if (
        len(x) != n
        or len(y) < len(A)
        or len(z) < len(G)
        or not all(np.isfinite(v).all() for v in (x, y, z, box))
    ):
        return np.inf
    y, z = y[: len(A)], z[: len(G)]  # Some backends return a zero without rows.

    def largest(*vectors):
        return max([1.0, *(np.abs(v[np.isfinite(v)]).max(initial=0.0) for v in vectors)])

    ends = {"b": np.zeros(0), "h": np.zeros(0), "lb": np.full(n, -np.inf), "ub": np.full(n, np.inf)}
    b, h, low, high = (np.asarray(program.get(name, missing)) for name, missing in ends.items())
    terms = program["P"] @ x, program["q"], A.T @ y, G.T @ z, box
    ax, gx = A @ x, G @ x
    force = largest(*terms)
    size = largest(ax, b, gx, h, x)
    gap = np.concatenate([gx - h, low - x, x - high])
    w = np.concatenate([z, np.maximum(-box, 0.0), np.maximum(box, 0.0)])
    is_finite = np.isfinite(gap)
    product = (
        np.where(is_finite, np.abs(np.where(is_finite, gap, 0.0) * w) / size, np.abs(w)) / force
    )
    errors = (
        np.abs(sum(terms)) / force,
        np.abs(ax - b) / size,
        np.maximum(gap, 0.0) / size,
        -w / force,
        product,
    )
    return float(max(np.max(part, initial=0.0) for part in errors))


def call_alone(program, name, tol=TOL):
    """Return the KKT error of the backend called through qpsolvers; infinite if it returns no answer."""
    import qpsolvers

    settings = {k: tol if v == TOL else v for k, v in ALONE.get(name, {}).items()}
    arrays = {k: program.get(k) for k in ("P", "q", "G", "h", "A", "b", "lb", "ub")}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = qpsolvers.solve_problem(qpsolvers.Problem(**arrays), name, **settings)
    except Exception:  # Backends raise their own exceptions for programs that they do not accept.
        return np.inf
    if not found.found:
        return np.inf
    return compute_kkt_error(program, found.x, found.y, found.z, found.z_box)


def call_here(program, name, is_lcp, tol=TOL):
    """Return the answer's KKT error and the `Solution`, of the backend called by this package."""
    if is_lcp:
        A = program["P"]
        b = -program["q"]
        solution = lv.solve(lv.Problem.lcp(A, b), name, tol=tol)
        x = solution.impulse
        return compute_kkt_error(program, x, z_box=-np.maximum(A @ x - b, 0.0)), solution
    answer = lv.solve_qp(lv.Problem.from_qp(**program), name, tol=tol)
    return compute_kkt_error(program, answer.x, answer.y, answer.z, answer.z_box), answer.solution
