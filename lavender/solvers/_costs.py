"""What each candidate of `auto` would cost on a problem, counted from its structure.

    sweeps         START + n (SWEEP work + SWEEP_ROW m)         work: multiply-adds of one sweep (`Data.work`)
    factorising    START + f (STEP + ROW m + rate flops)        flops: multiply-adds of one factor, f: how many

The rates below are nanoseconds of one core, the same constants on every machine, so that a choice depends on the
problem alone: no clock is read. `lavender bench auto` measures what is lost by them; a rate that is off by
two moves a choice only where two candidates cost about the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lavender.problem import LAWS, Problem
from lavender.registry import FEW
from lavender.solvers._accelerated import sweep_work
from lavender.solvers._factor import DENSE_SHARE, SMALL_BAND, PanelsLU, choose, filled_cost, panels_cost
from lavender.solvers._islands import block_bodies
from lavender.solvers._newton.general import factor_flops
from lavender.solvers._newton.systems import (
    DENSE_FILL,
    PANELS,
    MatrixSystem,
    System,
    make_system,
)
from lavender.solvers._sweeping import reads_whitened
from lavender_ext.core import assemble
from lavender_ext.factor import graph
from lavender_ext.pivot.principal import bandwidth

__all__ = ["Costs", "Exact", "general_cost", "is_loose", "islands_cost"]

# Rates [ns], from times and counts of drawn problems that `lavender bench auto --out` writes.
# For each multiply-add of a sweep, mixing included; the cone law solves each contact exactly.
SWEEP = {"linear": 1.05, "lcp": 1.0, "coulomb": 0.65, "cone": 1.25}
SWEEP_ROW = 5.0  # for each row of a sweep
SWEEP_START = 80e3  # what Python needs for sweeps,
LOOK = 20e3  # for each look at their residual,
ROWS_OF_A = 80e3  # and where they run over rows of A that must be formed first
START = {"direct": 60e3, "newton": 300e3, "lemke": 500e3}  # of a call, before anything is factored
STEP = {"direct": 10e3, "newton": 35e3}  # beside each factor
ROW = 30.0  # for each row beside each factor of `direct`,
NEWTON_ROW = {"linear": 150.0, "lcp": 150.0, "cone": 300.0, "coulomb": 300.0}  # and of `newton`
BODIES_START, BODIES_STEP, BODIES_ROW = 150e3, 8e3, 190.0  # of `newton` over bodies under a convex law
DENSE, DENSE_ENTRY = 0.03, 3.0  # for each multiply-add of a dense factor, and for each entry of its matrix
BAND = 0.4  # of a band's
# `direct` on few bounded rows, in compiled code, with one shift where A is singular: a call and its rounds, each a row
# and a factor.
FEW_START, FEW_ROUNDS = 45e3, 9.0
FEW_PIVOT = 2e3  # of `lemke`, of whose time a call is most there
HASTY_KEY = (
    "direct False"  # `Exact.key` of that (HASTY of `_at_once.py`): it gives up where one shift is stuck
)
VELOCITY_KEY = "newton velocity"  # `Exact.key` of newton over generalised velocities
BLOCK, PANEL = 0.35, 0.2  # of one over bodies, by block rows and by panels
SPARSE = 100.0  # for each nonzero of a sparse factor's matrix,
SPARSE_ROWS = 1000.0  # as many times more as it has thousands of rows: fill grows with the size
PIVOT, PIVOT_ENTRY = 60e3, 0.5  # of each pivot of lemke, and for each entry of its tableau
# Newton over generalised velocities: a call, for each row beside each factor, and each multiply-add of the dense
# factor of an island, most of whose entries are nought unless every contact is inside its cone.
GENERAL_START = 60e3
GENERAL_ROW = {"linear": 40.0, "lcp": 100.0, "cone": 140.0, "coulomb": 400.0}
GENERAL = {"linear": 0.1, "lcp": 0.06, "cone": 0.06, "coulomb": 0.02}
GENERAL_SOFT = (
    1e-6  # of d: the least softness of a row without a proximal term; where all are soft, one factor ends it
)
# The same under Coulomb's law where soft rows are many: a step, for each row in it, and steps as they usually are (8 to
# 33 on flexes of 1,800 to 10,200 rows; what few rows cost above holds their tails, too).
MANY_STEP, MANY_ROW, MANY_COUNT = 15e3, 110.0, 10.0
MANY_ROWS = 1000  # rows beyond which that is counted
GENERAL_FIRST = 0.6e6  # ns of it up to which nothing else is looked at first
FORM = 1.0  # of each multiply-add of Y Y^T
WITH_A = 2.0  # times what A costs to form, that others cost with their first factor of it
FORMED_ROWS = 6.0  # of each entry of A over bodies
FORMED_START, FORMED = 60e3, 2.0  # of A formed of J and M, and of each of its entries
# The same under friction, before which sweeps that end there are not given up.
RUBBED_START, RUBBED = 280e3, 6.0
ADMM_START, ADMM_ROW, ADMM_ENTRY = (
    500e3,
    40.0,
    0.15,
)  # a call; of each iteration for each row and each entry of L

FIRST_LOOK, LAST_LOOK = 16, 64  # sweeps before the first look at the residual: so many at least and at most,
LOOKED = 60e3  # ns, or as cost so much: a look and a cut in the sweeps are not free

GLANCED = 200e3  # ns of a first look at sweeps that may come before anything else is found out
GLANCE = 0.35  # share of a finite solver's cost for which a first look at sweeps is always worth it

# Factorisations to expect, by law: medians over drawn problems. Friction has a long tail.
DIRECT = {"linear": 1.5, "lcp": 6.0}
NEWTON = {"linear": 2.0, "lcp": 9.0, "cone": 14.0, "coulomb": 8.0}
NEWTON_DECADE = {"linear": 0.0, "lcp": 0.0, "cone": 1.5, "coulomb": 0.0}  # and more for each decade above six
PER_ROW = {
    "linear": 0.0,
    "lcp": 0.0,
    "cone": 0.0,
    "coulomb": 1.0 / 40.0,
}  # more of them: contacts change their side
TAIL_LEAST, TAIL_TIME = 6, 2e6  # of them at least under Coulomb's law, else as many as take so long [ns]
BUDGET = {"linear": 2.0, "lcp": 2.0, "cone": 2.0, "coulomb": 1.2}  # times as many that its first turn has
TAIL = {"linear": 2, "lcp": 10, "cone": 40, "coulomb": 24}  # more that are granted before another is asked
MOST = 30.0  # of what rows add
GENERAL_COUNT = {"linear": 5.0, "lcp": 5.0, "cone": 12.0, "coulomb": 30.0}  # over generalised velocities
ADMM_COUNT, ADMM_FACTORS = 80.0, 2.0  # iterations to six decades where it gets there, and how often rho moves
# Share of problems on which it does, over bodies and over rows of A: of candidates that may fail, those of least cost
# for each chance come first.
ADMM_LUCK_BODIES, ADMM_LUCK = 0.15, 0.4
ADMM_FILL = 6.0  # entries of L for each of A
DIRECT_ROUNDS = 40  # of `direct` on bounded rows that are granted before another is asked
AT_REST = 8.0  # of faces on faces, most of whose rows hold
UNSYMMETRIC = 2.0  # LU against Cholesky, where friction or A asks for it
SINGULAR = 6.0  # times as many of `direct` where A is singular and one shift does not end it,
STUCK = 10.0  # and where exchanges were stuck

# Sweeps to expect before anything was swept, to six decades: median over drawn problems, and where the same weight
# rests on more points than are needed.
SWEEPS, SWEEPS_REDUNDANT = 60.0, 400.0

ISLAND = 400e3  # what Python takes for an island of its own
# Islands in compiled code: a call, as it showed in `wild` with them and without; for each island beside its solve, and
# for each of its rows (`python benchmarks/bench_islands.py`).
TOGETHER, TOGETHER_ISLAND, TOGETHER_ROW = 200e3, 1e3, 60.0
BAND_AT_ONCE = 4e6  # ns of `direct` on a narrow band up to which nothing else is looked at
LU_ROWS = 300  # of a linear system that is not symmetric, up to which sweeps are looked at before its factor
FEW_JOINTS = 300  # rows up to which a linear system is not looked at more closely
NARROW_ENTRIES = 12  # of A in a row up to which a narrow band is looked for
NARROW = 40  # half bandwidth up to which a band is what `direct` takes
TREE = 1.05  # neighbours of a body, in the mean, up to which bodies form trees
LOOKS = 4  # at so many sweeps
# Steps that it then has, beside those that are expected of each island but one; under Coulomb's law, where it ends soon
# or late, as many as in one compiled call.
GENERAL_STEPS = {"linear": 256, "lcp": 256, "cone": 256, "coulomb": 64}
# All that `general_first` reads, for a compiled loop over many problems.
GENERAL_GATE = (
    GENERAL_START,
    tuple(GENERAL_ROW[law] for law in LAWS),
    tuple(GENERAL[law] for law in LAWS),
    GENERAL_FIRST,
    FORM,
    tuple(GENERAL_COUNT[law] for law in LAWS),
)
# Steps over generalised velocities that are granted beside twice those expected.
GENERAL_TAIL = 60
ADMM_GENERAL = 1500  # rows up to which A of J and M, whose entries are not known, is formed for `admm`
LEMKE_ROWS = 1000  # beyond, a dense tableau of 8 MB and more


@dataclass(frozen=True)
class Exact:
    """A finite solver, what it is expected to cost [ns], and its budget: twice the iterations expected."""

    name: str
    cost: float
    limit: int
    options: tuple[tuple[str, Any], ...] = ()  # that the solver is made with
    once: float = np.inf  # ns, with the first factorisation alone
    each: float = 0.0  # ns of one more iteration, 0 where nobody asks

    @property
    def key(self) -> str:
        """Name and options: what gave up once is known by it."""
        return " ".join([self.name, *(str(value) for _, value in self.options)])


def general_cost(problem: Problem, largest: int) -> float:
    """Newton over generalised velocities, `largest` of them in one island [ns]."""
    factor = GENERAL[problem.law] * factor_flops(problem, largest)
    return GENERAL_START + general_count(problem) * (GENERAL_ROW[problem.law] * problem.m + factor)


def general_count(problem: Problem) -> float:
    """Its steps, as expected: one where rows are free and soft, since then it has no proximal term."""
    if problem.law == "linear" and problem.m:
        assert problem.compliance is not None
        if np.all(problem.compliance >= GENERAL_SOFT * problem.d):
            return 1.0
    return GENERAL_COUNT[problem.law]


def sweep_cost(problem: Problem) -> float:
    """Of one sweep [ns]."""
    return SWEEP[problem.law] * sweep_work(problem) + SWEEP_ROW * problem.m


def first_look(per: float) -> int:
    """Sweeps, each of cost `per` [ns], before their residual is looked at."""
    return int(min(max(FIRST_LOOK, LOOKED / per), LAST_LOOK))


def general_first(problem: Problem, largest: int) -> bool:
    """Newton over generalised velocities costs next to nothing, or less than only to form A = Y Y^T for the others.

    The columns of Y have n_c entries: sum n_c^2 >= (sum n_c)^2 / nv multiply-adds. Without friction, whose steps are
    less certain, what Python needs for it and each of its entries counts, of a linear system what `direct` then costs
    as well, under the cone law what sweeps usually cost. Or, of many soft rows under Coulomb's law, more than
    velocities, less than sweeps usually do where rows depend on each other.
    """
    assert problem.generalized is not None
    cost = general_cost(problem, largest)
    if cost <= GENERAL_FIRST:
        return True
    entries = 0.5 * (problem.metric.work - 4.0 * problem.m)
    if cost <= FORM * entries * entries / max(1, problem.generalized.nv):
        return True
    if problem.law == "linear" and cost <= joints_formed(problem):
        return True
    if problem.law == "lcp" and cost <= formed_cost(problem):
        return True
    # Under the cone law sweeps end few problems that it does not, and those late.
    if problem.law == "cone" and cost <= WITH_A * formed_cost(problem) + SWEEPS * sweep_cost(problem):
        return True
    if (
        problem.law != "coulomb"
        or problem.m <= max(MANY_ROWS, problem.generalized.nv)
        or not np.all(problem.compliance)
    ):
        return False
    step = MANY_STEP + MANY_ROW * problem.m + GENERAL["coulomb"] * factor_flops(problem, largest)
    return GENERAL_START + MANY_COUNT * step <= SWEEPS_REDUNDANT * sweep_cost(problem)


def general_steps(problem: Problem, islands: int) -> int:
    """Steps that Newton's method over generalised velocities has before another solver is asked."""
    law = problem.law
    if law == "coulomb":
        return GENERAL_STEPS[law]
    return GENERAL_STEPS[law] + int(GENERAL_COUNT[law]) * (islands - 1)


