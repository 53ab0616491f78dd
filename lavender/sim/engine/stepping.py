"""LavenderSim's step loop: substeps, the solver that a scene names, what a step tells."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from threading import RLock
from time import perf_counter
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_int
from lavender.base.arrays import check_bool as checked
from lavender.base.errors import InputError, LavenderError, SolveFailed, UnknownName
from lavender.judge.solution import Solution, order_name, uninterrupted
from lavender.problem import Problem
from lavender.sim.engine.film import Film
from lavender.sim.engine.layout import HEAD, SIZE
from lavender.sim.engine.problem import judged, moved, problem_of
from lavender.sim.engine.state import State
from lavender.sim.scene import Scene
from lavender.sim.scene.scene import Parameters
from lavender.sim.scene.steppers import get_stepper
from lavender.solvers.newton import SPEC as NEWTON_SPEC
from lavender.solvers.registry import get
from lavender.solvers.warm_start import claim_of
from lavender.solving.outcome import finish
from lavender.solving.solve import solve
from lavender_ext.engine.arrays import NEED_ROOM, OK

NEWTON = NEWTON_SPEC.factory
TOL = 1e-6  # of lavender.solve
INSIDE = "this simulation is inside a step; a solver or callback may not use it until the step has ended"
CLOSED = "this simulation is closed"
CHUNK = 256  # compiled substeps between two looks for Ctrl-C
HALF = "a step ended between its substeps"
LAST_STEP = 2**31 - 1  # head's count of substeps begins again after it
P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S", bound="Stepping")


@dataclass(frozen=True)
class _Pending:
    """How a substep's solve ended; its `Solution` is made when it is asked for."""

    how: int
    sweeps: int
    factorisations: int
    time: float  # s


