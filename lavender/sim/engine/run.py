"""Run a scene and record its solver values."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_int
from lavender.base.errors import InputError, require_packages
from lavender.io.stored import as_path, prepare_step_folder, write_bytes, write_text
from lavender.sim.engine.simulation import Simulation
from lavender.sim.engine.stepping import get_sweep_order
from lavender.sim.engine.values import SOLVER_FIELDS
from lavender.solvers.registry import get


@dataclass(frozen=True, eq=False)
class Trace:
    """Measurements of a run, with one entry for each step.

    Parameters
    ----------
    scene : str
    time : (steps,) s
        Simulated time.
    solver : (steps, 8)
        Solver values; see `SOLVER_FIELDS`.
    depth : (steps,) m
        Largest penetration depth.
    cost : (steps,) s
        Wall time of the step.
    lost_body : str
        Name of the body with the non-finite state that ended the run, or empty.
    recorded : int
        Number of problems written.
    title : str
        Title of figures.
    order : str
        Order in which a sweep visits the contacts.
    method : str
        Name of the solver (empty for the engine's own sweeps) and of the sweep order (left out if it has none).
    stopped : bool
        Ctrl-C ended the run; the trace contains the steps before.
    """

    scene: str
    time: FloatArray
    solver: FloatArray
    depth: FloatArray
    cost: FloatArray
    lost_body: str = ""
    recorded: int = 0
    title: str = ""
    order: str = ""
    method: str = ""
    stopped: bool = False

    def __len__(self) -> int:
        return len(self.time)

    def column(self, name: str) -> FloatArray:
        """Return one of `SOLVER_FIELDS` for all steps (steps,)."""
        return self.solver[:, SOLVER_FIELDS.index(name)]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the trace as CSV, one line for each step."""
        lines = [["step", "time", *SOLVER_FIELDS, "depth", "cost", "order"]]
        for i in range(len(self)):
            row = [self.time[i], *self.solver[i], self.depth[i], self.cost[i]]
            lines.append([str(i + 1), *(repr(float(x)) for x in row), self.order])
        write_text(path, "".join(",".join(format_step) + "\r\n" for format_step in lines))

    def plot(self, path: str | PathLike[str]) -> None:
        """Write a figure of residuals, contacts with cache matches, and depth over time."""
        require_packages("a figure of a run", "matplotlib")
        from matplotlib import rc_context
        from matplotlib.figure import Figure

        path = check_figure_path(path)
        content = io.BytesIO()
        canvas = Figure(figsize=(8, 7), layout="constrained")
        top, middle, bottom = canvas.subplots(3, 1, sharex=True)
        for name, label in (
            ("residual_initial", "before the\nfirst sweep"),
            ("residual_final", "after the last"),
        ):
            value = self.column(name)
            top.semilogy(self.time, np.where(value > 0.0, value, np.nan), label=label)
        top.set(title=f"{self.title}: residual of the normals", ylabel="max $|e_n|$ [N s]")
        for name, label, width in (
            ("contacts", "contacts", 5.0),
            ("cache_matches", "matches", 1.5),
        ):
            middle.plot(self.time, self.column(name), linewidth=width, label=label)
        middle.set(title="contacts, and those found in the cache", ylim=(0, None))
        for axes in (top, middle):
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
        bottom.plot(self.time, 1e3 * self.depth)
        bottom.set(title="largest depth", xlabel="time [s]", ylabel="[mm]", ylim=(0, None))
        try:
            with rc_context(
                {"pdf.fonttype": 42}
            ):  # Embed TrueType fonts, since publishers reject Type 3 fonts.
                canvas.savefig(content, format=path.suffix[1:].lower())
        except (ValueError, OverflowError) as error:
            raise InputError(f"cannot write the figure {str(path)!r}: {error}") from None
        write_bytes(path, content.getvalue())


def check_figure_path(path: str | PathLike[str]) -> Path:
    """Return the path of a figure, with .png if it has no suffix; InputError if matplotlib cannot write the format."""
    from matplotlib.backend_bases import FigureCanvasBase

    path = as_path(path)
    path = path if path.suffix else path.with_name(path.name + ".png")
    known = ", ".join(sorted(FigureCanvasBase.get_supported_filetypes()))
    if path.suffix[1:].lower() not in known.split(", "):
        raise InputError(f"cannot write the figure {str(path)!r}: its suffix must be of {known}")
    return path


def run(
    simulation: Simulation,
    steps: int,
    *,
    record: str | PathLike[str] | None = None,
    replace: bool = False,
    watch: Callable[[int, dict[str, Any], dict[str, Any]], Any] | None = None,
) -> Trace:
    """Step a simulation and return its trace; stop if the state is no longer finite, and after Ctrl-C.

    Parameters
    ----------
    simulation : Simulation
    steps : int
    record : path, optional
        Folder for the problem of every step.
    replace : bool
        Whether to remove the problems of another recording from the folder; if false, such a folder raises an error.
    watch : callable, optional
        Called as watch(step, observation, info) after every step.

    Returns
    -------
    Trace
    """
    steps = check_int("steps", steps, 1)
    recorded = 0
    solver = np.zeros((steps, 8))
    depth = np.zeros(steps)
    cost = np.zeros(steps)
    time = np.zeros(steps)
    lost = ""
    done = 0
    stopped = False
    folder = None if record is None else prepare_step_folder(record, replace)
    try:
        while done < steps and not lost:
            if folder is not None:
                recorded += simulation.write_problem(folder, 6) is not None
            start = perf_counter()
            observation, _, _, _, info = simulation.run(1)
            cost[done] = perf_counter() - start
            solver[done] = observation["solver"]
            depth[done] = observation["contacts"]["depth"].max(initial=0.0)
            time[done] = info["time"]
            lost = info.get("lost_body", "")
            done += 1
            if watch is not None:
                watch(done, observation, info)
    except KeyboardInterrupt:
        if not done:
            raise
        stopped = True
    scene = simulation.scene
    spec = get(scene.parameters.solver)
    order = get_sweep_order(scene.parameters) or scene.parameters.order
    method_parts = [] if spec.name == "sequential_impulses" else [spec.name]
    method = ", ".join([*method_parts, f"order {order}"] if spec.order else method_parts)
    title = f"{scene.name or 'scene'}, {simulation.solver_iterations} iterations, "
    title += f"{'warm' if simulation.warm_start else 'cold'}, {method}"
    return Trace(
        repr(scene),
        time[:done],
        solver[:done],
        depth[:done],
        cost[:done],
        lost_body=lost,
        recorded=recorded,
        title=title,
        order=order,
        method=method,
        stopped=stopped,
    )


def format_step(step: int, observation: Mapping[str, Any], info: Mapping[str, Any]) -> str:
    """Format a step as one line: time, contacts, contacts found in the cache, residual before and after, depth."""
    s = observation["solver"]
    depth = observation["contacts"]["depth"].max(initial=0.0)
    text = (
        f"step {step:>6}  t {info['time']:8.3f} s  contacts {int(s[2]):>5}  matches {int(s[3]):>5}  "
        f"residual {s[4]:.2e} -> {s[5]:.2e} N s  violation {s[7]:.2e} m/s  depth {1e3 * depth:7.3f} mm"
    )
    failed = f"  failed solves {info['failed_solves']}" if info["failed_solves"] else ""
    residual_text = (
        f"  relative {info['residual']['relative']:.2e}, worst {info['residual']['worst']}"
        if "residual" in info
        else ""
    )
    return text + failed + residual_text