def is_glanced(problem: Problem, per: float) -> bool:
    """A first look at sweeps, each of cost `per` [ns], comes before anything else is found out."""
    if problem.law == "linear":
        # LU of few rows costs as much as hundreds of sweeps, and more where they depend on each other.
        return not problem.is_symmetric and problem.m <= LU_ROWS
    if problem.m <= FEW:
        return not factors_at_once(problem)
    if is_redundant(problem) or factors_at_once(problem):
        return False
    look, most = FIRST_LOOK * per, GLANCED
    if look > most and problem.law == "lcp" and not _may_be_narrow(problem):
        # Whether A is symmetric, and what a factor of it takes, is not asked for before.
        most += GLANCE * (formed_cost(problem) + finite_least(problem, True))
    return look <= most


def _may_be_narrow(problem: Problem) -> bool:
    """Its A is a narrow band in the order of elimination, or has no more entries than one where nobody has looked."""
    if problem.generalized is not None:
        return False
    kept = problem.derived.factor
    if kept is not None:
        return bool(kept[0] == "band")
    if problem.rows is not None:
        return True
    m, entries = problem.m, len(problem._compressed[1])
    return entries <= (2 * NARROW + 1) * m and (
        entries < DENSE_SHARE * m * m or max(bandwidth(*problem._compressed[:2])) <= SMALL_BAND
    )


