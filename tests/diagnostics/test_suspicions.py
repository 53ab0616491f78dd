"""Absurd input is told, and what is meant so is not."""

from dataclasses import fields, replace

import numpy as np
import pytest
from ball_pile import Pile
from random_problems import as_matrix, general, touching
from worked import after

import lavender as lv
from lavender import suite
from lavender.judge.certificates import list_conflicting_blocks
from lavender.sim.scene import SCENES as SCENES_OF_GALLERY
from lavender.solvers.certify import prove_relaxation_infeasible

SCENES = {
    "stack": after(2, "stack", n=12, size=0.5, mass=60.0).constraint_problem(),
    "bridge": after(40, "bridge").constraint_problem(),
    "pit": after(60, "pile", n=60, size=0.3).constraint_problem(),
}


def given(problem):
    """Rows as somebody would give them, and b's target."""
    rows = {
        f.name: np.array(getattr(problem.rows, f.name))
        for f in fields(problem.rows)
        if f.name != "copy"
    }
    return rows, problem.b + problem.jacobian @ problem.rows.v_free.ravel()


def made(problem, rows, target):
    c = problem.cones
    kj = problem.rows.n_joints
    mj = len(rows["jac"])
    return lv.Problem.from_rows(
        lv.Rows(**rows),
        target,
        lower=c.lower[:mj],
        upper=c.upper[:mj],
        mu=c.mu[kj:],
        tangents=c.n_tangents[kj:],
    )


def kinds(problem, impulse=None):
    return {s.kind for s in lv.diagnose(problem, impulse)}


def test_diagnose_of_the_suite_reports_nothing():
    assert [c.name for c in suite.cases("default") if lv.diagnose(c.problem)] == []


#: Sizes of scenes of the gallery that have many bodies by default.
FEW_BODIES = {"pyramid": {"base": 4}, "pile": {"n": 12}, "chain": {"n": 6}, "bridge": {"n": 5}}
#: Margins [m] and steps [s] that a user may set.
MARGINS_AND_STEPS = [
    (0.0, 5e-4),
    (0.01, 0.02),
    (0.1, 1 / 120),
    (0.3, 5e-3),
    (1.0, 0.02),
    (1.0, 5e-4),
]


@pytest.mark.parametrize("name", [*SCENES_OF_GALLERY])
def test_diagnose_of_every_step_of_the_gallery_reports_nothing(name):
    """Only the rows of the closed loop of four bars contradict each other."""
    allowed = {"conflict"} if name == "four_bar" else set()
    for margin, dt in MARGINS_AND_STEPS:
        simulation = after(0, name, margin=margin, dt=dt, **FEW_BODIES.get(name, {}))
        for step in range(40):
            seen = simulation.step()[0]
            if step % 13:
                continue
            problem = simulation.constraint_problem()
            moving = [i for i, body in enumerate(simulation.scene.bodies) if not body.is_static]
            velocity = seen["velocities"][moving]
            found = lv.diagnose(problem, velocity=velocity)
            assert {s.kind for s in found} <= allowed, (margin, dt, step, found)


@pytest.mark.parametrize("name", ["stack", "pit"])
def test_diagnose_of_opposed_or_repeated_contacts_reports_them(name):
    problem = SCENES[name]
    rows, _ = given(problem)
    for sign, kind in ((1.0, "duplicate rows"), (-1.0, "opposed normals")):
        twice = dict(rows)
        for key in ("contact_body", "tangent", "arm_a", "arm_b"):
            twice[key] = np.concatenate([rows[key], rows[key][-1:]])
        second = np.cross(rows["normal"][-1:], rows["tangent"][-1:])
        for angle in (
            (0.0, 0.3) if sign < 0.0 else (0.0,)
        ):  # [rad] Normals that are nearly opposite contradict, too.
            normal = np.cos(angle) * rows["normal"][-1:] + np.sin(angle) * second
            twice["normal"] = np.concatenate([rows["normal"], sign * normal])
            assert kind in kinds(lv.Problem.from_rows(lv.Rows(**twice), mu=0.5))


def test_diagnose_of_targets_in_wrong_order_reports_them():
    problem = SCENES["bridge"]
    rows, target = given(problem)
    mj = len(rows["jac"])
    target[np.abs(target) < 1e-12] = 0.0
    target[:mj:3] = 0.6  # m/s: they close gaps of a centimetre
    assert kinds(made(problem, rows, target)) == set()
    assert kinds(made(problem, rows, np.roll(target, -mj))) == {"targets"}


