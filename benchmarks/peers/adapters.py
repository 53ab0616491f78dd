"""Other solvers by their own interfaces, and lavender's: time to a given error by one judge.

A contestant solves a problem with increasingly tight settings of its own. Each run gives a CPU time and an impulse; the
time to an error is the smallest time of a run that reaches it by the judge, whatever its setting. A contestant gets a
problem in its better form (impulse or velocity form of `lavender.programs.forms`, scaled, in its own data layout).
Only the call of its interface is timed, not conversion and judging.
"""

from __future__ import annotations

import functools
import importlib.util
import math
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import scipy.sparse as sp

from benchmarks.pairs import run_timed, time_call
from benchmarks.peers.backend_time import measure_backend_time
from lavender import registry
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender.problem.cones import CONTACT
from lavender.programs.backend import Backend
from lavender.programs.backends import BACKENDS
from lavender.programs.forms import PROGRAM_FORMS, Form, build_form
from lavender.programs.qp_solver import QPSolver, explain_refusal
from lavender.programs.running import Limits
from lavender.solving.prepared import prepare

TARGETS = (1e-3, 1e-6, 1e-9)  # relative residuals to reach
SCRATCH = ", from scratch"  # suffix of lavender's solvers that are timed with forming A
SCIPY = "scipy "  # prefix of SciPy's factorisations
#: Settings of other solvers from loose to tight, in their own error measures, with unknowns scaled to about 1.
LADDER = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-12, 1e-14)
START = 60.0  # s, wall time allowed for imports of a backend on a loaded machine
QUICK = {
    **dict.fromkeys(("daqp", "quadprog"), (("", True),)),
    **dict.fromkeys(("piqp", "proxqp"), ((" sparse", False), (" dense", True))),
}
DENSE_ROWS = 1700  # maximum rows for Siconos' solvers of dense matrices

Call = Callable[[], tuple[float, FloatArray]]  # one run: s of CPU, impulse (m,) [N s]
Runs = Callable[[Problem, float], Iterator[Call]]  # (problem, limit [s]) -> a call for each setting


@dataclass(frozen=True)
class Contestant:
    """A solver with its problem form."""

    name: str
    peer: bool
    runs: Runs = field(repr=False)
    refuses: Callable[[Problem], str | None] = field(default=lambda _: None, repr=False)


@dataclass
class Result:
    """Result of one contestant on one problem."""

    problem: str
    rows: int
    law: str
    solver: str
    peer: bool
    runs: list[tuple[float, float]] = field(
        default_factory=list
    )  # (time [s], relative residual) of every setting
    note: str = ""

    def time(self, target: float) -> float:
        """Return the smallest time [s] of a run with at most this relative residual, or inf."""
        return min((t for t, r in self.runs if r <= target), default=math.inf)


# -- QP and cone backends --------------------------------------------------------------------------


def _limits(eps: float, n: int, limit: float) -> Limits:
    # The gap decreases as eps^2 if impulse and slack vanish together; below 1e-18 rounding hides it.
    return Limits(eps, max(1e-2 * eps, 1e-18), n, limit)


def _impulse(form: Form, x: FloatArray | None, lam: FloatArray | None) -> FloatArray:
    program = form.program
    if x is None or lam is None or len(x) != len(program.q) or not np.isfinite(lam).all():
        return form.problem.start()
    return form.recover_impulse(*program.restore_point(x, lam))


def _backend(backend: Backend, form: str, own: str = "") -> Contestant:
    """Return the runs of a backend called by `lavender.programs`; `own`: only its own set-up and solve are timed."""

    def runs(problem: Problem, limit: float) -> Iterator[Call]:
        built = QPSolver(backend, form=form).prepare(problem)
        if form == "velocity" and backend.needs_definite and not built.is_definite:
            return
        scaled = built.program.scaled
        if backend.needs_definite:
            scaled = scaled.make_definite(0)

        def once(eps: float) -> tuple[float, FloatArray]:
            limits = _limits(eps, backend.max_iter, limit)
            with measure_backend_time(backend.name if own else "") as spent:
                answer, seconds = run_timed(lambda: backend.run(scaled, None, limits, {}))
            return sum(spent) if own else seconds, _impulse(built, answer.x, answer.lam)

        untold = backend.call is None and backend.settings is None  # has a fixed tolerance
        for eps in LADDER[:1] if untold else LADDER:
            yield functools.partial(once, eps)

    def refuses(problem: Problem) -> str | None:
        if form == "velocity" and problem.rows is None:
            return "no rows"
        spec = registry.get(backend.name)
        if problem.law not in spec.laws or (backend.cones and problem.law != "cone"):
            return "friction"
        if own and backend.dense and problem.m > DENSE_ROWS:
            return "a dense matrix"
        return spec.refuses(problem)

    return Contestant(f"{own or backend.name} ({form})", True, runs, refuses)