def factors_at_once(problem: Problem) -> bool:
    """Bounded rows, few or of a symmetric narrow band that is found in no time: `direct`, without a look."""
    if problem.law != "lcp":
        return False
    m = problem.m
    if m <= FEW:
        return True
    if problem.generalized is not None or is_redundant(problem):
        return False
    if problem.rows is not None and problem.rows.n_bodies:
        width = graph.body_spread(problem.cones.ptr, block_bodies(problem), problem.rows.n_bodies) + 1
        if width <= NARROW:
            return _is_hasty(m, width)
    # Rows of bodies may be narrow in another order, which that of A tells.
    entries = (
        int(assemble.bound(problem.data)[0]) if problem.rows is not None else len(problem._compressed[1])
    )
    if entries > NARROW_ENTRIES * m or not problem.is_symmetric:
        return False
    form, band, _ = choose(problem)
    return form == "band" and _is_hasty(m, band + 1)


def _is_hasty(m: int, width: int) -> bool:
    """A band of m bounded rows so narrow that nothing else is looked at before `direct`."""
    return DIRECT["lcp"] * BAND * m * float(width) ** 2 <= BAND_AT_ONCE


def joints_at_once(problem: Problem) -> bool:
    """A symmetric linear system for `direct`, without a look at what else there is.

    Of few rows; a matrix, whose factor costs less than the one of `newton`; bodies, by the entries that A can have.
    """
    if problem.m <= FEW_JOINTS or problem.matrix is not None:
        return True
    if problem.rows is None or problem.rows.n_bodies == 0:
        return False
    direct = rows_direct(problem)
    start, step, row = newton_rates(problem)
    if direct <= start + NEWTON["linear"] * (step + row * problem.m):
        return True  # whatever the factor of newton costs
    return direct <= Costs(problem, 1e-6).newton_guess


