"""The motions that solve one problem: under Coulomb's law there may be several, and no solver accuracy selects one.

Runs from different starts, in different orders and by different solvers end at solutions; solutions with equal motions
count as one motion. A search finds motions but does not prove that no others exist. `prove_uniqueness` can prove
it, and problems of up to eight contacts with one tangent are enumerated completely (`lavender/lab/motion/modes.py`).
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
from lavender.judge.solution import raise_if_interrupted
from lavender.lab.motion.bound import subtract_impulses
from lavender.lab.motion.error import (
    SAME_MOTION_FRACTION,
    MotionError,
    convert_to_ellipse_rows,
    drop_non_finite,
    measure_distance,
)
from lavender.lab.motion.modes import enumerate_modes
from lavender.lab.motion.reference import Reference, as_reference, get_motion_cache, make_reference
from lavender.lab.motion.reference import get_reference as reference_of
from lavender.lab.motion.unique import prove_uniqueness
from lavender.problem import Problem, check_problem
from lavender.problem.cones import project_impulse
from lavender.solvers.certify import add_compliance
from lavender.solvers.registry import available, get
from lavender.solving.solve import solve

N_SEARCH_RUNS = 12  # Number of runs of a search, in addition to `auto`'s.
SEARCH_SOLVERS = ("anderson", "newton", "sequential_impulses", "block_gauss_seidel", "admm", "nncg")
SEARCH_ORDERS = ("given", "reverse", "random")
# Relative residual tolerance of a search run. It is below most round-off floors, so a run ends when its solver stalls.
SEARCH_TOL = 1e-11
SWEEP_WORK_LIMIT = 2e9  # [units of `Data.work`, about 1 ns] The sweeps of one run may cost at most this much.
SWEEP_RANGE = (400, 20_000)  # The number of sweeps of one run is clipped to this range.
SELECTION_RULES = ("nearest", "dissipation", "compliant")
# The rule "compliant" of `SolutionSet.select` solves with a compliance of LARGEST_COMPLIANCE_FRACTION times d, then
# multiplies it by COMPLIANCE_STEP and solves again, down to SMALLEST_COMPLIANCE_FRACTION times d.
LARGEST_COMPLIANCE_FRACTION, COMPLIANCE_STEP = 1.0, 0.1
SMALLEST_COMPLIANCE_FRACTION = 1e-12
# If rounding alone makes an enumerated impulse miss the residual of a solution, a solution is within this
# `Distance.relative_distance` of it; otherwise the enumeration counts as incomplete.
NEAR_SOLUTION_FRACTION = 1e-6
MAX_COMPARED_MOTIONS = 100  # At most this many motions of an enumeration are compared with each other.


@dataclass(frozen=True, eq=False)
class Motion:
    """One solution, as a motion; `str()` gives one line.

    Parameters
    ----------
    impulse : (m,) N s
    slack : (m,) m/s
        w.
    reference : Reference
    relative : float
        Relative residual.
    energy : float, J
        1/2 lambda.A lambda - b.lambda: the energy that the constraints add to the bodies if targets are at rest.
    dissipation : float, J
        -sum w.lambda over friction rows.
    separation_speed : float, m/s
        Largest normal slack of a contact with a normal impulse: the error of the cone law's convex relaxation.
    count : int
        Number of runs that ended here.
    found_by : tuple of str
        Solver, order and start of each of these runs.
    """

    impulse: FloatArray = field(repr=False)
    slack: FloatArray = field(repr=False)
    reference: Reference = field(repr=False)
    relative: float
    energy: float
    dissipation: float
    separation_speed: float
    count: int
    found_by: tuple[str, ...]

    def __str__(self) -> str:
        return (
            f"relative {self.relative:.1e}, energy {self.energy:.6g} J, friction takes {self.dissipation:.4g} J, "
            f"separation {self.separation_speed:.1e} m/s, found {self.count} times"
        )


class Distance(NamedTuple):
    """Distance of two motions.

    Parameters
    ----------
    speed : float, m/s
        Largest difference of a body's velocity; of a row's if bodies are not known.
    energy : float, sqrt J
        sqrt(1/2) |.|_A of the difference; m/s of a row if A is not an energy.
    relative_distance : float
        `energy` divided by the larger of the energy norms of the two motions.
    """

    speed: float
    energy: float
    relative_distance: float


class Pick(NamedTuple):
    """The motion at which a solver ends by itself.

    Parameters
    ----------
    motion : int
        Index of the nearest motion.
    distance : float, m/s
        Distance from this motion. If it is above rounding, the search has not found the solver's motion.
    """

    motion: int
    distance: float


@dataclass(frozen=True, eq=False)
class SolutionSet:
    """Motions that all solve one problem, most frequent first; `str()` gives one line for each.

    Parameters
    ----------
    problem : Problem
    motions : tuple of Motion
    spread : float, m/s
        Largest distance of two motions: of a body's velocity, or of a row's if bodies are not known.
    spread_energy : float or None, sqrt J
        Largest sqrt(1/2) |.|_A of a difference; None if A is not an energy.
    unique : str
        Criterion that proves that there is one motion; empty if no criterion holds.
    runs : int
        Number of runs that ended at a solution.
    failed : int
        Number of runs that did not end at a solution.
    all : bool
        Whether `motions` is complete: a proof shows that there is one motion, or every mode of the contacts was
        enumerated.
    """

    problem: Problem = field(repr=False)
    motions: tuple[Motion, ...]
    spread: float
    spread_energy: float | None
    unique: str
    runs: int
    failed: int
    all: bool = False

    def __iter__(self) -> Iterator[Motion]:
        return iter(self.motions)

    def __len__(self) -> int:
        return len(self.motions)

    def __bool__(self) -> bool:
        return True  # A set without motions is true, too, so that `if solutions:` tests for None only.

    def __getitem__(self, i: Any) -> Any:
        """Return motion i, or a list of motions."""
        i = resolve_index(i, len(self.motions), "motion")
        return [self.motions[j] for j in i] if isinstance(i, list) else self.motions[i]

    def select(self, choice: str, impulse: Any = None) -> Motion:
        """Select one of the motions by a named rule.

        Parameters
        ----------
        choice : {"nearest", "dissipation", "compliant"}
            "nearest": the motion nearest to a warm start. "dissipation": the motion in which friction dissipates the
            largest energy. "compliant": the motion nearest to the limit of vanishing compliance. That limit is
            computed with a compliance s d on every row and s from 1 to 1e-12 in factors of ten, each solve starting
            from the result of the one before.
        impulse : (m,) N s, optional
            With "nearest": the warm start. Default: the problem's guess, otherwise the zero impulse.

        Raises
        ------
        InputError
            Unknown `choice`, wrong `impulse`, or no motion was found.
        """
        choice = check_choice("choice", choice, SELECTION_RULES)
        if not self.motions:
            raise InputError(
                "none of the runs ended at a solution, so no motion can be selected: give more runs, more "
                "iterations or a larger tol"
            )
        if choice == "dissipation":
            return max(self.motions, key=lambda motion: motion.dissipation)
        p = self.problem
        if choice == "compliant":
            return self.nearest(solve_with_vanishing_compliance(p))
        if impulse is None:
            impulse = p.start() if p.guess is None else p.guess
        return self.nearest(p.impulse_array(impulse))

    def nearest(self, impulse: FloatArray) -> Motion:
        """Return the motion whose difference from the motion of an impulse (m,) [N s] has the smallest energy."""
        return min(
            self.motions,
            key=lambda motion: measure_motion_distance(self.problem, impulse, motion.impulse).energy,
        )

    def picks(
        self, solvers: Iterable[str] | None = None, *, tol: float = 1e-9, max_iter: int = SWEEP_RANGE[1]
    ) -> dict[str, Pick | None]:
        """Return the motion at which each solver ends by itself; None if the solver does not reach `tol`.

        Parameters
        ----------
        solvers : names, optional
            Default: all available solvers that accept the problem.
        tol : float
            Relative residual tolerance, at least twice the round-off floor.
        max_iter : int
            Largest number of iterations of sweep solvers; other solvers keep their own limits.
        """
        p = self.problem
        out: dict[str, Pick | None] = {}
        for name in available(p) if solvers is None else check_sequence("solvers", solvers, "names"):
            try:
                budget = max_iter if get(name).resumable else None
                result = raise_if_interrupted(solve(p, name, tol=tol, max_iter=budget))
            except CapabilityError:
                continue
            out[name] = None
            if self.motions and (result.success or result.residual.at_floor):
                near = self.nearest(result.impulse)
                off = measure_motion_distance(p, result.impulse, near.impulse)
                out[name] = Pick(self.motions.index(near), off.speed)
        return out

    def __str__(self) -> str:
        name = self.problem.name or f"{self.problem.m} rows"
        if not self.motions:
            return f"{name}: none of {self.failed} runs ended at a solution"
        energy = "" if self.spread_energy is None else f", {self.spread_energy:.2e} sqrt(J)"
        many = "one motion" if len(self) == 1 else f"{len(self)} motions"
        kind = f"one motion, unique: {self.unique}" if self.unique else f"{many}, no others exist"
        kind = kind if self.all else f"at least {many}"
        spread = f", up to {self.spread:.2g} m/s{energy} apart" if len(self) > 1 else ""
        failed = f", {self.failed} did not end at one" if self.failed else ""
        head = f"{name} ({self.problem.law}): {kind}{spread}; {self.runs} runs{failed}"
        return "\n".join([head, *(f"  {i}: {motion}" for i, motion in enumerate(self.motions))])


@np.errstate(over="ignore", invalid="ignore")  # Impulses that are not finite are not solutions.
def find_solutions(
    problem: Problem, n: int = N_SEARCH_RUNS, seed: int = 0, *, always: bool = False
) -> SolutionSet:
    """Find the motions that solve a problem, by enumeration or from several starts, orders and solvers.

    Problems of up to eight contacts with at most one tangent each are enumerated: `SolutionSet.all` is then true, and
    no run is needed. Otherwise the motions that are found are a lower bound of their number.

    Parameters
    ----------
    problem : Problem
    n : int, default 12
        Number of runs after `auto`'s; none if the motion is proved to be unique, or all motions are enumerated.
    seed : int, default 0
        Seed of starts and random orders: equal seeds give equal results.
    always : bool, default False
        Search also if the motion is proved to be unique: to test the proof.

    Returns
    -------
    SolutionSet
        Stored with the problem, for `motion_error`.

    Raises
    ------
    InputError
        `n` or `seed` is not an integer or is negative; `always` is not a bool.
    """
    check_problem(problem)
    n, seed, always = check_int("n", n), check_int("seed", seed, high=None), check_bool("always", always)
    proof = prove_uniqueness(problem)
    reference = reference_of(problem)
    solutions = [(reference, "auto")] if reference.is_accepted else []
    failed = 0 if reference.is_accepted else 1
    complete = bool(proof)
    if (always or not proof) and (modes := enumerate_modes(problem)) is not None:
        best_last = sorted(modes[0], key=lambda x: -residual(problem, x).relative)
        # Modes with the same motion have one entry.
        distinct = {_make_motion_key(problem, x): x for x in best_last}
        ends = [
            make_reference(problem, x, "every mode") for x in list(distinct.values())[:MAX_COMPARED_MOTIONS]
        ]
        solved = [end for end in ends if end.is_accepted]
        solutions += [(end, "every mode") for end in solved]
        # An impulse that satisfies an inequality only by rounding must be near a solution; else the list is
        # incomplete.
        distances = (
            min(
                (measure_motion_distance(problem, e.impulse, s.impulse).relative_distance for s in solved),
                default=1.0,
            )
            for e in ends
        )
        complete |= (
            modes[1]
            and len(distinct) <= MAX_COMPARED_MOTIONS
            and max(distances, default=1.0) < NEAR_SOLUTION_FRACTION
        )
    if always or not complete:
        for label, impulse in search_solutions(problem, reference, n, seed):
            candidate = make_reference(problem, impulse, label)
            if candidate.is_accepted:
                solutions.append((candidate, label))
            else:
                failed += 1
    merged = _merge_equal_motions(problem, solutions)
    speed, energy = 0.0, 0.0
    for i, first in enumerate(merged):
        for second in merged[:i]:
            pair_distance = measure_motion_distance(problem, first.impulse, second.impulse)
            speed, energy = max(speed, pair_distance.speed), max(energy, pair_distance.energy)
    result = SolutionSet(
        problem=problem,
        motions=tuple(merged),
        spread=speed,
        spread_energy=None if reference.refusal else energy,
        unique=proof.reason if proof else "",
        runs=len(solutions),
        failed=failed,
        all=complete,
    )
    get_motion_cache(problem).motions = result
    return result


def _make_motion_key(problem: Problem, x: FloatArray) -> bytes:
    """Return a key that is equal for equal motions: the slack w, rounded on two scales.

    w [m/s] is rounded to 1e-9 of the largest |b|. w scaled to sqrt(J) is rounded, too, which distinguishes slow
    motions of heavy bodies.
    """
    parts = []
    for unit in (np.ones(problem.m), 1.0 / np.sqrt(problem.d)):
        largest = float(np.max(np.abs(unit * problem.b), initial=0.0)) or 1.0
        parts.append(np.round(unit * problem.slack(x) / largest, 9) + 0.0)
    return np.concatenate(parts).tobytes()


def get_solutions(problem: Problem, n: int = N_SEARCH_RUNS) -> SolutionSet:
    """Return the motions of an earlier search with any number of runs; if there is none, search with `n` runs."""
    return get_motion_cache(problem).motions or find_solutions(problem, n)


def converge_to_solution(problem: Problem, impulse: Any) -> Reference:
    """Return the solution to which sweeps from an impulse (m,) [N s] converge; `newton` continues if they stall.

    If a problem under Coulomb's law has several motions, this is the motion that a solver would have reached if it had
    not stopped early. It is not stored with the problem. `Reference.is_accepted` shows whether it is a solution.
    """
    check_problem(problem)
    best = None
    x = problem.impulse_array(impulse)
    for name in ("anderson", "newton"):
        if name not in available(problem):
            continue
        end = raise_if_interrupted(solve(problem, name, impulse=x, tol=SEARCH_TOL))
        new = (
            make_reference(problem, end.impulse, f"{name} from it")
            if np.isfinite(end.impulse).all()
            else None
        )
        if new is not None and (best is None or new.residual.relative < best.residual.relative):
            best = new
        if best is not None and best.is_accepted:
            break
    return reference_of(problem) if best is None else best


def solve_with_vanishing_compliance(problem: Problem) -> FloatArray:
    """Return the solution (m,) [N s] that is the limit of solutions with vanishing compliance.

    Row i gets the compliance s A_ii. The factor s falls from 1 to 1e-12, then the problem is solved without it. Each
    solve starts from the result of the one before.
    """
    x, s = problem.start(), LARGEST_COMPLIANCE_FRACTION
    while s >= SMALLEST_COMPLIANCE_FRACTION:
        x = np.array(
            raise_if_interrupted(
                solve(add_compliance(problem, s * problem.d), "auto", impulse=x, tol=1e-12)
            ).impulse
        )
        s *= COMPLIANCE_STEP
    return np.array(raise_if_interrupted(solve(problem, "auto", impulse=x, tol=1e-13)).impulse)


def search_solutions(
    problem: Problem, reference: Reference, n: int, seed: int
) -> Iterator[tuple[str, FloatArray]]:
    """Run n solves; yield the label of each and the impulse (m,) [N s] at which it ended."""
    here = set(available(problem))
    solvers = [name for name in SEARCH_SOLVERS if name in here] or ["auto"]
    if "sequential_impulses" not in here and "pgs" in here:
        solvers.append("pgs")
    rng = np.random.default_rng(seed)
    budget = int(min(max(SWEEP_WORK_LIMIT / max(1, problem.data.work), SWEEP_RANGE[0]), SWEEP_RANGE[1]))
    for i in range(n):
        cycle, which = divmod(i, len(solvers))
        spec = get(solvers[which])
        options: dict[str, Any] = {}
        label = spec.name
        if spec.order:
            options["order"] = SEARCH_ORDERS[(i + cycle) % len(SEARCH_ORDERS)]
            label += f" {options['order']}"
            if options["order"] == "random":
                options["seed"] = int(rng.integers(2**31))
        # Solvers with a sweep order use start 0 in the first two cycles, in different orders. Other solvers get a new
        # start in each cycle.
        start = _make_start(problem, reference, rng, max(cycle - spec.order, 0))
        limit = budget if spec.resumable else spec.max_iter
        try:
            end = raise_if_interrupted(
                solve(problem, spec.name, impulse=start[1], tol=SEARCH_TOL, max_iter=limit, **options)
            )
        except LavenderError:  # The solver rejected the numbers of this problem.
            continue
        if np.isfinite(end.impulse).all():
            yield f"{label} from {start[0]}", end.impulse


def _make_start(
    problem: Problem, reference: Reference, rng: np.random.Generator, i: int
) -> tuple[str, FloatArray]:
    """Return start i and its name: first the guess (or the zero impulse), then random changes of the reference."""
    if i == 0:
        return ("doing nothing", problem.start()) if problem.guess is None else ("the guess", problem.guess)
    c = problem.cones
    x = reference.impulse * rng.lognormal(sigma=0.7, size=problem.m)
    size = (
        float(np.median(np.abs(reference.impulse[reference.impulse != 0.0])))
        if reference.impulse.any()
        else 1.0
    )
    normal, tangents = c.normal_rows, c.friction_rows
    x[normal] = np.maximum(x[normal], size * rng.random(len(normal)))
    x[tangents] = size * rng.normal(size=int(tangents.sum()))
    return "a random start", project_impulse(c, x)


def _merge_equal_motions(problem: Problem, solutions: list[tuple[Reference, str]]) -> list[Motion]:
    """Return one `Motion` for each set of solutions with equal motions, the most frequent first.

    It holds the solution of the set with the smallest residual.
    """
    groups: list[list[tuple[Reference, str]]] = []
    for first in solutions:
        for group in groups:
            if (
                measure_motion_distance(problem, first[0].impulse, group[0][0].impulse).relative_distance
                <= SAME_MOTION_FRACTION
            ):
                group.append(first)
                break
        else:
            groups.append([first])
    out = []
    for group in groups:
        best = min((reference for reference, _ in group), key=lambda r: r.residual.relative)
        out.append(_make_motion(problem, best, tuple(label for _, label in group)))
    return sorted(out, key=lambda motion: -motion.count)


def _make_motion(problem: Problem, reference: Reference, labels: tuple[str, ...]) -> Motion:
    """Build a `Motion` from a solution and the labels of the runs that found it."""
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


@np.errstate(over="ignore", invalid="ignore")  # Impulses may be at the limit of float64.
def measure_motion_distance(problem: Problem, x: ArrayLike, y: ArrayLike) -> Distance:
    """Compute the distance between the motions of two impulses (m,) [N s]."""
    cache = get_motion_cache(problem)
    operator = cache.operator
    x, y = problem.impulse_array(x, "x"), problem.impulse_array(y, "y")
    delta, size = subtract_impulses(operator, x, y)
    velocity = operator.compute_velocity(delta, np.zeros(problem.m))
    rows = np.abs(operator.compute_slack_with_rounding_bound(delta)[0] + problem.b)
    speed = rows if velocity is None else operator.compute_speeds(velocity[0])[0]
    max_speed = float(np.max(speed, initial=0.0))
    if cache.refusal:
        energy = float(np.max(rows, initial=0.0))
        largest = max(
            float(np.max(np.abs(operator.compute_slack_with_rounding_bound(z)[0] + problem.b), initial=0.0))
            for z in (x, y)
        )
    else:
        energy = size.energy
        largest = max(operator.compute_energy_norm(z, np.zeros(problem.m)).energy for z in (x, y))
    return Distance(
        max_speed, energy, energy / largest if largest > 0.0 else (0.0 if energy == 0.0 else np.inf)
    )


def motion_error(problem: Problem, impulse: Any, reference: Any = None) -> MotionError:
    """Compute the error of an impulse's motion: its distance from the solution, with a bound.

    With lambda* the reference and M^-1 J^T (lambda - lambda*) the difference dv of body velocities,

        kinetic = sqrt(1/2 dv.M dv)        energy = sqrt(1/2 (lambda - lambda*).A (lambda - lambda*))

    so that two impulses with a difference that moves no body (a table on four legs) have distance 0. The bound holds
    for any reference, also an inaccurate one: with e the judge's error of lambda*, the solution of the problem with
    targets shifted by d e is within sqrt(1/2) |e|_A of lambda* (proof in `lavender.lab.motion.bound`).

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s
    reference : (m,) N s, Solution or Reference, optional
        The solution to compare with. Default: the result of `auto` at the round-off floor, solved once and stored with
        the problem. Under Coulomb's law, the default is the nearest of the motions that `lavender.find_solutions`
        finds and of the motion to which sweeps from `impulse` converge.

    Returns
    -------
    MotionError
        Distances are None if the reference is not a solution, that is, if its relative residual is above 1e-10 and
        above twice its floor. Energies are None if A is asymmetric or indefinite; bounds are None under Coulomb's law.
        `note` gives the reason.

    Raises
    ------
    InputError
        An impulse or reference has a wrong length or is not finite.
    CapabilityError
        M couples more than 2000 generalised velocities.
    """
    check_problem(problem)
    x = problem.on_disk(problem.impulse_array(impulse))
    if problem.cones.has_ellipse:  # Measure the motion on the equivalent problem with friction disks.
        if reference is not None and not isinstance(reference, Reference):
            impulse_of_reference = problem.impulse_array(
                getattr(reference, "impulse", reference), "reference"
            )
            reference = problem.on_disk(impulse_of_reference)
        error = motion_error(problem.disk, x, reference)
        with np.errstate(over="ignore", invalid="ignore"):
            return convert_to_ellipse_rows(problem, x, error)
    with np.errstate(over="ignore", invalid="ignore"):  # Results that are not finite are reported in `note`.
        if reference is not None:
            return measure_distance(problem, x, as_reference(problem, reference))
        if problem.law != "coulomb":
            return measure_distance(problem, x, reference_of(problem))
        return measure_distance_to_nearest(problem, x, get_solutions(problem))


def measure_distance_to_nearest(problem: Problem, x: FloatArray, solutions: SolutionSet) -> MotionError:
    """Compute the distance of an impulse x (m,) [N s] from the nearest of several motions.

    The motion to which sweeps from x converge (`converge_to_solution`) is one of them.
    """
    references = [motion.reference for motion in solutions]
    spread, energy = solutions.spread, solutions.spread_energy
    if not solutions.unique:
        own = converge_to_solution(problem, x)
        distances = [measure_motion_distance(problem, own.impulse, motion.impulse) for motion in solutions]
        if own.is_accepted and all(d.relative_distance > SAME_MOTION_FRACTION for d in distances):
            references.append(own)
            spread = max([spread, *(d.speed for d in distances)])
            energy = None if energy is None else max([energy, *(d.energy for d in distances)])
    if not references:
        return measure_distance(problem, x, reference_of(problem))
    best = min((measure_distance(problem, x, reference) for reference in references), key=_get_error_sort_key)
    nearest_error = replace(
        best, spread=energy, spread_speed=spread, count=len(references), unique=solutions.unique
    )
    return drop_non_finite(nearest_error, ("spread", "spread_speed"))


def _get_error_sort_key(error: MotionError) -> float:
    """Return the sort key of an error: its energy, else its row error, else inf."""
    known = error.energy if error.energy is not None else error.rows
    return math.inf if known is None else known
