"""The motions that solve one problem: Coulomb's law may leave several, and no accuracy of a solver chooses.

Runs from different starts, in different orders, by different solvers end at solutions; those whose motions
agree are one. A search finds motions, it does not prove that there are no more: `uniqueness` can, and up to eight
contacts with one tangent are enumerated whole (`lavender/lab/motion/modes.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    check_bool,
    check_choice,
    check_int,
    check_sequence,
    resolve_index,
)
from lavender.base.errors import CapabilityError, InputError, LavenderError
from lavender.judge.residuals import residual
from lavender.judge.solution import uninterrupted
from lavender.lab.motion.bound import difference
from lavender.lab.motion.error import SAME, MotionError, in_own_rows, measure, told
from lavender.lab.motion.modes import enumerated
from lavender.lab.motion.reference import Reference, as_reference, judged, kept
from lavender.lab.motion.reference import reference as reference_of
from lavender.lab.motion.unique import uniqueness
from lavender.problem import Problem, check_problem
from lavender.problem.cones import project
from lavender.solvers.certify import softened
from lavender.solvers.registry import available, get
from lavender.solving.solve import solve

RUNS = 12  # of a search, after `auto` itself
SOLVERS = ("anderson", "newton", "sequential_impulses", "block_gauss_seidel", "admm", "nncg")
ORDERS = ("given", "reverse", "random")
ASKED = 1e-11  # relative residual asked of a run, which nobody but its own solver ends
WORK = 2e9  # of `Data.work`, about nanoseconds: what the sweeps of one run may cost
SWEEPS = (400, 20_000)  # least and most of one run
CHOICES = ("nearest", "dissipation", "compliant")
SOFTEST, STEP = 1.0, 0.1  # softness of "compliant" as a share of d, and what each round leaves of it
HARDEST = 1e-12
BESIDE = 1e-6  # -, of `Distance.relative_distance`: an enumerated end that rounding alone keeps from being a solution
MANY = 100  # motions of an enumeration that are compared with each other


@dataclass(frozen=True, eq=False)
class Motion:
    """One solution, as a motion. `str()` is one line."""

    impulse: FloatArray = field(repr=False)  # (m,) N s
    slack: FloatArray = field(repr=False)  # (m,) m/s, w
    reference: Reference = field(repr=False)
    relative: float  # -, residual
    energy: float  # J, 1/2 lambda.A lambda - b.lambda: what the constraints add to the bodies' energy at rest targets
    dissipation: float  # J, -sum w.lambda over friction rows
    # m/s, largest normal slack of a contact that presses: what the cone law pays for being convex
    separation_speed: float
    count: int  # runs that ended here
    found_by: tuple[str, ...]  # their solvers, orders and starts

    def __str__(self) -> str:
        return (
            f"relative {self.relative:.1e}, energy {self.energy:.6g} J, friction takes {self.dissipation:.4g} J, "
            f"separation {self.separation_speed:.1e} m/s, found {self.count} times"
        )


class Distance(NamedTuple):
    """Of two motions."""

    speed: float  # m/s of a body; of a row where bodies are not known
    energy: float  # sqrt J, sqrt(1/2) |.|_A; m/s of a row where A is no energy
    relative_distance: float  # -, that over the larger of the same of both


class Pick(NamedTuple):
    """Where a solver ends without being told."""

    motion: int  # place of the nearest one
    distance: float  # m/s to it: more than rounding where the search has not found this motion


@dataclass(frozen=True, eq=False)
class SolutionSet:
    """Motions that all solve one problem, most often found first; `str()` is a line each."""

    problem: Problem = field(repr=False)
    motions: tuple[Motion, ...]
    spread: float  # m/s, the largest distance of two: of a body, or of a row where bodies are not known
    spread_energy: float | None  # sqrt J, sqrt(1/2) |.|_A of the same; None where A is no energy
    unique: str  # the criterion that proves there is one; empty where none does
    runs: int  # that ended at a solution
    failed: int  # runs that did not
    all: bool = False  # there are no others: proved, or every mode of the contacts was looked at

    def __iter__(self) -> Iterator[Motion]:
        return iter(self.motions)

    def __len__(self) -> int:
        return len(self.motions)

    def __bool__(self) -> bool:
        return True  # also where none was found: the search has been

    def __getitem__(self, i: Any) -> Any:
        """Motion i, or a list of several."""
        i = resolve_index(i, len(self.motions), "motion")
        return [self.motions[j] for j in i] if isinstance(i, list) else self.motions[i]

    def select(self, choice: str, impulse: Any = None) -> Motion:
        """One of the motions by a rule that has a name.

        Parameters
        ----------
        choice : {"nearest", "dissipation", "compliant"}
            Nearest to a warm start; the one in which friction takes most energy; the limit of vanishing
            softness: compliance d s on every row, s from 1 to 1e-12 by tenths, each solved from the last, as
            far as the search found where this path ends.
        impulse : (m,) N s, optional
            With "nearest": the warm start. Default: the problem's guess, else doing nothing.

        Raises
        ------
        InputError
            No such choice, a wrong impulse, or no motion to choose from.
        """
        choice = check_choice("choice", choice, CHOICES)
        if not self.motions:
            raise InputError("no run ended at a solution; there is nothing to choose from")
        if choice == "dissipation":
            return max(self.motions, key=lambda motion: motion.dissipation)
        p = self.problem
        if choice == "compliant":
            return self.nearest(compliant(p))
        if impulse is None:
            impulse = p.start() if p.guess is None else p.guess
        return self.nearest(p.impulse_array(impulse))

    def nearest(self, impulse: FloatArray) -> Motion:
        """The motion at the least distance from an impulse (m,) [N s]."""
        return min(self.motions, key=lambda motion: distance(self.problem, impulse, motion.impulse).energy)

    def picks(
        self, solvers: Iterable[str] | None = None, *, tol: float = 1e-9, max_iter: int = SWEEPS[1]
    ) -> dict[str, Pick | None]:
        """Which motion each solver ends at without being told; None where it does not get to `tol`.

        Parameters
        ----------
        solvers : names, optional
            Default: all that take the problem here.
        tol : float
            Relative residual asked of them, or twice the floor.
        max_iter : int
            Budget of those that sweep; the others keep their own.
        """
        p = self.problem
        out: dict[str, Pick | None] = {}
        for name in available(p) if solvers is None else check_sequence("solvers", solvers, "names"):
            try:
                budget = max_iter if get(name).resumable else None
                found = uninterrupted(solve(p, name, tol=tol, max_iter=budget))
            except CapabilityError:
                continue
            out[name] = None
            if self.motions and (found.success or found.residual.at_floor):
                near = self.nearest(found.impulse)
                off = distance(p, found.impulse, near.impulse)
                out[name] = Pick(self.motions.index(near), off.speed)
        return out

    def __str__(self) -> str:
        name = self.problem.name or f"{self.problem.m} rows"
        if not self.motions:
            return f"{name}: none of {self.failed} runs ended at a solution"
        energy = "" if self.spread_energy is None else f", {self.spread_energy:.2e} sqrt(J)"
        many = "one motion" if len(self) == 1 else f"{len(self)} motions"
        kind = f"one motion, unique: {self.unique}" if self.unique else f"{many}, all that there are"
        kind = kind if self.all else f"at least {many}"
        spread = f", up to {self.spread:.2g} m/s{energy} apart" if len(self) > 1 else ""
        failed = f", {self.failed} did not end at one" if self.failed else ""
        head = f"{name} ({self.problem.law}): {kind}{spread}; {self.runs} runs{failed}"
        return "\n".join([head, *(f"  {i}: {motion}" for i, motion in enumerate(self.motions))])


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is no solution
def find_solutions(problem: Problem, n: int = RUNS, seed: int = 0, *, always: bool = False) -> SolutionSet:
    """The motions that solve a problem: from several starts, in several orders, by several solvers, or all of them.

    Up to eight contacts with at most one tangent each are enumerated: `SolutionSet.all` is then true, and no run is
    needed. Otherwise there are at least those that are found.

    Parameters
    ----------
    problem : Problem
    n : int, default 12
        Runs, after the one of `auto`; none where the motion is proved to be unique, or all are enumerated.
    seed : int, default 0
        Of starts and random orders: equal seeds give equal results.
    always : bool, default False
        Search also where one motion is proved: to test the proof.

    Returns
    -------
    SolutionSet
        Kept with the problem, for `motion_error`.

    Raises
    ------
    InputError
        `n` or `seed` is no whole number, or negative; `always` is neither True nor False.
    """
    check_problem(problem)
    n, seed, always = check_int("n", n), check_int("seed", seed, high=None), check_bool("always", always)
    proof = uniqueness(problem)
    own = reference_of(problem)
    found = [(own, "auto")] if own.accepted else []
    failed = 0 if own.accepted else 1
    whole = bool(proof)
    if (always or not proof) and (modes := enumerated(problem)) is not None:
        best_last = sorted(modes[0], key=lambda x: -residual(problem, x).relative)
        single = {_rounded(problem, x): x for x in best_last}  # modes that share a motion
        ends = [judged(problem, x, "every mode") for x in list(single.values())[:MANY]]
        solved = [end for end in ends if end.accepted]
        found += [(end, "every mode") for end in solved]
        # what rounding lets pass an inequality lies beside a motion that it would otherwise have missed
        beside = (
            min((distance(problem, e.impulse, s.impulse).relative_distance for s in solved), default=1.0)
            for e in ends
        )
        whole |= modes[1] and len(single) <= MANY and max(beside, default=1.0) < BESIDE
    if always or not whole:
        for label, impulse in search(problem, own, n, seed):
            candidate = judged(problem, impulse, label)
            if candidate.accepted:
                found.append((candidate, label))
            else:
                failed += 1
    merged = _merge(problem, found)
    speed, energy = 0.0, 0.0
    for i, one in enumerate(merged):
        for two in merged[:i]:
            apart = distance(problem, one.impulse, two.impulse)
            speed, energy = max(speed, apart.speed), max(energy, apart.energy)
    result = SolutionSet(
        problem=problem,
        motions=tuple(merged),
        spread=speed,
        spread_energy=None if own.refusal else energy,
        unique=proof.reason if proof else "",
        runs=len(found),
        failed=failed,
        all=whole,
    )
    kept(problem).motions = result
    return result


def _rounded(problem: Problem, x: FloatArray) -> bytes:
    """w to 1e-9 of the largest |b|, in m/s and in sqrt(J): heavy bodies that move slowly move all the same."""
    parts = []
    for unit in (np.ones(problem.m), 1.0 / np.sqrt(problem.d)):
        largest = float(np.max(np.abs(unit * problem.b), initial=0.0)) or 1.0
        parts.append(np.round(unit * problem.slack(x) / largest, 9) + 0.0)
    return np.concatenate(parts).tobytes()


def get_solutions(problem: Problem, n: int = RUNS) -> SolutionSet:
    """The motions that were searched already, whatever their number of runs, or a search of `n` runs."""
    return kept(problem).motions or find_solutions(problem, n)


def branch(problem: Problem, impulse: Any) -> Reference:
    """The solution that an impulse (m,) [N s] leads to: sweeps from it to the floor, then `newton` where they stop.

    Where Coulomb's law leaves several motions, this is the one that a solver stopped early was on its way to.
    Kept by nobody; `accepted` says whether it is a solution.
    """
    check_problem(problem)
    found = None
    x = problem.impulse_array(impulse)
    for name in ("anderson", "newton"):
        if name not in available(problem):
            continue
        end = uninterrupted(solve(problem, name, impulse=x, tol=ASKED))
        new = judged(problem, end.impulse, f"{name} from it") if np.isfinite(end.impulse).all() else None
        if new is not None and (found is None or new.residual.relative < found.residual.relative):
            found = new
        if found is not None and found.accepted:
            break
    return reference_of(problem) if found is None else found


def compliant(problem: Problem) -> FloatArray:
    """Where softness that vanishes leads: compliance s d on every row, s from 1 to 1e-12, then none; (m,) [N s]."""
    x, s = problem.start(), SOFTEST
    while s >= HARDEST:
        x = np.array(
            uninterrupted(solve(softened(problem, s * problem.d), "auto", impulse=x, tol=1e-12)).impulse
        )
        s *= STEP
    return np.array(uninterrupted(solve(problem, "auto", impulse=x, tol=1e-13)).impulse)


def search(problem: Problem, own: Reference, n: int, seed: int) -> Iterator[tuple[str, FloatArray]]:
    """n runs: what each was, and where it ended."""
    here = set(available(problem))
    solvers = [name for name in SOLVERS if name in here] or ["auto"]
    if "sequential_impulses" not in here and "pgs" in here:
        solvers.append("pgs")
    rng = np.random.default_rng(seed)
    budget = int(min(max(WORK / max(1, problem.data.work), SWEEPS[0]), SWEEPS[1]))
    for i in range(n):
        turn, which = divmod(i, len(solvers))
        spec = get(solvers[which])
        options: dict[str, Any] = {}
        label = spec.name
        if spec.order:
            options["order"] = ORDERS[(i + turn) % len(ORDERS)]
            label += f" {options['order']}"
            if options["order"] == "random":
                options["seed"] = int(rng.integers(2**31))
        # Two turns start where nobody has moved anything, in different orders; a solver without orders starts anew.
        start = _start(problem, own, rng, max(turn - spec.order, 0))
        limit = budget if spec.resumable else spec.max_iter
        try:
            end = uninterrupted(
                solve(problem, spec.name, impulse=start[1], tol=ASKED, max_iter=limit, **options)
            )
        except LavenderError:  # refused after a look at the numbers
            continue
        if np.isfinite(end.impulse).all():
            yield f"{label} from {start[0]}", end.impulse


def _start(problem: Problem, own: Reference, rng: np.random.Generator, i: int) -> tuple[str, FloatArray]:
    """A start and its name: doing nothing, the guess, then the reference with its normals and tangents at random."""
    if i == 0:
        return ("doing nothing", problem.start()) if problem.guess is None else ("the guess", problem.guess)
    c = problem.cones
    x = own.impulse * rng.lognormal(sigma=0.7, size=problem.m)
    size = float(np.median(np.abs(own.impulse[own.impulse != 0.0]))) if own.impulse.any() else 1.0
    normal, tangents = c.normal_rows, c.friction_rows
    x[normal] = np.maximum(x[normal], size * rng.random(len(normal)))
    x[tangents] = size * rng.normal(size=int(tangents.sum()))
    return "a random start", project(c, x)


def _merge(problem: Problem, found: list[tuple[Reference, str]]) -> list[Motion]:
    """One motion of all that agree, the best solved of each; most often found first."""
    groups: list[list[tuple[Reference, str]]] = []
    for one in found:
        for group in groups:
            if distance(problem, one[0].impulse, group[0][0].impulse).relative_distance <= SAME:
                group.append(one)
                break
        else:
            groups.append([one])
    out = []
    for group in groups:
        best = min((reference for reference, _ in group), key=lambda r: r.residual.relative)
        out.append(_motion(problem, best, tuple(label for _, label in group)))
    return sorted(out, key=lambda motion: -motion.count)


def _motion(problem: Problem, reference: Reference, labels: tuple[str, ...]) -> Motion:
    x = reference.impulse
    w = residual(problem, x).slack
    normal, friction = problem.cones.normal_rows, problem.cones.friction_rows
    pressed = normal[x[normal] > 0.0]
    return Motion(
        impulse=x,
        slack=w,
        reference=reference,
        relative=reference.residual.relative,
        energy=float(0.5 * (x @ (w - problem.b))),
        dissipation=-float(w[friction] @ x[friction]),
        separation_speed=float(np.max(w[pressed], initial=0.0)),
        count=len(labels),
        found_by=labels,
    )


@np.errstate(over="ignore", invalid="ignore")  # of impulses at the edge of float64
def distance(problem: Problem, x: ArrayLike, y: ArrayLike) -> Distance:
    """How far apart the motions of two impulses (m,) [N s] are."""
    own = kept(problem)
    operator = own.operator
    x, y = problem.impulse_array(x, "x"), problem.impulse_array(y, "y")
    delta, size = difference(operator, x, y)
    velocity = operator.velocity(delta, np.zeros(problem.m))
    rows = np.abs(operator.slack(delta)[0] + problem.b)
    speed = rows if velocity is None else operator.lengths(velocity[0])[0]
    fastest = float(np.max(speed, initial=0.0))
    if own.refusal:
        far = float(np.max(rows, initial=0.0))
        whole = max(float(np.max(np.abs(operator.slack(z)[0] + problem.b), initial=0.0)) for z in (x, y))
    else:
        far = size.energy
        whole = max(operator.size(z, np.zeros(problem.m)).energy for z in (x, y))
    return Distance(fastest, far, far / whole if whole > 0.0 else (0.0 if far == 0.0 else np.inf))


def motion_error(problem: Problem, impulse: Any, reference: Any = None) -> MotionError:
    """How wrong the motion of an impulse is: its distance to the solution, with a bound.

    With lambda* the reference and M^-1 J^T (lambda - lambda*) the difference dv of body velocities,

        kinetic = sqrt(1/2 dv.M dv)        energy = sqrt(1/2 (lambda - lambda*).A (lambda - lambda*))

    so that two impulses which differ by what moves nothing (a table on four legs) are at distance 0. The
    bound needs no trust in the reference: with e the judge's error of lambda* and targets moved by d e,
    the solution is within sqrt(1/2) |e|_A of it (proof in `lavender.lab.motion.bound`).

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s
    reference : (m,) N s, Solution or Reference, optional
        What stands for the solution. Default: what `auto` finds at the floor, solved for once and kept
        with the problem; under Coulomb's law the nearest of the motions that `lavender.find_solutions` finds and of the
        one that the impulse itself leads to.

    Returns
    -------
    MotionError
        No estimate where the reference is no solution (relative above 1e-10 and above twice its floor); no
        energies where A is asymmetric or indefinite; no bound under Coulomb's law. `note` says so.

    Raises
    ------
    InputError
        An impulse or reference of the wrong length, or one that is not finite.
    CapabilityError
        Generalised coordinates in which M couples more than 2000 velocities.
    """
    check_problem(problem)
    x = problem.on_disk(problem.impulse_array(impulse))
    if problem.cones.has_ellipse:  # measured on its disks
        if reference is not None and not isinstance(reference, Reference):
            given = problem.impulse_array(getattr(reference, "impulse", reference), "reference")
            reference = problem.on_disk(given)
        found = motion_error(problem.disk, x, reference)
        with np.errstate(over="ignore", invalid="ignore"):
            return in_own_rows(problem, x, found)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is told in `note`
        if reference is not None:
            return measure(problem, x, as_reference(problem, reference))
        if problem.law != "coulomb":
            return measure(problem, x, reference_of(problem))
        return nearest(problem, x, get_solutions(problem))


def nearest(problem: Problem, x: FloatArray, found: SolutionSet) -> MotionError:
    """The distance of an impulse x (m,) to the nearest of several motions, and of the one that it leads to."""
    references = [motion.reference for motion in found]
    spread, energy = found.spread, found.spread_energy
    if not found.unique:
        own = branch(problem, x)
        far = [distance(problem, own.impulse, motion.impulse) for motion in found]
        if own.accepted and all(d.relative_distance > SAME for d in far):
            references.append(own)
            spread = max([spread, *(d.speed for d in far)])
            energy = None if energy is None else max([energy, *(d.energy for d in far)])
    if not references:
        return measure(problem, x, reference_of(problem))
    best = min((measure(problem, x, reference) for reference in references), key=_distance)
    made = replace(best, spread=energy, spread_speed=spread, count=len(references), unique=found.unique)
    return told(made, ("spread", "spread_speed"))


def _distance(error: MotionError) -> float:
    known = error.energy if error.energy is not None else error.rows
    return math.inf if known is None else known
