"""What each candidate of `auto` would cost on a problem, counted from its structure.

    sweeps         START + n (SWEEP work + SWEEP_ROW m)         work: multiply-adds of one sweep (`Data.work`)
    factorising    START + f (STEP + ROW m + rate flops)        flops: multiply-adds of one factor, f: how many

Rates stand in `_rates.py`, what a single call, factor or sweep costs in `_counts.py`; here is what is found out of one
problem, when it is first asked, and which finite solvers it has.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lavender.problem import Problem
from lavender.registry import FEW
from lavender.solvers import _rates as rates
from lavender.solvers._accelerated import sweep_work
from lavender.solvers._counts import (
    admm_cost,
    dense_factor,
    few_direct,
    filled,
    finite_least,
    formed_cost,
    general_count,
    is_redundant,
    newton_factor,
    newton_rates,
    sparse_factor,
    sweep_cost,
    velocities_cost,
)
from lavender.solvers._factor import PanelsLU, choose, filled_cost, panels_cost
from lavender.solvers._islands import block_bodies
from lavender.solvers._newton.systems import (
    DENSE_ROWS,
    System,
    is_full,
    make_system,
)
from lavender_ext.core import assemble
from lavender_ext.factor import graph

HASTY_KEY = (
    "direct False"  # `Exact.key` of that (HASTY of `_at_once.py`): it gives up where one shift is stuck
)
VELOCITY_KEY = "newton velocity"  # `Exact.key` of newton over generalised velocities


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


class Costs:
    """Of one problem; what takes time to find out is found when it is first asked.

    `largest`: velocities of the largest of the `islands` of a problem in generalised coordinates, 0 where Newton's
    method has no room for so many.
    """

    def __init__(self, problem: Problem, tol: float, largest: int = 0, islands: int = 1) -> None:
        self.problem, self.largest, self.islands = problem, largest, islands
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
        return rates.SWEEP_START + rates.LOOK + sweeps * self.sweep

    @cached_property
    def redundant(self) -> bool:
        """`is_redundant`."""
        return is_redundant(self.problem)

    @cached_property
    def sweeping(self) -> float:
        """Sweeps to the end as they usually go [ns], before the first of them."""
        n = rates.SWEEPS_REDUNDANT if self.redundant else rates.SWEEPS
        formed = rates.ROWS_OF_A if self.problem.law == "lcp" and self.problem.rows is not None else 0.0
        return rates.SWEEP_START + formed + rates.LOOKS * rates.LOOK + n * self.decades / 6.0 * self.sweep

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
            far = p.matrix is None and most > self.sweeping
            found = most if far else self.newton_guess
            if p.matrix is not None and p.law in ("cone", "coulomb"):
                found = min(found, self._admm[0])
        else:
            stuck = self.redundant or any(key.startswith("direct") for key in self.ended)
            times = rates.SINGULAR if p.law == "lcp" and stuck else 1.0
            found = min(self.newton_guess, self._direct(self._factor_guess, times))
        return min(self.formed + found, self.over_velocities)

    @cached_property
    def formed(self) -> float:
        """`formed_cost`."""
        return formed_cost(self.problem)

    @cached_property
    def over_velocities(self) -> float:
        """Newton over generalised velocities [ns]; inf where it has no room, or none are given."""
        return velocities_cost(self.problem, self.largest) if self.largest else np.inf

    @property
    def over_velocities_exact(self) -> Exact | None:
        """The same as a finite solver; A is not formed to tell."""
        return next((e for e in self._others if e.key == VELOCITY_KEY), None)

    @property
    def asking(self) -> float:
        """What it takes to find out what the finite solvers cost [ns], A formed, as far as that is not known."""
        if "system" in self.__dict__ or self._others_win:
            return 0.0
        p = self.problem
        if p.generalized is not None:
            return rates.ASK
        if p.rows is not None and p.rows.n_bodies:
            return rates.ASK_BODIES + rates.ASK_BODIES_ROW * p.m
        return rates.ASK + rates.ASK_ROW * p.m + rates.ASK_ENTRY * len(p._compressed[1])

    @cached_property
    def exact(self) -> list[Exact]:
        """The finite solvers that take this problem, cheapest first."""
        if self.problem.cones.has_round:
            return [e for e in self._others if e.name == "newton"] or [Exact("newton", np.inf, 0)]
        # Newton's system is made only where it may be the cheapest: it costs as much as a small solve.
        cost = self.newton_guess if self._others_win else self._newton(newton_factor(self.system))
        p = self.problem
        form = () if p.generalized is None else (("form", "impulse"),)
        limit = int(rates.BUDGET[p.law] * self._newton_count)
        start = newton_rates(p)[0]
        each = (cost - start) / self._newton_count
        # To ask another and to come back costs time, too: small problems go on for longer.
        limit += (
            rates.TAIL[p.law]
            if p.law != "coulomb"
            else int(min(rates.TAIL[p.law], max(rates.TAIL_LEAST, rates.TAIL_TIME / each)))
        )
        once = self.formed + start + each
        newton = Exact("newton", self.formed + cost, limit, options=form, once=once, each=each)
        return sorted([*self._others, newton], key=lambda e: e.cost)

    @cached_property
    def _others(self) -> list[Exact]:
        p = self.problem
        found = []
        if self._direct_takes:
            rounds = 0 if p.law == "linear" else rates.DIRECT_ROUNDS
            singular = p.law == "lcp" and self.redundant
            factor = self.whole_factor
            once = self.formed + self._direct(factor, 1.0 / rates.DIRECT[p.law])
            if p.law == "lcp" and not singular and p.generalized is None:
                # Most are regular where they are free; where not, it says so and is asked again last. Not so over J and
                # M: what comes between is a method that the same redundancy holds up.
                found.append(Exact("direct", self._direct(factor), rounds, (("patience", False),), once))
            count = 1.0
            if p.law == "lcp" and p.generalized is None:
                count = rates.SINGULAR if singular else rates.STUCK
            found.append(Exact("direct", self.formed + self._direct(factor, count), rounds, once=once))
        if p.law == "lcp" and p.m <= rates.LEMKE_ROWS:
            capped = int(np.count_nonzero(np.isfinite(p.cones.lower) & np.isfinite(p.cones.upper)))
            entries = rates.PIVOT_ENTRY * float(p.m + capped) ** 2
            # It goes on where it stood: twice the pivots expected, and small problems for longer.
            limit = 2 * p.m + int(rates.TAIL_TIME / entries)
            pivot = rates.PIVOT if p.m > FEW else rates.FEW_PIVOT
            found.append(Exact("lemke", rates.START["lemke"] + p.m * (pivot + entries), limit))
        if self.largest:
            # A step is that of one island.
            count = (2 * int(rates.GENERAL_COUNT[p.law]) + rates.GENERAL_TAIL) * self.islands
            cost = velocities_cost(p, self.largest)
            once = rates.GENERAL_START + (cost - rates.GENERAL_START) / general_count(p)
            found.append(Exact("newton", cost, count, (("form", "velocity"),), once))
        if p.law in ("cone", "coulomb") and (p.generalized is None or p.m <= rates.ADMM_GENERAL):
            cost, once, each = self._admm
            limit = int(2.0 * self._admm_count)
            found.append(Exact("admm", self.formed + cost, limit, once=self.formed + once, each=each))
        return found

    @property
    def _admm_count(self) -> float:
        return rates.ADMM_COUNT * max(1.0, self.decades / 6.0)

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
            "direct", times * rates.DIRECT[p.law], factor * (1.0 if p.is_symmetric else rates.UNSYMMETRIC)
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
            return self._newton(rates.BLOCK * s**3 * (1.0 + 0.5 * max(1.0, self._width(n)) ** 2) * n)
        m = float(p.m)
        if p.generalized is not None:
            return self._newton(min(rates.BAND * m, float(dense_factor(m))))
        nnz = len(p._compressed[1])
        if is_full(nnz, p.m, self._bounded):
            return self._newton(float(dense_factor(m)))
        # Its entries fill; a band is narrower than they are at best, and neither Coulomb's law nor LU asks for one.
        least = float(filled(nnz, 0.0)) if p.m > DENSE_ROWS else float(dense_factor(m))
        if p.law != "coulomb" and p.is_symmetric:
            least = min(least, rates.BAND * m * max(1.0, 0.5 * nnz / m) ** 2)
        return self._newton(least)

    @property
    def _factor_guess(self) -> float:
        """What one factor of A as `direct` makes it hardly costs less than [ns]; of bounded rows given as A, all."""
        p, m = self.problem, self.problem.m
        if p.law == "lcp" and p.matrix is not None:
            return self.whole_factor
        width = self._width(m) if p.rows is not None else 0.5 * p.metric.work / max(m, 1)
        return rates.BAND * m * max(3.0, width) ** 2

    def _width(self, n: int) -> float:
        """Neighbours that elimination leaves each of n unknowns, at a guess: none in a tree, as in a plane else."""
        return 0.5 * float(np.sqrt(n)) * self._loops if self._loops > rates.TREE else 0.0

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
        start, step, row = (
            newton_rates(self.problem)
            if name == "newton"
            else (rates.START[name], rates.STEP[name], rates.ROW)
        )
        return start + count * (step + row * self.problem.m + factor)

    def _newton(self, factor: float) -> float:
        p = self.problem
        lu = rates.UNSYMMETRIC if p.law == "coulomb" or not p.is_symmetric else 1.0
        found = self._finite("newton", self._newton_count, lu * factor)
        if p.matrix is None or p.law == "linear" or p.is_symmetric or p.m <= DENSE_ROWS:
            return found
        return (
            found if is_full(len(p._compressed[1]), p.m, self._bounded) else found * rates.ASYMMETRIC[p.law]
        )

    @property
    def _bounded(self) -> bool:
        return self.problem.law in ("linear", "lcp")

    @property
    def _newton_count(self) -> float:
        p = self.problem
        if p.law == "lcp" and self.redundant:
            return rates.AT_REST
        decades = max(self.decades - 6.0, -3.0)
        return (
            rates.NEWTON[p.law]
            + rates.NEWTON_DECADE[p.law] * decades
            + min(rates.MOST, rates.PER_ROW[p.law] * p.m)
        )

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
            if self._loops <= rates.TREE:
                width = min(width, 2 * clique)
            entries = int(assemble.bound(p.data)[0])
            return min(dense, rates.BAND * m * float(width) ** 2, self._sparse(entries))
        form, band, _ = choose(p) if p.is_symmetric else ("general", max(p.bandwidth), None)
        if form == "band":
            return rates.BAND * m * float(min(band, m) + 1) ** 2
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
