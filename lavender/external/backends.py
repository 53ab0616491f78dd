"""Specs of all QP backends, for linear problems and boxed LCPs with symmetric A.

    min 1/2 l.A l - b.l,  lower <= l <= upper        (impulse form), or the velocity form of `forms`

`clarabel_cone` also supports the convex relaxation of friction. Disk and spin are second-order cones; a round cone is
one cone:

    l_n >= 0,  |l_t| <= mu l_n,  |l_s| <= mu r l_n,  or the dual cone w_n >= a |w_t| + a_s |w_s|

OSQP and Clarabel are called by their own interfaces (`native.py`), for warm starts, iteration counts and cones. The
others are called through qpsolvers (`backend.py`). `backends.json` has the table of all backends: settings (a text is a
field of `Limits`, other values are fixed), capabilities, and the behaviour that was observed.
"""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lavender.external import native
from lavender.external.backend import Backend, Behaviour
from lavender.external.qp_solver import OPTION_HELP, QPSolver, explain_refusal
from lavender.judge.solution import Status
from lavender.problem import Problem
from lavender.solvers.registry import SolverSpec

_DATA = json.loads(Path(__file__).with_name("backends.json").read_text(encoding="utf-8"))
#: Programs of the probes, by the field of `Behaviour` that holds the result.
PROBE_PROGRAMS: dict[str, str] = _DATA["programs"]
#: Remedy of the adapter for an observation, by field of `Behaviour`.
ADAPTER_REMEDIES: dict[str, str] = _DATA["remedies"]
_PHRASES: dict[str, dict[str, str]] = _DATA["phrases"]


def _make_backend(comment: str = "", behaviour: dict[str, Any] | None = None, **fields: Any) -> Backend:
    """Build a backend from its entry in `backends.json`."""
    fields["modules"] = tuple(fields["modules"])
    if "call" in fields:
        fields["call"] = getattr(native, fields["call"])
    return Backend(behaviour=None if behaviour is None else Behaviour(**behaviour), **fields)


BACKENDS: tuple[Backend, ...] = tuple(_make_backend(**entry) for entry in _DATA["backends"])


def describe_behaviour(behaviour: Behaviour) -> dict[str, str]:
    """Return a sentence for each field and each note of an observed behaviour."""
    b = behaviour
    sentences = {
        "triangle": _PHRASES["triangles"][b.triangle],
        "start": f"A start is used: {b.start}." if b.start else "No start is used.",
    }
    verdicts = ("repeated", "dependent", "contradictory", "unbounded", "singular", "convex_on_rows", "saddle")
    for name in verdicts:
        sentences[name] = f"The program {PROBE_PROGRAMS[name]} {_PHRASES['verdicts'][getattr(b, name)]}."
    values = ("linear_term", "x2", 1.0), ("small_part", "x3", 0.5), ("offset", "x1 - 1e8", 0.3)
    for name, symbol, right in values:
        value = getattr(b, name)
        result = "is not solved" if value is None else f"gives {symbol} = {value:g}; {right:g} is right"
        sentences[name] = f"The program {PROBE_PROGRAMS[name]} {result}."
    size, far, found = b.smallest, b.far_bound, {"none": "is None", "raises": "is lost by an exception"}
    sentences["smallest"] = (
        f"Solutions of about {size:g} and below are wrong."
        if size
        else "Solutions down to 1e-10 are returned within 1 %."
    )
    sentences["far_bound"] = (
        f"Inactive bounds of {far:g} and above prevent a solution."
        if far < math.inf
        else "Inactive bounds up to 1e19 do no harm."
    )
    sentences["fixed_multiplier"] = f"A fixed variable with a multiplier of -1 has {b.fixed_multiplier:g}."
    sentences["infeasible_x"] = (
        f"After the program {PROBE_PROGRAMS['infeasible_x']}, x {found.get(b.infeasible_x, 'holds ' + b.infeasible_x)}."
    )
    if b.conflict:
        result = f"is reported as solved up to d = {b.conflict:g}"
        sentences["conflict"] = f"The program {PROBE_PROGRAMS['conflict']}, {result}."
    if b.second_solve:
        sentences["second_solve"] = (
            f"A second solve of one object without a start gives {_PHRASES['second_solve'][b.second_solve]}."
        )
    if b.time_limit:
        sentences["time_limit"] = f"Its time limit is measured {b.time_limit}."
    return sentences | dict(b.notes)


