"""Specs of all QP backends, for linear problems and boxed LCPs with symmetric A.

    min 1/2 l.A l - b.l,  lower <= l <= upper        (impulse form), or the velocity form of `as_qp`

`clarabel_cone` also supports the convex relaxation of friction. Disk and spin are second-order cones; a round cone is
one cone:

    l_n >= 0,  |l_t| <= mu l_n,  |l_s| <= mu r l_n,  or the dual cone w_n >= a |w_t| + a_s |w_s|

Some backends are called by their own interface (`native.py`), because qpsolvers returns neither their numbers of
iterations nor their exit flags and certificates, and cannot warm-start them. The others are called through qpsolvers
(`backend.py`).
"""

from __future__ import annotations

from functools import partial

from lavender.external import native
from lavender.external.backend import Backend
from lavender.external.qp_solver import OPTION_HELP, QPSolver, explain_refusal
from lavender.solvers.registry import SolverSpec

#: Options of backends that qpsolvers calls: a str is a field of `Limits`, other values are fixed.
PROXIMAL = {  # Without the test of the duality gap, proxqp accepts non-zero multipliers of inactive bounds.
    "eps_abs": "eps", "eps_rel": 0.0, "max_iter": "max_iter",
    "check_duality_gap": True, "eps_duality_gap_abs": "gap", "eps_duality_gap_rel": "gap_relative",
}  # fmt: skip
CVXOPT = {"feastol": "eps", "abstol": "gap", "reltol": "gap_relative", "maxiters": "max_iter"}
ECOS = {"feastol": "eps", "abstol": "gap", "reltol": "gap_relative", "max_iters": "max_iter"}
GUROBI = {
    "FeasibilityTol": "eps", "OptimalityTol": "eps", "BarConvTol": "gap", "BarIterLimit": "max_iter",
    "IterationLimit": "max_iter", "Threads": 1, "TimeLimit": "time_limit",
}  # fmt: skip
COPT = {
    "FeasTol": "eps",
    "DualTol": "eps",
    "BarIterLimit": "max_iter",
    "Threads": 1,
    "TimeLimit": "time_limit",
}
QTQP = {
    "tol_feas": "eps", "tol_gap_abs": "gap", "tol_gap_rel": "gap_relative", "max_iter": "max_iter",
    "collect_stats": True,
}  # fmt: skip
PYQPMAD = {"tolerance": "eps", "max_iter": "max_iter"}
QPAX = {"solver_tol": "eps"}
JAXOPT = {"tol": "eps", "maxiter": "max_iter"}
SIP = {"eps_abs": "eps", "eps_rel": 0.0, "max_iterations": "max_iter", "time_limit": "time_limit"}

