"""`python -m benchmarks score`: run cells of the scorecard and add them to the table of results."""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import click

from benchmarks.output import markdown
from benchmarks.score.adapters import CannotExpress
from benchmarks.score.records import PATH, Record, read_records, write_records
from benchmarks.score.scenes import SCENES, classify, count_steps
from benchmarks.score.settings import ENGINES, Entry
from benchmarks.score.simulate import (
    Failed,
    Simulator,
    create_environment,
    find_program,
    split_requirement,
)
from lavender._version import __version__
from lavender.base.errors import InputError, LavenderError, UnknownName
from lavender.cli.options import ListType

#: Columns of the scorecard: settings and steps a second. From one to the next, one of the two changes.
COLUMNS = (("default", 240), ("accurate", 240), ("accurate", 1000))
LEVELS = tuple(dict.fromkeys(level for level, _ in COLUMNS))
STEP_RATES = tuple(dict.fromkeys(rate for _, rate in COLUMNS))
LIMIT = 5.0  # s of CPU time for a cell
CURVE_FACTOR = 4  # Scenes with many simulations have this multiple of the limit.
CLASSES = ("good", "fair", "poor", "wrong")


def get_settings(entry: Entry, level: str) -> dict[str, object]:
    """Return the options of an engine in a column."""
    return {**entry.common, **(entry.accurate if level == "accurate" else {})}


