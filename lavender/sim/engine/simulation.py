"""`Simulation`: the step loop with its problems, records and snapshots."""

from __future__ import annotations

from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from lavender import io
from lavender.base.arrays import IntArray, check_int, mark_read_only
from lavender.base.errors import InputError, LavenderError, check_name
from lavender.io.stored import prepare_step_folder
from lavender.problem import Problem
from lavender.sim.engine.check import (
    check_snapshot_fields,
    check_state,
    check_state_sizes,
    require_intact,
)
from lavender.sim.engine.layout import HEAD
from lavender.sim.engine.snapshot import Snapshot
from lavender.sim.engine.state import State
from lavender.sim.engine.stepping import (
    INCOMPLETE_STEP,
    INSIDE_STEP,
    SIMULATION_CLOSED,
    Stepping,
    invalidate_pair_list,
    run_exclusively,
)
from lavender_ext.engine.arrays import NEED_CAPACITY, compute_buffer_lengths


class Simulation(Stepping):
    """Simulation of a scene in time. The scene is copied; later changes of it have no effect.

    Threads may share a simulation: a call waits until the calls of other threads have ended. A call from inside a step
    (by a solver that the step runs) raises LavenderError.

    A simulation is a context manager, which `close` ends.

    Parameters
    ----------
    scene : Scene or str
        A scene, or the name of one of the gallery.
    report_residual : bool, default False
        Compute the judge's residual of all rows of the last substep as `info["residual"]`. It costs about as much as a
        step.
    report_motion : bool, default False
        Compute the motion error of the last substep, the error of the bodies' velocities, as `info["motion"]`. It
        costs a solve to the round-off floor, and two solves with Coulomb friction.

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

    @run_exclusively
    def constraint_problem(self) -> Problem:
        """Return the velocity problem of the next substep, with its warm start as `guess`; the state is unchanged.

        It is the first substep of the next step, in which all contacts are built. Later substeps keep the rows of
        contacts whose bodies hardly move, and differ from it in velocities, gaps and impulses.

        `lavender.solve(problem, "sequential_impulses", tol=0, max_iter=n)` with n = `solver_iterations` returns the
        impulses of that substep bit for bit, with `order=sweep_order()` if the scene names an order. The observation
        of a step contains the impulses of its last substep.
        """
        return self._build_problem(self._prepare_next_substep())

    @run_exclusively
    def sweep_order(self) -> str | IntArray:
        """Return the `order` with which `lavender.solve` sweeps `constraint_problem()` as the next substep does.

        Returns
        -------
        str or (k,) int
            The scene's order. Under `alternating`, the problem lists the contacts as they are swept, and the order is
            "given"; under `colored_pairs`, the order is a permutation of blocks.
        """
        order = self._parameters.order
        if order != "colored_pairs":
            return "given" if order == "alternating" else order
        blocks: IntArray = self._prepare_next_substep().kernel.compute_sweep_order()
        return blocks

    def _prepare_next_substep(self) -> State:
        """Return a copy of the state with the problem of the next substep."""
        state = self.state.copy()
        if self._restored:
            invalidate_pair_list(state)
        while state.kernel.prepare_substep() == NEED_CAPACITY:
            state = state.with_larger_buffers()
        return state

    def sweep_seed(self) -> int:
        """Return the `seed` with which `lavender.solve(..., order="random")` uses the order of the next substep."""
        head = self.state.head
        return (int(head[HEAD["seed"]]) << 32) ^ int(head[HEAD["step"]])

    @run_exclusively
    def residual(self) -> dict[str, Any]:
        """Return the judge's residual of all rows of the last substep, for the impulses that it used.

        Returns
        -------
        dict
            relative [-], energy [sqrt J], velocity [m/s], floor [-], worst (name of a row), and share: the fractions
            of the squared energy error on joints, normals, disks and torsion (their sum is 1, or 0 without error).

        Raises
        ------
        InputError
            No step has been done.
        """
        return self._summarise_residual()

    @run_exclusively
    def motion(self) -> dict[str, Any]:
        """Return the motion error of the last substep: the distance to its solution, see `lavender.motion_error`.

        With Coulomb friction, several motions may be solutions; the reference is the solution that `auto` finds from
        the impulses of the step.

        Returns
        -------
        dict
            relative [-], kinetic [sqrt J], speed [m/s] and body (its name), spin [rad/s]; a value that cannot be
            computed is None.

        Raises
        ------
        InputError
            No step has been done.
        """
        return self._summarise_motion_error()

    def record(self, folder: str | PathLike[str], steps: int, *, form: str = "npz") -> list[Path]:
        """Step `steps` times and write the problem of the first substep of each step, with its warm start.

        Parameters
        ----------
        folder : path
            Created if it does not exist. `lavender report` can read it.
        steps : int
        form : {"npz", "fclib"}
            `.npz` holds every problem; `.hdf5` (FCLIB, extra `fclib`) only contacts without joints, torsional friction
            or soft rows.

        Returns
        -------
        list of Path
            One file for each step with rows.

        Raises
        ------
        InputError
            The folder cannot be written or holds problems that this simulation did not write, or `form` is unknown.
        CapabilityError
            FCLIB cannot hold the rows of the next step. That step is not done; the files of earlier steps are kept.
        """
        check_name("form", form, ("npz", "fclib"))
        steps = check_int("steps", steps, 1)
        folder = Path(folder)
        digits = len(str(self._steps + steps))
        written = []
        prepare_step_folder(folder, continued=folder.resolve() == self._recorded)
        self._recorded = folder.resolve()
        for _ in range(steps):
            written.append(self.write_problem(folder, digits, form))
            if self.step()[2]:
                break
        return [path for path in written if path is not None]

    def write_problem(self, folder: Path, digits: int, form: str = "npz") -> Path | None:
        """Write the problem of the next substep and return its path, or None if it has no rows.

        The file name consists of the scene's name and the number of the step with `digits` digits.
        """
        problem = self.constraint_problem()
        if not problem.m:
            return None
        suffix, drop = (".npz", ()) if form == "npz" else (".hdf5", ("names", "key"))
        path = folder / f"{self.scene.name or 'scene'}-{self._steps + 1:0{digits}d}{suffix}"
        io.save(problem, path, drop=drop)
        return path

    # -- the end --------------------------------------------------------------------------------

    def close(self) -> None:
        """End this simulation.

        Later calls raise LavenderError; the time, the number of steps and the settings can still be read. A second
        `close` does nothing.

        Raises
        ------
        LavenderError
            Called from inside a step.
        """
        with self._lock:
            if self._refusal == INSIDE_STEP:
                raise LavenderError(INSIDE_STEP)
            self._refusal = SIMULATION_CLOSED
            self._state_before_step = self._last = None

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- snapshots ------------------------------------------------------------------------------

    @run_exclusively
    def snapshot(self) -> Snapshot:
        """Return the complete state: bodies, contact cache, joint impulses, sweep budget, warm-start mode, counters.

        Raises
        ------
        LavenderError
            A step ended between its substeps.
        """
        if self._end_reason == INCOMPLETE_STEP:
            raise LavenderError(f"{INCOMPLETE_STEP}; call reset(), or restore a snapshot")
        s = self.state
        return Snapshot(
            fingerprint=self._fingerprint,
            steps=self._steps,
            failed=self._failed,
            lost=self._find_lost_body(),
            **{
                name: mark_read_only(getattr(s, name).copy())
                for name in ("size", "real", "index", "keys")
            },
        )

    @run_exclusively
    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of this scene, bit for bit.

        Raises
        ------
        InputError
            `snapshot` is not a snapshot, belongs to another scene, or contains a number that no step can produce. The
            simulation is unchanged.
        """
        if not isinstance(snapshot, Snapshot):
            raise InputError(
                f"snapshot is a {type(snapshot).__name__}; a Snapshot is needed: sim.snapshot()"
            )
        if snapshot.fingerprint != self._fingerprint:
            raise InputError(
                "the snapshot belongs to another scene, because bodies, joints or parameters differ; a "
                "snapshot of this scene is needed"
            )
        check_snapshot_fields(snapshot)
        size = snapshot.size.copy()
        check_state_sizes(self.state, size)
        found_lengths = (len(snapshot.real), len(snapshot.index), len(snapshot.keys))
        used = compute_buffer_lengths(size)
        is_complete = found_lengths == (used[0], used[1], max(used[2], 1))
        require_intact(is_complete, "its arrays do not have the sizes that it declares")
        state = State(size)
        state.real[:], state.index[:], state.keys[:] = snapshot.real, snapshot.index, snapshot.keys
        lost = snapshot.lost
        check_state(self.state, state, self._sweeps, bool(lost))
        is_lost_body = not lost or lost == self._names[state.head[HEAD["lost"]]]
        require_intact(is_lost_body, f"{lost[:40]!r} is not the body with the lost state")
        self.state = state
        self._restored = True
        self._steps, self._failed = snapshot.steps, snapshot.failed
        self._last = None
        self._end_reason = ""
        self._find_lost_body()

    def save(self, path: str | PathLike[str]) -> None:
        """Write a snapshot to a file; see `Snapshot.save`."""
        self.snapshot().save(path)

    def load(self, path: str | PathLike[str]) -> None:
        """Continue from a file written by `save`."""
        self.restore(Snapshot.load(path))

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy or pickle as a new simulation that continues from the same state."""
        make = partial(
            Simulation, report_residual=self.report_residual, report_motion=self.report_motion
        )
        return make, (self.scene,), self.snapshot()

    def __setstate__(self, snapshot: Snapshot) -> None:
        self.restore(snapshot)
