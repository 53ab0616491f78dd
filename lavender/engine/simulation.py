"""LavenderSim's step loop, and the constraint problem inside every step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from os import PathLike
from pathlib import Path
from threading import RLock
from time import perf_counter
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from lavender import io
from lavender._arrays import FloatArray, read_only
from lavender.cones import CONTACT_SPIN, Cones
from lavender.engine.check import same_scene, well_formed, whole_state
from lavender.engine.film import Film, header_of
from lavender.engine.layout import HEAD, NEED_ROOM, OK, SIZE
from lavender.engine.picture import save_picture
from lavender.engine.snapshot import Snapshot
from lavender.engine.state import State
from lavender.errors import InputError, LavenderError, SolveFailed, UnknownName
from lavender.problem import Problem
from lavender.registry import get
from lavender.residuals import Residual, residual
from lavender.rows import Rows
from lavender.scene import Scene
from lavender.scene.arithmetic import norm
from lavender.scene.parts import whole
from lavender.scene.scene import SWEEPS
from lavender.solution import Solution, Status
from lavender.solve import finish, solve
from lavender.solvers.newton import SPEC as NEWTON_SPEC
from lavender.solvers.warm_start import Tried, claim_of
from lavender_ext.engine.arrays import lengths

if TYPE_CHECKING:
    from lavender.web.view import Viewer

__all__ = ["SOLVER_FIELDS", "Simulation"]

#: The eight values of `observation["solver"]`, of the final substep: sweep budget, warm-start mode (0 or 1),
#: contacts, contacts found in the cache, max |e_n| [N s] before the first sweep and after the last, and
#: max(0, -w_n) [m/s] likewise.
SOLVER_FIELDS = (
    "iterations",
    "warm_start",
    "contacts",
    "cache_matches",
    "residual_initial",
    "residual_final",
    "violation_initial",
    "violation_final",
)
PARTS = ("joint", "normal", "disk", "spin")
NEWTON = NEWTON_SPEC.factory
TOL = 1e-6  # of lavender.solve
INSIDE = "this simulation is inside a step; a solver or callback may not use it until the step has ended"
AT_ONCE = 256  # compiled substeps between two looks for Ctrl-C
HALF = "a step ended between its substeps"
LAST_STEP = 2**31 - 1  # head's count of substeps begins again after it
P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class _Pending:
    """How a substep's solve ended; its `Solution` is made when it is asked for."""

    how: int
    sweeps: int
    factorisations: int
    time: float  # s


