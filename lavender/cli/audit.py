"""Define `lavender audit`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.base.errors import InputError
from lavender.base.exits import EXIT_UNMET
from lavender.cli.completion import complete_choice
from lavender.cli.measuring import explain_early_interrupt, show_page, show_progress
from lavender.cli.options import (
    FILE,
    FOLDER,
    add_worlds_options,
    is_option_set,
    limit_to_one_thread,
    precision_option,
    print_escaped,
    reject_unused_options,
    threshold_option,
)
from lavender.io.stored import lock_output

DEFAULT_CLAIM_WORLDS = 8  # Default number of worlds for engines with claims, which step all worlds at once.


@click.command()
@click.argument("model", metavar="MODEL.xml|SCENE.py", type=FILE)
@add_worlds_options(worlds=None, steps=200)
@click.option("--engine", default="mujoco", show_default=True,
              metavar="mujoco|mjx|mujoco_warp|kamino|newton-mujoco|genesis", shell_complete=complete_choice,
              help="Engine that steps the worlds.")  # fmt: skip
@click.option("--max-velocity-error", type=float, metavar="M/S",
              help="Exit with 1 if a step above its floor has a larger velocity error [m/s, rad/s].")  # fmt: skip
@click.option("--keep", type=int, metavar="N",
              help="Keep the N worst steps; default: the worst step of each of three worlds.")  # fmt: skip
@click.option("--save-states", type=(click.Choice(["contact", "worst"]), FILE), metavar="contact|worst FILE.npz",
              help="Write the states before steps with contact (about 1000 at most), or before the worst steps, for "
              "--states of tune, slip, record and report.")  # fmt: skip
@threshold_option
@precision_option
@click.option("--workers", type=int, default=-1, help="Processes, for mujoco; -1: one for each core.")
@click.option("--backend", default="loky", show_default=True, help="A backend of joblib, such as dask.")
@click.option("--out", type=FOLDER, default=Path("lavender-audit"),
              show_default=True, help="Folder of the page, the records and the worst worlds.")  # fmt: skip
@click.pass_context
def audit(
    context: click.Context,
    /,
    model: Path,
    out: Path,
    max_velocity_error: float | None,
    keep: int | None,
    save_states: tuple[str, Path] | None,
    **options: Any,
) -> None:
    """Judge every step of many worlds of a MuJoCo model.

    MODEL.xml is an MJCF file. For kamino, newton-mujoco and genesis, SCENE.py is a Python file whose function build()
    returns a newton.ModelBuilder, or build(worlds) a built genesis.Scene; or it is the name of a builder in
    newton.tests.utils.basics. The page then compares what the engine claims about each solve with the verdict.

    Without --worlds the audit takes about a minute; the remaining time is shown. The page
    shows how many steps were judged, how many of these stopped before convergence,
    their errors with time and body, and the numbers of rows and contacts. The worst worlds are problem files in
    OUT/worst; OUT/states.npz holds the states before them, from which --states starts again.

    Exit code 1: a world diverged, a step could not be judged, or an answer that is not at its floor has a velocity
    error above --max-velocity-error. Exit code 130: stopped by Ctrl-C; the page shows the completed steps.
    """
    from lavender.audit.audit import audit as run
    from lavender.audit.engine_scenes import CLAIM_ENGINES
    from lavender.report.text import format_count

    if max_velocity_error is not None and not max_velocity_error >= 0.0:
        raise InputError(f"--max-velocity-error is {max_velocity_error}; a velocity error in m/s is needed")
    if options["engine"] != "mujoco":
        for name in ("workers", "backend", "precision"):
            if is_option_set(context, name):
                raise InputError(
                    f"--{name} has no effect with another engine than MuJoCo: leave it out, or give "
                    "--engine mujoco"
                )
    if options["engine"] in CLAIM_ENGINES:
        if is_option_set(context, "control"):
            raise InputError(
                f"--controls needs a model of MuJoCo; the scene of {options['engine']} sets its own controls"
            )
        reject_unused_options(context, ["keep", "save_states"], f"with --engine {options['engine']}")
        _audit_claims(context, model, out, max_velocity_error, options)
        return
    context.with_resource(lock_output(out, folder=True))
    limit_to_one_thread()
    with explain_early_interrupt("the first step"), show_progress() as watch:
        result = run(
            model, watch=watch, max_velocity_error=max_velocity_error, keep=keep,
            keep_contact_states=save_states is not None and save_states[0] == "contact", **options,
        )  # fmt: skip
    result.write(out)
    if save_states is not None:
        n = result.save_states(*save_states)
        print_escaped(f"{save_states[1]}: {format_count(n, 'state')} for --states")
    show_page(result.summary_page, out)
    if result.n_diverged or result.n_unjudged or result.n_above_limit:
        raise click.exceptions.Exit(EXIT_UNMET)


def _audit_claims(
    context: click.Context, scene: Path, out: Path, max_velocity_error: float | None, options: dict[str, Any]
) -> None:
    """Compare the claims of an engine with the verdicts, and write the page."""
    from lavender.audit.claims import compare_claims
    from lavender.audit.engine_scenes import step_scene
    from lavender.audit.simulated_worlds import SPREADS

    worlds, steps = options["worlds"] or DEFAULT_CLAIM_WORLDS, options["steps"]
    starts = {name: options[name] for name in ("states", "seed")}
    starts["spread"] = SPREADS[0] if options["spread"] is None else options["spread"]
    stepped = step_scene(scene, options["engine"], worlds=worlds, steps=steps, **starts)
    context.with_resource(lock_output(out, folder=True))
    limit_to_one_thread()
    with explain_early_interrupt("the first step of all worlds"), show_progress() as watch:
        result = compare_claims(
            stepped,
            engine=options["engine"],
            threshold=options["threshold"],
            folder=out,
            total=steps,
            watch=watch,
        )
    result.error_limit = max_velocity_error
    show_page(result.summary_page, out)
    if result.is_any_lost or result.n_above_limit:
        raise click.exceptions.Exit(EXIT_UNMET)