def test_diagnose_of_duplicate_keys_forces_and_large_friction_reports_them():
    problem = SCENES["stack"]
    doubled = np.array(problem.key)
    doubled[5] = doubled[7]
    assert kinds(replace(problem, key=doubled)) == {"duplicate keys"}
    assert lv.diagnose(replace(problem, key=doubled))[0].blocks == (5, 7)
    solved = lv.solve(problem, tol=1e-9).impulse
    assert kinds(problem, solved) == set()
    assert kinds(problem, 240.0 * solved) == {"impulses"}
    assert kinds(replace(problem, guess=240.0 * solved)) == {"impulses"}
    wild = replace(problem, cones=lv.Cones.contacts(12.0, count=problem.n_blocks))
    assert kinds(wild) == {"friction"}


def boxes(n=3):
    """Boxes side by side on the ground in generalised coordinates: J (12 n, 6 n), M, v*."""
    problem = after(1, "stack", n=1, size=0.5, mass=60.0).constraint_problem()
    j = problem.jacobian.toarray()
    mass = np.linalg.inv(problem.rows.inverse_mass_matrix().toarray())
    return np.kron(np.eye(n), j), np.kron(np.eye(n), mass), np.tile(problem.rows.v_free.ravel(), n)


def test_diagnose_of_wrong_row_order_in_j_reports_it():
    j, mass, v = boxes()
    cones = lv.Cones.contacts(0.5, count=12)

    def problem(j, mass=mass, target=0.0):
        return lv.Problem.from_jacobian(j, mass, v, target=target, cones=cones)

    assert kinds(problem(j)) == set()
    last = np.arange(36).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    assert kinds(problem(j[last])) == {"tangents first"}
    rows = np.arange(36).reshape(-1, 3)
    for grouped in (rows.T.ravel(), np.r_[rows[:, 0], rows[:, 1:].ravel()]):
        assert kinds(problem(j[grouped])) == {"all normals first"}
        target = (j @ v + np.where(np.arange(36) % 12 == 0, 0.01, 0.0))[
            grouped
        ]  # which does not tell the order
        (found,) = lv.diagnose(problem(j[grouped], target=target))
        assert "if all normals come first" in found.reason
    moving = np.arange(len(mass)) % 6 < 3
    inverse = np.linalg.inv(mass)
    for wrong, words in (
        (inverse, "inverses for mass and inertia"),
        (np.where(moving[:, None] & moving, inverse, mass), "inverse mass for mass"),
    ):
        assert (
            kinds(problem(j, wrong)) == {"masses"}
            and words in lv.diagnose(problem(j, wrong))[0].reason
        )
    assert (
        kinds(problem(np.concatenate([j[:-3], j[:3]]))) == set()
    )  # one of twelve: collision detection does that
    assert kinds(problem(np.concatenate([j[:18], j[:18]]))) == {"duplicate rows"}


def test_diagnose_of_a_matrix_with_opposed_rows_reports_it():
    a = np.eye(6)
    a[3:, :3] = a[:3, 3:] = np.diag([-1.0, 1.0, 1.0])
    problem = lv.Problem.contact(a, [0.3, 0.0, 0.0, 0.1, 0.0, 0.0], mu=[0.5, 0.5])
    assert "opposed normals" in kinds(problem)
    assert kinds(lv.Problem.contact(a, [0.3, 0.0, 0.0, -0.4, 0.0, 0.0], mu=[0.5, 0.5])) == set()


def test_diagnose_with_velocities_of_a_planar_engine_finds_wrong_ones():
    dt = 0.01
    velocity = np.array([(0.3, -0.2, 1.0), (0.0, 0.0, 0.0)])

    def diagnose(after, given):
        builder = lv.RowBuilder([1.0, 0.5], [6.0, 3.0], after, dt, [(0.0, 0.5), (3.0, 0.5)])
        builder.hinge(0, 1, (1.5, 0.5))
        for body, x in ((0, -0.5), (0, 0.5), (1, 2.5), (1, 3.5)):
            builder.contact(-1, body, (x, 0.0), (0.0, 1.0), mu=0.5)
        return lv.diagnose(builder.problem(), velocity=given)

    fall = np.array([0.0, -9.81, 0.0])
    wide = np.zeros((2, 6))
    wide[:, [0, 1, 5]] = velocity
    for given in (velocity, velocity.tolist(), wide):
        assert [s.kind for s in diagnose(velocity + dt * fall, given)] == []
        assert "v* equals v" in str(diagnose(velocity, given))
        assert "do accelerations lack dt" in str(diagnose(velocity + fall, given))


