"""What an import from MuJoCo costs, its checks included: `python -m benchmarks imports [MODEL ...]`.

Of every model 200 steps of controls drawn by seed 0; of every tenth, after `mj_forward`, the median of 50 imports. The
table has the median and the largest over these states.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import click
import numpy as np

from benchmarks.output import markdown
from lavender.io import from_mujoco

STEPS, EVERY, REPEATS = 200, 10, 50


def models() -> list[Path]:
    """Those of dm_control's suite, where it is installed."""
    spec = find_spec("dm_control")
    return [] if spec is None or spec.origin is None else sorted(Path(spec.origin).parent.glob("suite/*.xml"))


def states(model: Any) -> Iterator[Any]:
    """MjData at every tenth step, after its forward pass."""
    import mujoco as mj

    data, rng = mj.MjData(model), np.random.default_rng(0)
    for step in range(1, STEPS + 1):
        data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
        mj.mj_step(model, data)
        if step % EVERY == 0:
            mj.mj_forward(model, data)
            yield data


def cost(model: Any, data: Any) -> float:
    """Time [s] of one import of a state that has been imported before, median."""
    times = []
    for _ in range(REPEATS):
        start = perf_counter()
        from_mujoco(model, data)
        times.append(perf_counter() - start)
    return median(times)


@click.command("imports")
@click.argument("paths", nargs=-1, type=click.Path(exists=True, path_type=Path))
def command(paths: tuple[Path, ...]) -> None:
    """Time of one import of each model; default: those of dm_control's suite."""
    import mujoco as mj

    rows = []
    for path in paths or models():
        try:
            model = mj.MjModel.from_xml_path(str(path))
        except ValueError as error:  # a model that needs assets which are not there
            click.echo(f"{path.stem} is left out: {str(error).splitlines()[0]}", err=True)
            continue
        found = [(int(data.nefc), 1e6 * cost(model, data)) for data in states(model)]
        times = [time for _, time in found]
        rows.append(
            (path.stem, model.nv, max(m for m, _ in found), f"{median(times):.1f}", f"{max(times):.1f}")
        )
    click.echo(markdown(("model", "nv", "rows, most", "median [µs]", "largest [µs]"), rows))
