"""`lavender bench mujoco MODEL.xml ...`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click

from lavender.base.errors import InputError, LavenderError
from lavender.cli.options import EXIT_UNMET, PATH, one_thread, say
from lavender.io.stored import check_writable, write_text


@click.group()
def bench() -> None:
    """Measure lavender's solvers inside the steps of your own simulator (`lavender report` measures files)."""


@bench.command("mujoco")
@click.argument("models", nargs=-1, required=True, type=PATH)
@click.option(
    "--steps", type=click.IntRange(0), default=10, show_default=True, help="Problems of each model."
)
@click.option(
    "--every",
    type=click.IntRange(1),
    default=20,
    show_default=True,
    help="Simulation steps between two problems.",
)
@click.option(
    "--warm",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Also measure this many consecutive steps of each model, warm-started.",
)
@click.option("--out", type=PATH, help="Write the numbers of every problem as JSON lines.")
def mujoco(models: tuple[Path, ...], steps: int, every: int, warm: int, out: Path | None) -> None:
    """Measure lavender's `newton` beside MuJoCo's Newton solver on steps of your own models (MJCF files).

    Exit code 1: a model is left out, of every number.
    """
    one_thread()
    if out is not None:
        check_writable(out)
    from lavender.io.mujoco import package
    from lavender.lab.bench.machine import cpu_name, versions
    from lavender.lab.bench.simulators import Step, WarmStep, measure, measure_warm
    from lavender.lab.report.simulators import table, warm_table

    mj = package()
    found: list[Step] = []
    consecutive: list[WarmStep] = []
    lost: list[str] = []
    for path in models:
        try:
            new = measure(mj, path, steps, every)
            after = measure_warm(mj, path, warm)
        except (ValueError, LavenderError) as error:  # MuJoCo's own word about a file is a ValueError
            lost.append(f"{path.name}: left out: {str(error).splitlines()[0][:140]}")
            say(lost[-1], err=True)
            continue
        found += new
        consecutive += after
        say(f"{path.name}: {len(new)} problems", err=True)
    if out is not None:
        lines = [json.dumps({"cpu": cpu_name(), **versions(("mujoco", "numpy"))})]
        lines += [json.dumps(asdict(s)) for s in found]
        lines += [json.dumps(asdict(w)) for w in consecutive]
        write_text(out, "\n".join(lines) + "\n")
    if not found and not consecutive:
        raise InputError("no step of these models had a problem to solve: more steps, or other models")
    if found:
        say(table(found))
    if consecutive:
        say(f"\n{warm_table(consecutive)}")
    if lost:
        say("\n".join(lost))
        raise click.exceptions.Exit(EXIT_UNMET)
