"""Define `lavender run`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from lavender.base.errors import InputError
from lavender.base.exits import EXIT_UNMET
from lavender.cli.completion import complete_scene, complete_solver
from lavender.cli.options import (
    PATH,
    exit_after_interrupt,
    parse_parameters,
    print_escaped,
    reject_options_without_effect,
)
from lavender.io.stored import check_writable


@click.command()
@click.argument("scene", shell_complete=complete_scene)
@click.option("--steps", type=int, default=240, show_default=True, help="Number of steps.")
@click.option("--iterations", "solver_iterations", type=int, help="Sweeps per solve, 4 to 64.")
@click.option(
    "--warm-start/--no-warm-start",
    default=None,
    help="Carry impulses from step to step.  [default: warm-start]",
)
@click.option(
    "--order",
    help="Order in which a sweep visits the blocks: given, reverse, bottom_up, top_down, alternating, ... "
    "Default: alternating.",
)
@click.option(
    "--solver",
    shell_complete=complete_solver,
    help="Solver of each step, by name. Default: sequential_impulses.",
)
@click.option(
    "--velocity-tol",
    type=float,
    metavar="M/S",
    help="With --solver: velocity error that each solve must reach [m/s, rad/s], in place of its tolerance.",
)
@click.option(
    "--set",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    help="Set a parameter of the scene, e.g. n=20 or friction=0.3; may be repeated.",
)
@click.option(
    "--residual", is_flag=True, help="Also measure the judge's residual of all rows in every step."
)
@click.option("--plot", type=PATH, help="Write a figure of the run (.svg, .png).")
@click.option("--trace", type=PATH, help="Write the values of every step (.csv).")
@click.option("--record", type=PATH, help="Write the problem of every step (.npz) to this folder.")
@click.option(
    "--replace",
    is_flag=True,
    help="With --record: first delete the problems of an earlier recording.",
)
@click.option("--film", type=PATH, help="Write a film of the run (.gif).")
@click.pass_context
def run(
    context: click.Context,
    /,
    scene: str,
    steps: int,
    parameters: tuple[str, ...],
    residual: bool,
    plot: Path | None,
    trace: Path | None,
    record: Path | None,
    replace: bool,
    film: Path | None,
    velocity_tol: float | None,
    **scene_options: Any,
) -> None:
    """Simulate a scene of the gallery.

    With --record, its steps are written as a sequence for `lavender report`.

    SCENE is stack, pyramid, card_house, pile, chain, bridge, heavy_on_light, table, ramp, spinner, newtons_cradle or
    four_bar.

    Exit code 1: the run diverged. Exit code 130: stopped by Ctrl-C; the files contain the completed steps.
    """
    from lavender.sim.engine import Simulation
    from lavender.sim.engine import run as run_simulation
    from lavender.sim.engine.picture import Film
    from lavender.sim.engine.run import check_figure_path, format_step
    from lavender.sim.scene import Scene

    reject_options_without_effect(context, without_record=record is None)
    if plot is not None:
        plot = check_figure_path(plot)
    outputs = {"trace": trace, "figure": plot, "film": film}
    files = {name: path for name, path in outputs.items() if path is not None}
    for path in files.values():
        check_writable(path)
    if film is not None and film.suffix.lower() != ".gif":
        raise InputError(
            f"--film {film} is of format {film.suffix!r}; a name that ends in .gif is needed"
        )
    live = sys.stdout.isatty()

    def show(text: str) -> None:
        # On a terminal each line replaces the previous one.
        click.echo(f"\r{text}\x1b[K" if live else text, nl=not live)

    scene_parameters = _collect_parameters(parameters, scene_options, velocity_tol)
    simulation = Simulation(Scene(scene, **scene_parameters), report_residual=residual)
    every = 1 if live else max(1, steps // 20)
    frames = None if film is None else Film(simulation)

    def show_step(step: int, observation: dict[str, Any], info: dict[str, Any]) -> None:
        if step % every == 0 or step == steps or "lost_body" in info:
            show(format_step(step, observation, info))
        if frames is not None:
            frames.add(info["time"], observation["positions"], observation["quaternions"])

    result = run_simulation(simulation, steps, record=record, replace=replace, watch=show_step)
    if result.lost_body:
        show(f"stopped: the state of {result.lost_body!r} is not finite")
    if trace is not None:
        result.save(trace)
    if plot is not None:
        result.plot(plot)
    if film is not None and frames is not None:
        frames.save(film)
    if live:
        click.echo()
    for name, path in files.items():
        print_escaped(f"{name}: {path}")
    if record is not None:
        print_escaped(f"{result.recorded} problems in {record}: lavender report {record}")
    best = 1e3 * result.cost.min()
    click.echo(
        f"{result.scene}: {len(result)} steps, {result.time[-1]:.3f} s, {result.method}, {best:.3g} ms per step at best"
    )
    if result.stopped:
        exit_after_interrupt()
    if result.lost_body:
        raise click.exceptions.Exit(EXIT_UNMET)


def _collect_parameters(
    assignments: tuple[str, ...], options: dict[str, Any], velocity_tol: float | None
) -> dict[str, Any]:
    """Return the parameters of the scene from `--set` and from the options for single parameters."""
    values = parse_parameters(assignments)
    for name, value in options.items():
        if value is None:
            continue
        if name in values:
            raise InputError(
                f"--set {name}={values[name]} and the option {value} set the same parameter, {name}: leave "
                "one of them out"
            )
        values[name] = value
    own_sweeps = values.get("solver", "sequential_impulses") == "sequential_impulses"
    solver_options: dict[str, Any] = {}
    if velocity_tol is not None:
        if own_sweeps:
            raise InputError(
                "--velocity-tol needs a solver that stops at an error, and the scene's sequential_impulses "
                "runs a fixed number of sweeps: name another solver, for example --solver newton"
            )
        solver_options["velocity_tol"] = velocity_tol
    if not own_sweeps and "order" in values:
        # Pass the order as an option of the solver; a solver without sweep orders rejects it.
        solver_options["order"] = values.pop("order")
    return values | ({"solver_options": solver_options} if solver_options else {})
