"""A number that a command prints changes with the units of length, mass and time as the unit beside it says."""

import re

import numpy as np
import pandas as pd
import pytest
from random_problems import CONTACTS
from units import UNITS

import lavender as lv

NUMBER = r"(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)"
PREFIXES = {"": 1.0, "m": 1e-3, "µ": 1e-6}
WRITTEN = re.compile(NUMBER + r"[\s\u00a0]*(m|µ)?(sqrt\(J\)|rad/s|m/s\^2|m/s|N m s|N s|N m|N|m)(?![\w/])")  # fmt: skip
COLUMN = re.compile(r"(.*) \[(.*)\]")


def read_numbers(text):
    """Return the numbers of a text that have a unit, in the unit without its prefix, and these units."""
    found = WRITTEN.findall(text)
    return [float(x) * PREFIXES[prefix] for x, prefix, _ in found], [unit for *_, unit in found]


def write_pages(problem, impulse, gap, dt, limit, path, lavender):
    """Return the texts of calls and commands about an impulse, and the table of its rows."""
    lv.io.save(problem, path, impulse=impulse, gap=gap)
    table = path.with_suffix(".csv")
    lavender("judge", str(path), "--csv", str(table), "--threshold", str(limit))
    zero = np.zeros(problem.m)
    return {
        "residual": str(lv.residual(problem, impulse)),
        # The largest of errors in m/s and in rad/s depends on the unit of length: `rows` is left out.
        "motion error": re.sub("rows [^;]*", "", str(lv.motion_error(problem, zero))),
        "diagnose": " ".join(map(str, lv.diagnose(problem, impulse, gap=gap[-len(problem.rows.normal) :], dt=dt))),
        "solve": lavender("solve", str(path), "--solver", "pgs", "--max-iter", "5")[1],
        "check": lavender("check", str(path), "--solvers", "pgs,newton", "--threshold", str(limit))[1],
    }, pd.read_csv(table)  # fmt: skip


@pytest.mark.parametrize("units", UNITS.values(), ids=UNITS)
def test_printed_numbers_change_with_the_units_as_the_unit_beside_them_says(lavender, tmp_path, units):  # fmt: skip
    problem = CONTACTS["rolling and spin"](4)
    impulse = 1.0 + np.random.default_rng(4).random(problem.m)
    gap = 0.001 * np.arange(problem.n_blocks) - 0.003
    scaled, factor = units.scale(problem)
    length = units.factor("m")
    before, rows = write_pages(problem, impulse, gap, 0.01, 1e-6, tmp_path / "before.npz", lavender)
    after, other = write_pages(
        scaled, factor * impulse, length * gap, 0.01 * units.time, 1e-6 * units.factor("m/s"),
        tmp_path / "after.npz", lavender,
    )  # fmt: skip
    for name in before:
        numbers, expected = read_numbers(before[name])
        found, named = read_numbers(after[name])
        assert named == expected and len(named) > 0, (name, before[name], after[name])
        wanted = [x * units.factor(unit) for x, unit in zip(numbers, named, strict=True)]
        # Two or three digits are printed.
        np.testing.assert_allclose(found, wanted, rtol=0.11, err_msg=name)
    assert list(rows) == list(other)
    angular = [problem.row_name(i) for i in np.flatnonzero(problem.angular_rows)]
    for column in rows:
        if (unit := COLUMN.fullmatch(column)) is None:
            continue
        # Errors of angular rows are converted to m/s, their impulses are in N m s.
        one = {"mm": "m", "m/s, rad/s": "m/s"}.get(unit[2], unit[2])
        turns = rows["row"].isin(angular)
        wanted = rows[column] * np.where((one == "N s") & turns, units.factor("N m s"), units.factor(one))  # fmt: skip
        np.testing.assert_allclose(other[column], wanted, rtol=1e-6, atol=1e-12, err_msg=column)