def _cone(name: str, form: str) -> Contestant:
    """Return the runs of a solver of second-order cone programs by its own interface."""

    def runs(problem: Problem, limit: float) -> Iterator[Call]:
        built = build_form(problem, form)
        scaled = built.program.scaled
        # A x + s = b: equations, inequalities with the bounds, cones.
        rows = scaled.select_rows(np.arange(len(scaled.t)), -1.0, False)
        rhs = -scaled.t
        upper = sp.triu(scaled.get_hessian(False), format="csc")
        n_nonneg = len(rhs) - scaled.free - sum(scaled.cones)

        def scs(eps: float) -> tuple[Any, Any]:
            import scs

            cone = {"z": scaled.free, "l": n_nonneg, "q": list(scaled.cones)}
            data = {"P": upper, "A": rows, "b": rhs, "c": scaled.q}
            found = scs.SCS(
                data,
                cone,
                eps_abs=eps,
                eps_rel=0.0,
                eps_infeas=1e-14,
                max_iters=10**7,
                time_limit_secs=limit,
                verbose=False,
            ).solve()
            return found["x"], found["y"]

        def qoco(eps: float) -> tuple[Any, Any]:
            import qoco

            z = scaled.free
            solver = qoco.QOCO()
            equal = (rows[:z], rhs[:z]) if z else (None, None)
            solver.setup(
                scaled.n,
                len(rhs) - z,
                z,
                upper,
                scaled.q,
                *equal,
                sp.csc_matrix(rows[z:]),
                rhs[z:],
                n_nonneg,
                len(scaled.cones),
                np.asarray(scaled.cones, np.int32),
                abstol=max(eps, 1e-13),
                reltol=1e-16,
                verbose=0,
                max_iters=200,
            )
            found = solver.solve()
            return np.asarray(found.x), np.concatenate(
                [np.asarray(found.y)[:z], np.asarray(found.z)]
            )

        def once(eps: float) -> tuple[float, FloatArray]:
            (x, y), seconds = run_timed(functools.partial(scs if name == "scs" else qoco, eps))
            return seconds, _impulse(built, np.asarray(x), np.asarray(y, float))

        for eps in LADDER:
            yield functools.partial(once, eps)

    def refuses(problem: Problem) -> str | None:
        if problem.law != "cone":
            return "for the convex law of friction"
        return (
            "no rows" if form == "velocity" and problem.rows is None else explain_refusal(problem)
        )

    return Contestant(f"{name} cones ({form})", True, runs, refuses)


# -- Pinocchio -------------------------------------------------------------------------------------


def _three_rows_each(problem: Problem) -> bool:
    c = problem.cones
    return bool(problem.m and np.all(c.kind == CONTACT) and np.all(np.diff(c.ptr) == 3))