ADMM = "Stellato et al. 2020, OSQP: an operator splitting solver for quadratic programs"
BACKENDS: tuple[Backend, ...] = (
    Backend("osqp", ("osqp",), "osqp", "operator splitting with polishing", ADMM,
            call=native.call_osqp, max_iter=100_000, warm=True, stoppable=True, interrupts=True),
    Backend("clarabel", ("clarabel",), "clarabel", "interior point, homogeneous embedding",
            "Goulart, Chen 2024, Clarabel", call=native.call_clarabel, max_iter=200, stoppable=True),
    Backend("piqp", ("qpsolvers", "piqp"), "piqp", "proximal interior point",
            "Schwan, Jiang, Kuhn, Jones 2023, PIQP", settings=PROXIMAL, max_iter=250),
    Backend("proxqp", ("qpsolvers", "proxsuite"), "proxsuite", "proximal augmented Lagrangian",
            "Bambade et al. 2022, ProxQP", settings=PROXIMAL, warm=True),
    Backend("qpalm", ("qpalm",), "qpalm", "proximal augmented Lagrangian, semismooth Newton",
            "Hermans, Themelis, Patrinos 2022, QPALM", call=native.call_qpalm, warm=True, stoppable=True),
    Backend("daqp", ("daqp",), "daqp", "dual active set", "Arnström, Bemporad, Axehill 2022, DAQP",
            call=native.call_daqp, dense=True, warm=True, stoppable=True),
    Backend("highs", ("highspy",), "highspy", "null-space active set", "Huangfu, Hall 2018, HiGHS",
            call=native.call_highs, max_iter=100_000, stoppable=True),
    Backend("scs", ("scs",), "scs", "operator splitting, homogeneous embedding",
            "O'Donoghue 2021, SCS 3", call=native.call_scs, max_iter=100_000, warm=True, stoppable=True,
            interrupts=True),
    Backend("quadprog", ("qpsolvers", "quadprog"), "quadprog", "dual active set, positive definite A",
            "Goldfarb, Idnani 1983", dense=True, definite=True, finite=True),
    Backend("cvxopt", ("qpsolvers", "cvxopt"), "cvxopt", "interior point", "Vandenberghe 2010, CVXOPT",
            settings=CVXOPT, max_iter=100, finite=True),
    Backend("kvxopt", ("qpsolvers", "kvxopt"), "kvxopt", "interior point, CVXOPT with more factorisations",
            "Vandenberghe 2010, CVXOPT", settings=CVXOPT, max_iter=100),
    Backend("ecos", ("qpsolvers", "ecos"), "ecos", "interior point for second-order cones",
            "Domahidi, Chu, Boyd 2013, ECOS", settings=ECOS, max_iter=100,
            dense=True, definite=True, finite=True, interrupts=True),
    Backend("gurobi", ("qpsolvers", "gurobipy"), "gurobipy", "interior point and simplex", "Gurobi manual",
            settings=GUROBI, min_tolerance=1e-9, stoppable=True, noisy=True),
    Backend("copt", ("qpsolvers", "coptpy"), "coptpy", "interior point", "COPT manual",
            settings=COPT, min_tolerance=1e-9, stoppable=True, noisy=True),
    Backend("mosek", ("qpsolvers", "cvxopt", "mosek"), "cvxopt mosek", "interior point", "MOSEK manual", noisy=True,
            finite=True),
    Backend("qtqp", ("qpsolvers", "qtqp"), "qtqp", "primal-dual interior point", "QTQP manual",
            settings=QTQP, max_iter=200, finite=True),
    Backend("pyqpmad", ("qpsolvers", "pyqpmad"), "pyqpmad", "dual active set, positive definite A",
            "Goldfarb, Idnani 1983", settings=PYQPMAD, min_tolerance=1e-12, dense=True, definite=True),
    Backend("qpax", ("qpsolvers", "qpax"), "qpax", "interior point in JAX", "Tracy, Manchester 2024, qpax",
            settings=QPAX, min_tolerance=1e-12, max_iter=30, dense=True, noisy=True, jax=True,
            finite=True),
    Backend("jaxopt_osqp", ("qpsolvers", "jaxopt"), "jaxopt", "operator splitting in JAX", ADMM,
            settings=JAXOPT, dense=True, noisy=True, jax=True, finite=True),
    Backend("hpipm", ("qpsolvers", "hpipm_python"), "hpipm_python (github.com/giaf/hpipm)", "interior point",
            "Frison, Diehl 2020, HPIPM", dense=True),
    Backend("nppro", ("qpsolvers", "nppro"), "nppro", "active set", "NPPro manual", dense=True),
    Backend("pdhcg", ("qpsolvers", "pdhcg"), "pdhcg", "primal-dual hybrid conjugate gradient",
            "Huang et al. 2024, PDHCG", noisy=True),
    Backend("qpoases", ("qpsolvers", "qpoases"), "qpoases", "online active set",
            "Ferreau et al. 2014, qpOASES", dense=True),
    Backend("qpswift", ("qpsolvers", "qpSWIFT"), "qpSWIFT", "interior point",
            "Pandala, Ding, Park 2019, qpSWIFT", dense=True, finite=True),
    Backend("sip", ("qpsolvers", "sip_qp_python"), "sip-qp-python", "interior point", "SIP manual",
            settings=SIP, max_iter=500, stoppable=True),
    Backend("clarabel_cone", ("clarabel",), "clarabel",
            "interior point on the convex relaxation of friction, second-order cones",
            "Goulart, Chen 2024, Clarabel; Tasora, Anitescu 2011 for the relaxation",
            call=native.call_clarabel, max_iter=200, stoppable=True, cones=True),
)  # fmt: skip


def _make_spec(backend: Backend) -> SolverSpec:
    """Build the registry entry of a backend."""
    return SolverSpec(
        name=backend.name,
        factory=partial(QPSolver, backend),
        laws=frozenset({"linear", "lcp", *(["cone"] if backend.cones else [])}),
        # Under the law "cone", friction boxes are written as one row for each edge of the cone, which makes A
        # singular.
        box_friction_laws=frozenset() if backend.definite else frozenset({"cone"}),
        resumable=False,
        external=True,
        impulse=backend.warm,
        singular_programs=not (backend.definite or backend.cones),
        round_cones=backend.cones,
        supports_rolling=backend.cones,
        max_iter=backend.max_iter,
        options=OPTION_HELP,
        requires=backend.modules,
        install=backend.install,
        summary=backend.summary if backend.cones else f"{backend.summary} (QP backend)",
        reference=backend.reference,
        refusal=explain_refusal,
    )


SPECS: tuple[SolverSpec, ...] = tuple(map(_make_spec, BACKENDS))
