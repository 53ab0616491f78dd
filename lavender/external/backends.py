"""Every backend of qpsolvers by its own name, on linear problems and boxed LCPs with symmetric A.

    min 1/2 l.A l - b.l,  lower <= l <= upper        (impulse form), or the velocity form of `as_qp`

`clarabel_cone` adds the convex relaxation of friction, disk and spin as second-order cones, a round cone as one:

    l_n >= 0,  |l_t| <= mu l_n,  |l_s| <= mu r l_n,  or the dual cone w_n >= a |w_t| + a_s |w_s|

Backends of which qpsolvers passes on the iterate but not what happened (iterations, exit flag,
certificates, warm start) are called by their own interface (`native/`), the others through it (`backend.py`).
"""

from __future__ import annotations

from functools import partial
from typing import Any

from lavender.external.backend import Backend
from lavender.external.native import clarabel, daqp, highs, osqp, qpalm
from lavender.external.qp_solver import OPTIONS, QPSolver, refusal
from lavender.external.running import Limits, at_least
from lavender.solvers.registry import SolverSpec

# -- settings of those that go through qpsolvers -----------------------------------------------------


def _proximal(limit: Limits) -> dict[str, Any]:
    # Without the gap proxqp accepts multipliers on bounds that are not active (met on a redundant stack).
    return {
        "eps_abs": limit.eps, "eps_rel": 0.0, "max_iter": limit.max_iter,
        "check_duality_gap": True, "eps_duality_gap_abs": limit.gap, "eps_duality_gap_rel": limit.gap_relative,
    }  # fmt: skip


def _scs(limit: Limits) -> dict[str, Any]:
    more = {} if limit.time_limit is None else {"time_limit_secs": limit.time_limit}
    return {"eps_abs": limit.eps, "eps_rel": 0.0, "eps_infeas": 1e-11, "max_iters": limit.max_iter, **more}


def _cvxopt(limit: Limits, count: str = "maxiters") -> dict[str, Any]:
    return {
        "feastol": limit.eps,
        "abstol": limit.gap,
        "reltol": limit.gap_relative,
        count: limit.max_iter,
    }


def _gurobi(limit: Limits) -> dict[str, Any]:
    more = {} if limit.time_limit is None else {"TimeLimit": limit.time_limit}
    eps = at_least(limit.eps, 1e-9)
    return {
        "FeasibilityTol": eps, "OptimalityTol": eps, "BarConvTol": limit.gap,
        "BarIterLimit": limit.max_iter, "IterationLimit": limit.max_iter, "Threads": 1, **more,
    }  # fmt: skip


def _copt(limit: Limits) -> dict[str, Any]:
    more = {} if limit.time_limit is None else {"TimeLimit": limit.time_limit}
    eps = at_least(limit.eps, 1e-9)
    return {"FeasTol": eps, "DualTol": eps, "BarIterLimit": limit.max_iter, "Threads": 1, **more}


def _qtqp(limit: Limits) -> dict[str, Any]:
    return {
        "tol_feas": limit.eps, "tol_gap_abs": limit.gap, "tol_gap_rel": limit.gap_relative,
        "max_iter": limit.max_iter, "collect_stats": True,
    }  # fmt: skip


def _pyqpmad(limit: Limits) -> dict[str, Any]:
    return {"tolerance": at_least(limit.eps, 1e-12), "max_iter": limit.max_iter}


def _qpax(limit: Limits) -> dict[str, Any]:
    return {"solver_tol": at_least(limit.eps, 1e-12)}