def is_redundant(problem: Problem) -> bool:
    """The same weight rests on more points than the bodies can tell apart, and none of them is soft.

    Faces on faces; sweeps then hardly move it. With Coulomb friction a Newton method suffers as much.
    """
    p = problem
    if p.rows is None or p.law == "coulomb" or p.m <= 6 * p.rows.n_bodies:
        return False
    assert p.compliance is not None
    return not p.compliance.any() and (p.law != "cone" or not is_loose(p))


def finite_least(problem: Problem, symmetric: bool | None = None) -> float:
    """What no finite solver costs less than [ns]; `symmetric`: as if A were, or were not."""
    m = problem.m
    if problem.law == "linear" or (
        problem.law == "lcp" and (m <= FEW or (problem.is_symmetric if symmetric is None else symmetric))
    ):
        if m <= FEW and problem.law == "lcp":
            return few_direct(m)
        width = 3.0 if problem.matrix is None else max(3.0, 0.5 * len(problem._compressed[1]) / m)
        factor = min(BAND * m * width * width, float(dense_factor(m)))
        return START["direct"] + DIRECT[problem.law] * (STEP["direct"] + ROW * m + factor)
    start, step, row = newton_rates(problem)
    return start + NEWTON[problem.law] * (step + row * m)


def few_direct(m: int) -> float:
    """`direct` on so many bounded rows, up to FEW [ns]."""
    return FEW_START + FEW_ROUNDS * (ROW * m + BAND * m**3 / 6.0)


