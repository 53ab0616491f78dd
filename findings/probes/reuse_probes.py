"""Probes of backends that are used more than once: time limits, second solves of an object, threads."""

import math
import signal
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scipy.sparse as sp
from backend_probes import be_quiet, call_qpsolvers, draw_bounded_program

SPARSE_SIZE = (
    100_000  # Unknowns with which the set-up of Clarabel takes about as long as its solve.
)


class OsqpSession:
    """Set-up and solve of OSQP for min x.P x/2 + q.x with |A x| <= 1; so are the other sessions."""

    def __init__(self, P, q, A, limit=None):
        import osqp

        self.solver = osqp.OSQP()
        one = np.ones(len(A))
        settings = {} if limit is None else {"time_limit": limit}
        self.solver.setup(
            sp.csc_matrix(sp.triu(P)),
            q,
            sp.csc_matrix(A),
            -one,
            one,
            verbose=False,
            warm_starting=False,
            **settings,
        )

    def solve(self):
        found = self.solver.solve(raise_error=False)
        return found.info.status == "solved", found.x.copy()


class ScsSession:
    def __init__(self, P, q, A, limit=None):
        import scs

        data = {
            "P": sp.csc_matrix(sp.triu(P)),
            "c": q,
            "A": sp.csc_matrix(np.vstack([A, -A])),
            "b": np.ones(2 * len(A)),
        }
        settings = {} if limit is None else {"time_limit_secs": limit}
        self.solver = scs.SCS(data, {"l": 2 * len(A)}, verbose=False, **settings)

    def solve(self):
        found = self.solver.solve(warm_start=False)
        return found["info"]["status"] == "solved", found["x"].copy()


class ClarabelSession:
    def __init__(self, P, q, A, limit=None):
        import clarabel

        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        settings.time_limit = math.inf if limit is None else limit
        rows = sp.csc_matrix(np.vstack([A, -A]))
        cones = [clarabel.NonnegativeConeT(2 * len(A))]
        self.solver = clarabel.DefaultSolver(
            sp.csc_matrix(sp.triu(P)), q, rows, np.ones(2 * len(A)), cones, settings
        )

    def solve(self):
        found = self.solver.solve()
        return "Solved" in str(found.status), np.array(found.x)


class QpalmSession:
    def __init__(self, P, q, A, limit=None):
        import qpalm

        data = qpalm.Data(len(q), len(A))
        settings = qpalm.Settings()
        data.Q = sp.csc_matrix(P)
        data.q = q
        data.A = sp.csc_matrix(A)
        data.bmin = -np.ones(len(A))
        data.bmax = np.ones(len(A))
        settings.verbose = False
        if limit is not None:
            settings.time_limit = limit
        self.solver = qpalm.Solver(data, settings)

    def solve(self):
        self.solver.solve()
        return str(self.solver.info.status) == "solved", np.array(self.solver.solution.x)


class PiqpSession:
    def __init__(self, P, q, A):
        import piqp

        self.solver = piqp.DenseSolver()
        self.solver.setup(P, q, None, None, A, -np.ones(len(A)), np.ones(len(A)), None, None)

    def solve(self):
        return self.solver.solve() == 1, np.array(self.solver.result.x)


class ProxqpSession:
    def __init__(self, P, q, A):
        from proxsuite import proxqp

        self.solver = proxqp.dense.QP(len(q), 0, len(A))
        self.solver.init(P, q, None, None, A, -np.ones(len(A)), np.ones(len(A)))

    def solve(self):
        self.solver.solve()
        return True, np.array(self.solver.results.x)


class HighsSession:
    def __init__(self, P, q, A):
        import highspy

        self.solver, model = highspy.Highs(), highspy.HighsModel()
        self.solver.setOptionValue("output_flag", False)
        lower = sp.csc_matrix(np.tril(P))
        rows = sp.csc_matrix(A)
        one = np.ones(len(A))
        model.hessian_.dim_ = len(q)
        model.hessian_.start_, model.hessian_.index_, model.hessian_.value_ = (
            lower.indptr,
            lower.indices,
            lower.data,
        )
        lp = model.lp_
        lp.num_col_ = len(q)
        lp.num_row_ = len(A)
        lp.col_cost_ = q
        lp.col_lower_ = np.full(len(q), -np.inf)
        lp.col_upper_ = np.full(len(q), np.inf)
        lp.row_lower_ = -one
        lp.row_upper_ = one
        lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
        lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = (
            rows.indptr,
            rows.indices,
            rows.data,
        )
        self.solver.passModel(model)

    def solve(self):
        self.solver.run()
        return True, np.array(self.solver.getSolution().col_value)


