"""Mistakes planted in problems that have none: the share that `lv.diagnose` finds, and nothing else.

The problems are 30 steps of the gallery's scenes, as bodies and with the same J and M; contacts overlap by up to 1 mm
or have a gap. A mistake that changes nothing in a problem (the sign of gaps if there are none) is not counted.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from worked import after

import lavender as lv

SCENES = (
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
MAX_OVERLAP = 1e-3  # m
OVERLAP_FRACTION_PER_STEP = 0.2  # of an overlap, that one step removes


@dataclass
class Step:
    """What an engine knows of a step: J, M and v*, or rows; the targets, and what v* was made of."""

    jac: Any  # (m, nv)
    mass: Any  # (nv, nv)
    before: Any  # (nv,) v before the step
    acceleration: Any  # (nv,)
    dt: float
    target: Any  # (m,)
    cones: lv.Cones
    gap: Any  # (c,) m, between surfaces
    rows: lv.Rows | None = None
    v_free: Any = None  # v + dt a

    def __post_init__(self):
        self.v_free = (
            self.before + self.dt * self.acceleration if self.v_free is None else self.v_free
        )

    @property
    def problem(self):
        """The problem, by rows if there are rows."""
        c = self.cones
        if self.rows is None:
            return lv.Problem.from_jacobian(
                self.jac, self.mass, self.v_free, target=self.target, cones=c
            )
        rows = replace(self.rows, v_free=self.v_free.reshape(-1, 6))
        kj = self.rows.n_joints
        mj = len(rows.jac)
        bounds = {"lower": c.lower[:mj], "upper": c.upper[:mj]}
        return lv.Problem.from_rows(
            rows, self.target, mu=c.mu[kj:], tangents=c.n_tangents[kj:], **bounds
        )

    @property
    def state(self):
        """The arguments of `diagnose` except the problem."""
        velocity = self.before if self.rows is None else self.before.reshape(-1, 6)
        return {"velocity": velocity, "gap": self.gap, "dt": self.dt}

    @property
    def contacts(self):
        """Rows of each contact (c, 3)."""
        return self.cones.ptr[:-1][self.cones.kind != lv.ROW][:, None] + np.arange(3)

    def with_axes(self, order, sign=1.0):
        """Return the step with normal and tangents in another order; the targets move with them."""
        at = self.contacts
        jac = self.jac.copy()
        target = self.target.copy()
        rows = self.rows
        jac[at], target[at] = self.jac[at[:, order]], self.target[at[:, order]]
        jac[at[:, 0]] *= sign
        if rows is not None:
            axes = (rows.normal, rows.tangent, np.cross(rows.normal, rows.tangent))
            rows = replace(rows, normal=sign * axes[order[0]], tangent=axes[order[1]])
        return replace(self, jac=jac, target=target, rows=rows)

    def with_targets(self, factor):
        """Return the step with targets of normals times a factor."""
        target = self.target.copy()
        target[self.contacts[:, 0]] *= factor
        return replace(self, target=target)

    def with_angles_of_friction(self):
        """Return the step with coefficients of friction as angles in degrees."""
        c = self.cones
        return replace(
            self, cones=replace(c, mu=np.where(c.kind == lv.ROW, c.mu, np.degrees(np.arctan(c.mu))))
        )


NONE = "none"
MISTAKES = {
    NONE: lambda s: s,
    "normals flipped": lambda s: s.with_axes((0, 1, 2), -1.0),
    "tangents first": lambda s: s.with_axes((1, 2, 0)),
    "gap or depth of the wrong sign": lambda s: s.with_targets(-1.0),
    "targets times dt once more": lambda s: s.with_targets(s.dt),
    "targets divided by dt twice": lambda s: s.with_targets(1.0 / s.dt),
    "v* = v + a instead of v + dt a": lambda s: replace(s, v_free=s.before + s.acceleration),
    "v* = v instead of v + dt a": lambda s: replace(s, v_free=s.before),
    "mu in degrees": lambda s: s.with_angles_of_friction(),
}
#: Kinds of the mistakes that only the state before the step shows.
SHOWN_BY_STATE = dict.fromkeys(list(MISTAKES)[3:6], "targets") | dict.fromkeys(
    list(MISTAKES)[6:8], "v_free"
)


def plant(step):
    """Yield each mistake that changes something, first none, and the step with it."""
    for name, change in MISTAKES.items():
        has_no_targets = (
            SHOWN_BY_STATE.get(name) == "targets" and not step.target[step.contacts[:, 0]].any()
        )
        if not (has_no_targets or (name == "mu in degrees" and not np.any(step.cones.mu > 0.0))):
            yield name, change(step)


def scene_step(name, parameters, steps):
    """Return a step of a scene as bodies; None if it has no contacts."""
    simulation = after(steps, name, **parameters)
    p = simulation.constraint_problem()
    rows = p.rows
    contact = p.cones.normal_rows
    if rows is None or not len(contact):
        return None
    given = simulation.scene.parameters
    dt = given.dt / (given.substeps or np.ceil(given.dt / given.max_substep - 1e-9))
    target = p.b + p.jacobian @ rows.v_free.ravel()
    touching = contact[np.abs(target[contact]) < 1e-9]
    overlap = np.random.default_rng(steps).uniform(0.0, MAX_OVERLAP, len(touching))
    target[np.abs(target) < 1e-9] = 0.0
    target[touching] = OVERLAP_FRACTION_PER_STEP * overlap / dt
    gap = -dt * np.where(target > 0.0, target / OVERLAP_FRACTION_PER_STEP, target)[contact]
    fall = np.where(rows.inv_mass[:, None] > 0.0, [0.0, 0.0, -9.81, 0.0, 0.0, 0.0], 0.0).ravel()
    mass = (
        np.linalg.inv(rows.inverse_mass_matrix().toarray()) if np.all(rows.inv_mass > 0.0) else None
    )
    v = rows.v_free.ravel() - dt * fall
    return Step(p.jacobian.toarray(), mass, v, fall, dt, target, p.cones, gap, rows)


@pytest.fixture(scope="module")
def scenes():
    """Steps of the gallery's scenes that have contacts, by name."""
    made = {(i, n): scene_step(*SCENES[i], n) for i in range(len(SCENES)) for n in STEPS}
    return {f"{SCENES[i][0]} {i} {n}": step for (i, n), step in made.items() if step is not None}