def rows_direct(problem: Problem) -> float:
    """`direct` on joints between bodies, A formed, by panels [ns]."""
    m, entries = problem.m, int(assemble.bound(problem.data)[0])
    factor = panels_cost(entries, m)
    return START["direct"] + FORMED_ROWS * entries + DIRECT["linear"] * (STEP["direct"] + ROW * m + factor)


def joints_formed(problem: Problem) -> float:
    """`direct` on linear rows in generalised coordinates, A formed [ns]; its entries at a guess.

    Rows of A meet in the columns of Y that they share: half of a row's, in the mean.
    """
    m = problem.m
    in_row = 0.5 * (problem.metric.work - 4.0 * m) / max(m, 1)
    entries = int(problem.metric.entries_of_a / max(1.0, 0.5 * in_row))
    factor = min(panels_cost(entries, m), float(dense_factor(m)))
    return formed_cost(problem) + START["direct"] + DIRECT["linear"] * (STEP["direct"] + ROW * m + factor)


def newton_rates(problem: Problem) -> tuple[float, float, float]:
    """Of `newton` [ns]: a call, and beside each factor a step and each row."""
    if problem.rows is not None and problem.rows.n_bodies and problem.law != "coulomb":
        return BODIES_START, BODIES_STEP, BODIES_ROW
    return START["newton"], STEP["newton"], NEWTON_ROW[problem.law]


def formed_cost(problem: Problem) -> float:
    """What A costs before a solver that needs it begins, of J and M that sweeps take as they are [ns]."""
    if problem.generalized is None or not reads_whitened(problem):
        return 0.0
    if problem.law in ("cone", "coulomb"):
        return RUBBED_START + RUBBED * float(problem.metric.entries_of_a)
    return FORMED_START + FORMED * float(problem.metric.entries_of_a)