class DaqpModel:
    def __init__(self, P, q, A, limit=0.0):
        import daqp

        self.solver = daqp.Model()
        one = np.ones(len(A))
        self.solver.settings = self.solver.settings | {"time_limit": limit}
        self.solver.setup(P, q, A, one, -one)

    def solve(self):
        found = self.solver.solve()
        return found[2] == 1, np.array(found[0])


SESSIONS = {
    "osqp": OsqpSession,
    "scs": ScsSession,
    "clarabel": ClarabelSession,
    "qpalm": QpalmSession,
    "piqp": PiqpSession,
    "proxqp": ProxqpSession,
    "highs": HighsSession,
    "daqp": DaqpModel,
}


def find_time_limit(name):
    """Return whether a limit shorter than set-up and solve together, but longer than the solve, allows a solution."""
    if name not in ("osqp", "scs", "daqp", "clarabel"):
        return ""
    rng = np.random.default_rng(0)
    sparse = name == "clarabel"  # Only its set-up of sparse rows takes long.
    root = np.zeros((1, 1)) if sparse else rng.normal(size=(800, 800)) / 28.0
    n = SPARSE_SIZE if sparse else len(root)
    P = sp.eye_array(n, format="csc") if sparse else root @ root.T + np.eye(n)
    program = (P + P.T) / 2.0, np.ones(n), sp.eye_array(2, n, format="csc").toarray()
    SESSIONS[name](*program)  # The first object imports the backend.
    times = [time.perf_counter()]
    session = SESSIONS[name](*program)
    times.append(time.perf_counter())
    session.solve()
    times.append(time.perf_counter())
    setup, solve = np.diff(times)
    limit = min(solve + setup / 4.0, 2.0 * solve)
    is_solved = any(
        SESSIONS[name](*program, limit=limit).solve()[0] for _ in range(3)
    )  # A busy machine delays one.
    return "without set-up" if is_solved else "with set-up"


def find_second_solve(name):
    """Return whether a second solve of one object, without a start, gives the "same" bits or "other" bits; else ""."""
    if name not in SESSIONS:
        return ""
    with be_quiet():
        session = SESSIONS[name](*draw_bounded_program())
        first, second = session.solve()[1], session.solve()[1]
    return "same" if np.array_equal(first, second) else "other"


def solve_drawn(name, seed):
    """Return the bits of x of a drawn program; the size of the program depends on the seed."""
    P, q, A = draw_bounded_program(8 + seed, 5 + seed)
    found = call_qpsolvers(name, P, q, G=A, h=np.ones(len(A)))
    return None if isinstance(found, Exception) or found.x is None else found.x.tobytes()


def find_after_others(name):
    """Return whether a program after another one in the same process has the "same" or "other" bits."""
    with be_quiet():
        found = [solve_drawn(name, k) for k in (0, 3, 0)]
    return "failed" if None in found else "same" if found[0] == found[2] else "other"


def find_in_threads(name):
    """Return whether programs in four threads at the same time have the "same" or "other" bits as one by one."""
    with be_quiet(), ThreadPoolExecutor(4) as threads:
        alone = [solve_drawn(name, k) for k in range(4)]
        found = list(threads.map(lambda k: solve_drawn(name, k), [0, 1, 2, 3] * 4))
    # Of two calls at the same time, osqp and ecos leave a handler of their own: without this line, Ctrl-C would raise
    # nothing in any later test of this process.
    signal.signal(signal.SIGINT, signal.getsignal(signal.SIGINT))
    return "failed" if None in alone else "same" if found == alone * 4 else "other"


#: Field of an observed behaviour -> function of a backend's name.
REUSE_PROBES = {"time_limit": find_time_limit, "second_solve": find_second_solve}
