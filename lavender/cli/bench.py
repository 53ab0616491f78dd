"""Define `lavender bench mujoco MODEL.xml ...`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click

from lavender.base.errors import InputError, LavenderError
from lavender.cli.options import EXIT_UNMET, PATH, limit_to_one_thread, print_escaped
from lavender.io.stored import check_writable, write_text


@click.group()
def bench() -> None:
    """Measure solvers inside the steps of your own simulator.

    `lavender report` measures solvers on files.
    """


@bench.command("mujoco")
@click.argument("models", nargs=-1, required=True, type=PATH)
@click.option(
    "--steps", type=click.IntRange(0), default=10, show_default=True, help="Problems of each model."
)
@click.option(
    "--record-every",
    "every",
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
    """Compare `newton` with MuJoCo's Newton solver on your models.

    The problems are steps of your own models (MJCF files). Exit code 1: a model is left out of all numbers.
    """
    limit_to_one_thread()
    if out is not None:
        check_writable(out)
    from lavender.io.mujoco import import_mujoco
    from lavender.lab.bench.machine import get_cpu_name, get_versions
    from lavender.lab.bench.simulators import Step, WarmStep, measure_model, measure_model_warm
    from lavender.lab.report.simulators import format_time_ratio_table, format_warm_time_ratio_table

    mj = import_mujoco()
    measured: list[Step] = []
    consecutive: list[WarmStep] = []
    left_out: list[str] = []
    for path in models:
        try:
            new = measure_model(mj, path, steps, every)
            after = measure_model_warm(mj, path, warm)
        except (ValueError, LavenderError) as error:  # MuJoCo reports an invalid file as ValueError.
            left_out.append(f"{path.name}: left out: {str(error).splitlines()[0][:140]}")
            print_escaped(left_out[-1], err=True)
            continue
        measured += new
        consecutive += after
        print_escaped(f"{path.name}: {len(new)} problems", err=True)
    if out is not None:
        lines = [json.dumps({"cpu": get_cpu_name(), **get_versions(("mujoco", "numpy"))})]
        lines += [json.dumps(asdict(s)) for s in measured]
        lines += [json.dumps(asdict(w)) for w in consecutive]
        write_text(out, "\n".join(lines) + "\n")
    if not measured and not consecutive:
        raise InputError("no step of these models had a problem to solve: give more steps, or other models")
    if measured:
        print_escaped(format_time_ratio_table(measured))
    if consecutive:
        print_escaped(f"\n{format_warm_time_ratio_table(consecutive)}")
    if left_out:
        print_escaped("\n".join(left_out))
        raise click.exceptions.Exit(EXIT_UNMET)