def kinds(problem, **state):
    """Return the kinds of all that `diagnose` reports."""
    return {diagnostic.kind for diagnostic in lv.diagnose(problem, **state)}


@pytest.mark.nightly
def test_diagnose_with_state_finds_every_planted_mistake(scenes):
    """The mistake is found if something is reported that is not reported without it."""
    found = {}
    for form, form_of in (("bodies", lambda s: s), ("J and M", lambda s: replace(s, rows=None))):
        for has_state in (False, True):
            for step in map(form_of, scenes.values()):
                expected = set()
                for mistake, wrong in plant(step):
                    reported = kinds(wrong.problem, **(wrong.state if has_state else {}))
                    expected = reported if mistake == NONE else expected
                    cell = found.setdefault(mistake, {}).setdefault((form, has_state), [0, 0])
                    cell[0] += bool(reported if mistake == NONE else reported - expected)
                    cell[1] += 1
                    if has_state and mistake in SHOWN_BY_STATE:
                        assert SHOWN_BY_STATE[mistake] in reported
    for mistake, cells in found.items():
        for (form, has_state), (count, total) in cells.items():
            if mistake == NONE:
                assert count == 0, (form, has_state)
            elif has_state:
                assert count == total, (
                    mistake,
                    form,
                )  # the state of the engine reveals every planted mistake


@pytest.mark.parametrize("mistake", [mistake for mistake in MISTAKES if mistake != NONE])
def test_diagnose_of_a_stack_with_a_planted_mistake_reports_it(scenes, mistake):
    step = scenes["stack 0 2"]
    assert kinds(step.problem, **step.state) == set()
    wrong = MISTAKES[mistake](step)
    found = kinds(wrong.problem, **wrong.state)
    assert found and SHOWN_BY_STATE.get(mistake, "") in {*found, ""}


@pytest.mark.parametrize("has_round_inertia", [True, False])
def test_diagnose_of_a_kinematic_tree_does_not_assume_rigid_bodies(scenes, has_round_inertia):
    """A base that hangs below its feet is no mistake if there are joints in between."""
    step = scenes["stack 0 2"]
    mass = step.mass.copy()
    if has_round_inertia:
        mass[3, 3] = mass[4, 4] = mass[5, 5]
    flipped = replace(step, rows=None, mass=mass).with_axes((0, 1, 2), -1.0)
    assert "normals" in kinds(flipped.problem)
    n = len(mass)
    with_joint = np.pad(mass, (0, 1))
    with_joint[n, n], with_joint[n, 3], with_joint[3, n] = 0.1, 0.01, 0.01
    jac = np.pad(flipped.jac, ((0, 0), (0, 1)))
    jac[:3, n] = 0.3
    more = {
        "before": np.append(flipped.before, 0.0),
        "acceleration": np.append(flipped.acceleration, 0.0),
    }
    assert kinds(replace(flipped, jac=jac, mass=with_joint, v_free=None, **more).problem) == set()


def test_diagnose_of_a_conveyor_reports_nothing(scenes):
    step = replace(scenes["ramp 11 2"], rows=None)
    target = step.target.copy()
    target[step.contacts[:, 0]], target[step.contacts[:, 1]] = 0.0, 0.8
    assert kinds(replace(step, target=target).problem) == set()


@pytest.mark.parametrize(
    ("offset", "kinds"), [(0.5, []), (5.0, ["joint targets"])]
)  # m, at 60 steps per second
def test_diagnose_of_anchors_in_a_wrong_frame_reports_them(offset, kinds):
    builder = lv.RowBuilder([1.0], np.eye(3)[None], np.zeros((1, 6)), 1 / 60, [(1.0, 0.0, 0.0)])
    builder.hinge(-1, 0, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), anchor_b=(0.0, 0.0, offset))
    found = lv.diagnose(builder.problem())
    assert [diagnostic.kind for diagnostic in found] == kinds
    assert all(repr(diagnostic) == f"<Diagnostic {diagnostic}>" for diagnostic in found)