def _pinocchio(lanczos: int | None) -> Contestant:
    """Return the runs of Pinocchio's ADMM on the Delassus matrix, tangents first; lanczos None: its default."""

    def runs(problem: Problem, limit: float) -> Iterator[Call]:
        import pinocchio as pin

        m, c = problem.m, problem.n_blocks
        order = (np.arange(c)[:, None] * 3 + np.array([1, 2, 0])).ravel()
        # 1/kg, m/s
        unit = float(np.mean(problem.d))
        speed = max(get_zero_impulse_reference(problem)[1], 1e-300)
        a = sp.csc_matrix(problem.csr[order][:, order] / unit)
        g = -problem.b[order] / speed
        model = pin.Model()
        joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "body")
        models, datas = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
        for mu in problem.cones.mu:
            one = pin.PointContactConstraintModel(model, joint)
            one.setFriction(float(mu))
            models.append(pin.ConstraintModel(one))
            datas.append(models[len(models) - 1].createData())

        def once(eps: float, cap: int) -> tuple[float, FloatArray]:
            settings = pin.ADMMSolverSettings()
            settings.absolute_feasibility_tol = settings.absolute_complementarity_tol = eps
            settings.relative_feasibility_tol = settings.relative_complementarity_tol = 0.0
            settings.max_iterations = cap
            settings.solve_ncp = problem.law == "coulomb"
            if lanczos is not None:
                settings.lanczos_size = lanczos
            result = pin.ADMMSolverResult()

            def solve() -> None:
                matrix = pin.DelassusOperatorSparse(a)
                pin.ADMMConstraintSolver(m).solve(matrix, g, models, datas, settings, result)

            seconds = time_call(solve)
            x = np.empty(m)
            x[order] = np.asarray(result.retrieveConstraintImpulses()).ravel()
            return seconds, x * (speed / unit)

        # Estimate the iterations within the limit from the time of 50 iterations.
        most = int(min(10**6, max(50, limit / max(once(1e-16, 50)[0] / 50, 1e-7))))
        for eps in LADDER:
            yield functools.partial(once, eps, most)

    def refuses(problem: Problem) -> str | None:
        if not _three_rows_each(problem):
            return "for contacts with two tangents each"
        return None if problem.is_symmetric else "for a symmetric A"

    return Contestant(
        "pinocchio ADMM" + ("" if lanczos is None else f", lanczos {lanczos}"), True, runs, refuses
    )


# -- SciPy, for linear systems ---------------------------------------------------------------------


def _scipy(name: str) -> Contestant:
    def runs(problem: Problem, limit: float) -> Iterator[Call]:
        from scipy.linalg import solveh_banded
        from scipy.sparse.linalg import spsolve

        a = sp.csc_matrix(problem.csr)
        width = max(problem.bandwidth)

        def banded() -> FloatArray:
            entries = a.tocoo()
            band = np.zeros((width + 1, problem.m))
            keep = entries.col >= entries.row
            row, col = entries.row[keep], entries.col[keep]
            band[width + row - col, col] = entries.data[keep]
            return solveh_banded(band, problem.b)

        def once() -> tuple[float, FloatArray]:
            x, seconds = run_timed(
                banded if name == "banded" else functools.partial(spsolve, a, problem.b)
            )
            return seconds, np.asarray(x)

        yield once

    def refuses(problem: Problem) -> str | None:
        if problem.law != "linear":
            return "for linear systems"
        return "a wide band" if name == "banded" and max(problem.bandwidth) > 100 else None

    return Contestant(f"{SCIPY}{name}", True, runs, refuses)


# -- Siconos, in an interpreter of its own ---------------------------------------------------------

SICONOS_FRICTION = ("NSGS", "NSGS dense", "NSGS+projection", "NSN_AC", "NSN_AC dense", "ADMM")
SICONOS_LCP = ("PGS", "LEMKE", "MURTY", "NEWTON_FB_FBLSA", "NEWTON_MIN_FBLSA")


def _siconos(python: str, name: str, friction: bool) -> Contestant:
    def runs(problem: Problem, limit: float) -> Iterator[Call]:
        a = problem.csr
        ladder = LADDER if name not in ("LEMKE", "MURTY") else LADDER[-1:]
        with tempfile.TemporaryDirectory() as folder:
            given = Path(folder) / "problem.npz"
            np.savez(
                given,
                A_data=a.data,
                A_indices=a.indices,
                A_indptr=a.indptr,
                b=problem.b,
                solver=name,
                mu=problem.cones.mu if friction else np.zeros(0),
                tolerances=np.array(ladder),
                limit=limit,
            )
            script = Path(__file__).with_name("siconos_server.py")
            with subprocess.Popen(
                [python, "-I", str(script), str(given), folder],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            ) as process:
                try:
                    for i in range(len(ladder)):
                        answer = Path(folder) / f"{i}.npz"
                        patience = monotonic() + START + 4.0 * limit
                        while (
                            not answer.exists()
                            and process.poll() is None
                            and monotonic() < patience
                        ):
                            _nap()
                        if not answer.exists():
                            return
                        with np.load(answer, allow_pickle=False) as found:
                            yield functools.partial(
                                _found, float(found["seconds"]), np.array(found["impulse"])
                            )
                finally:
                    process.kill()

    def refuses(problem: Problem) -> str | None:
        c = problem.cones
        if friction:
            if problem.law != "coulomb" or not _three_rows_each(problem):
                return "for Coulomb contacts with two tangents each"
            return "a dense matrix" if name.endswith("dense") and problem.m > DENSE_ROWS else None
        if problem.law != "lcp" or np.any(c.lower != 0.0) or np.any(np.isfinite(c.upper)):
            return "for impulses >= 0"
        return "a dense matrix" if name != "PGS" and problem.m > DENSE_ROWS else None

    return Contestant(f"siconos {name}", True, runs, refuses)


