"""`lavender run`."""

from __future__ import annotations

import contextlib
import sys
from typing import Any

import click

from lavender.base.errors import InputError
from lavender.cli.options import PATH, going_on, parameters_of, refuse_unused, say

FILES = ("trace", "plot", "film", "record")  # options that leave them
OF_THE_SCENE = (
    "solver_iterations",
    "warm_start",
    "order",
    "solver",
    "stepper",
)  # options that `--set` has, too


@click.command()
@click.argument("scene")
@click.option("--steps", type=int, default=240, show_default=True, help="Number of steps.")
@click.option(
    "--iterations", "solver_iterations", type=int, help="Sweeps per solve, 4 to 64 (other steppers: 1 to 64)."
)
@click.option(
    "--warm-start/--no-warm-start",
    default=None,
    help="Carry impulses from step to step.  [default: warm-start]",
)
@click.option(
    "--order",
    help="Order in which a sweep visits the blocks: given, reverse, bottom_up, top_down, alternating, ... "
    "Default: the stepper's.",
)
@click.option("--solver", help="Solver of each step, by name. Default: sequential_impulses.")
@click.option("--stepper", help="Time stepping: impulses (default), soft_step, xpbd or avbd.")
@click.option(
    "--set",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    help="Set a parameter of the scene, e.g. n=20 or friction=0.3; may be repeated.",
)
@click.option("--residual", is_flag=True, help="Also measure the judge's residual of all rows in every step.")
@click.option("--plot", type=PATH, help="Write a figure of the run (.svg, .png).")
@click.option("--trace", type=PATH, help="Write the values of every step (.csv).")
@click.option("--record", type=PATH, help="Write the problem of every step (.npz) to this folder.")
@click.option(
    "--replace", is_flag=True, help="With --record: first delete the problems of an earlier recording."
)
@click.option("--view", is_flag=True, help="Show the run live in a web page on this machine, until Ctrl-C.")
@click.option(
    "--film",
    type=PATH,
    help="Write a film of the run: .gif, .mp4, .png pictures, or a file for `lavender view`.",
)
@click.pass_context
def run(
    context: click.Context,
    /,
    scene: str,
    steps: int,
    parameters: tuple[str, ...],
    **asked: Any,
) -> None:
    """Simulate a scene of the gallery; optionally record its steps as a sequence for `lavender report`.

    SCENE is stack, pyramid, card_house, pile, chain, bridge, heavy_on_light, table, ramp, spinner,
    newtons_cradle or four_bar.
    """
    from lavender.sim.engine import run_scene

    record = asked["record"]
    if record is None:
        refuse_unused(context, ["replace"], "without --record")

    live, files = sys.stdout.isatty(), any(asked[name] is not None for name in FILES)

    def show(text: str) -> None:
        # on a terminal each line takes the place of the one before
        with going_on() if files else contextlib.nullcontext():
            click.echo(f"\r{text}\x1b[K" if live else text, nl=not live)

    found = run_scene(
        scene,
        steps=steps,
        parameters=_parameters(parameters, {name: asked.pop(name) for name in OF_THE_SCENE}),
        every=1 if live else max(1, steps // 20),
        show=show,
        **asked,
    )
    if live:
        click.echo()
    for name, option in (("trace", "trace"), ("figure", "plot"), ("film", "film")):
        if asked[option] is not None:
            say(f"{name}: {asked[option]}")
    if record is not None:
        say(f"{found.recorded} problems in {record}: lavender report {record}")
    best = 1e3 * found.cost.min()
    click.echo(
        f"{found.scene}: {len(found)} steps, {found.time[-1]:.3f} s, {found.method}, {best:.3g} ms a step at best"
    )


def _parameters(words: tuple[str, ...], options: dict[str, Any]) -> dict[str, Any]:
    """Parameters of the scene from `--set` and from the options that mean one of them."""
    found = parameters_of(words)
    for name, value in options.items():
        if value is None:
            continue
        if name in found:
            raise InputError(
                f"--set {name}={found[name]} and an option ({value}) both say {name}: leave one out"
            )
        found[name] = value
    if found.get("solver", "sequential_impulses") != "sequential_impulses" and "order" in found:
        found["solver_options"] = {"order": found.pop("order")}  # a solver that takes none refuses it
    return found