@pytest.mark.parametrize(("mass", "size"), [(100.0, 1.0), (1000.0, 2.0)])
def test_diagnose_of_masses_as_inverse_masses_reports_them_in_space_only(mass, size):
    """Check the statement of docs/failures.md."""
    inertia = mass * size**2 / 6
    dt = 1 / 60
    corners = (-size / 2, size / 2)
    plane = lv.RowBuilder([mass], [inertia], [(0.0, -9.81 * dt, 0.0)], dt, [(0.0, size / 2)])
    space = lv.RowBuilder(
        [mass],
        [inertia * np.eye(3)],
        [(0.0, 0.0, -9.81 * dt, 0.0, 0.0, 0.0)],
        dt,
        [(0.0, 0.0, size / 2)],
    )
    for x in corners:
        plane.contact(-1, 0, (x, 0.0), (0.0, 1.0), mu=0.5)
        for y in corners:
            space.contact(-1, 0, (x, y, 0.0), (0.0, 0.0, 1.0), mu=0.5)
    assert lv.diagnose(plane.problem()) == ()
    assert [s.kind for s in lv.diagnose(space.problem())] == ["masses"]


def test_diagnose_of_a_bounce_with_a_gap_reports_nothing():
    dt = 0.01
    fall = np.array([-2.0, -3.0])
    e = 0.5
    gap = np.array([0.01, 0.02])  # m, closed within the step

    def found(target):
        n = len(fall)
        cones = lv.Cones.contacts(0.0, tangents=0, count=n)
        problem = lv.Problem.from_jacobian(
            np.eye(n), np.eye(n), fall - 9.81 * dt, target=target, cones=cones
        )
        return [s.kind for s in lv.diagnose(problem, velocity=fall, gap=gap, dt=dt)]

    assert found(-e * fall) == []
    assert found(gap / dt) == ["targets"]
    # Bounces of few among contacts that only close their gaps.
    fall = np.append(fall, np.full(5, -0.2))
    gap = np.append(gap, np.full(5, 0.001))
    assert found(np.append(-e * fall[:2], -gap[2:] / dt)) == []


def pressed(law, form):
    """A ball that contact 0 pushes up by 0.1 m/s and a joint of one row holds; contact 1 has no part in it.

    y = 1 on both: w.y = 0 whatever the impulses, b.y = 0.1.
    """
    rows = touching([[-1, 0], [-1, 1]], normal=np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]))
    jac = np.zeros((1, 12))
    jac[0, 8] = -1.0
    rows = replace(rows, jac=jac, joint_ptr=np.array([0, 1]), joint_body=np.array([[-1, 0]]))
    friction = (
        {"friction": law, "tangents": 2, "mu": 0.5}
        if law in ("coulomb", "cone")
        else {"tangents": 0}
    )
    ends = {"lower": -np.inf, "upper": np.inf}
    target = np.zeros(1 + 2 * (1 + friction["tangents"]))
    target[1] = 0.1
    problem = lv.Problem.from_rows(rows, target=target, **ends, **friction)
    return {"bodies": problem, "J and M": general(problem), "A": as_matrix(problem)}[form]


@pytest.mark.parametrize("form", ["bodies", "J and M", "A"])
@pytest.mark.parametrize("law", ["lcp", "coulomb", "cone"])
def test_diagnose_of_a_conflict_names_its_blocks_and_compliance_removes_it(law, form):
    problem = pressed(law, form)
    for name in ("auto",) if law == "coulomb" else ("auto", "newton"):
        solution = lv.solve(problem, name)
        assert solution.status is lv.Status.INFEASIBLE
        joints, contacts = list_conflicting_blocks(problem, solution.certificate)
        assert joints == (0,) and contacts == (1,)  # blocks
        assert f"row 0 against {problem.row_name(1).split(',')[0]}" in solution.message
    (found,) = (s for s in lv.diagnose(problem) if s.kind == "conflict")
    assert found.blocks == (0, 1)
    softened = np.where(
        np.arange(problem.m) == 0, 1e-2 * problem.d, 0.0
    )  # the bounded row of the conflict
    if form == "A":
        softer = replace(problem, matrix=problem.dense() + np.diag(softened))
    else:
        softer = replace(problem, compliance=problem.compliance + softened)
    assert not [s for s in lv.diagnose(softer) if s.kind == "conflict"]