class Costs:
    """Of one problem; what takes time to find out is found when it is first asked.

    `largest`: velocities of the largest island of a problem in generalised coordinates, 0 where Newton's method has
    no room for so many.
    """

    def __init__(self, problem: Problem, tol: float, largest: int = 0) -> None:
        self.problem, self.largest = problem, largest
        self.decades = float(-np.log10(min(max(tol, 1e-16), 0.1)))
        self.sweep = sweep_cost(problem)
        self.ended = set[str]()  # keys of finite solvers that gave up

    def gave_up(self, key: str) -> None:
        """A finite solver gave up: what was guessed of the others beside it is looked at closely when it is asked."""
        self.ended.add(key)
        self.__dict__.pop("guess", None)
        if key == VELOCITY_KEY:
            self.over_velocities = np.inf
            self.__dict__.pop("least", None)
        if self.__dict__.get("_others_win"):
            del self._others_win
            self.__dict__.pop("exact", None)

    @property
    def cheapest(self) -> float:
        """Of the finite solvers that did not give up [ns]."""
        if self.few_bounded:
            return few_direct(self.problem.m)
        return next((e.cost for e in self.exact if e.key not in self.ended), self.exact[0].cost)

    @property
    def few_bounded(self) -> bool:
        """Few bounded rows: nothing costs less than `direct`, and it did not give up."""
        p = self.problem
        return p.law == "lcp" and p.m <= FEW and p.generalized is None and HASTY_KEY not in self.ended

    def glance(self, sweeps: int) -> float:
        """A first look at so many sweeps [ns]."""
        return SWEEP_START + LOOK + sweeps * self.sweep

    @cached_property
    def redundant(self) -> bool:
        """`is_redundant`."""
        return is_redundant(self.problem)

    @cached_property
    def sweeping(self) -> float:
        """Sweeps to the end as they usually go [ns], before the first of them."""
        n = SWEEPS_REDUNDANT if self.redundant else SWEEPS
        formed = ROWS_OF_A if self.problem.law == "lcp" and self.problem.rows is not None else 0.0
        return SWEEP_START + formed + LOOKS * LOOK + n * self.decades / 6.0 * self.sweep

    @cached_property
    def system(self) -> System:
        """Newton's system, which knows what its factor costs; `newton` takes it over."""
        rows = self.problem.rows
        return make_system(self.problem, "impulse" if rows is None or rows.n_bodies == 0 else "velocity")

    @cached_property
    def least(self) -> float:
        """What no finite solver costs less than [ns]."""
        return min(self.formed + finite_least(self.problem), self.over_velocities)

    @cached_property
    def guess(self) -> float:
        """What the cheapest finite solver hardly costs less than [ns], without looking closer."""
        p = self.problem
        if self.few_bounded:
            return few_direct(p.m)
        if not self._direct_takes:
            start, step, row = newton_rates(p)
            most = start + self._newton_count * (step + row * p.m)  # whatever the factor costs
            found = most if most > self.sweeping else self.newton_guess
        else:
            m = p.m
            width = self._width(m) if p.rows is not None else 0.5 * p.metric.work / max(m, 1)
            stuck = self.redundant or any(key.startswith("direct") for key in self.ended)
            times = SINGULAR if p.law == "lcp" and stuck else 1.0
            found = min(self.newton_guess, self._direct(BAND * m * max(3.0, width) ** 2, times))
        return min(self.formed + found, self.over_velocities)

    @cached_property
    def formed(self) -> float:
        """`formed_cost`."""
        return formed_cost(self.problem)

    @cached_property
    def over_velocities(self) -> float:
        """Newton over generalised velocities [ns]; inf where it has no room, or none are given."""
        return general_cost(self.problem, self.largest) if self.largest else np.inf

    @cached_property
    def exact(self) -> list[Exact]:
        """The finite solvers that take this problem, cheapest first."""
        if self.problem.cones.has_round:
            return [e for e in self._others if e.name == "newton"] or [Exact("newton", np.inf, 0)]
        # Newton's system is made only where it may be the cheapest: it costs as much as a small solve.
        cost = self.newton_guess if self._others_win else self._newton(newton_factor(self.system))
        p = self.problem
        form = () if p.generalized is None else (("form", "impulse"),)
        limit = int(BUDGET[p.law] * self._newton_count)
        start = newton_rates(p)[0]
        each = (cost - start) / self._newton_count
        # To ask another and to come back costs time, too: small problems go on for longer.
        limit += (
            TAIL[p.law] if p.law != "coulomb" else int(min(TAIL[p.law], max(TAIL_LEAST, TAIL_TIME / each)))
        )
        once = self.formed + start + each
        newton = Exact("newton", self.formed + cost, limit, options=form, once=once, each=each)
        return sorted([*self._others, newton], key=lambda e: e.cost)

    @cached_property
    def _others(self) -> list[Exact]:
        p = self.problem
        found = []
        if self._direct_takes:
            rounds = 0 if p.law == "linear" else DIRECT_ROUNDS
            singular = p.law == "lcp" and self.redundant
            factor = self.whole_factor
            once = self.formed + self._direct(factor, 1.0 / DIRECT[p.law])
            if p.law == "lcp" and not singular and p.generalized is None:
                # Most are regular where they are free; where not, it says so and is asked again last. Not so over J and
                # M: what comes between is a method that the same redundancy holds up.
                found.append(Exact("direct", self._direct(factor), rounds, (("patience", False),), once))
            count = 1.0
            if p.law == "lcp" and p.generalized is None:
                count = SINGULAR if singular else STUCK
            found.append(Exact("direct", self.formed + self._direct(factor, count), rounds, once=once))
        if p.law == "lcp" and p.m <= LEMKE_ROWS:
            capped = int(np.count_nonzero(np.isfinite(p.cones.lower) & np.isfinite(p.cones.upper)))
            entries = PIVOT_ENTRY * float(p.m + capped) ** 2
            # It goes on where it stood: twice the pivots expected, and small problems for longer.
            limit = 2 * p.m + int(TAIL_TIME / entries)
            pivot = PIVOT if p.m > FEW else FEW_PIVOT
            found.append(Exact("lemke", START["lemke"] + p.m * (pivot + entries), limit))
        if self.largest:
            count = 2 * int(GENERAL_COUNT[p.law]) + GENERAL_TAIL
            cost = general_cost(p, self.largest)
            once = GENERAL_START + (cost - GENERAL_START) / general_count(p)
            found.append(Exact("newton", cost, count, (("form", "velocity"),), once))
        if p.law in ("cone", "coulomb") and (p.generalized is None or p.m <= ADMM_GENERAL):
            cost, once, each = self._admm
            limit = int(2.0 * self._admm_count)
            found.append(Exact("admm", self.formed + cost, limit, once=self.formed + once, each=each))
        return found

    @property
    def _admm_count(self) -> float:
        return ADMM_COUNT * max(1.0, self.decades / 6.0)

    @property
    def _admm(self) -> tuple[float, float, float]:
        p = self.problem
        entries = float(sweep_work(p))
        if p.rows is not None and 6 * p.rows.n_bodies >= p.m:
            # It takes the rows of A then: of one heavy body all of them.
            entries = max(entries, min(float(assemble.bound(p.data)[0]), float(p.m) ** 2))
        whole, once, each = admm_cost(p, p.m, entries, self._admm_count)
        return float(whole), float(once), float(each)

    def _direct(self, factor: float, times: float = 1.0) -> float:
        p = self.problem
        if self.few_bounded:
            return few_direct(p.m)
        return self._finite(
            "direct", times * DIRECT[p.law], factor * (1.0 if p.is_symmetric else UNSYMMETRIC)
        )

    @cached_property
    def _others_win(self) -> bool:
        left = [e.cost for e in self._others if e.key not in self.ended]
        return min(left, default=np.inf) <= self.newton_guess

    @cached_property
    def newton_guess(self) -> float:
        """Of `newton` [ns]: its factor is at least that of a tree of bodies, or of a diagonal; loops fill it."""
        p = self.problem
        if p.rows is not None and p.rows.n_bodies:
            # One row each, and no joint: most likely spheres, which no contact turns.
            turns = p.rows.inv_inertia.any() and (p.rows.n_joints or p.m > p.n_blocks)
            s = 6 if turns else 3
            n = p.rows.n_bodies
            return self._newton(BLOCK * s**3 * (1.0 + 0.5 * max(1.0, self._width(n)) ** 2) * n)
        m, nnz = float(p.m), float(len(p._compressed[1])) if p.generalized is None else float(p.m)
        share = nnz / (m * m)
        return self._newton(
            min(BAND * m * max(1.0, 0.5 * nnz / m) ** 2, sparse_factor(int(nnz), p.m), dense_factor(m))
            if share < DENSE_FILL
            else dense_factor(m)
        )

    def _width(self, n: int) -> float:
        """Neighbours that elimination leaves each of n unknowns, at a guess: none in a tree, as in a plane else."""
        return 0.5 * float(np.sqrt(n)) * self._loops if self._loops > TREE else 0.0

    @cached_property
    def _loops(self) -> float:
        """Pairs of bodies with a block between them, for each body: 1 in a chain, 2 or 3 in a lattice; at least 1."""
        p = self.problem
        if p.rows is None or p.rows.n_bodies == 0:
            return 1.0
        pairs = graph.body_pairs(block_bodies(p), p.rows.n_bodies, False)
        return max(1.0, pairs / p.rows.n_bodies)

    @property
    def _direct_takes(self) -> bool:
        # Exchanges of many rows of an asymmetric A as often go round in circles.
        p = self.problem
        return p.law == "linear" or (p.law == "lcp" and (p.m <= FEW or p.is_symmetric))

    def _finite(self, name: str, count: float, factor: float) -> float:
        start, step, row = newton_rates(self.problem) if name == "newton" else (START[name], STEP[name], ROW)
        return start + count * (step + row * self.problem.m + factor)

    def _newton(self, factor: float) -> float:
        p = self.problem
        lu = UNSYMMETRIC if p.law == "coulomb" or not p.is_symmetric else 1.0
        return self._finite("newton", self._newton_count, lu * factor)

    @property
    def _newton_count(self) -> float:
        p = self.problem
        if p.law == "lcp" and self.redundant:
            return AT_REST
        decades = max(self.decades - 6.0, -3.0)
        return NEWTON[p.law] + NEWTON_DECADE[p.law] * decades + min(MOST, PER_ROW[p.law] * p.m)

    @cached_property
    def whole_factor(self) -> float:
        """One factor of A as `direct` makes it [ns]; of a factored problem without forming A."""
        p, m = self.problem, self.problem.m
        dense = float(dense_factor(m))
        if p.rows is not None and p.rows.n_bodies:
            bodies, n = block_bodies(p), p.rows.n_bodies
            width = graph.body_spread(p.cones.ptr, bodies, n) + 1
            of = np.repeat(bodies, np.diff(p.cones.ptr), axis=0)
            clique = int(np.bincount(of[of >= 0], minlength=1).max())  # rows of one body are all neighbours
            if self._loops <= TREE:
                width = min(width, 2 * clique)
            entries = int(assemble.bound(p.data)[0])
            return min(dense, BAND * m * float(width) ** 2, self._sparse(entries))
        form, band, _ = choose(p) if p.is_symmetric else ("general", max(p.bandwidth), None)
        if form == "band":
            return BAND * m * float(min(band, m) + 1) ** 2
        nnz = len(p._compressed[1])
        if form == "sparse" or (form == "general" and p.law == "linear" and PanelsLU.takes(p)):
            return min(dense, self._sparse(nnz))
        return min(dense, sparse_factor(nnz, m))

    def _sparse(self, entries: int) -> float:
        """One sparse factor of so many entries [ns]; with bounds rows are analysed anew for each free set."""
        p = self.problem
        if p.law != "linear":
            return sparse_factor(entries, p.m)
        return panels_cost(entries, p.m) if p.matrix is None else filled_cost(p)