def _alone(
    method: Callable[Concatenate[Simulation, P], R],
) -> Callable[Concatenate[Simulation, P], R]:
    """One call at a time: other threads wait, and a call from inside a step is refused."""

    @wraps(method)
    def call(self: Simulation, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._lock:
            if self._inside:
                raise LavenderError(INSIDE)
            return method(self, *args, **kwargs)

    return call


class Simulation:
    """Steps a scene. The scene is read once; changing it later changes nothing here.

    Threads may share one: a call waits until those of the others have ended. What a solver calls from inside
    a step is refused.

    Parameters
    ----------
    scene : Scene or str
        A scene, or the name of one of the gallery.
    report_residual : bool, default False
        Put the judge's residual over all rows of the final substep into `info["residual"]`; costs about as
        much as a step.
    report_motion : bool, default False
        Put how wrong the bodies move after the final substep into `info["motion"]`; costs a solve to the floor,
        under Coulomb's law two.

    Raises
    ------
    InputError
        Not a scene, or one without bodies.
    """

    def __init__(
        self, scene: Scene | str, *, report_residual: bool = False, report_motion: bool = False
    ) -> None:
        if isinstance(scene, str):
            scene = Scene(scene)
        if not isinstance(scene, Scene):
            raise InputError(f"scene is a {type(scene).__name__}; a lavender.Scene is needed, or a name")
        if not scene.bodies:
            raise InputError("the scene has no bodies; add some (add_box, add_sphere, add_plane)")
        self.scene = scene
        self.report_residual = report_residual
        self.report_motion = report_motion
        self._lock, self._inside = RLock(), False
        self._films: list[Film] = []  # that every step is added to
        self._load(scene)

    def _load(self, scene: Scene) -> None:
        p = self._parameters = scene.parameters
        self._names = tuple(b.name for b in scene.bodies)
        self._joint_names = tuple(j.name for j in scene.joints)
        self._state = State.of_scene(scene)
        self._fingerprint = scene.fingerprint()
        self._own_sweeps = p.solver == "sequential_impulses"
        # `newton` with nothing but a tolerance asked for: its first phase runs on the engine's own arrays
        tol = p.solver_options.get("tol", TOL)
        self._warm_tol = 0.0
        if p.solver == "newton" and set(p.solver_options) <= {"tol"} and isinstance(tol, (int, float)):
            self._warm_tol = float(tol) if 0.0 < tol < np.inf else 0.0
        self._steps = 0
        self._failed = 0
        self._over = ""  # why no step can follow
        self._restored = False  # the list of pairs is somebody else's
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
        return int(self._state.head[HEAD["iterations"]])

    @property
    def warm_start(self) -> bool:
        """Whether impulses are carried over from the cache."""
        return bool(self._state.head[HEAD["warm_start"]])

    @property
    @_alone
    def last_solution(self) -> Solution | None:
        """What the registered solver returned for the last substep.

        None with the built-in sweeps, and where the last substep had no rows.
        """
        if isinstance(self._last, _Pending):
            self._last = self._told(self._last)
        return self._last

    @property
    def nbytes(self) -> int:
        """Bytes of the engine's arrays."""
        return self._state.nbytes

    @_alone
    def set_solver_iterations(self, n: int) -> None:
        """Budget from the next step on.

        Raises
        ------
        InputError
            Not a whole number of 4 to 64 for sequential_impulses, of at least 1 for other solvers.
        """
        low, high = SWEEPS if self._own_sweeps else (1, 2**31 - 1)
        self._state.head[HEAD["iterations"]] = whole("solver_iterations", n, low, high)

    @_alone
    def set_warm_start(self, flag: bool) -> None:
        """Warm starting from the next step on; the cache is kept up to date either way."""
        if not isinstance(flag, (bool, np.bool_)):
            raise InputError(f"warm_start is {flag!r}; True or False is needed")
        self._state.head[HEAD["warm_start"]] = bool(flag)

    @_alone
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
            self.scene = self.scene.with_parameters(seed=whole("seed", seed))
        self._load(self.scene)
        self._state.head[HEAD["iterations"]] = sweeps
        self._state.head[HEAD["warm_start"]] = warm
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
            joint_impulses (mj,) [N s, N m s], solver (8,) see `SOLVER_FIELDS`, and contacts: pair (c, 2),
            point, normal, tangent (c, 3), depth (c,) [m, positive inside], impulses (c, r) [N s, N m s], the
            rows that contacts of this scene can have: normal, two tangents, spin. Contacts and impulses are
            those of the final substep.
        reward : float
            0.0
        terminated : bool
            A position or velocity is no longer finite; `info["lost_body"]` names the body.
        truncated : bool
            False
        info : dict
            time [s], step, failed_solves, and on request residual and motion.

        Raises
        ------
        SolveFailed
            With `on_failure="raise"`, before the state has changed.
        KeyboardInterrupt
            Ctrl-C while a registered solver runs: the state is that of before the step, or of after it where it
            was done already; never of a part.
        LavenderError
            The simulation had terminated: reset it or restore a snapshot.
        """
        if action is not None:
            raise InputError(f"action is {action!r}; this simulation takes none")
        with self._lock:
            if self._inside:
                raise LavenderError(INSIDE)
            if self._over:
                raise LavenderError(f"{self._over}; reset() or restore a snapshot")
            self._inside = True
            try:
                self._advance()
                lost = self._lost_body()
                observation = self._observe()
                if self._films:
                    for film in self._films:
                        film.add(self.time, observation)
                return observation, 0.0, bool(lost), False, self._info(lost)
            finally:
                self._inside = False

    def _advance(self) -> None:
        substeps, first = self._parameters.substeps, self._state
        begun, failed = first.head.item(HEAD["step"]), self._failed
        # A registered solver may raise or be stopped in any substep, which then must be as if none had been;
        # until the first has ended, nothing has changed that the next step starts from.
        keeps = substeps > 1 and not self._own_sweeps
        if self._restored:
            _make_pairs_anew(first)
            self._restored = False
        if keeps:
            first.kernel.keep()
        try:
            if self._own_sweeps:
                self._sweep_substeps()
            else:
                self._solve_substeps()
        except BaseException as error:
            done = (self._state.head.item(HEAD["step"]) - begun) % (LAST_STEP + 1)
            if done == substeps or self._lost_body():
                self._steps += 1  # it was whole
                raise
            if done and keeps:
                first.kernel.put_back()
                self._state = first
            if done and not keeps:
                self._over = HALF
            self._failed = failed
            if not isinstance(error, SolveFailed):
                self._last = None  # it may lie in arrays that have been written over
            raise
        self._steps += 1

    def _lost_body(self) -> str:
        # name of the body whose state is not finite, or empty; no step follows
        lost = self._state.head.item(HEAD["lost"])
        if lost < 0:
            return ""
        self._over = f"the state of {self._names[lost]!r} is not finite"
        return self._names[lost]

    def _sweep_substeps(self) -> None:
        left = self._parameters.substeps
        while True:
            status, done = self._state.kernel.substeps(min(left, AT_ONCE))
            left -= done
            if status == NEED_ROOM:
                self._state = self._state.grown()
            elif left == 0 or status != OK:
                return

    def _prepare(self) -> None:
        while self._state.kernel.prepare() == NEED_ROOM:
            self._state = self._state.grown()

    def _solve_substeps(self) -> None:
        warm = self._warm_tol > 0.0 and get("newton").factory == NEWTON
        for _ in range(self._parameters.substeps):
            self._last = None
            self._prepare()
            kernel, a = self._state.kernel, self._state.a
            kernel.solve(False)
            if not (warm and self._solve_in_place()):
                try:
                    problem = self._problem(self._state)
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
        self._state.kernel.apply()
        if self._state.kernel.finish() == OK:
            bodies = [*self._state.a["contact_pair"][:1].ravel().tolist(), int(self._state.a["body_of"][0])]
            self._state.head[HEAD["lost"]] = next(i for i in bodies if self._state.a["dyn"][i] >= 0)

    def _solve_in_place(self) -> bool:
        # The bits of lavender.solve(problem, "newton"), whose first phase this is, without making the problem.
        start = perf_counter()
        how, sweeps, factorisations = self._state.warm.solve(self._warm_tol)
        if how:
            self._last = _Pending(how, sweeps, factorisations, perf_counter() - start)
        return bool(how)

    def _told(self, pending: _Pending) -> Solution:
        # The arrays of the last substep's problem stay as they were until the next one.
        problem = self._problem(self._state, steps=self._steps)
        claim = claim_of(Tried(pending.how, pending.sweeps, pending.factorisations))
        assert claim is not None
        impulse = self._state.a["impulse"][: problem.m].copy()
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
        if solution.status is Status.INTERRUPTED and "callback" not in p.solver_options:
            raise KeyboardInterrupt  # the front door has turned it into a result; half a solve is no step
        self._last = solution
        judged = solution.residual
        if solution.success or judged.relative <= 2.0 * judged.floor:
            return solution.impulse
        if p.on_failure == "raise":
            raise SolveFailed(f"{self.scene!r}, step {self._steps}: {solution}")
        self._failed += 1
        if p.on_failure == "keep" or not np.isfinite(solution.impulse).all():
            return guess
        return 0.5 * (guess + solution.impulse) if p.on_failure == "damp" else solution.impulse

    def _observe(self) -> dict[str, Any]:
        s = self._state
        c, rows = s.head.item(HEAD["contacts"]), s.head.item(HEAD["contact_rows"])
        seen = s.seen(c, rows)
        impulses = seen.impulses() if seen.impulses is not None else self._spread(c, seen.per)
        return {
            "positions": seen.positions(),
            "quaternions": seen.quaternions(),
            "velocities": seen.velocities(),
            "contacts": {
                "pair": seen.pair(),
                "point": seen.point(),
                "normal": seen.normal(),
                "tangent": seen.tangent(),
                "depth": 0.0 - seen.gap,
                "impulses": impulses,
            },
            "joint_impulses": seen.joint_impulses(),
            "solver": seen.solver(),
        }

    def _spread(self, c: int, per: int) -> FloatArray:
        # contacts that lack some of the scene's rows have zeros there
        a, kj = self._state.a, int(self._state.size[SIZE["joints"]])
        out = np.zeros((c, per))
        first, end = a["ptr"][kj : kj + c], a["ptr"][kj + 1 : kj + c + 1]
        for row in range(per):
            has = first + row < end
            out[has, row] = a["impulse"][first[has] + row]
        return out

    def _info(self, lost: str = "") -> dict[str, Any]:
        info: dict[str, Any] = {"time": self.time, "step": self._steps, "failed_solves": self._failed}
        if lost:
            info["lost_body"] = lost
        elif self._state.head.item(HEAD["solved"]):
            if self.report_residual:
                info["residual"] = self._judged()
            if self.report_motion:
                info["motion"] = self._moved()
        return info

    # -- the problem ----------------------------------------------------------------------------

    @_alone
    def constraint_problem(self) -> Problem:
        """The next substep's velocity problem, with its warm start as `guess`; changes no state.

        `lavender.solve(problem, "sequential_impulses", tol=0, max_iter=n)` returns the impulses of that substep,
        bit for bit, n being `solver_iterations`; with the scene's `order`, unless that is `alternating`: the
        contacts of such a problem stand in the order in which they are swept. The step publishes the
        impulses of its last substep.
        """
        state = self._state.copy()
        if self._restored:
            _make_pairs_anew(state)
        while state.kernel.prepare() == NEED_ROOM:
            state = state.grown()
        return self._problem(state)

    def sweep_seed(self) -> int:
        """`seed` for `lavender.solve(..., order="random")` that gives the next substep's order."""
        head = self._state.head
        return (int(head[HEAD["seed"]]) << 32) ^ int(head[HEAD["step"]])

    def _problem(self, state: State, steps: int | None = None) -> Problem:
        a = state.a
        kj, mj = int(state.size[SIZE["joints"]]), int(state.size[SIZE["joint_rows"]])
        c = int(state.head[HEAD["contacts"]])
        k, m = kj + c, mj + int(state.head[HEAD["contact_rows"]])
        normal = a["normal"][:c].copy()
        tangent = a["tangent"][:c].copy() if len(a["tangent"]) else np.zeros((c, 3))
        # contacts without friction have no tangent; any unit vector normal to the normal stands in
        bare = np.flatnonzero(a["mu"][kj:k] == 0.0)
        tangent[bare] = _any_tangent(normal[bare])
        rows = Rows(
            inv_mass=a["inv_mass"].copy(),
            inv_inertia=a["inv_inertia"].copy(),
            v_free=a["v_free"].copy(),
            jac=a["jac"].copy(),
            joint_ptr=a["ptr"][: kj + 1].copy(),
            joint_body=a["joint_body"].copy(),
            normal=normal,
            tangent=tangent,
            arm_a=a["arm_a"][:c].copy(),
            arm_b=a["arm_b"][:c].copy(),
            contact_body=a["contact_body"][:c].copy(),
            copy=False,
        )
        lower, upper = np.full(m, -np.inf), np.full(m, np.inf)
        lower[:mj], upper[:mj] = a["lower"][:mj], a["upper"][:mj]
        cones = Cones(
            ptr=a["ptr"][: k + 1].copy(),
            kind=a["kind"][:k].copy(),
            lower=lower,
            upper=upper,
            mu=a["mu"][:k].copy(),
            patch_radius=a["patch_radius"][:k].copy(),
        )
        guess = a["impulse"][:m].copy() if state.head[HEAD["warm_start"]] else None
        return Problem(
            a["b"][:m].copy(),
            cones,
            rows=rows,
            compliance=a["compliance"][:m].copy(),
            guess=guess,
            key=self._block_keys(state, kj, c),
            names=self._block_names(a["contact_pair"][:c], a["key"][:c]),
            name=f"{self.scene.name or 'scene'}, step {self._steps + 1 if steps is None else steps}",
            copy=False,
        )

    def _block_keys(self, state: State, kj: int, c: int) -> np.ndarray:
        # joints above all contacts: 24 bits for each body leave the pair (2^24 - 1, ...) free
        joints = np.uint64(0xFFFFFF << 40) + np.arange(kj, dtype=np.uint64)
        return np.concatenate([joints, state.a["key"][:c]])

    def _block_names(self, pair: np.ndarray, key: np.ndarray) -> list[str]:
        names = self._names
        points = (key & np.uint64(0xFFFF)).tolist()
        return [
            *self._joint_names,
            *(
                f"{names[i]} on {names[j]}, point {f}"
                for (i, j), f in zip(pair.tolist(), points, strict=True)
            ),
        ]

    @_alone
    def residual(self) -> dict[str, Any]:
        """The judge over all rows of the last substep, with the impulses that it used.

        Returns
        -------
        dict
            relative [-], energy [sqrt J], velocity [m/s], floor [-], worst (name of a row), and share: the
            part of energy squared that joints, normals, disks and spins have (they add up to 1, or to 0
            without error).

        Raises
        ------
        InputError
            No step has been done.
        """
        return self._judged()

    def _judged(self) -> dict[str, Any]:
        if not self._state.head[HEAD["solved"]]:
            raise InputError("no step has been done yet, or the last was stopped; call step() and ask again")
        problem = self._problem(self._state)
        judged = residual(problem, self._state.a["impulse"][: problem.m].copy())
        return {
            "relative": judged.relative,
            "energy": judged.energy,
            "velocity": judged.velocity,
            "floor": judged.floor,
            "worst": judged.worst_name,
            "share": _shares(problem, judged),
        }

    @_alone
    def motion(self) -> dict[str, Any]:
        """How wrong the bodies move after the last substep: distance to its solution, see `lavender.motion_error`.

        Under Coulomb's law, where several motions may be right, the distance is to the nearer of what `auto`
        finds and of what the step's own impulses lead to.

        Returns
        -------
        dict
            relative [-], kinetic [sqrt J], speed [m/s] and body (its name), spin [rad/s], bound [sqrt J] and
            bound_speed [m/s]; None where there is no number. open [m/s]: how far apart those two solutions are, 0
            without friction.

        Raises
        ------
        InputError
            No step has been done.
        """
        return self._moved()

    def _moved(self) -> dict[str, Any]:
        if not self._state.head[HEAD["solved"]]:
            raise InputError("no step has been done yet, or the last was stopped; call step() and ask again")
        problem = self._problem(self._state)
        impulse = self._state.a["impulse"][: problem.m].copy()
        from lavender import motion

        error, apart = motion.measure(problem, impulse, motion.reference(problem)), 0.0
        if problem.law == "coulomb":
            own = motion.branch(problem, impulse)
            near = motion.measure(problem, impulse, own)
            if own.accepted and error.reference.accepted:
                apart = motion.measure(problem, own.impulse, error.reference).speed or 0.0
            if near.kinetic is not None and (error.kinetic is None or near.kinetic < error.kinetic):
                error = near
        names = ("relative", "kinetic", "speed", "spin", "bound", "bound_speed")
        moving = [b.name for b in self.scene.bodies if not b.is_static]
        body = moving[error.body] if error.body >= 0 else ""
        return {**{name: getattr(error, name) for name in names}, "body": body, "open": apart}

    def record(self, folder: str | PathLike[str], steps: int, *, form: str = "npz") -> list[Path]:
        """Step `steps` times and write the problem of each (of its first substep), with its warm start.

        Parameters
        ----------
        folder : path
            Made if it does not exist; `lavender report` takes it as it is.
        steps : int
        form : {"npz", "fclib"}
            `.npz` holds everything; `.hdf5` (FCLIB, extra `fclib`) contacts without joints, spin or soft rows.

        Returns
        -------
        list of Path
            One file for each step that had rows.

        Raises
        ------
        InputError
            A folder that cannot be written, another form.
        CapabilityError
            FCLIB cannot hold these rows; nothing is stepped.
        """
        if form not in ("npz", "fclib"):
            raise UnknownName("form", form, ("npz", "fclib"))
        steps = whole("steps", steps, 1)
        folder = Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot make the folder {str(folder)!r}: {error.strerror}") from None
        more: dict[str, Any] = {} if form == "npz" else {"drop": ("names", "key")}
        suffix = ".npz" if form == "npz" else ".hdf5"
        name, digits = self.scene.name or "scene", len(str(self._steps + steps))
        written = []
        for _ in range(steps):
            problem = self.constraint_problem()
            if problem.m:
                path = folder / f"{name}-{self._steps + 1:0{digits}d}{suffix}"
                io.save(problem, path, **more)
                written.append(path)
            if self.step()[2]:
                break
        return written

    # -- pictures -------------------------------------------------------------------------------

    def film(self, steps: int) -> Film:
        """Step `steps` times and keep the poses, from the present ones on; stops where the state is no longer finite.

        Parameters
        ----------
        steps : int

        Returns
        -------
        Film
            steps + 1 frames; `save` writes a file that `lavender view` opens.
        """
        steps = whole("steps", steps, 1)
        film = self.start_film()
        try:
            for _ in range(steps):
                if self.step()[2]:
                    break
        finally:
            self.end_film(film)
        return film

    @_alone
    def start_film(self) -> Film:
        """A film of the present poses, to which every step is added until `end_film`."""
        film = Film(header_of(self.scene, self._state))
        film.add(self.time, self._observe())
        self._films.append(film)
        return film

    @_alone
    def end_film(self, film: Film) -> None:
        """No step is added to that film any more."""
        film.ended = True
        self._films = [other for other in self._films if other is not film]

    def frames(self, path: str | PathLike[str], steps: int = 120, **more: Any) -> Path:
        """Step `steps` times and write pictures by matplotlib: `.gif` an animation, `.png`, `.svg`, `.pdf` a strip.

        Parameters
        ----------
        path : path
        steps : int
        **more
            frames (4, of a strip), turn, tilt [rad], size [inch], rate [1/s, of an animation].

        Returns
        -------
        Path

        Raises
        ------
        InputError
            Another suffix, a path that cannot be written.
        """
        return save_picture(self.film(steps), path, **more)

    def view(self, *, port: int = 0, browser: bool = True) -> Viewer:
        """Show this simulation in a page on this machine: every step from now on, live, and all of them again.

        Parameters
        ----------
        port : int
            On the loopback address; 0 takes a free one.
        browser : bool
            Open the page.

        Returns
        -------
        Viewer
            A context manager; `address`, `film`, `wait()` until Ctrl-C, `close()`.

        Raises
        ------
        InputError
            A port that is taken.

        Examples
        --------
        >>> import lavender as lv
        >>> sim = lv.Simulation("stack")
        >>> with sim.view(browser=False) as viewer:
        ...     for _ in range(10):
        ...         _ = sim.step()
        >>> len(viewer.film)
        11
        """
        from lavender.web.view import Viewer  # above this room: only when it is asked for

        film = self.start_film()
        try:
            return Viewer(film, port=port, browser=browser, end=lambda: self.end_film(film))
        except BaseException:
            self.end_film(film)
            raise

    # -- snapshots ------------------------------------------------------------------------------

    @_alone
    def snapshot(self) -> Snapshot:
        """The whole state: bodies, contact cache, joint impulses, sweep budget, warm-start mode, counters.

        Raises
        ------
        LavenderError
            A step ended between its substeps.
        """
        if self._over == HALF:
            raise LavenderError(f"{HALF}; reset() or restore a snapshot")
        s = self._state
        return Snapshot(
            fingerprint=self._fingerprint,
            steps=self._steps,
            failed=self._failed,
            lost=self._lost_body(),
            size=read_only(s.size.copy()),
            real=read_only(s.real.copy()),
            index=read_only(s.index.copy()),
            keys=read_only(s.keys.copy()),
        )

    @_alone
    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of this scene, bit for bit.

        Raises
        ------
        InputError
            Not a snapshot, of another scene, or with a number in it that no step can have left. Nothing changes.
        """
        if not isinstance(snapshot, Snapshot):
            raise InputError(
                f"snapshot is a {type(snapshot).__name__}; a Snapshot is needed (sim.snapshot())"
            )
        if snapshot.fingerprint != self._fingerprint:
            raise InputError("the snapshot is of another scene: bodies, joints or parameters differ")
        well_formed(snapshot)
        size = snapshot.size.copy()
        same_scene(self._state, size)
        given = (len(snapshot.real), len(snapshot.index), len(snapshot.keys))
        used = lengths(size)
        if given != (used[0], used[1], max(used[2], 1)):
            raise InputError("the snapshot is damaged: its arrays do not fit its sizes")
        state = State(size)
        state.real[:], state.index[:], state.keys[:] = snapshot.real, snapshot.index, snapshot.keys
        lost = snapshot.lost
        whole_state(self._state, state, SWEEPS if self._own_sweeps else (1, 2**31 - 1), bool(lost))
        if lost != (self._names[state.head[HEAD["lost"]]] if lost else ""):
            raise InputError(
                f"the snapshot is damaged: {lost[:40]!r} is not the body whose state it says is lost"
            )
        self._state, self._restored = state, True
        self._steps, self._failed = snapshot.steps, snapshot.failed
        self._last, self._over = None, ""
        self._lost_body()

    def save(self, path: str | PathLike[str]) -> None:
        """Write a snapshot to a file; see `Snapshot.save`."""
        self.snapshot().save(path)

    def load(self, path: str | PathLike[str]) -> None:
        """Continue from a file written by `save`.

        Raises
        ------
        InputError
            Not such a file, damaged, or of another scene.
        """
        self.restore(Snapshot.load(path))

    def __repr__(self) -> str:
        return f"<Simulation of {self.scene!r}, step {self._steps}>"


def _make_pairs_anew(state: State) -> None:
    # a list that lacks a pair cannot be told from one that is right; contacts do not depend on its age
    for name in ("pairs_valid", "need_pairs", "need_contacts"):
        state.head[HEAD[name]] = 0


def _any_tangent(normal: FloatArray) -> FloatArray:
    out = np.zeros_like(normal)
    for i, n in enumerate(normal):
        t = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        size = norm(t)
        if size > 0.0:  # a body so far off that its contact has no direction: Rows says so
            out[i] = t / size
    return out


def _shares(problem: Problem, judged: Residual) -> dict[str, float]:
    c = problem.cones
    part = np.zeros(problem.m, np.int32)
    contact = np.flatnonzero(c.kind > 0)
    part[c.ptr[0] :] = 2
    joints = len(c.kind) - len(contact)
    part[: c.ptr[joints]] = 0
    part[c.ptr[:-1][contact]] = 1
    part[c.ptr[1:][c.kind == CONTACT_SPIN] - 1] = 3
    with np.errstate(invalid="ignore"):
        size = np.sqrt(problem.d) * np.abs(judged.error)
    top = float(size.max(initial=0.0))
    # Over the largest, so that squares neither overflow nor vanish; what is infinite has no shares.
    energy = (size / top) ** 2 if 0.0 < top < np.inf else np.zeros(problem.m)
    total = float(energy.sum())
    sums = np.bincount(part, weights=energy, minlength=4) if problem.m else np.zeros(4)
    return {name: float(x / total) if total > 0.0 else 0.0 for name, x in zip(PARTS, sums, strict=True)}
