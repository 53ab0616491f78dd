"""Tabulate an answer row by row: its impulse, an exact one, its error in units, and the state of its block."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from lavender.base.arrays import FloatArray
from lavender.diagnostics.forces import name_pair
from lavender.diagnostics.redundancy import redundancy
from lavender.judge.residuals import Residual
from lavender.judge.solution import Solution
from lavender.judge.states import compute_states
from lavender.problem import Problem
from lavender.report.text import format_speed


def tabulate_rows(
    problem: Problem,
    impulse: Any,
    judged: Residual,
    exact: Solution | None,
    gap: FloatArray | None = None,
) -> pd.DataFrame:
    """Return a DataFrame with a row for each row of a problem, the largest errors first.

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s
        The answer.
    judged : Residual
        Its residual.
    exact : Solution or None
        A solution, or None if none was found.
    gap : (k,) m, optional
        Distance of the surfaces of each contact.

    Returns
    -------
    DataFrame
        `row`, `bodies`, `gap [mm]` of contacts if it is given, `impulse [N s]` and `exact [N s]` (N m s on angular
        rows), `unique` (whether all solutions have the same impulse), `error` (text in m/s or rad/s), `error [m/s,
        rad/s]` and `state`.
    """
    states = compute_states(problem, impulse)
    names = [name for state in states for name in state.rows]
    error = judged.velocity_by_row
    rows = range(problem.m)
    table = pd.DataFrame(
        {
            "row": [problem.row_name(i) for i in rows],
            "bodies": _name_bodies(problem),
            "impulse [N s]": np.asarray(impulse, float),
            "exact [N s]": np.nan if exact is None else exact.impulse,
            "unique": redundancy(problem).impulse_is_unique,
            "error": [format_speed(float(error[i]), problem.row_unit(i)) for i in rows],
            "error [m/s, rad/s]": error,
            "state": names,
        }
    )
    if gap is not None:
        of_rows = np.full(problem.m, np.nan)
        of_rows[problem.cones.ptr[:-1]] = 1e3 * gap
        table.insert(2, "gap [mm]", of_rows)
    return table.sort_values("error [m/s, rad/s]", ascending=False, kind="stable")


def _name_bodies(problem: Problem) -> list[str]:
    """Return the bodies of each row: those in parentheses after its name, else numbers; else empty texts."""
    rows = problem.rows
    if problem.names:
        sizes = np.diff(problem.cones.ptr).tolist()
        found = [name_pair(problem.block_name(k)) for k in range(problem.n_blocks)]
        if rows is None or all(found):
            return [text for text, n in zip(found, sizes, strict=True) for _ in range(n)]
    if rows is None:
        return [""] * problem.m
    pairs = [*rows.joint_body.tolist(), *rows.contact_body.tolist()]
    texts = [
        " and ".join("ground" if body < 0 else f"body {body}" for body in pair) for pair in pairs
    ]
    sizes = np.diff(problem.cones.ptr).tolist()
    # A joint may be several blocks: each block of it has the bodies of its rows.
    if len(texts) == len(sizes):
        return [text for text, n in zip(texts, sizes, strict=True) for _ in range(n)]
    joints = np.repeat(np.arange(rows.n_joints), np.diff(rows.joint_ptr)).tolist()
    own = [texts[k] for k in joints]
    contacts = texts[rows.n_joints :]
    later = [n for n, is_contact in zip(sizes, problem.cones.is_contact, strict=True) if is_contact]
    return own + [text for text, n in zip(contacts, later, strict=True) for _ in range(n)]