def alone(
    method: Callable[Concatenate[S, P], R],
) -> Callable[Concatenate[S, P], R]:
    """One call at a time: other threads wait; a call from inside a step or after `close` is refused."""

    @wraps(method)
    def call(self: S, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._lock:
            if self._refusal:
                raise LavenderError(self._refusal)
            return method(self, *args, **kwargs)

    return call


class Stepping:
    """The step loop of a scene: what `Simulation` adds its problems, records, films and snapshots to."""

    def __init__(
        self,
        scene: Scene | str,
        *,
        stepper: str | None = None,
        report_residual: bool = False,
        report_motion: bool = False,
    ) -> None:
        if isinstance(scene, str):
            scene = Scene(scene)
        if not isinstance(scene, Scene):
            raise InputError(f"scene is a {type(scene).__name__}; a lavender.Scene is needed, or a name")
        if not scene.bodies:
            raise InputError("the scene has no bodies; add some (add_box, add_sphere, add_plane)")
        if stepper is not None and get_stepper(stepper).name != scene.parameters.stepper:
            scene = scene.with_parameters(stepper=stepper, stepper_options={})
        self.scene = scene = copy(scene)  # what is added to it later is not in this simulation
        self.report_residual = checked("report_residual", report_residual)
        self.report_motion = checked("report_motion", report_motion)
        self._lock, self._refusal = RLock(), ""  # why no call is accepted: INSIDE, CLOSED, or empty
        self.films: list[Film] = []  # that every step is added to
        self._viewers: dict[int, Any] = {}  # open pages by the id of their film
        self._load(scene)

    def _load(self, scene: Scene) -> None:
        p = self._parameters = scene.parameters
        self._names = tuple(b.name for b in scene.bodies)
        self._joint_names = tuple(j.name for j in scene.joints)
        self.state = State.of_scene(scene)
        self._fingerprint = scene.fingerprint()
        self._own_sweeps = p.solver == "sequential_impulses"
        self._sweeps = get_stepper(p.stepper).sweeps if self._own_sweeps else (1, 2**31 - 1)
        # `newton` with nothing but a tolerance asked for: its first phase runs on the engine's own arrays
        tol = p.solver_options.get("tol", TOL)
        self._warm_tol = 0.0
        if p.solver == "newton" and set(p.solver_options) <= {"tol"} and isinstance(tol, (int, float)):
            self._warm_tol = float(tol) if 0.0 < tol < np.inf else 0.0
        self._order = sweep_order(p)
        self._steps = 0
        self._failed = 0
        self._over = ""  # why no step can follow
        self._recorded: Path | None = None  # where its steps were written last
        self._restored = False  # the list of pairs is somebody else's
        self._before: State | None = None  # a copy of what a step that may be stopped inside began with
        self._last: Solution | _Pending | None = None

    # -- running --------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._steps * self._parameters.dt

    @property
    def steps(self) -> int:
        """Steps done since the start or the last reset."""
        return self._steps

    @property
    def solver_iterations(self) -> int:
        """Budget of the velocity solve."""
        return int(self.state.head[HEAD["iterations"]])

    @property
    def warm_start(self) -> bool:
        """Whether impulses are carried over from the cache."""
        return bool(self.state.head[HEAD["warm_start"]])

    @property
    @alone
    def last_solution(self) -> Solution | None:
        """What the registered solver returned for the last substep.

        None with the built-in sweeps, and where the last substep had no rows.
        """
        if isinstance(self._last, _Pending):
            self._last = self._told(self._last)
        return self._last

    @alone
    def set_solver_iterations(self, n: int) -> None:
        """Budget from the next step on.

        Raises
        ------
        InputError
            Not a whole number of 4 to 64 for sequential_impulses (1 to 64 under other steppers than "impulses"), of at
            least 1 for other solvers.
        """
        self.state.head[HEAD["iterations"]] = check_int("solver_iterations", n, *self._sweeps)

    @alone
    def set_warm_start(self, flag: bool) -> None:
        """Warm starting from the next step on; the cache is kept up to date either way."""
        self.state.head[HEAD["warm_start"]] = checked("warm_start", flag)

    @alone
    def set_velocity(self, body: int | str, velocity: Any = None, angular_velocity: Any = None) -> None:
        """Set the velocity with which a body enters the next step, for example to apply an impact.

        What the last step published (observation, residual, solution, contact cache) does not change. A snapshot
        keeps the new velocity.

        Parameters
        ----------
        body : int or str
            Number or name of a body that is not static.
        velocity, angular_velocity : (3,) m/s, rad/s, optional
            In world axes. One that is left out stays as it is.

        Raises
        ------
        UnknownName
            No body has that name.
        InputError
            No such number, a name that several bodies have, a static body, or numbers that are not finite or too large.
        LavenderError
            The simulation had terminated: reset it or restore a snapshot.
        """
        self._check_can_step()
        i = self._body_number(body)
        name = self._names[i]
        if self.state.a["dyn"][i] < 0:
            raise InputError(f"{name} is static; it has no velocity")
        parts = ((0, "velocity", velocity, "m/s"), (3, "angular_velocity", angular_velocity, "rad/s"))
        values = [
            (first, as_array(f"{what} of {name}", x, (3,), unit=unit))
            for first, what, x, unit in parts
            if x is not None
        ]
        for first, x in values:
            self.state.a["v"][i, first : first + 3] = x

    def _body_number(self, body: int | str) -> int:
        if not isinstance(body, str):
            return check_int("body", body, 0, len(self._names) - 1)
        if body not in self._names:
            raise UnknownName("body", body, self._names)
        if self._names.count(body) > 1:
            raise InputError(f"{self._names.count(body)} bodies are named {body!r}; give the number of one")
        return self._names.index(body)

    @alone
    def reset(self, seed: int | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Back to the start of the scene; with `seed`, of the scene built with that seed.

        The sweep budget and the warm-start mode stay as they are.

        Returns
        -------
        observation, info
            As `step`, without a residual.
        """
        sweeps, warm = self.solver_iterations, self.warm_start
        if seed is not None:
            self.scene = self.scene.with_parameters(seed=check_int("seed", seed))
        self._load(self.scene)
        self.state.head[HEAD["iterations"]] = sweeps
        self.state.head[HEAD["warm_start"]] = warm
        return self._observe(), self._info()

    def step(self, action: None = None) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Advance by dt.

        Parameters
        ----------
        action : None
            There are no actions; the argument is there for Gymnasium's shape.

        Returns
        -------
        observation : dict of fresh arrays
            positions (n, 3) [m], quaternions (n, 4) w x y z, velocities (n, 6) [m/s, rad/s],
            joint_impulses (mj,) [N s, N m s], solver (8,) see `SOLVER_FIELDS` (its text has names and units), and
            contacts: pair (c, 2), point, normal, tangent (c, 3), depth (c,) [m, positive inside], impulses (c, r)
            [N s, N m s], the rows that contacts of this scene can have: normal, two tangents, spin, two that roll.
            Contacts and impulses are those of the final substep.
        reward : float
            0.0
        terminated : bool
            A position or velocity is no longer finite; `info["lost_body"]` names the body.
        truncated : bool
            False
        info : dict
            time [s], step, failed_solves, order (of the sweeps, by name; None if the solver takes none), and on
            request residual and motion.

        Raises
        ------
        SolveFailed
            With `on_failure="raise"`, before the state has changed.
        KeyboardInterrupt
            Ctrl-C while a registered solver runs: the state is that of before the step, or of after it where it
            was done already; never of a part.
        LavenderError
            The simulation had terminated (reset it or restore a snapshot), or is closed.
        """
        if action is not None:
            raise InputError(f"action is {action!r}; this simulation takes none")
        with self._lock:
            if self._refusal:
                raise LavenderError(self._refusal)
            self._check_can_step()
            self._refusal = INSIDE
            try:
                self._advance()
                lost = self._lost_body()
                observation = self._observe()
                if self.films:
                    for film in self.films:
                        film.add(self.time, observation)
                return observation, 0.0, bool(lost), False, self._info(lost)
            finally:
                self._refusal = ""

    def _check_can_step(self) -> None:
        if self._over:
            raise LavenderError(f"{self._over}; reset() or restore a snapshot")

    def _advance(self) -> None:
        substeps, first = self._parameters.substeps, self.state
        begun, failed = first.head.item(HEAD["step"]), self._failed
        # A registered solver may raise or be stopped in any substep, which then must be as if none had been;
        # until the first has ended, nothing has changed that the next step starts from.
        keeps = substeps > 1 and not self._own_sweeps
        if self._restored:
            make_pairs_anew(first)
            self._restored = False
        if keeps:
            if self._before is None or not np.array_equal(self._before.size, first.size):
                self._before = State(first.size)
            self._before.take(first)
        try:
            if self._own_sweeps:
                self._sweep_substeps()
            else:
                self._solve_substeps()
        except BaseException as error:
            done = (self.state.head.item(HEAD["step"]) - begun) % (LAST_STEP + 1)
            if done == substeps or self._lost_body():
                self._steps += 1  # it was whole
                raise
            if done and self._before is not None and keeps:
                first.take(self._before)
                first.head[HEAD["solved"]] = 0
                self.state = first
            if done and not keeps:
                self._over = HALF
            self._failed = failed
            if not isinstance(error, SolveFailed):
                self._last = None  # it may lie in arrays that have been written over
            raise
        self._steps += 1

    def _lost_body(self) -> str:
        # name of the body whose state is not finite, or empty; no step follows
        lost = self.state.head.item(HEAD["lost"])
        if lost < 0:
            return ""
        self._over = f"the state of {self._names[lost]!r} is not finite"
        return self._names[lost]

    def _sweep_substeps(self) -> None:
        left = self._parameters.substeps
        while True:
            status, done = self.state.kernel.substeps(min(left, CHUNK))
            left -= done
            if status == NEED_ROOM:
                self.state = self.state.grown()
            elif left == 0 or status != OK:
                return

    def prepare_substep(self) -> None:
        """Collide and build the rows of the next substep in `state`."""
        while self.state.kernel.prepare() == NEED_ROOM:
            self.state = self.state.grown()

    def _solve_substeps(self) -> None:
        warm = self._warm_tol > 0.0 and get("newton").factory == NEWTON
        for _ in range(self._parameters.substeps):
            self._last = None
            self.prepare_substep()
            kernel, a = self.state.kernel, self.state.a
            kernel.solve(False)
            if not (warm and self._solve_in_place()):
                try:
                    problem = self._problem(self.state)
                except InputError:  # its numbers are not finite
                    self._lose()
                    return
                if problem.m:
                    a["impulse"][: problem.m] = self._solve(problem)
                kernel.apply()
            if kernel.finish() != OK:
                return

    def _lose(self) -> None:
        # no solver takes the prepared problem: the run ends here, at the body that finish() finds
        self.state.kernel.apply()
        if self.state.kernel.finish() == OK:
            bodies = [*self.state.a["contact_pair"][:1].ravel().tolist(), int(self.state.a["body_of"][0])]
            self.state.head[HEAD["lost"]] = next(i for i in bodies if self.state.a["dyn"][i] >= 0)

    def _solve_in_place(self) -> bool:
        # The bits of lavender.solve(problem, "newton"), whose first phase this is, without making the problem.
        start = perf_counter()
        how, sweeps, factorisations, _ = self.state.warm.solve(self._warm_tol)
        if how:
            self._last = _Pending(how, sweeps, factorisations, perf_counter() - start)
        return bool(how)

    def _told(self, pending: _Pending) -> Solution:
        # The arrays of the last substep's problem stay as they were until the next one.
        problem = self._problem(self.state, steps=self._steps)
        claim = claim_of(pending.how, pending.sweeps, pending.factorisations)
        assert claim is not None
        impulse = self.state.a["impulse"][: problem.m].copy()
        options = dict(self._parameters.solver_options)
        options.pop("tol", None)
        return finish(
            problem, get("newton"), options, impulse, claim, self._warm_tol, 0.0, pending.time, None
        )

    def _solve(self, problem: Problem) -> FloatArray:
        p = self._parameters
        guess = problem.start() if problem.guess is None else problem.guess
        solution = solve(
            problem, p.solver, impulse=guess, max_iter=self.solver_iterations, **p.solver_options
        )
        if "callback" not in p.solver_options:
            uninterrupted(solution)  # half a solve is no step
        self._last = solution
        if solution.success or solution.residual.at_floor:
            return solution.impulse
        if p.on_failure == "raise":
            raise SolveFailed(f"{self.scene!r}, step {self._steps}: {solution}")
        self._failed += 1
        if p.on_failure == "keep" or not np.isfinite(solution.impulse).all():
            return guess
        return 0.5 * (guess + solution.impulse) if p.on_failure == "damp" else solution.impulse

    def _observe(self) -> dict[str, Any]:
        s = self.state
        c = s.head.item(HEAD["contacts"])
        seen = s.seen(c, s.head.item(HEAD["contact_rows"]))
        observation: dict[str, Any] = {name: copied() for name, copied in seen.whole.items()}
        contacts = {name: copied() for name, copied in seen.contacts.items()}
        contacts["depth"] = 0.0 - seen.gap
        contacts["impulses"] = seen.impulses() if seen.impulses is not None else self._spread(c, seen.per)
        observation["contacts"] = contacts
        return observation

    def _spread(self, c: int, per: int) -> FloatArray:
        # contacts that lack some of the scene's rows have zeros there
        a, kj = self.state.a, int(self.state.size[SIZE["joints"]])
        out = np.zeros((c, per))
        first, end = a["ptr"][kj : kj + c], a["ptr"][kj + 1 : kj + c + 1]
        for row in range(per):
            has = first + row < end
            out[has, row] = a["impulse"][first[has] + row]
        if per == 6:  # what rolls stands last, with or without spin before it
            bare = end - first == 5
            out[bare, 3:] = np.roll(out[bare, 3:], 1, axis=1)
        return out

    def _info(self, lost: str = "") -> dict[str, Any]:
        info: dict[str, Any] = {
            "time": self.time,
            "step": self._steps,
            "failed_solves": self._failed,
            "order": self._order,
        }
        if lost:
            info["lost_body"] = lost
        elif self.state.head.item(HEAD["solved"]):
            if self.report_residual:
                info["residual"] = self._judged()
            if self.report_motion:
                info["motion"] = self._moved()
        return info

    # -- the problem of the last substep ----------------------------------------------------------

    def _problem(self, state: State, steps: int | None = None) -> Problem:
        step = self._steps + 1 if steps is None else steps
        return problem_of(state, self._names, self._joint_names, f"{self.scene.name or 'scene'}, step {step}")

    def _judged(self) -> dict[str, Any]:
        return judged(*self._solved())

    def _moved(self) -> dict[str, Any]:
        problem, impulse = self._solved()
        return moved(problem, impulse, [b.name for b in self.scene.bodies if not b.is_static])

    def _solved(self) -> tuple[Problem, FloatArray]:
        # the problem of the last substep, and its impulses (m,) [N s]
        if not self.state.head[HEAD["solved"]]:
            raise InputError("no step has been done yet, or the last was stopped; call step() and ask again")
        problem = self._problem(self.state)
        return problem, self.state.a["impulse"][: problem.m].copy()

    def __repr__(self) -> str:
        return f"<Simulation of {self.scene!r}, step {self._steps}>"


def sweep_order(p: Parameters) -> str | None:
    """Return the order in which the solver of a scene visits the blocks in each sweep; None if it takes none."""
    if not get(p.solver).order:
        return None
    return order_name(p.solver_options.get("order", p.order))


def make_pairs_anew(state: State) -> None:
    """Have the next substep look for pairs itself: a list that lacks one cannot be told from one that is right."""
    for name in ("pairs_valid", "need_pairs", "need_contacts"):
        state.head[HEAD[name]] = 0