ADMM = "Stellato et al. 2020, OSQP: an operator splitting solver for quadratic programs"
BACKENDS: tuple[Backend, ...] = (
    Backend("osqp", ("osqp",), "osqp", "operator splitting with polishing", ADMM,
            call=osqp.call, max_iter=100_000, warm=True, stoppable=True),
    Backend("clarabel", ("clarabel",), "clarabel", "interior point, homogeneous embedding",
            "Goulart, Chen 2024, Clarabel", call=clarabel.call, max_iter=200, stoppable=True),
    Backend("piqp", ("qpsolvers", "piqp"), "piqp", "proximal interior point",
            "Schwan, Jiang, Kuhn, Jones 2023, PIQP", settings=_proximal, max_iter=250),
    Backend("proxqp", ("qpsolvers", "proxsuite"), "proxsuite", "proximal augmented Lagrangian",
            "Bambade et al. 2022, ProxQP", settings=_proximal, warm=True),
    Backend("qpalm", ("qpalm",), "qpalm", "proximal augmented Lagrangian, semismooth Newton",
            "Hermans, Themelis, Patrinos 2022, QPALM", call=qpalm.call, warm=True, stoppable=True),
    Backend("daqp", ("daqp",), "daqp", "dual active set", "Arnström, Bemporad, Axehill 2022, DAQP",
            call=daqp.call, dense=True, warm=True, stoppable=True),
    Backend("highs", ("highspy",), "highspy", "null-space active set", "Huangfu, Hall 2018, HiGHS",
            call=highs.call, max_iter=100_000, stoppable=True, noisy=True),
    Backend("scs", ("qpsolvers", "scs"), "scs", "operator splitting, homogeneous embedding",
            "O'Donoghue 2021, SCS 3", settings=_scs, max_iter=100_000, warm=True, stoppable=True),
    Backend("quadprog", ("qpsolvers", "quadprog"), "quadprog", "dual active set, positive definite A",
            "Goldfarb, Idnani 1983", dense=True, definite=True),
    Backend("cvxopt", ("qpsolvers", "cvxopt"), "cvxopt", "interior point", "Vandenberghe 2010, CVXOPT",
            settings=_cvxopt, max_iter=100),
    Backend("kvxopt", ("qpsolvers", "kvxopt"), "kvxopt", "interior point, CVXOPT with more factorisations",
            "Vandenberghe 2010, CVXOPT", settings=_cvxopt, max_iter=100),
    Backend("ecos", ("qpsolvers", "ecos"), "ecos", "interior point for second-order cones",
            "Domahidi, Chu, Boyd 2013, ECOS", settings=partial(_cvxopt, count="max_iters"), max_iter=100,
            dense=True, definite=True, linear="equality", finite=True),
    Backend("gurobi", ("qpsolvers", "gurobipy"), "gurobipy", "interior point and simplex", "Gurobi manual",
            settings=_gurobi, stoppable=True, noisy=True),
    Backend("copt", ("qpsolvers", "coptpy"), "coptpy", "interior point", "COPT manual",
            settings=_copt, stoppable=True, noisy=True),
    Backend("mosek", ("qpsolvers", "cvxopt", "mosek"), "cvxopt mosek", "interior point", "MOSEK manual", noisy=True),
    Backend("qtqp", ("qpsolvers", "qtqp"), "qtqp", "primal-dual interior point", "QTQP manual",
            settings=_qtqp, max_iter=200, linear=""),
    Backend("pyqpmad", ("qpsolvers", "pyqpmad"), "pyqpmad", "dual active set, positive definite A",
            "Goldfarb, Idnani 1983", settings=_pyqpmad, dense=True, definite=True),
    Backend("qpax", ("qpsolvers", "qpax"), "qpax", "interior point in JAX", "Tracy, Manchester 2024, qpax",
            settings=_qpax, max_iter=30, dense=True, noisy=True),
    Backend("jaxopt_osqp", ("qpsolvers", "jaxopt"), "jaxopt", "operator splitting in JAX", ADMM,
            dense=True, noisy=True),
    Backend("hpipm", ("qpsolvers", "hpipm_python"), "hpipm_python (github.com/giaf/hpipm)", "interior point",
            "Frison, Diehl 2020, HPIPM", dense=True),
    Backend("nppro", ("qpsolvers", "nppro"), "nppro", "active set", "NPPro manual", dense=True),
    Backend("pdhcg", ("qpsolvers", "pdhcg"), "pdhcg", "primal-dual hybrid conjugate gradient",
            "Huang et al. 2024, PDHCG", noisy=True),
    Backend("qpoases", ("qpsolvers", "qpoases"), "qpoases", "online active set",
            "Ferreau et al. 2014, qpOASES", dense=True),
    Backend("qpswift", ("qpsolvers", "qpSWIFT"), "qpSWIFT", "interior point",
            "Pandala, Ding, Park 2019, qpSWIFT", dense=True, linear="", finite=True),
    Backend("sip", ("qpsolvers", "sip_qp_python"), "sip-qp-python", "interior point", "SIP manual"),
    Backend("clarabel_cone", ("clarabel",), "clarabel",
            "interior point on the convex relaxation of friction, second-order cones",
            "Goulart, Chen 2024, Clarabel; Tasora, Anitescu 2011 for the relaxation",
            call=clarabel.call, max_iter=200, stoppable=True, cones=True),
)  # fmt: skip


def _spec(backend: Backend) -> SolverSpec:
    laws = {"lcp"} | ({"linear"} if backend.linear else set()) | ({"cone"} if backend.cones else set())
    return SolverSpec(
        name=backend.name,
        factory=partial(QPSolver, backend),
        laws=frozenset(laws),
        boxes=frozenset() if backend.definite else frozenset({"cone"}),  # as edges of cones A is singular
        resumable=False,
        external=True,
        impulse=backend.warm,
        round_cones=backend.cones,
        parts=backend.cones,
        max_iter=backend.max_iter,
        options=OPTIONS,
        requires=backend.modules,
        install=backend.install,
        summary=backend.summary if backend.cones else f"{backend.summary} (QP backend)",
        reference=backend.reference,
        refusal=refusal,
    )


SPECS: tuple[SolverSpec, ...] = tuple(map(_spec, BACKENDS))
