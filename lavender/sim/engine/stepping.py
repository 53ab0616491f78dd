"""LavenderSim's step loop: substeps, the solver of the scene, and the observation of a step."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import partial, wraps
from pathlib import Path
from threading import RLock
from time import perf_counter
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_int
from lavender.base.arrays import check_bool as check_flag
from lavender.base.errors import InputError, LavenderError, SolveFailed, UnknownName
from lavender.judge.solution import Solution, get_order_name, raise_if_interrupted
from lavender.problem import Problem
from lavender.sim.engine.layout import HEAD, SIZE
from lavender.sim.engine.problem import build_problem, summarise_motion, summarise_residual
from lavender.sim.engine.state import State
from lavender.sim.scene import Scene
from lavender.sim.scene.parameters import MAX_SWEEPS, MIN_SWEEPS, Parameters
from lavender.solvers.newton import SPEC as NEWTON_SPEC
from lavender.solvers.newton import make_warm_start_claim
from lavender.solvers.registry import get
from lavender.solving.finish import FinishedRun, finish
from lavender.solving.solve import solve
from lavender_ext.engine.arrays import NEED_CAPACITY, OK

NEWTON = NEWTON_SPEC.factory
TOL = 1e-6  # Default tolerance of lavender.solve.
ZERO = np.zeros(())  # An array is subtracted from faster than a float.
INSIDE_STEP = (
    "this simulation is inside a step; a solver or callback may not use it until the step has ended"
)
SIMULATION_CLOSED = "this simulation is closed"
SUBSTEPS_PER_CALL = (
    256  # A compiled call does up to this many substeps; Ctrl-C is checked between calls.
)
INCOMPLETE_STEP = "a step ended between its substeps"
LAST_STEP = 2**31 - 1  # The counter of substeps in `head` restarts from 0 after this number.
P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S", bound="Stepping")


def run_exclusively(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """Decorate a method so that only one thread at a time runs it.

    A call from inside a step, or after `close`, raises LavenderError.
    """

    @wraps(method)
    def call(self: S, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._lock:
            if self._refusal:
                raise LavenderError(self._refusal)
            return method(self, *args, **kwargs)

    return call


class Stepping:
    """Base class of `Simulation`: the step loop of a scene, without records and snapshots."""

    def __init__(
        self, scene: Scene | str, *, report_residual: bool = False, report_motion: bool = False
    ) -> None:
        if isinstance(scene, str):
            scene = Scene(scene)
        if not isinstance(scene, Scene):
            raise InputError(
                f"scene is a {type(scene).__name__}; a lavender.Scene is needed, or a name"
            )
        if not scene.bodies:
            raise InputError(
                "the scene has no bodies; at least one is needed: add some with add_box, add_sphere or add_plane"
            )
        self.scene = scene = copy(
            scene
        )  # Later additions to the scene do not change this simulation.
        self.report_residual = check_flag("report_residual", report_residual)
        self.report_motion = check_flag("report_motion", report_motion)
        self._lock = RLock()
        self._refusal = ""  # `_refusal` is the reason why calls are rejected, or empty.
        self._load_scene(scene)

    def _load_scene(self, scene: Scene) -> None:
        """Set all attributes to the start of the scene."""
        p = self._parameters = scene.parameters
        self._names = tuple(b.name for b in scene.bodies)
        self._joint_names = tuple(j.name for j in scene.joints)
        self.state = State.from_scene(scene)
        self._fingerprint = scene.fingerprint()
        self._own_sweeps = p.solver == "sequential_impulses"
        self._sweeps = (MIN_SWEEPS, MAX_SWEEPS) if self._own_sweeps else (1, 2**31 - 1)
        # If `newton` has no option but the tolerance, its first phase runs on the engine's own arrays.
        tol = p.solver_options.get("tol", TOL)
        self._warm_tol = 0.0
        if (
            p.solver == "newton"
            and set(p.solver_options) <= {"tol"}
            and isinstance(tol, (int, float))
        ):
            self._warm_tol = float(tol) if 0.0 < tol < np.inf else 0.0
        self._order = get_sweep_order(p)
        # Whole steps of a compiled call.
        self._steps_per_call = max(1, SUBSTEPS_PER_CALL // p.substeps)
        self._steps = 0
        self._failed = 0
        self._end_reason = ""  # Reason why no step can follow, or empty.
        self._recorded: Path | None = None  # Folder to which `record` wrote last.
        # True if the state comes from a snapshot, so that its list of pairs is not valid.
        self._restored = False
        # Copy of the state, if a step can be stopped between substeps.
        self._state_before_step: State | None = None
        # Solution of the last substep, or a function that builds it at its first access.
        self._last: Solution | Callable[[], Solution] | None = None

    # -- running --------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._steps * self._parameters.dt

    @property
    def steps(self) -> int:
        """Number of steps since the start or the last reset."""
        return self._steps

    @property
    def solver_iterations(self) -> int:
        """Iteration budget of the velocity solve."""
        return int(self.state.head[HEAD["iterations"]])

    @property
    def warm_start(self) -> bool:
        """Whether a solve starts from the impulses of the contact cache."""
        return bool(self.state.head[HEAD["warm_start"]])

    @property
    @run_exclusively
    def last_solution(self) -> Solution | None:
        """Solution of the registered solver for the last substep.

        None with the built-in sweeps, or if the last substep had no rows.
        """
        if callable(self._last):
            self._last = self._last()
        return self._last

    @run_exclusively
    def set_solver_iterations(self, n: int) -> None:
        """Set the iteration budget from the next step on.

        Raises
        ------
        InputError
            `n` is not an integer from 4 to 64 for sequential_impulses, or of 1 or more for other solvers.
        """
        self.state.head[HEAD["iterations"]] = check_int("solver_iterations", n, *self._sweeps)

    @run_exclusively
    def set_warm_start(self, flag: bool) -> None:
        """Switch warm starting on or off from the next step on; the contact cache is updated in both cases."""
        self.state.head[HEAD["warm_start"]] = check_flag("warm_start", flag)

    @run_exclusively
    def set_velocity(
        self, body: int | str, velocity: Any = None, angular_velocity: Any = None
    ) -> None:
        """Set the velocity with which a body enters the next step, for example to apply an impact.

        The results of the last step (observation, residual, solution, contact cache) do not change. A snapshot
        contains the new velocity.

        Parameters
        ----------
        body : int or str
            Number or name of a body that is not static.
        velocity, angular_velocity : (3,) m/s, rad/s, optional
            In world axes. A velocity that is not given does not change.

        Raises
        ------
        UnknownName
            No body has that name.
        InputError
            The number does not exist, several bodies have the name, the body is static, or a velocity is not finite or
            too large.
        LavenderError
            The simulation has terminated: reset it or restore a snapshot.
        """
        self._check_can_step()
        if isinstance(body, str):
            if body not in self._names:
                raise UnknownName("body", body, self._names)
            if self._names.count(body) > 1:
                raise InputError(
                    f"{self._names.count(body)} bodies are named {body!r}; give the number of one"
                )
            body = self._names.index(body)
        i = check_int("body", body, 0, len(self._names) - 1)
        name = self._names[i]
        if self.state.a["dyn"][i] < 0:
            raise InputError(
                f"{name} is static, so its velocity cannot be set: choose a dynamic body"
            )
        parts = (
            (0, "velocity", velocity, "m/s"),
            (3, "angular_velocity", angular_velocity, "rad/s"),
        )
        values = [
            (first, as_array(f"{quantity} of {name}", x, (3,), unit=unit))
            for first, quantity, x, unit in parts
            if x is not None
        ]
        for first, x in values:
            self.state.a["v"][i, first : first + 3] = x
        # The body may meet others that the contacts kept so far do not know.
        self.state.head[HEAD["kept"]] = 0

    @run_exclusively
    def reset(self, seed: int | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return to the start of the scene; with `seed`, of the scene built with that seed.

        The sweep budget and the warm-start mode do not change.

        Returns
        -------
        observation, info
            As `step`, without a residual.
        """
        sweeps, warm = self.solver_iterations, self.warm_start
        if seed is not None:
            self.scene = self.scene.with_parameters(seed=check_int("seed", seed))
        self._load_scene(self.scene)
        self.state.head[HEAD["iterations"]] = sweeps
        self.state.head[HEAD["warm_start"]] = warm
        return self._make_observation(), self._make_step_info()

    def step(self, action: None = None) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Advance by dt.

        Parameters
        ----------
        action : None
            There are no actions; the argument exists for compatibility with Gymnasium.

        Returns
        -------
        observation : dict of new arrays
            positions (n, 3) [m], quaternions (n, 4) w x y z, velocities (n, 6) [m/s, rad/s],
            joint_impulses (mj,) [N s, N m s], solver (8,) see `SOLVER_FIELDS` (its text has names and units), and
            contacts: pair (c, 2), point, normal, tangent (c, 3), depth (c,) [m, positive inside], impulses (c, r)
            [N s, N m s] of the rows that contacts of this scene can have: normal, two tangents, torsion, two rolling
            rows. Contacts and impulses belong to the last substep.
        reward : float
            0.0
        terminated : bool
            A position or velocity is no longer finite; `info["lost_body"]` names the body.
        truncated : bool
            False
        info : dict
            time [s], step, failed_solves, order (name of the sweep order; None if the solver has none), and residual
            and motion if they were requested.

        Raises
        ------
        SolveFailed
            With `on_failure="raise"`, before the state has changed.
        KeyboardInterrupt
            Ctrl-C while a registered solver runs. The state is the one before the step, or the one after it if the
            step was complete; never one between substeps.
        LavenderError
            The simulation has terminated (reset it or restore a snapshot), or is closed.
        """
        if action is not None:
            raise InputError(
                f"action is {action!r}; this simulation has no actions, and None is needed"
            )
        return self._run_steps(1)

    def run(self, n: int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Advance by n steps, bit for bit as n calls of `step`, and return what the last of them returns.

        The built-in sweeps do many steps in one compiled call. The run ends early if the state is no longer finite.

        Parameters
        ----------
        n : int
            Number of steps, at least 1.

        Raises
        ------
        InputError
            `n` is not an integer of 1 or more.
        SolveFailed, KeyboardInterrupt, LavenderError
            As `step`. The complete steps before are kept and counted.

        Examples
        --------
        >>> import lavender as lv
        >>> observation, *_, info = lv.Simulation("stack").run(240)
        >>> info["step"]
        240
        """
        return self._run_steps(check_int("n", n, 1))

    def _run_steps(self, n: int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Do n steps, fewer if the state is lost, and return the result of the last one; see `step`."""
        with self._lock:
            if self._refusal:
                raise LavenderError(self._refusal)
            self._check_can_step()
            self._refusal = INSIDE_STEP
            if self._restored:
                invalidate_pair_list(self.state)
                self._restored = False
            lost = ""
            try:
                while n > 0 and not lost:
                    steps = min(n, self._steps_per_call) if self._own_sweeps else 1
                    if self._own_sweeps:
                        self._advance_by_sweeps(steps)
                    else:
                        self._advance_by_solver()
                    lost = self._find_lost_body()
                    n -= steps
                return self._make_observation(), 0.0, bool(lost), False, self._make_step_info(lost)
            finally:
                self._refusal = ""

    def _check_can_step(self) -> None:
        if self._end_reason:
            raise LavenderError(f"{self._end_reason}; reset() or restore a snapshot")

    def _advance_by_sweeps(self, steps: int) -> None:
        """Do steps by the compiled sweeps, and count those that are complete if an error ends them."""
        substeps = self._parameters.substeps
        first_substep = self.state.head.item(HEAD["step"])
        left = steps * substeps
        try:
            while left > 0:
                status, done = self.state.kernel.run_substeps(min(left, SUBSTEPS_PER_CALL))
                left -= done
                if status == NEED_CAPACITY:
                    self.state = self.state.with_larger_buffers()
                elif status != OK:
                    break
        finally:
            rest = 0
            if left == 0:
                self._steps += steps
            else:
                done = (self.state.head.item(HEAD["step"]) - first_substep) % (LAST_STEP + 1)
                complete, rest = divmod(done, substeps)
                self._steps += complete
            if rest and self.state.head.item(HEAD["lost"]) >= 0:
                self._steps += 1  # The step in which the state was lost counts.
            elif rest:
                self._end_reason = INCOMPLETE_STEP

    def _advance_by_solver(self) -> None:
        """Do a step by the registered solver; restore the state before the step if a substep raises."""
        substeps = self._parameters.substeps
        first = self.state
        first_substep = first.head.item(HEAD["step"])
        failed = self._failed
        # The solver may raise or be interrupted in any substep; the state before the step is then restored from a
        # copy. A single substep needs no copy: it changes the state only after its solve.
        needs_copy = substeps > 1
        if needs_copy:
            if self._state_before_step is None or not np.array_equal(
                self._state_before_step.size, first.size
            ):
                self._state_before_step = State(first.size)
            self._state_before_step.copy_from(first)
        try:
            self._solve_substeps()
        except BaseException as error:
            done = (self.state.head.item(HEAD["step"]) - first_substep) % (LAST_STEP + 1)
            if done == substeps or self._find_lost_body():
                self._steps += 1  # All substeps were done before the interruption: count the step.
                raise
            if done and self._state_before_step is not None:
                first.copy_from(self._state_before_step)
                first.head[HEAD["solved"]] = 0
                self.state = first
            self._failed = failed
            if not isinstance(error, SolveFailed):
                self._last = None  # The arrays of the last solution may have been overwritten.
            raise
        self._steps += 1

    def _find_lost_body(self) -> str:
        """Return the name of the body with a non-finite state, after which no step is possible, or an empty text."""
        lost = self.state.head.item(HEAD["lost"])
        if lost < 0:
            return ""
        self._end_reason = f"the state of {self._names[lost]!r} is not finite"
        return self._names[lost]

    def prepare_substep(self) -> None:
        """Detect collisions and build the rows of the next substep in `state`."""
        while self.state.kernel.prepare_substep() == NEED_CAPACITY:
            self.state = self.state.with_larger_buffers()

    def _solve_substeps(self) -> None:
        """Do the substeps with the registered solver of the scene."""
        warm = self._warm_tol > 0.0 and get("newton").factory == NEWTON
        for _ in range(self._parameters.substeps):
            self._last = None
            self.prepare_substep()
            kernel, a = self.state.kernel, self.state.a
            kernel.solve(False)
            rows = self.state.size.item(SIZE["joint_rows"]) + self.state.head.item(
                HEAD["contact_rows"]
            )
            if rows and warm:
                # Run the first phase of `newton` on the engine's arrays. The impulses are bit for bit the result of
                # lavender.solve(problem, "newton"), without building the problem.
                start = perf_counter()
                *counts, _ = self.state.warm_start_phase.solve(self._warm_tol)
                if counts[0]:
                    self._last = partial(self._build_solution, counts, perf_counter() - start)
            if rows and self._last is None:
                try:
                    problem = self._build_problem(self.state)
                except InputError:  # The numbers of the problem are not finite.
                    kernel.apply_impulses()
                    if kernel.finish_substep() == OK:  # Else it has reported the lost body.
                        bodies = [*a["contact_pair"][:1].ravel().tolist(), int(a["body_of"][0])]
                        self.state.head[HEAD["lost"]] = next(i for i in bodies if a["dyn"][i] >= 0)
                    return
                a["impulse"][: problem.m] = self._solve(problem)
                kernel.apply_impulses()
            if kernel.finish_substep() != OK:
                return

    def _build_solution(self, counts: list[int], solve_time: float) -> Solution:
        """Build the solution of the last substep. Its arrays do not change until the next substep."""
        problem = self._build_problem(self.state, steps=self._steps)
        claim = make_warm_start_claim(*counts)
        assert claim is not None
        impulse = self.state.a["impulse"][: problem.m].copy()
        options = dict(self._parameters.solver_options)
        options.pop("tol", None)
        run = FinishedRun(
            problem,
            get("newton"),
            options,
            impulse,
            claim,
            tol=self._warm_tol,
            start=impulse,  # The phase returns a start that it only judges as it is.
            solve_time=solve_time,
        )
        return finish(run)

    def _solve(self, problem: Problem) -> FloatArray:
        """Return impulses (m,) [N s] of the registered solver; a failed solve is treated as `on_failure` requires."""
        p = self._parameters
        guess = problem.start() if problem.guess is None else problem.guess
        solution = solve(
            problem, p.solver, impulse=guess, max_iter=self.solver_iterations, **p.solver_options
        )
        if "callback" not in p.solver_options:
            raise_if_interrupted(solution)  # An interrupted solve must not be used for a step.
        self._last = solution
        if solution.success or solution.residual.at_floor:
            return solution.impulse
        if p.on_failure == "raise":
            raise SolveFailed(
                f"step {self._steps} of {self.scene!r} failed, because {p.solver!r} did not solve its problem: "
                f"{solution}. Give more solver_iterations or another solver, or on_failure='use' to continue"
            )
        self._failed += 1
        if p.on_failure == "keep" or not np.isfinite(solution.impulse).all():
            return guess
        return 0.5 * (guess + solution.impulse) if p.on_failure == "damp" else solution.impulse

    def _make_observation(self) -> dict[str, Any]:
        """Return the observation of the present state, in new arrays."""
        s = self.state
        c = s.head.item(HEAD["contacts"])
        x, q, v, joints, out, pair, point, normal, tangent, gap, impulses = s.get_observation_views(
            c, s.head.item(HEAD["contact_rows"])
        )
        contacts: dict[str, Any] = {
            "pair": pair(),
            "point": point(),
            "normal": normal(),
            "tangent": tangent(),
            "depth": ZERO - gap,
        }
        contacts["impulses"] = impulses() if impulses else self._collect_uneven_impulses(c)
        return {
            "positions": x(),
            "quaternions": q(),
            "velocities": v(),
            "joint_impulses": joints(),
            "solver": out(),
            "contacts": contacts,
        }

    def _collect_uneven_impulses(self, c: int) -> FloatArray:
        """Return the impulses (c, r) [N s, N m s] of contacts with different numbers of rows; missing rows are zero."""
        s = self.state
        a = s.a
        kj = int(s.size[SIZE["joints"]])
        per = int(s.size[SIZE["rows_per_contact"]])
        out = np.zeros((c, per))
        first = a["ptr"][kj : kj + c]
        end = a["ptr"][kj + 1 : kj + c + 1]
        for row in range(per):
            has = first + row < end
            out[has, row] = a["impulse"][first[has] + row]
        if per == 6:
            # The rolling rows are the last two rows of a contact, with or without a torsion row before them.
            no_torsion = end - first == 5
            out[no_torsion, 3:] = np.roll(out[no_torsion, 3:], 1, axis=1)
        return out

    def _make_step_info(self, lost: str = "") -> dict[str, Any]:
        """Return the `info` of a step."""
        info: dict[str, Any] = {
            "time": self.time,
            "step": self._steps,
            "failed_solves": self._failed,
            "order": self._order,
        }
        if lost:
            info["lost_body"] = lost
        elif (self.report_residual or self.report_motion) and self.state.head.item(HEAD["solved"]):
            if self.report_residual:
                info["residual"] = self._summarise_residual()
            if self.report_motion:
                info["motion"] = self._summarise_motion_error()
        return info

    # -- the problem of the last substep ----------------------------------------------------------

    def _build_problem(self, state: State, steps: int | None = None) -> Problem:
        """Return the problem of a prepared substep of `state`."""
        step = self._steps + 1 if steps is None else steps
        return build_problem(
            state, self._names, self._joint_names, f"{self.scene.name or 'scene'}, step {step}"
        )

    def _summarise_residual(self) -> dict[str, Any]:
        return summarise_residual(*self._rebuild_last_problem())

    def _summarise_motion_error(self) -> dict[str, Any]:
        problem, impulse = self._rebuild_last_problem()
        return summarise_motion(
            problem, impulse, [b.name for b in self.scene.bodies if not b.is_static]
        )

    def _rebuild_last_problem(self) -> tuple[Problem, FloatArray]:
        """Return the problem of the last substep and its impulses (m,) [N s]; InputError if there is none."""
        if not self.state.head[HEAD["solved"]]:
            raise InputError(
                "the simulation has no complete last step, because none was made or it was stopped: call step() first"
            )
        problem = self._build_problem(self.state)
        return problem, self.state.a["impulse"][: problem.m].copy()

    def __repr__(self) -> str:
        return f"<Simulation of {self.scene!r}, step {self._steps}>"


def get_sweep_order(p: Parameters) -> str | None:
    """Return the name of the order in which the scene's solver visits the blocks; None if it has no order."""
    if not get(p.solver).order:
        return None
    return get_order_name(p.solver_options.get("order", p.order))


def invalidate_pair_list(state: State) -> None:
    """Mark the list of pairs of bodies that may touch as invalid, so that the next substep builds it again.

    The list of a snapshot is not used, because a missing pair in it could not be detected.
    """
    for name in ("pairs_valid", "need_pairs", "need_contacts"):
        state.head[HEAD[name]] = 0