def test_prove_relaxation_infeasible_of_a_tight_pile_returns_a_proof():
    """Walls leave these balls no space; the first step depends on no earlier solve."""
    problem = Pile(17).problem()
    proof = prove_relaxation_infeasible(problem, 1e-6)
    assert proof is not None and not proof.reason
    # A y = 0 to rounding and b.y > 0, computed without the package.
    y = proof.y / np.abs(proof.y).max()
    assert np.abs(problem.dense() @ y).max() <= 1e-12 * problem.d.max() and problem.b @ y > 1e-3
    joints, contacts = list_conflicting_blocks(problem, proof.y)
    assert not joints and len(contacts) >= 2


def thin_wall(entry, as_bodies):
    """A body of 0.5 kg that a wall pushes out with 0.05 m/s, along a row of J of this size, and a floor."""
    cones = lv.Cones.contacts(0.0, count=2, tangents=0)
    if not as_bodies:
        jac = np.array([[entry, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return lv.Problem.from_jacobian(
            jac, 0.5 * np.eye(3), [0.2, -0.1, -0.00981], target=[0.05, 0.0], cones=cones
        )
    jac = np.zeros((2, 12))
    jac[0, 6] = entry
    jac[1, 8] = 1.0
    rows = lv.Rows(
        inv_mass=[2.0],
        inv_inertia=[np.eye(3)],
        v_free=[[0.2, -0.1, -0.00981, 0.0, 0.0, 0.0]],
        jac=jac,
        joint_ptr=[0, 1, 2],
        joint_body=[(-1, 0)] * 2,
    )
    return lv.Problem.from_rows(rows, target=[0.05, 0.0], lower=[0.0, 0.0])


@pytest.mark.parametrize("as_bodies", [False, True])
def test_diagnose_impulse_far_above_momentum_is_reported(as_bodies):
    for entry, reported in ((1e-9, True), (1e-2, False), (1.0, False)):
        problem = thin_wall(entry, as_bodies)
        solution = lv.solve(problem, tol=1e-9)
        assert solution.success
        found = lv.diagnose(problem, solution.impulse)
        assert [d.kind for d in found] == ["impulses"] * reported, entry
        if reported:
            assert list(found[0].blocks) == [0]
            # the impulse times the entry of J: 0.5 kg (0.05 m/s / 1e-9)
            assert found[0].data["push"] == pytest.approx(2.5e7)
    problem = thin_wall(1.0, as_bodies)
    far = lv.solve(problem, tol=1e-9).impulse + np.array([0.0, 1e6])
    assert "impulses" in [d.kind for d in lv.diagnose(problem, far)]


@pytest.mark.parametrize("copies", [10, 200])
def test_diagnose_limit_of_impulses_grows_with_the_rows(copies):
    """An impulse counts if it pushes with max(1, rows / 100) 1e4 times the sum of M_jj max(|v*_j|, |b|)."""
    one = thin_wall(1.0, False).generalized
    for factor, reported in ((0.5, False), (2.0, True)):
        momentum = (
            copies * 0.5 * (0.2 + 0.15 + 0.15)
        )  # kg m/s; the walls move out of the way with |b| = 0.15 m/s
        push = factor * 1e4 * max(1.0, 2 * copies / 100) * momentum
        jac = np.kron(np.eye(copies), one.jac.toarray())
        jac[0, 0] = 0.05 * 0.5 / push
        problem = lv.Problem.from_jacobian(
            jac,
            0.5 * np.eye(3 * copies),
            np.tile(one.v_free, copies),
            target=np.tile([0.05, 0.0], copies),
            cones=lv.Cones.contacts(0.0, count=2 * copies, tangents=0),
        )
        solution = lv.solve(problem, tol=1e-9)
        assert solution.success and jac[0, 0] * solution.impulse[0] == pytest.approx(push, rel=0.01)
        assert ("impulses" in kinds(problem, solution.impulse)) == reported, factor


def test_diagnose_asks_for_forces_only_if_a_time_step_makes_impulses_of_them():
    """A heavy body on a light one: 1 % off, the impulses err more than the zero impulse, and are no forces."""
    jac = np.array([[1.0, 0.0], [-1.0, 1.0]])
    mass = np.diag([1.0, 1e6])
    problem = lv.Problem.from_jacobian(
        jac, mass, [-0.1, -0.1], cones=lv.Cones.bounded(np.zeros(2), np.full(2, np.inf))
    )
    solved = lv.solve(problem, tol=1e-12).impulse
    near = solved * [1.0, 1.01]
    assert lv.residual(problem, near).relative > 50.0
    assert not any("forces" in d.reason for d in lv.diagnose(problem, near))
    for rate in (60.0, 240.0, 1e4):
        assert any("forces" in d.reason for d in lv.diagnose(problem, rate * solved))