def dense_factor(m: Any) -> Any:
    """Of m rows [ns]."""
    m = np.asarray(m, float)
    return DENSE * m**3 / 3.0 + DENSE_ENTRY * m**2


def sparse_factor(nnz: int, m: int) -> float:
    """Of a matrix of m rows and nnz entries [ns]."""
    return SPARSE * nnz * (1.0 + m / SPARSE_ROWS)


def newton_factor(system: System) -> float:
    """One symmetric factor of Newton's matrix [ns]."""
    if not isinstance(system, MatrixSystem):
        return (BLOCK if system.cost < PANELS else PANEL) * system.cost
    if system.dense:
        return float(dense_factor(system.sc.m))
    if system.band is not None and system.sc.problem.law != "coulomb":
        return BAND * system.sc.m * float(system.band.h.shape[1]) ** 2
    return sparse_factor(system.h.nnz, system.sc.m)


def admm_cost(problem: Problem, m: Any, entries: Any, count: float) -> tuple[Any, Any, Any]:
    """`admm` on m rows [ns]: to the end, for each chance to get there; with the first factor alone; an iteration."""
    lu = 1.0 if problem.is_symmetric else UNSYMMETRIC
    factor = lu * SPARSE * entries * (1.0 + m / SPARSE_ROWS)
    if problem.is_symmetric:
        factor = np.minimum(factor, dense_factor(m))
    each = ADMM_ROW * m + ADMM_ENTRY * lu * np.minimum(ADMM_FILL * entries, 0.5 * m * m)
    whole = ADMM_START + ADMM_FACTORS * factor + count * each
    return whole / (ADMM_LUCK if problem.rows is None else ADMM_LUCK_BODIES), ADMM_START + factor, each