def describe_backend(name: str) -> tuple[list[str], list[str]]:
    """Return sentences on the behaviour of the backend `name` alone, and on the measures of its adapter."""
    behaviour = _get_behaviour(name)
    if behaviour is None:
        return [], []
    usual = Behaviour(behaviour.version)
    measures = [
        text for key, text in ADAPTER_REMEDIES.items() if getattr(behaviour, key) != getattr(usual, key)
    ]
    return [*describe_behaviour(behaviour).values()], [*dict.fromkeys(measures)]


def explain_contradicted_claim(name: str, problem: Problem, status: Status) -> str:
    """Return the observations on the backend `name` that fit a claim that the judge contradicts; "" without one.

    Parameters
    ----------
    name : str
        Name of a solver.
    problem : Problem
    status : Status
        The claim.
    """
    behaviour = _get_behaviour(name)
    if behaviour is None:
        return ""
    sentences = describe_behaviour(behaviour)
    if status is Status.INFEASIBLE:
        keys = ["false_infeasible" if "false_infeasible" in sentences else "infeasible_x"]
    else:
        bounds = np.abs(
            [problem.cones.lower, problem.cones.upper] if problem.qp is None else problem.qp.target
        )
        far = bounds[np.isfinite(bounds)].max(initial=0.0)
        is_affected = {
            "far_bound": far >= behaviour.far_bound,
            "linear_term": problem.has_singular_program and behaviour.linear_term != 1.0,
            "unbounded": problem.has_singular_program and behaviour.unbounded == "wrong",
            "contradictory": behaviour.contradictory == "wrong",
            "small_part": behaviour.small_part != 0.5,
            "smallest": behaviour.smallest > 0.0,
        }
        keys = [key for key, is_true in is_affected.items() if is_true][:2]
    texts = " ".join(sentences[key] for key in keys)
    return f"observed with {name} {behaviour.version}: {texts}" if texts else ""


def get_observed_version(name: str) -> str:
    """Return the version of the backend `name` with which its behaviour was observed; "" if it was not."""
    behaviour = _get_behaviour(name)
    return "" if behaviour is None else behaviour.version


def _get_behaviour(name: str) -> Behaviour | None:
    """Return the observed behaviour of a backend; `clarabel_cone` has the entry of `clarabel`."""
    name = name.removesuffix("_cone")
    return next((b.behaviour for b in BACKENDS if b.name == name), None)


def _make_spec(backend: Backend) -> SolverSpec:
    """Build the registry entry of a backend."""
    return SolverSpec(
        name=backend.name,
        factory=partial(QPSolver, backend),
        laws=frozenset({"linear", "lcp", *(["cone"] if backend.cones else [])}),
        # Under the law "cone", friction boxes are written as one row for each edge of the cone, which makes A singular.
        box_friction_laws=frozenset() if backend.needs_definite else frozenset({"cone"}),
        resumable=False,
        external=True,
        impulse=backend.starts,
        singular_programs=not backend.cones,
        round_cones=backend.cones,
        supports_rolling=backend.cones,
        max_iter=backend.max_iter,
        options=OPTION_HELP,
        requires=backend.modules,
        install=backend.install,
        summary=backend.summary if backend.cones else f"{backend.summary} (QP backend)",
        reference=backend.reference,
        refusal=explain_refusal,
    )


SPECS: tuple[SolverSpec, ...] = tuple(map(_make_spec, BACKENDS))
