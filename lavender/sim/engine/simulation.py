"""`Simulation`: the step loop with its problems, records, films and snapshots."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

from lavender import io
from lavender.base.arrays import check_int, read_only
from lavender.base.errors import InputError, LavenderError, check_name
from lavender.base.lazy_import import lazy_module
from lavender.io.stored import folder_for_steps
from lavender.problem import Problem
from lavender.sim.engine.check import same_scene, well_formed, whole_state
from lavender.sim.engine.film import Film, header_of
from lavender.sim.engine.layout import HEAD
from lavender.sim.engine.picture import save_picture
from lavender.sim.engine.snapshot import Snapshot
from lavender.sim.engine.state import State
from lavender.sim.engine.stepping import CLOSED, HALF, INSIDE, Stepping, alone, make_pairs_anew
from lavender.sim.scene import Scene
from lavender_ext.engine.arrays import NEED_ROOM, lengths


class Simulation(Stepping):
    """Steps a scene in time. The scene is copied at the start; changing it later has no effect here.

    Threads may share a simulation: a call waits until the calls of other threads have ended. A call from inside a step
    (by a solver that the step runs) is refused.

    A simulation is a context manager: `close` ends its films and viewers.

    Parameters
    ----------
    scene : Scene or str
        A scene, or the name of one of the gallery.
    stepper : str, optional
        A name of `lavender.sim.scene.steppers`, used with its default options instead of the scene's stepper.
    report_residual : bool, default False
        Put the judge's residual of all rows of the last substep into `info["residual"]`; costs about as much as a
        step.
    report_motion : bool, default False
        Put the motion error of the last substep into `info["motion"]` (how wrong the bodies' velocities are); costs a
        solve to the floor, and two under Coulomb's law.

    Raises
    ------
    InputError
        `scene` is not a scene, or has no bodies.

    Examples
    --------
    >>> import lavender as lv
    >>> with lv.Simulation("stack") as sim:
    ...     sim.set_velocity("box 6", (1.0, 0.0, 0.0))  # m/s, an impact on the top box
    ...     observation, *_ = sim.step()
    >>> bool(observation["velocities"][6, 0] > 0.9)
    True
    """

    # -- the problem ----------------------------------------------------------------------------

    @alone
    def constraint_problem(self) -> Problem:
        """The next substep's velocity problem, with its warm start as `guess`; changes no state.

        `lavender.solve(problem, "sequential_impulses", tol=0, max_iter=n)` returns the impulses of that substep,
        bit for bit, n being `solver_iterations`; with the scene's `order`, unless that is `alternating`: the
        contacts of such a problem stand in the order in which they are swept. The step publishes the
        impulses of its last substep. So it is with the stepper `impulses`; others solve no velocity problem, or
        another one, and their impulses are not those of any solver of this.
        """
        state = self.state.copy()
        if self._restored:
            make_pairs_anew(state)
        while state.kernel.prepare() == NEED_ROOM:
            state = state.grown()
        return self._problem(state)

    def sweep_seed(self) -> int:
        """`seed` for `lavender.solve(..., order="random")` that gives the next substep's order."""
        head = self.state.head
        return (int(head[HEAD["seed"]]) << 32) ^ int(head[HEAD["step"]])

    @alone
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

    @alone
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
            A folder that cannot be written or that holds problems which this simulation did not write, another form.
        CapabilityError
            FCLIB cannot hold the rows of the next step, which is not done; files of the steps before it stay.
        """
        check_name("form", form, ("npz", "fclib"))
        steps = check_int("steps", steps, 1)
        folder = Path(folder)
        digits, written = len(str(self._steps + steps)), []
        with folder_for_steps(folder, continued=folder.resolve() == self._recorded):
            self._recorded = folder.resolve()
            for _ in range(steps):
                written.append(self.write_problem(folder, digits, form))
                if self.step()[2]:
                    break
        return [path for path in written if path is not None]

    def write_problem(self, folder: Path, digits: int, form: str = "npz") -> Path | None:
        """Write the next substep's problem, where it has rows, under the scene's name and the step's number."""
        problem = self.constraint_problem()
        if not problem.m:
            return None
        suffix, drop = (".npz", ()) if form == "npz" else (".hdf5", ("names", "key"))
        path = folder / f"{self.scene.name or 'scene'}-{self._steps + 1:0{digits}d}{suffix}"
        io.save(problem, path, drop=drop)
        return path

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
        steps = check_int("steps", steps, 1)
        film = self.start_film()
        try:
            for _ in range(steps):
                if self.step()[2]:
                    break
        finally:
            self.end_film(film)
        return film

    @alone
    def start_film(self) -> Film:
        """A film of the present poses, to which every step is added until `end_film`."""
        film = Film(header_of(self.scene, self.state))
        film.add(self.time, self._observe())
        self.films.append(film)
        return film

    def end_film(self, film: Film) -> None:
        """Add no further step to a film."""
        with self._lock:
            if self._refusal == INSIDE:
                raise LavenderError(INSIDE)
            film.ended = True
            self.films = [other for other in self.films if other is not film]

    def frames(self, path: str | PathLike[str], steps: int = 120, **more: Any) -> Path:
        """Step `steps` times and write pictures: `.gif`, `.mp4` an animation, `.png`, `.svg`, `.pdf` a strip.

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

    def view(self, *, port: int = 0, browser: bool = True) -> Any:
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
        film = self.start_film()

        def end() -> None:
            self._viewers.pop(id(film), None)
            self.end_film(film)

        try:
            viewer = lazy_module("lavender.sim.web.view").Viewer(film, port=port, browser=browser, end=end)
        except BaseException:
            self.end_film(film)
            raise
        self._viewers[id(film)] = viewer
        return viewer

    # -- the end --------------------------------------------------------------------------------

    def close(self) -> None:
        """End the films and close the viewers of this simulation.

        Later calls raise LavenderError; the time, the number of steps and the settings can still be read. A second
        `close` does nothing.

        Raises
        ------
        LavenderError
            Called from inside a step.
        """
        with self._lock:
            if self._refusal == INSIDE:
                raise LavenderError(INSIDE)
            self._refusal = CLOSED
            for film in self.films:
                film.ended = True
            self.films = []
            self._before = self._last = None
        for viewer in list(self._viewers.values()):
            viewer.close()

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- snapshots ------------------------------------------------------------------------------

    @alone
    def snapshot(self) -> Snapshot:
        """The whole state: bodies, contact cache, joint impulses, sweep budget, warm-start mode, counters.

        Raises
        ------
        LavenderError
            A step ended between its substeps.
        """
        if self._over == HALF:
            raise LavenderError(f"{HALF}; reset() or restore a snapshot")
        s = self.state
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

    @alone
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
        same_scene(self.state, size)
        given = (len(snapshot.real), len(snapshot.index), len(snapshot.keys))
        used = lengths(size)
        if given != (used[0], used[1], max(used[2], 1)):
            raise InputError("the snapshot is damaged: its arrays do not fit its sizes")
        state = State(size)
        state.real[:], state.index[:], state.keys[:] = snapshot.real, snapshot.index, snapshot.keys
        lost = snapshot.lost
        whole_state(self.state, state, self._sweeps, bool(lost))
        if lost != (self._names[state.head[HEAD["lost"]]] if lost else ""):
            raise InputError(
                f"the snapshot is damaged: {lost[:40]!r} is not the body whose state it says is lost"
            )
        self.state, self._restored = state, True
        self._steps, self._failed = snapshot.steps, snapshot.failed
        self._last, self._over = None, ""
        self._lost_body()

    def save(self, path: str | PathLike[str]) -> None:
        """Write a snapshot to a file; see `Snapshot.save`."""
        self.snapshot().save(path)

    def load(self, path: str | PathLike[str]) -> None:
        """Continue from a file written by `save`."""
        self.restore(Snapshot.load(path))

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied or pickled it is one of its own that goes on from the same state; films stay with this one."""
        return _gone_on, (self.scene, self.report_residual, self.report_motion, self.snapshot())


def _gone_on(scene: Scene, report_residual: bool, report_motion: bool, snapshot: Snapshot) -> Simulation:
    sim = Simulation(scene, report_residual=report_residual, report_motion=report_motion)
    sim.restore(snapshot)
    return sim
