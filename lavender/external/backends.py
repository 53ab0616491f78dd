"""Specs of all QP backends, for linear problems and boxed LCPs with symmetric A.

    min 1/2 l.A l - b.l,  lower <= l <= upper        (impulse form), or the velocity form of `forms`

`clarabel_cone` also supports the convex relaxation of friction. Disk and spin are second-order cones; a round cone is
one cone:

    l_n >= 0,  |l_t| <= mu l_n,  |l_s| <= mu r l_n,  or the dual cone w_n >= a |w_t| + a_s |w_s|

OSQP and Clarabel are called by their own interfaces (`native.py`), for warm starts, iteration counts and cones. The
others are called through qpsolvers (`backend.py`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from lavender.external import native
from lavender.external.backend import Backend, Behaviour
from lavender.external.qp_solver import OPTION_HELP, QPSolver, explain_refusal
from lavender.judge.solution import Status
from lavender.problem import Problem
from lavender.solvers.registry import SolverSpec

#: Options of backends that qpsolvers calls: a str is a field of `Limits`, other values are fixed.
PROXIMAL = {  # Without the test of the duality gap, proxqp accepts non-zero multipliers of inactive bounds.
    "eps_abs": "eps", "eps_rel": 0.0, "max_iter": "max_iter",
    "check_duality_gap": True, "eps_duality_gap_abs": "gap", "eps_duality_gap_rel": "gap",
}  # fmt: skip
# [-] Weight of ProxQP's proximal steps of x. With its default 1e-6, 18 of 400 solvable programs are called infeasible,
# with 1e-2 only 3. With 0.1, 2 are, but ProxQP needs 1.6 times as many iterations.
PROXQP_PROXIMAL_WEIGHT = 1e-2
# [-] Added to the diagonal of P by HiGHS. With its default 1e-7, it changes the solution; without it, its active-set
# method ends at wrong points if P is singular.
HIGHS_REGULARIZATION = 1e-10
DAQP = {"primal_tol": "eps", "dual_tol": 1e-12, "iter_limit": "max_iter", "time_limit": "time_limit"}
HIGHS = {
    "primal_feasibility_tolerance": "eps", "dual_feasibility_tolerance": "eps", "qp_iteration_limit": "max_iter",
    "qp_regularization_value": HIGHS_REGULARIZATION, "time_limit": "time_limit",
}  # fmt: skip
SCS = {"eps_abs": "eps", "eps_rel": "eps", "max_iters": "max_iter", "time_limit_secs": "time_limit"}
QPALM = {
    "eps_abs": "eps", "eps_rel": 0.0, "eps_abs_in": 1.0, "eps_rel_in": 0.0, "eps_prim_inf": 1e-11,
    "eps_dual_inf": 1e-11, "max_iter": "max_iter", "inner_max_iter": "max_iter", "time_limit": "time_limit",
}  # fmt: skip
CVXOPT = {"feastol": "eps", "abstol": "gap", "reltol": "gap", "maxiters": "max_iter"}
ECOS = {"feastol": "eps", "abstol": "gap", "reltol": "gap", "max_iters": "max_iter"}
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
    "tol_feas": "eps", "tol_gap_abs": "gap", "tol_gap_rel": "gap", "max_iter": "max_iter",
    "collect_stats": True,
}  # fmt: skip
PYQPMAD = {"tolerance": "eps", "max_iter": "max_iter"}
QPAX = {"solver_tol": "eps"}
JAXOPT = {"tol": "eps", "maxiter": "max_iter"}
# RELTOL limits residuals, ABSTOL the gap.
QPSWIFT = {"RELTOL": "eps", "ABSTOL": "gap", "MAXITER": "max_iter"}
QPOASES = {"max_wsr": "max_iter", "time_limit": "time_limit", "terminationTolerance": "eps"}
SIP = {"eps_abs": "eps", "eps_rel": 0.0, "max_iterations": "max_iter", "time_limit": "time_limit"}

CVXOPT_BEHAVIOUR = Behaviour(
    "1.3.3", "lower", conflict=1.0, offset=0.4, repeated="raises", contradictory="wrong", convex_on_rows="raises",
    saddle="right",
    unbounded="wrong", infeasible_x="raises", far_bound=1e16, small_part=0.9, notes={
    "infinite": "qpsolvers passes infinite bounds as 1e10. An unbounded program ends there as solved."},
)  # fmt: skip
ADMM = "Stellato et al. 2020, OSQP: an operator splitting solver for quadratic programs"
BACKENDS: tuple[Backend, ...] = (
    Backend("osqp", ("osqp",), "osqp", "operator splitting with polishing", ADMM,
            call=native.call_osqp, max_iter=100_000, starts=True, stoppable=True,
            interrupts=True,
            behaviour=Behaviour("1.1.3", conflict=1e-4, start="x and y", saddle="raises", infeasible_x="2143289344",
                linear_term=4e-5, second_solve="other", time_limit="with set-up", notes={
                "memory": "An object keeps its step size of earlier solves, also with warm_starting=False.",
                "kept_y": "A start x without y keeps y of the last solve."})),
    Backend("clarabel", ("clarabel",), "clarabel", "interior point, homogeneous embedding",
            "Goulart, Chen 2024, Clarabel", call=native.call_clarabel, max_iter=200, stoppable=True,
            behaviour=Behaviour("0.11.1", conflict=1e-8, offset=0.5, saddle="right", infeasible_x="0", far_bound=1e10,
                small_part=40.0,
                second_solve="same", time_limit="without set-up")),
    Backend("piqp", ("qpsolvers", "piqp"), "piqp", "proximal interior point",
            "Schwan, Jiang, Kuhn, Jones 2023, PIQP", settings=PROXIMAL, max_iter=250, prefers_dense=True,
            behaviour=Behaviour("0.7.0", conflict=1e-8, offset=0.01, saddle="right", infeasible_x="0", far_bound=1e9,
                small_part=2.0,
                second_solve="same", notes={
                "sparse": "With sparse arrays, a linear program is not solved that it solves with dense arrays.",
                "unsorted": "If the indices of a sparse P are not sorted, a solvable program is not solved."})),
    Backend("proxqp", ("qpsolvers", "proxsuite"), "proxsuite", "proximal augmented Lagrangian",
            "Bambade et al. 2022, ProxQP", settings=PROXIMAL | {"rho": PROXQP_PROXIMAL_WEIGHT},
            prefers_dense=True, starts=True,
            behaviour=Behaviour("0.8.0", conflict=1e-5, start="x, y and z", singular="wrong", saddle="wrong",
                infeasible_x="0",
                linear_term=0.1, second_solve="other", notes={
                "false_infeasible": "A solvable program with a singular P can be reported as primal infeasible. With "
                    "rho=0.1 it is not.",
                "dense_triangle": "This holds for a sparse P. Of a dense P, the lower triangle is read instead.",
                "crossed_bounds": "Bounds of a variable that exclude each other (lb > ub) are reported as solved."})),
    Backend("qpalm", ("qpsolvers", "qpalm"), "qpalm", "proximal augmented Lagrangian, semismooth Newton",
            "Hermans, Themelis, Patrinos 2022, QPALM", settings=QPALM, stoppable=True,
            behaviour=Behaviour("1.3.0", conflict=1e-4, offset=0.003, start="x and y", saddle="wrong",
                infeasible_x="0", linear_term=0.0,
                smallest=1e-5, second_solve="other")),
    Backend("daqp", ("qpsolvers", "daqp"), "daqp", "dual active set", "Arnström, Bemporad, Axehill 2022, DAQP",
            settings=DAQP, dense=True, starts=True, stoppable=True,
            behaviour=Behaviour("0.11.0", "all", "x", conflict=1.0, contradictory="wrong", convex_on_rows="not found",
                linear_term=0.03, second_solve="same", time_limit="without set-up", notes={
                "slice": "A P that is a slice of a larger array is read as if it was contiguous, and a wrong point is "
                    "reported as optimal.",
                "flag": "Contradictory equalities end with its exit flag -6, which qpsolvers reports as solved."})),
    Backend("highs", ("qpsolvers", "highspy"), "highspy", "null-space active set", "Huangfu, Hall 2018, HiGHS",
            settings=HIGHS, max_iter=100_000, stoppable=True, noisy=True,
            behaviour=Behaviour("1.16.0", "lower", conflict=1e-8, offset=0.0, convex_on_rows="not found",
                infeasible_x="0", smallest=1e-4,
                far_bound=1e15, second_solve="same", notes={
                "free_row": "A free row does not avoid the zeros below 1e-4; q and bounds multiplied by 1024 do."})),
    Backend("scs", ("qpsolvers", "scs"), "scs", "operator splitting, homogeneous embedding",
            "O'Donoghue 2021, SCS 3", settings=SCS, max_iter=100_000, stoppable=True,
            interrupts=True,
            behaviour=Behaviour("3.3.1", conflict=1e-4, offset=10.0, start="x, y and s", saddle="raises",
                infeasible_x="nan", linear_term=3e-5,
                small_part=0.8, second_solve="other", time_limit="without set-up", notes={
                "start": "A solution as start ends the solve at once if x, y and s are given, not with fewer of them.",
                "memory": "An object keeps its scale of earlier solves, also with warm_start=False."})),
    Backend("quadprog", ("qpsolvers", "quadprog"), "quadprog", "dual active set, positive definite A",
            "Goldfarb, Idnani 1983", dense=True, finite=True,
            behaviour=Behaviour("0.1.14", singular="raises", convex_on_rows="raises", saddle="raises",
                unbounded="raises", linear_term=None)),
    Backend("cvxopt", ("qpsolvers", "cvxopt"), "cvxopt", "interior point", "Vandenberghe 2010, CVXOPT",
            settings=CVXOPT, max_iter=100, finite=True,
            behaviour=CVXOPT_BEHAVIOUR),
    Backend("kvxopt", ("qpsolvers", "kvxopt"), "kvxopt", "interior point, CVXOPT with more factorisations",
            "Vandenberghe 2010, CVXOPT", settings=CVXOPT, max_iter=100, finite=True,
            behaviour=replace(CVXOPT_BEHAVIOUR, version="1.3.3.3")),
    Backend("ecos", ("qpsolvers", "ecos"), "ecos", "interior point for second-order cones",
            "Domahidi, Chu, Boyd 2013, ECOS", settings=ECOS, max_iter=100,
            dense=True, finite=True, interrupts=True,
            behaviour=Behaviour("2.0.14", "lower", conflict=1e-8, offset=1.0, singular="raises",
                convex_on_rows="raises", saddle="raises",
                unbounded="raises", infeasible_x="0", linear_term=None, far_bound=1e4, small_part=None)),
    Backend("gurobi", ("qpsolvers", "gurobipy"), "gurobipy", "interior point and simplex", "Gurobi manual",
            settings=GUROBI, min_tolerance=1e-9, stoppable=True, noisy=True,
            behaviour=Behaviour("13.0.3", "mean", conflict=1e-6, offset=0.0, saddle="right", linear_term=0.0,
                far_bound=1e12)),
    Backend("copt", ("qpsolvers", "coptpy"), "coptpy", "interior point", "COPT manual",
            settings=COPT, min_tolerance=1e-9, stoppable=True, noisy=True,
            behaviour=Behaviour("8.0.7", "mean", conflict=1e-6, convex_on_rows="not found", unbounded="wrong")),
    Backend("mosek", ("qpsolvers", "cvxopt", "mosek"), "cvxopt mosek", "interior point", "MOSEK manual", noisy=True,
            finite=True),
    Backend("qtqp", ("qpsolvers", "qtqp"), "qtqp", "primal-dual interior point", "QTQP manual",
            settings=QTQP, max_iter=200, finite=True,
            behaviour=Behaviour("0.0.7", "none", offset=0.5, repeated="not found", convex_on_rows="raises",
                saddle="raises",
                infeasible_x="nan", far_bound=1e12, small_part=30.0)),
    Backend("pyqpmad", ("qpsolvers", "pyqpmad"), "pyqpmad", "dual active set, positive definite A",
            "Goldfarb, Idnani 1983", settings=PYQPMAD, min_tolerance=1e-12, dense=True, finite=True,
            behaviour=Behaviour("1.4.1", "lower", singular="not found", convex_on_rows="not found", linear_term=None,
                fixed_multiplier=0.0, notes={"in_place": "It overwrites a P that is stored by columns."})),
    Backend("qpax", ("qpsolvers", "qpax"), "qpax", "interior point in JAX", "Tracy, Manchester 2024, qpax",
            settings=QPAX, min_tolerance=1e-12, max_iter=30, dense=True, noisy=True, jax=True,
            finite=True,
            behaviour=Behaviour("0.1.4", "mean", conflict=1.0, repeated="wrong", contradictory="wrong",
                convex_on_rows="not found",
                saddle="right", infeasible_x="0", linear_term=0.5, far_bound=1e3, small_part=None, notes={
                "nan": "With two equal equality rows, NaN is reported as solved."})),
    Backend("jaxopt_osqp", ("qpsolvers", "jaxopt"), "jaxopt", "operator splitting in JAX", ADMM,
            settings=JAXOPT, dense=True, noisy=True, jax=True, finite=True,
            behaviour=Behaviour("0.8.5", "all", conflict=1e-3, offset=None, convex_on_rows="not found",
                saddle="wrong", infeasible_x="0",
                linear_term=8e-7, smallest=1e-2)),
    Backend("hpipm", ("qpsolvers", "hpipm_python"), "hpipm_python (github.com/giaf/hpipm)", "interior point",
            "Frison, Diehl 2020, HPIPM", dense=True),
    Backend("nppro", ("qpsolvers", "nppro"), "nppro", "active set", "NPPro manual", dense=True),
    Backend("pdhcg", ("qpsolvers", "pdhcg"), "pdhcg", "primal-dual hybrid conjugate gradient",
            "Huang et al. 2024, PDHCG", noisy=True),
    Backend("qpoases", ("qpsolvers", "qpoases"), "qpoases", "online active set",
            "Ferreau et al. 2014, qpOASES", settings=QPOASES, dense=True, stoppable=True,
            behaviour=Behaviour("3.2", "all", conflict=1e-10, saddle="wrong", infeasible_x="0.021276596", notes={
                "columns": "Dense rows that are stored by columns are read as rows, and a wrong point is reported as "
                    "solved."})),
    Backend("qpswift", ("qpsolvers", "qpSWIFT"), "qpSWIFT", "interior point",
            "Pandala, Ding, Park 2019, qpSWIFT", settings=QPSWIFT, max_iter=100, dense=True, finite=True,
            behaviour=Behaviour("1.0.0", "all", repeated="raises", contradictory="raises", saddle="right",
                infeasible_x="0", far_bound=1e16)),
    Backend("sip", ("qpsolvers", "sip_qp_python"), "sip-qp-python", "interior point", "SIP manual",
            settings=SIP, max_iter=500, stoppable=True,
            behaviour=Behaviour("0.0.2", "none", conflict=1e-8, saddle="right", infeasible_x="0")),
    Backend("clarabel_cone", ("clarabel",), "clarabel",
            "interior point on the convex relaxation of friction, second-order cones",
            "Goulart, Chen 2024, Clarabel; Tasora, Anitescu 2011 for the relaxation",
            call=native.call_clarabel, max_iter=200, stoppable=True, cones=True),
)  # fmt: skip


#: Programs of the probes, by the field of `Behaviour` that holds the result.
PROBE_PROGRAMS = {
    "triangle": "min x.P x/2 - x1 - x2 with |x| <= 9 and P = [[2, 1], [0, 2]], then P = [[2, 0], [1, 2]]",
    "repeated": "min |x|²/2 with the row 0.3 x1 + 0.7 x2 = 1 twice",
    "contradictory": "min |x|²/2 with x1 + x2 = 1 and x1 + x2 = 2",
    "unbounded": "min x1²/2 - x2 with x >= 0 (unbounded)",
    "singular": "min x1²/2 - x2 with |x1| <= 5 and 0 <= x2 <= 1",
    "convex_on_rows": "min x1²/2 - x2²/2 with x2 = 0.5 and |x| <= 9",
    "saddle": "min x1²/2 - x2²/2 with |x1| <= 1 and -1 <= x2 <= 2",
    "linear_term": "min x1²/2 - 1e-7 x2 with 0 <= x <= 1",
    "small_part": "min x1² + x1 x2 + x2² - 3e6 (x1 + x2) + x3² + x3 x4 + x4² - x3 + x4 with x >= 0",
    "smallest": "min |x|²/2 - e (x1 + 2 x2) with |x| <= 1",
    "far_bound": "min x1² + x1 x2/2 + x2²/2 - x1 - x2 with x1 + x2 <= 1 and |x| <= B",
    "fixed_multiplier": "min |x|²/2 with 1 <= x1 <= 1 and -2 <= x2 <= -2",
    "infeasible_x": "min |x|²/2 with x1 <= -1 and x1 >= 1",
    "conflict": "min |x|²/2 with x1 + x2 = 1 and x1 + x2 = 1 + d, which contradict each other",
    "offset": "min |x|²/2 - (1e8 + 0.3) (x1 + x2) with 1e8 <= x <= 1e8 + 1",
    "second_solve": "min x.P x/2 + q.x with |A x| <= 1, with drawn P (30, 30), q (30) and A (20, 30)",
}
VERDICT_PHRASES = {
    "right": "is solved",
    "wrong": "is reported as solved at a wrong point",
    "not found": "is not solved",
    "raises": "raises an exception",
}
TRIANGLE_SENTENCES = {
    "upper": "Only the upper triangle of P is read.",
    "lower": "Only the lower triangle of P is read.",
    "mean": "The mean of both triangles of P is used.",
    "all": "Both triangles of P are used, and an asymmetric P gives a wrong answer.",
    "none": "An asymmetric P is rejected.",
}
SECOND_SOLVE_PHRASES = {"same": "the same bits", "other": "other bits"}
#: Remedy of the adapter for an observation, by field of `Behaviour`.
ADAPTER_REMEDIES = {
    "triangle": "Both triangles of P are passed equal in every bit, or the one that is read.",
    "start": "A start is passed to osqp, proxqp and daqp.",
    "linear_term": "Programs are scaled to numbers near 1, and a Newton step removes the error of the tolerance.",
    "small_part": "Programs are scaled to numbers near 1, and a Newton step removes the error of the tolerance.",
    "smallest": "Programs are scaled to numbers near 1.",
    "far_bound": "Far bounds are left out in the first call, and are checked at the solution.",
    "fixed_multiplier": "Bounds are passed as rows.",
    "infeasible_x": "A claim of infeasibility counts only with a certificate.",
    "conflict": "The judge contradicts such a claim at smaller tolerances than d.",
    "offset": "A Newton step removes the error of the tolerance.",
    "second_solve": "Each call makes a new object.",
    "contradictory": "The judge contradicts a wrong claim about contradictory rows.",
    "unbounded": "The judge contradicts a wrong claim about an unbounded program.",
}


def describe_behaviour(behaviour: Behaviour) -> dict[str, str]:
    """Return a sentence for each field and each note of an observed behaviour."""
    b = behaviour
    sentences = {
        "triangle": TRIANGLE_SENTENCES[b.triangle],
        "start": f"A start is used: {b.start}." if b.start else "No start is used.",
    }
    for name in ("repeated", "contradictory", "unbounded", "singular", "convex_on_rows", "saddle"):
        sentences[name] = f"The program {PROBE_PROGRAMS[name]} {VERDICT_PHRASES[getattr(b, name)]}."
    values = ("linear_term", "x2", 1.0), ("small_part", "x3", 0.5), ("offset", "x1 - 1e8", 0.3)
    for name, symbol, right in values:
        value = getattr(b, name)
        result = "is not solved" if value is None else f"gives {symbol} = {value:g}; {right:g} is right"
        sentences[name] = f"The program {PROBE_PROGRAMS[name]} {result}."
    size, far, found = b.smallest, b.far_bound, {"none": "is None", "raises": "is lost by an exception"}
    sentences["smallest"] = (
        f"Solutions of about {size:g} and below are wrong."
        if size
        else "Solutions down to 1e-10 are returned within 1 %."
    )
    sentences["far_bound"] = (
        f"Inactive bounds of {far:g} and above prevent a solution."
        if far < math.inf
        else "Inactive bounds up to 1e19 do no harm."
    )
    sentences["fixed_multiplier"] = f"A fixed variable with a multiplier of -1 has {b.fixed_multiplier:g}."
    sentences["infeasible_x"] = (
        f"After the program {PROBE_PROGRAMS['infeasible_x']}, x {found.get(b.infeasible_x, 'holds ' + b.infeasible_x)}."
    )
    if b.conflict:
        result = f"is reported as solved up to d = {b.conflict:g}"
        sentences["conflict"] = f"The program {PROBE_PROGRAMS['conflict']}, {result}."
    if b.second_solve:
        sentences["second_solve"] = (
            f"A second solve of one object without a start gives {SECOND_SOLVE_PHRASES[b.second_solve]}."
        )
    if b.time_limit:
        sentences["time_limit"] = f"Its time limit is measured {b.time_limit}."
    return sentences | dict(b.notes)


def describe_backend(name: str) -> tuple[list[str], list[str]]:
    """Return sentences on the behaviour of the backend `name` alone, and on the measures of its adapter."""
    behaviour = _get_behaviour(name)
    if behaviour is None:
        return [], []
    usual = Behaviour(behaviour.version)
    measures = [
        text for key, text in ADAPTER_REMEDIES.items() if getattr(behaviour, key) != getattr(usual, key)
    ]
    return [*describe_behaviour(behaviour).values()], [*dict.fromkeys(measures)]


def explain_contradicted_claim(name: str, problem: Problem, status: Status) -> str:
    """Return the observations on the backend `name` that fit a claim that the judge contradicts; "" without one.

    Parameters
    ----------
    name : str
        Name of a solver.
    problem : Problem
    status : Status
        The claim.
    """
    behaviour = _get_behaviour(name)
    if behaviour is None:
        return ""
    sentences = describe_behaviour(behaviour)
    if status is Status.INFEASIBLE:
        keys = ["false_infeasible" if "false_infeasible" in sentences else "infeasible_x"]
    else:
        bounds = np.abs(
            [problem.cones.lower, problem.cones.upper] if problem.qp is None else problem.qp.target
        )
        far = bounds[np.isfinite(bounds)].max(initial=0.0)
        is_affected = {
            "far_bound": far >= behaviour.far_bound,
            "linear_term": problem.has_singular_program and behaviour.linear_term != 1.0,
            "unbounded": problem.has_singular_program and behaviour.unbounded == "wrong",
            "contradictory": behaviour.contradictory == "wrong",
            "small_part": behaviour.small_part != 0.5,
            "smallest": behaviour.smallest > 0.0,
        }
        keys = [key for key, is_true in is_affected.items() if is_true][:2]
    texts = " ".join(sentences[key] for key in keys)
    return f"observed with {name} {behaviour.version}: {texts}" if texts else ""


def get_observed_version(name: str) -> str:
    """Return the version of the backend `name` with which its behaviour was observed; "" if it was not."""
    behaviour = _get_behaviour(name)
    return "" if behaviour is None else behaviour.version


def _get_behaviour(name: str) -> Behaviour | None:
    """Return the observed behaviour of a backend; `clarabel_cone` has the entry of `clarabel`."""
    name = name.removesuffix("_cone")
    return next((b.behaviour for b in BACKENDS if b.name == name), None)


def _make_spec(backend: Backend) -> SolverSpec:
    """Build the registry entry of a backend."""
    return SolverSpec(
        name=backend.name,
        factory=partial(QPSolver, backend),
        laws=frozenset({"linear", "lcp", *(["cone"] if backend.cones else [])}),
        # Under the law "cone", friction boxes are written as one row for each edge of the cone, which makes A singular.
        box_friction_laws=frozenset() if backend.needs_definite else frozenset({"cone"}),
        resumable=False,
        external=True,
        impulse=backend.starts,
        singular_programs=not backend.cones,
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
