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
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from lavender.judge.solution import Status
from lavender.problem import Problem
from lavender.programs import native
from lavender.programs.backend import Backend
from lavender.programs.qp_solver import OPTION_HELP, QPSolver, explain_refusal
from lavender.solvers.registry import SolverSpec

_DATA = json.loads(Path(__file__).with_name("backends.json").read_text(encoding="utf-8"))
#: Programs of the probes, by the field of the observed behaviour that holds the result.
PROBE_PROGRAMS: dict[str, str] = _DATA["programs"]
#: Remedy of the adapter for an observation, by field of the observed behaviour.
ADAPTER_REMEDIES: dict[str, str] = _DATA["remedies"]


def _make_backend(
    comment: str = "", behaviour: dict[str, Any] | None = None, **fields: Any
) -> Backend:
    """Build a backend from its entry in `backends.json`."""
    fields["modules"] = tuple(fields["modules"])
    if "call" in fields:
        fields["call"] = getattr(native, fields["call"])
    observed = None if behaviour is None else SimpleNamespace(**{**_DATA["usual"], **behaviour})
    return Backend(behaviour=observed, **fields)


BACKENDS: tuple[Backend, ...] = tuple(_make_backend(**entry) for entry in _DATA["backends"])


def describe_behaviour(behaviour: Any) -> dict[str, str]:
    """Return a sentence for each field and each note of an observed behaviour."""
    sentences = {}
    for name, by_value in _DATA["phrases"].items():
        value = getattr(behaviour, name)
        if sentence := by_value.get(str(value), by_value.get("else", "")):
            sentences[name] = sentence.format(value, program=PROBE_PROGRAMS.get(name))
    return sentences | behaviour.notes


def describe_backend(name: str) -> tuple[list[str], list[str]]:
    """Return sentences on the behaviour of the backend `name` alone, and on the measures of its adapter."""
    behaviour = get_behaviour(name)
    if behaviour is None:
        return [], []
    usual = _DATA["usual"]
    measures = [
        text for key, text in ADAPTER_REMEDIES.items() if getattr(behaviour, key) != usual[key]
    ]
    return [*describe_behaviour(behaviour).values()], [*dict.fromkeys(measures)]


def explain_contradicted_claim(name: str, problem: Problem, status: Status) -> str:
    """Return the observations on the backend `name` that fit a claimed status that the judge contradicts, or ""."""
    behaviour = get_behaviour(name)
    if behaviour is None:
        return ""
    sentences = describe_behaviour(behaviour)
    qp = problem.qp
    bounds = np.abs([problem.cones.lower, problem.cones.upper] if qp is None else qp.target)
    is_singular = problem.has_singular_program
    is_affected = {
        "far_bound": bounds[np.isfinite(bounds)].max(initial=0.0) >= behaviour.far_bound,
        "linear_term": is_singular and behaviour.linear_term != 1.0,
        "unbounded": is_singular and behaviour.unbounded == "wrong",
        "contradictory": behaviour.contradictory == "wrong",
        "small_part": behaviour.small_part != 0.5,
        "smallest": behaviour.smallest > 0.0,
    }
    keys = [key for key, is_true in is_affected.items() if is_true][:2]
    if status is Status.INFEASIBLE:
        keys = ["false_infeasible" if "false_infeasible" in sentences else "infeasible_x"]
    texts = " ".join(sentences[key] for key in keys)
    return f"observed with {name} {behaviour.version}: {texts}" if texts else ""


def get_behaviour(name: str) -> Any:
    """Return the observed behaviour of a backend, or None; `clarabel_cone` has the entry of `clarabel`."""
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