def _nap() -> None:
    from time import sleep

    sleep(0.005)


def _found(seconds: float, impulse: FloatArray) -> tuple[float, FloatArray]:
    return seconds, impulse


def check_siconos(python: str) -> None:
    """Raise an error if an interpreter does not have Siconos.

    Raises
    ------
    InputError
        The interpreter cannot be run, or cannot import siconos.numerics.
    """
    try:
        done = subprocess.run(
            [python, "-I", "-c", "import siconos.numerics"],
            capture_output=True,
            text=True,
            timeout=START,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"{python} cannot be run as the interpreter of Siconos: {error}") from None
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        raise InputError(
            f"{python} has no Siconos ({last}); on Debian: apt install python3-siconos"
        )


# -- all contestants--------------------------------------------------------------------------------


def is_installed(module: str) -> bool:
    """Return whether a package can be imported."""
    return importlib.util.find_spec(module) is not None


def contestants(siconos: str = "") -> list[Contestant]:
    """Return every other solver that is installed, in each of its forms.

    Parameters
    ----------
    siconos : path, optional
        Python interpreter that has Siconos.

    Raises
    ------
    InputError
        The interpreter does not have Siconos.
    """
    made: list[Contestant] = []
    for backend in BACKENDS:
        if registry.specs()[backend.name].missing() is not None:
            continue
        for form in PROGRAM_FORMS[:2]:
            # Backends with calls so short that the adapter's overhead matters, with dense and sparse matrices.
            ways = QUICK.get(backend.name)
            made += (
                [_backend(backend, form, "clarabel cones" if backend.cones else "")]
                if ways is None
                else [
                    _backend(
                        replace(backend, dense=dense), form, f"{backend.name}{word}, own interface"
                    )
                    for word, dense in ways
                ]
            )
    made += [
        _cone(name, form)
        for name in ("scs", "qoco")
        if is_installed(name)
        for form in PROGRAM_FORMS[:2]
    ]
    if is_installed("pinocchio"):
        made += [_pinocchio(None), _pinocchio(20)]
    made += [_scipy("banded"), _scipy("spsolve")]
    if siconos:
        check_siconos(siconos)
        made += [_siconos(siconos, name, True) for name in SICONOS_FRICTION]
        made += [_siconos(siconos, name, False) for name in SICONOS_LCP]
    return made


# -- lavender -----------------------------------------------------------------------------------------


def ours() -> list[Contestant]:
    """Return all of lavender's solvers, on problems with known A and from scratch."""
    names = [
        name
        for name, spec in registry.specs().items()
        if not spec.external and spec.missing() is None
    ]
    return [_ours(name, scratch) for name in names for scratch in (False, True)]


def _ours(name: str, scratch: bool) -> Contestant:
    """Return the runs of `prepare` and `solve` with A and d known, or from scratch without derived data."""

    def runs(problem: Problem, limit: float) -> Iterator[Call]:
        def once(tol: float) -> tuple[float, FloatArray]:
            given = replace(problem, copy=False) if scratch else problem
            prepared, setup = run_timed(functools.partial(prepare, given, name))
            get_zero_impulse_reference(given)  # compute the judge's reference before timing
            first = given.start()
            limits = {"tol": tol, "max_iter": 2**31 - 1, "time_limit": limit}
            solution, seconds = run_timed(lambda: prepared.solve(impulse=first, **limits))
            return setup + seconds, solution.impulse

        if not scratch:
            get_zero_impulse_reference(problem)
            if problem.csr_data.d.size and "rows" in registry.get(name).operators:
                _ = problem.data
        for tol in TARGETS:
            yield functools.partial(once, tol)

    return Contestant(name + SCRATCH * scratch, False, runs, registry.get(name).refuses)
