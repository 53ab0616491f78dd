"""The convex Maros-Meszaros programs of up to 320 variables (`programs/README.md`)."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from calls import installed

import lavender as lv
from benchmarks.corpus import read_program

FOLDER = Path(__file__).with_name("programs")
OBJECTIVES = json.loads((FOLDER / "objectives.json").read_text())


def mix_units(arrays, seed):
    """Return the program in other units of cost, rows and variables (powers of two), and the factors of x and cost."""
    rng = np.random.default_rng(seed)
    n = len(arrays["q"])
    unit = 2.0 ** rng.integers(-10, 11, n)
    cost = 2.0 ** rng.integers(-20, 21)
    out = {
        "P": sp.diags_array(cost * unit) @ sp.csc_array(arrays["P"]) @ sp.diags_array(unit),
        "q": cost * arrays["q"] * unit,
    }
    for matrix, side in (("A", "b"), ("G", "h")):
        if matrix in arrays:
            row = 2.0 ** rng.integers(-10, 11, len(arrays[side]))
            out[matrix] = sp.diags_array(row) @ sp.csc_array(arrays[matrix]) @ sp.diags_array(unit)
            out[side] = row * arrays[side]
    out |= {bound: arrays[bound] / unit for bound in ("lb", "ub") if bound in arrays}
    return out, cost


@pytest.mark.parametrize("solver", ["auto", *installed("clarabel", "piqp", "daqp")])
@pytest.mark.parametrize("is_mixed", [False, True], ids=["as is", "all units mixed"])
def test_solver_finds_every_program(solver, is_mixed):
    """The objective is compared to 1e-5 of its terms, because errors of up to tol = 1e-6 in rows change it."""
    lost = []
    for k, (name, objective) in enumerate(OBJECTIVES.items()):
        if is_mixed and (solver, name) == ("daqp", "QBEACONF"):
            continue  # daqp returns nothing in these units, with and without the package's scaling.
        arrays = read_program(FOLDER / f"{name}.npz")
        given, cost = mix_units(arrays, k) if is_mixed else (arrays, 1.0)
        answer = lv.solve_qp(**given, solver=solver, tol=1e-6)
        terms = max(abs(objective), 1e-3 * np.abs(given["q"]) @ np.abs(answer.x) / cost)
        off = abs(answer.objective / cost - objective) / max(terms, 1e-12)
        if not (answer.found and (off <= 1e-5 or name == "TAME")):
            lost.append((name, str(answer), off))
        if name == "TAME":  # its optimal value is 0
            assert abs(answer.objective) <= 1e-6 * cost
    assert not lost