def islands_cost(problem: Problem, sizes: Any) -> float:
    """Islands of so many rows, solved apart by Newton's method or `admm`, by their sizes alone [ns]."""
    m = np.asarray(sizes, float)
    count = NEWTON[problem.law] + np.minimum(MOST, PER_ROW[problem.law] * m)
    start, step, row = newton_rates(problem)
    factor = np.minimum(
        dense_factor(m), SPARSE * problem.metric.work / max(problem.m, 1) * m * (1.0 + m / SPARSE_ROWS)
    )
    each = start + count * (step + row * m + UNSYMMETRIC * factor)
    if problem.law in ("cone", "coulomb"):
        entries = sweep_work(problem) / max(problem.m, 1) * m
        each = np.minimum(each, admm_cost(problem, m, entries, ADMM_COUNT)[0])
    each += ISLAND
    return float(each.sum())


def together_cost(problem: Problem, count: int, largest: int) -> float:
    """What it takes to solve so many islands in compiled code, beside sweeps over each [ns].

    Under a convex law that of J and M is mostly Newton's method, `largest` velocities in an island, which hardly
    ever fails: half of it counts.
    """
    found = TOGETHER + TOGETHER_ISLAND * count + TOGETHER_ROW * problem.m
    if problem.generalized is not None and problem.law != "coulomb":
        found += 0.5 * general_cost(problem, largest) if largest else np.inf
    return found


def is_loose(problem: Problem) -> bool:
    """Nearly every contact between two bodies of its own, not one of a face: sweeps then settle which ones stick."""
    assert problem.rows is not None
    pairs = graph.body_pairs(block_bodies(problem), problem.rows.n_bodies, True)
    return bool(4 * pairs > 3 * problem.n_blocks)