def get_settings_key(entry: Entry, level: str) -> str:
    """Return eight digits that identify the options of an engine in a column."""
    text = json.dumps(get_settings(entry, level), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def get_version(entry: Entry) -> str:
    """Return the pinned version of an engine's first package."""
    return split_requirement(entry.packages[0])[1] if entry.packages else __version__


def measure_cell(
    simulator: Simulator, scene: str, rate: int, runs: int
) -> tuple[list[float], list[float], float, str, str]:
    """Return errors, costs [µs], residual, note and curve of the runs of a cell."""
    errors: list[float] = []
    costs: list[float] = []
    curve = ""
    residual = math.nan
    for _ in range(runs):
        simulator.start_cell(count_steps(scene, 1.0 / rate))
        try:
            found = SCENES[scene].measure(simulator.run, 1.0 / rate)
        except CannotExpress as error:
            return [math.nan], [math.nan], math.nan, f"cannot: {error}", ""
        except Failed as error:
            cost = 1e6 * simulator.cpu / simulator.steps if simulator.steps else math.nan
            return [math.nan], [cost], residual, str(error), ""
        error, values = found if isinstance(found, tuple) else (found, None)
        if values and not curve:
            curve = json.dumps([round(v, 5) if math.isfinite(v) else None for v in values])
        residual = simulator.residual if math.isnan(residual) else residual
        simulator.residuals = False  # The first run reads them.
        errors.append(error if math.isfinite(error) else math.inf)
        costs.append(1e6 * simulator.cpu / max(1, simulator.steps))
    return errors, costs, residual, "", curve


def run_cells(
    name: str, cells: list[tuple[str, int, str]], envs: Path, runs: int, limit: float
) -> Iterator[Record]:
    """Yield the record of each cell (column, rate, scene) of an engine.

    The note of a cell that failed begins with "failed"; so do those of all cells if the engine does not install.
    """
    entry = ENGINES[name]
    command = find_program(entry, envs)
    if command is None:
        try:
            create_environment(entry, envs)
        except LavenderError as error:
            for cell in cells:
                yield make_record(name, cell, runs, note=f"failed: {error}")
            return
        command = find_program(entry, envs)
        assert command is not None
    simulator = Simulator(command, {}, limit)
    try:
        for level, rate, scene in cells:
            curve = SCENES[scene].curve
            simulator.settings = get_settings(entry, level)
            simulator.residuals = not curve
            simulator.limit = get_limit(entry, scene, limit)
            errors, costs, residual, note, values = measure_cell(simulator, scene, rate, runs)
            if entry.fresh:
                simulator.close()
            yield make_record(
                name, (level, rate, scene), runs, errors, costs, residual, note, values
            )
    finally:
        simulator.close()


def get_limit(entry: Entry, scene: str, limit: float) -> float:
    """Return the CPU time [s] of a cell of an engine."""
    return limit * entry.patience * (CURVE_FACTOR if SCENES[scene].curve else 1)


def make_record(
    name: str,
    cell: tuple[str, int, str],
    runs: int,
    errors: Sequence[float] = (math.nan,),
    costs: Sequence[float] = (math.nan,),
    residual: float = math.nan,
    note: str = "",
    curve: str = "",
) -> Record:
    """Return the record of the runs of a cell (column, rate, scene)."""
    spread = max(errors) - min(errors) if all(map(math.isfinite, errors)) else math.nan
    entry = ENGINES[name]
    return Record(
        name,
        get_version(entry),
        *cell,
        runs,
        errors[0],
        spread,
        min(costs),
        max(costs),
        residual,
        note[:200].replace("\n", " "),
        curve,
        get_settings_key(entry, cell[0]),
    )


def needs_run(row: Record | None, repeat: int) -> bool:
    """Return whether a cell is missing, or its record is of other settings, another version or fewer runs."""
    if row is None or row.runs < repeat:
        return True
    entry = ENGINES[row.engine]
    return (row.version, row.settings) != (get_version(entry), get_settings_key(entry, row.level))


def add_record(rows: dict[tuple[str, str, int, str], Record], row: Record) -> bool:
    """Add a record unless the cell failed, or was too slow and has an error of the same settings; return whether."""
    old = rows.get(row.key)
    measured = old is not None and not old.note and old.settings == row.settings
    if row.note.startswith("failed") or (row.note.startswith("too slow") and measured):
        return False
    rows[row.key] = row
    return True


def make_table(rows: dict[tuple[str, str, int, str], Record], level: str, rate: int) -> str:
    """Return one table of engines and scenes: errors with the initial of their class."""
    names = [n for n in ENGINES if any(key[0] == n for key in rows)]

    def describe(name: str, scene: str) -> str:
        """Return the text of a cell."""
        row = rows.get((name, level, rate, scene))
        if row is None or row.note:
            return "" if row is None else row.note.split(":")[0]
        return f"{row.error:.2g} {CLASSES[classify(scene, row.error)][0]}"

    head = ("engine", *(f"{name} [{scene.unit}]" for name, scene in SCENES.items()))
    return markdown(
        head, [(ENGINES[n].title, *(describe(n, scene) for scene in SCENES)) for n in names]
    )


@click.command("score")
@click.option("--engine", type=ListType(str), help="Names with commas between; default: all.")
@click.option("--scene", type=ListType(str), help="Names with commas between; default: all.")
@click.option("--level", type=ListType(str), default=",".join(LEVELS), show_default=True)
@click.option(
    "--rate", type=ListType(int), default="240,1000", show_default=True, help="Steps a second."
)
@click.option(
    "--repeat", type=click.IntRange(1), default=1, show_default=True, help="Runs of each cell."
)
@click.option(
    "--limit",
    type=click.FloatRange(0.1),
    default=LIMIT,
    show_default=True,
    help="CPU time of a cell [s]; scenes with many simulations and slow engines have a multiple.",
)
@click.option("--again", is_flag=True, help="Run cells that the table has.")
@click.option(
    "--envs",
    type=click.Path(path_type=Path),
    help="Folder of the engines' environments; default: temporary.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=PATH,
    help="Table; default: the one of the repository.",
)
def command(
    engine: tuple[str, ...] | None,
    scene: tuple[str, ...] | None,
    level: tuple[str, ...],
    rate: tuple[int, ...],
    repeat: int,
    limit: float,
    again: bool,
    envs: Path | None,
    out: Path,
) -> None:
    """Run engines on contact scenes with truth formulas and add the cells that are missing to the table of results.

    Each engine runs in its own environment with pinned packages, which is created in --envs if it does not exist.
    """
    for kind, names, known in (
        ("engine", engine, ENGINES),
        ("scene", scene, SCENES),
        ("level", level, LEVELS),
    ):
        for name in names or ():
            if name not in known:
                raise UnknownName(kind, name, known)
    if not set(rate) <= set(STEP_RATES):
        raise InputError(f"--rate: {rate}; 240 and 1000 are possible")
    columns = [column for column in COLUMNS if column[0] in level and column[1] in rate]
    rows = read_records(out)
    failures = 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(envs or temporary).resolve()
        for name in engine or ENGINES:
            cells = [
                (*column, key)
                for column, key in product(columns, scene or SCENES)
                if again or needs_run(rows.get((name, *column, key)), repeat)
                if column[1] == STEP_RATES[0] or not SCENES[key].own_rates
            ]
            for row in run_cells(name, cells, folder, repeat, limit) if cells else ():
                if add_record(rows, row):
                    write_records(rows.values(), out)
                failures += row.note.startswith("failed")
                text = (
                    row.note
                    or f"{row.error:.3g} {SCENES[row.scene].unit}, {row.cost:.0f} µs a step"
                )
                click.echo(
                    f"{name} {row.version}, {row.level}, 1/{row.rate} s, {row.scene}: {text}",
                    err=True,
                )
    for column, steps in columns:
        click.echo(f"\n{column} settings, 1/{steps} s\n\n{make_table(rows, column, steps)}")
    if failures:
        raise click.ClickException(
            f"{failures} of the cells failed; the table keeps what it had of them"
        )
