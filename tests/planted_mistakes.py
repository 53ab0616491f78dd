"""Mistakes planted in problems that have none, and the share that `lv.diagnose` finds.

The problems are 30 steps of the gallery's scenes, as bodies and with the same J and M; contacts overlap by up to 1 mm
or have a gap. A mistake that changes nothing in a problem (the sign of gaps if there are none) is not counted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lavender.lab.diagnostics import diagnose
from lavender.problem import Problem
from lavender.problem.cones import ROW, Cones
from lavender.problem.rows import Rows
from lavender.sim.engine import Simulation
from lavender.sim.scene import Scene

SCENES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("stack", {"n": 12}),
    ("stack", {"n": 4, "size": 0.5, "mass": 60.0}),
    ("pyramid", {"base": 6}),
    ("card_house", {"levels": 2}),
    ("pile", {"n": 40, "size": 0.3}),
    ("pile", {"n": 30, "kind": "boxes", "size": 0.3}),
    ("bridge", {}),
    ("bridge", {"n": 8, "load": 3.0}),
    ("heavy_on_light", {}),
    ("heavy_on_light", {"ratio": 10.0, "n": 4}),
    ("table", {}),
    ("ramp", {}),
    ("ramp", {"angle": 0.6}),
    ("stack", {"n": 2}),
    ("card_house", {"levels": 3}),
)
STEPS = (2, 45)
DEPTH, SHARE = 1e-3, 0.2  # m, the deepest overlap; - of it that one step takes back
NONE = "none"


@dataclass
class Given:
    """What somebody gives: J, M and v*, or rows; the targets of contacts (c, 3), and what v* was made of."""

    jac: Any  # (m, nv)
    mass: Any  # (nv, nv)
    before: Any  # (nv,) v
    change: Any  # (nv,) a
    dt: float
    target: Any  # (m,)
    cones: Cones
    gap: Any  # (c,) m, between surfaces
    rows: Rows | None = None
    v_free: Any = None  # v + dt a

    def __post_init__(self) -> None:
        self.v_free = self.before + self.dt * self.change if self.v_free is None else self.v_free

    @property
    def problem(self) -> Problem:
        """Of rows where there are rows."""
        c = self.cones
        if self.rows is None:
            return Problem.from_jacobian(self.jac, self.mass, self.v_free, target=self.target, cones=c)
        rows, kj = replace(self.rows, v_free=self.v_free.reshape(-1, 6)), self.rows.n_joints
        mj = len(rows.jac)
        return Problem.from_rows(
            rows,
            self.target,
            lower=c.lower[:mj],
            upper=c.upper[:mj],
            mu=c.mu[kj:],
            tangents=c.n_tangents[kj:],
        )

    @property
    def state(self) -> dict[str, Any]:
        """What `diagnose` takes beside the problem."""
        velocity = self.before if self.rows is None else self.before.reshape(-1, 6)
        return {"velocity": velocity, "gap": self.gap, "dt": self.dt}

    @property
    def contacts(self) -> Any:
        """Rows of each contact (c, 3)."""
        return self.cones.ptr[:-1][self.cones.kind != ROW][:, None] + np.arange(3)

    def turned(self, to: tuple[int, int, int], sign: float = 1.0) -> Given:
        """With other rows of J in the place of normal, tangent, tangent; the targets move with them."""
        at = self.contacts
        jac, target = self.jac.copy(), self.target.copy()
        jac[at], target[at] = self.jac[at[:, to]], self.target[at[:, to]]
        jac[at[:, 0]] *= sign
        rows = self.rows
        if rows is not None:
            axes = (rows.normal, rows.tangent, np.cross(rows.normal, rows.tangent))
            rows = replace(rows, normal=sign * axes[to[0]], tangent=axes[to[1]])
        return replace(self, jac=jac, target=target, rows=rows)

    def aimed(self, factor: float) -> Given:
        """Targets of normals times a factor."""
        target = self.target.copy()
        target[self.contacts[:, 0]] *= factor
        return replace(self, target=target)

    def rubbed(self) -> Given:
        """Coefficients of friction as angles in degrees."""
        c = self.cones
        degrees = np.degrees(np.arctan(c.mu))
        values = {f.name: getattr(c, f.name) for f in fields(c)} | {
            "mu": np.where(c.kind == ROW, c.mu, degrees)
        }
        return replace(self, cones=Cones(**values))


def planted(given: Given) -> Iterator[tuple[str, Given]]:
    """Each mistake that changes something; first none."""
    yield NONE, given
    yield "normals flipped", given.turned((0, 1, 2), -1.0)
    yield "tangents first", given.turned((1, 2, 0))
    if given.target[given.contacts[:, 0]].any():
        yield "gap or depth of the wrong sign", given.aimed(-1.0)
        yield "targets times dt once more", given.aimed(given.dt)
        yield "targets divided by dt twice", given.aimed(1.0 / given.dt)
    yield "v* = v + a, without dt", replace(given, v_free=given.before + given.change)
    yield "v* = v, without a", replace(given, v_free=given.before)
    if np.any(given.cones.mu > 0.0):
        yield "mu in degrees", given.rubbed()


def scenes() -> Iterator[tuple[str, Given]]:
    """Steps of the gallery's scenes that have contacts, of bodies."""
    for (name, parameters), steps in ((s, n) for s in SCENES for n in STEPS):
        simulation = Simulation(Scene(name, **parameters))
        for _ in range(steps):
            simulation.step()
        p = simulation.constraint_problem()
        rows, contact = p.rows, p.cones.normal_rows
        if rows is None or not len(contact):
            continue
        given = simulation.scene.parameters
        dt = given.dt / (given.substeps or np.ceil(given.dt / given.max_substep - 1e-9))
        target = p.b + p.jacobian @ rows.v_free.ravel()
        touch = contact[np.abs(target[contact]) < 1e-9]
        depth = np.random.default_rng(steps).uniform(0.0, DEPTH, len(touch))
        target[np.abs(target) < 1e-9] = 0.0
        target[touch] = SHARE * depth / dt
        gap = -dt * np.where(target > 0.0, target / SHARE, target)[contact]
        fall = np.where(rows.inv_mass[:, None] > 0.0, [0.0, 0.0, -9.81, 0.0, 0.0, 0.0], 0.0).ravel()
        mass = np.linalg.inv(rows.inverse_mass_matrix().toarray()) if np.all(rows.inv_mass > 0.0) else None
        v = rows.v_free.ravel() - dt * fall
        yield f"{name} {steps}", Given(p.jacobian.toarray(), mass, v, fall, dt, target, p.cones, gap, rows)


def shares() -> dict[str, dict[str, tuple[int, int]]]:
    """For each form the problems with each mistake in which something was found, and their number."""
    found: dict[str, dict[str, tuple[int, int]]] = {}
    of_bodies = list(scenes())
    forms = {
        "bodies": of_bodies,
        "the same, J and M": [(name, replace(x, rows=None)) for name, x in of_bodies],
    }
    for form, problems in forms.items():
        rights: dict[str, set[str]] = {}
        for mistake, wrong in (x for _, given in problems for x in planted(given)):
            problem = wrong.problem
            for more, state in (("", {}), (", the state too", wrong.state)):
                kinds = {suspicion.kind for suspicion in diagnose(problem, **state)}
                right = rights[more] = kinds if mistake == NONE else rights[more]
                hit, all_ = found.setdefault(form + more, {}).get(mistake, (0, 0))
                found[form + more][mistake] = (
                    hit + bool(kinds if mistake == NONE else kinds - right),
                    all_ + 1,
                )
    return found
