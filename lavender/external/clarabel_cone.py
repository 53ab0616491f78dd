"""Clarabel on the convex relaxation of friction: disk and spin as second-order cones, a round cone as one.

    min 1/2 l.A l - b.l,   l_n >= 0,  |l_t| <= mu l_n,  |l_s| <= mu r l_n          (impulse form)

or the velocity form of `as_qp` with the dual cone w_n >= a |w_t| + a_s |w_s|. Bounded rows come along, so
it takes linear and boxed problems too.
"""

from __future__ import annotations

from functools import partial

from lavender.external.backend import Backend
from lavender.external.native import clarabel
from lavender.external.qp_solver import OPTIONS, QPSolver, refusal
from lavender.registry import SolverSpec

BACKEND = Backend(
    name="clarabel_cone",
    modules=("clarabel",),
    install="clarabel",
    summary="interior point on the convex relaxation of friction, second-order cones",
    reference="Goulart, Chen 2024, Clarabel; Tasora, Anitescu 2011 for the relaxation",
    call=clarabel.call,
    max_iter=200,
    stoppable=True,
)

SPEC = SolverSpec(
    name=BACKEND.name,
    factory=partial(QPSolver, BACKEND),
    laws=frozenset({"linear", "lcp", "cone"}),
    boxes=frozenset({"cone"}),
    resumable=False,
    external=True,
    impulse=False,
    round_cones=True,
    rolling=True,
    max_iter=BACKEND.max_iter,
    options=OPTIONS,
    requires=BACKEND.modules,
    install=BACKEND.install,
    summary=BACKEND.summary,
    reference=BACKEND.reference,
    refusal=refusal,
)
