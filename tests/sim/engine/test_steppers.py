"""Ways to step: laws that each keeps, beside test_exact_motions.py; twins in NumPy, snapshots, refusals."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from worked import after, energy

import lavender as lv
from lavender.sim.engine.layout import HEAD
from lavender.sim.scene import SCENES
from lavender.sim.scene.steppers import STEPPERS, get_stepper

NAMES = tuple(STEPPERS)
G = 9.81


def run(scene, steps, stepper=None):
    sim = lv.Simulation(scene, stepper=stepper)
    for _ in range(steps):
        seen, _, lost, _, _ = sim.step()
        assert not lost
    return sim, seen


def hanging(stepper, hertz, damping=1.0, **more):
    scene = lv.Scene(stepper=stepper, dt=1 / 480, **more)
    ball = scene.add_sphere(0.1, 2.0, position=(0, 0, 0))
    scene.add_joint("distance", -1, ball, anchor_a=(0, 0, 1.0), hertz=hertz, damping=damping)
    return scene


# -- laws of every stepper ------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_weight_on_a_soft_joint_hangs_where_the_spring_says(name):
    hertz = 2.0
    _, seen = run(hanging(name, hertz), 1440)
    assert -seen["positions"][0][2] == pytest.approx(G / (2 * math.pi * hertz) ** 2, rel=0.01)
    assert np.abs(seen["velocities"]).max() < 1e-3


@pytest.mark.parametrize("name", NAMES)
def test_a_ball_on_a_rod_swings_with_the_period_of_the_pendulum(name):
    # small swings of a point mass on a rod of 1 m, counted between zeros of its place
    scene = lv.Scene(stepper=name, dt=1 / 240)
    ball = scene.add_sphere(0.01, 1.0, position=(math.sin(0.1), 0, 1 - math.cos(0.1)))
    scene.add_joint("distance", -1, ball, anchor_a=(0, 0, 1.0))
    sim, x = lv.Simulation(scene), []
    for _ in range(1200):
        x.append(sim.step()[0]["positions"][0][0])
    zeros = np.flatnonzero(np.diff(np.sign(x)))
    period = 2 * np.diff(zeros).mean() / 240
    assert period == pytest.approx(2 * math.pi * math.sqrt(1 / G) * (1 + 0.1**2 / 16), rel=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_boxes_stand_for_ten_seconds(name):
    # xpbd without warm starts: few of them, in short substeps
    more = {"n": 3, "substeps": 20, "solver_iterations": 1} if name == "xpbd" else {}
    scene = lv.Scene("stack", stepper=name, dt=1 / 60, **more)
    _, seen = run(scene, 600)
    assert np.abs(seen["positions"][1:, :2]).max() < 0.01
    np.testing.assert_allclose(seen["positions"][1:, 2], np.arange(scene.n_bodies - 1) + 0.5, atol=0.01)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", NAMES)
def test_thrown_bodies_gain_no_energy_and_fall_through_nothing(name, seed):
    rng = np.random.default_rng(seed)
    scene = lv.Scene(stepper=name, dt=1 / 240, friction=rng.uniform())
    scene.add_plane()
    for i in range(8):
        more = {"position": (*rng.uniform(-0.6, 0.6, 2), 1.0 + 1.5 * i), "mass": 10.0 ** rng.uniform(-1, 1)}
        more |= {"velocity": rng.normal(scale=2.0, size=3), "angular_velocity": rng.normal(scale=3.0, size=3)}
        if rng.integers(2):
            scene.add_sphere(rng.uniform(0.1, 0.4), **more)
        else:
            turned = rng.normal(size=4)
            scene.add_box(rng.uniform(0.2, 0.8, 3), quaternion=turned / np.linalg.norm(turned), **more)
    sim = lv.Simulation(scene)
    start = energy(scene, sim.reset()[0])
    for _ in range(600):
        seen, _, lost, _, _ = sim.step()
        assert not lost
        assert energy(scene, seen) < 1.001 * start
    assert seen["positions"][1:, 2].min() > 0.05


SMALL = {"pyramid": {"base": 4}, "pile": {"n": 20}, "chain": {"n": 8}, "bridge": {"n": 6}}
GAINS = {
    "xpbd": 1e-2
}  # of the energy at the start, as docs/engine.md says; others: what rounding and projection lift


@pytest.mark.parametrize("of", sorted(SCENES))
@pytest.mark.parametrize("name", NAMES)
def test_no_scene_that_nothing_drives_ends_above_its_energy(name, of):
    scene = lv.Scene(of, **SMALL.get(of, {})).with_parameters(stepper=name)
    try:
        sim = lv.Simulation(scene)
    except lv.InputError as refused:  # spin friction, restitution
        pytest.skip(str(refused))
    start = energy(scene, sim.reset()[0])
    gained = max(energy(scene, sim.step()[0]) - start for _ in range(120))
    assert gained <= GAINS.get(name, 1e-5) * abs(start)


# -- twins ----------------------------------------------------------------------------------------


def test_soft_rows_are_the_implicit_damped_spring():
    options = {"hertz": 20.0, "damping_ratio": 3.0}
    scene = lv.Scene("stack", n=2, stepper="soft_step", dt=1 / 240, stepper_options=options)
    scene.bodies[2].position[2] -= 1e-3  # the upper box overlaps the lower
    sim = lv.Simulation(scene)
    p = sim.constraint_problem()
    depth = {"box 2 on box 1": 1e-3}
    for i in range(p.n_blocks):
        row, name = int(p.cones.ptr[i]), p.row_name(int(p.cones.ptr[i]))
        if not any(word in name for word in depth):
            continue
        h, omega = 1 / 240, 2 * math.pi * 20.0
        a1 = 2 * 3.0 + h * omega
        a = p.d[row] - p.compliance[row]
        assert p.compliance[row] == pytest.approx(a / (h * omega * a1), rel=1e-12)
        # target = rate depth, J v* = 0: both fall alike
        assert p.b[row] == pytest.approx(omega / a1 * 1e-3, rel=1e-9)
    assert (p.compliance > 0).sum() >= 4


def test_a_sphere_in_the_ground_comes_out_as_the_spring_says_and_keeps_no_speed():
    # one degree of freedom: v = (v - h w^2 x)/(1 + a2) with x the depth below, then relaxed to 0
    hertz, ratio, h, depth = 10.0, 1.0, 1 / 240, 1e-3
    options = {"hertz": hertz, "damping_ratio": ratio, "push_speed": 1e3}
    scene = lv.Scene(stepper="soft_step", dt=h, gravity=0.0, friction=0.0, stepper_options=options)
    scene.add_plane()
    scene.add_sphere(0.5, position=(0, 0, 0.5 - depth))
    seen = lv.Simulation(scene).step()[0]
    omega = 2 * math.pi * 2 * hertz  # twice as stiff against what never moves
    a2 = h * omega * (2 * ratio + h * omega)
    assert seen["positions"][1][2] - 0.5 + depth == pytest.approx(
        h * h * omega**2 * depth / (1 + a2), rel=1e-12
    )
    assert abs(seen["velocities"][1][2]) < 1e-15


@pytest.mark.parametrize("name", [*NAMES, "without relaxation"])
def test_a_spec_says_whether_the_exported_problem_is_the_step(name):
    more = {"stepper": name, "order": "given"}
    if name == "without relaxation":
        more = {"stepper": "soft_step", "order": "reverse", "stepper_options": {"relaxing_sweeps": 0}}
    sim = after(30, "pyramid", base=3, substeps=1, solver_iterations=7, **more)
    order = more["order"]
    found = lv.solve(sim.constraint_problem(), "sequential_impulses", tol=0, max_iter=7, order=order).impulse
    same = sim.step()[0]["contacts"]["impulses"].ravel().tobytes() == found.tobytes()
    assert same == (name not in STEPPERS or get_stepper(name).exact_problem)


def dense_descent(sim, passes, keep, stiffening):
    """One substep of `avbd` in NumPy from the exported rows: displacements (6 n)."""
    p = sim.constraint_problem()
    rows, h = p.rows, sim.scene.parameters.dt
    j = rows.jacobian(p.cones).toarray()
    n = rows.n_bodies
    state = sim.state.copy()
    state.kernel.prepare_substep()
    gap = state.a["gap"][: rows.n_contacts]
    mass = np.zeros((6 * n, 6 * n))
    for i in range(n):
        mass[6 * i : 6 * i + 3, 6 * i : 6 * i + 3] = np.eye(3) / rows.inv_mass[i]
        mass[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6] = np.linalg.inv(rows.inv_inertia[i])
    lam, y = np.zeros(p.m), h * rows.v_free.ravel()
    first = p.cones.ptr[:-1]
    kappa = 1 / (h * p.d[first])
    least, z = kappa.copy(), y.copy()
    error = np.where(gap > 0, gap, (1 - keep) * gap)

    def impulses(c):
        r = slice(first[c], p.cones.ptr[c + 1])
        x = lam[r] - kappa[c] * (j[r] @ z + np.array([error[c], 0, 0]))
        x[0] = max(x[0], 0.0)
        size, bound = np.hypot(*x[1:]), p.cones.mu[c] * x[0]
        if size > bound:
            x[1:] *= bound / size
        return r, x, x[0] > 0 and size <= bound

    for _ in range(passes):
        for i in range(n):
            own = slice(6 * i, 6 * i + 6)
            h_, g = mass[own, own] / h, -mass[own, own] @ (z[own] - y[own]) / h
            for c in range(len(first)):
                r, x, _ = impulses(c)
                if x[0] > 0 and np.abs(j[r, own]).max() > 0:
                    h_ = h_ + kappa[c] * j[r, own].T @ j[r, own]
                    g = g + j[r, own].T @ x
            z[own] += np.linalg.solve(h_, g)
        made = [impulses(c) for c in range(len(first))]
        for c, (r, x, sticks) in enumerate(made):
            lam[r] = x
            if sticks:
                kappa[c] += stiffening * least[c] * abs((j[r] @ z)[0] + error[c]) / sim.scene.parameters.slop
    return z, lam


def test_avbd_is_block_descent_written_densely():
    scene = lv.Scene("stack", n=3, stepper="avbd", dt=1 / 240, solver_iterations=5, warm_start=False)
    scene.bodies[2].velocity[0] = 0.3
    sim = after(3, scene)
    z, lam = dense_descent(sim, 5, 0.99, 0.03)
    before = sim.step()[0]
    np.testing.assert_allclose(before["velocities"][1:].ravel(), 240 * z, rtol=0, atol=1e-11)
    np.testing.assert_allclose(before["contacts"]["impulses"].ravel(), lam, rtol=0, atol=1e-12)


def test_one_correction_of_xpbd_is_equation_2():
    # a ball joint stretched by an error that free flight brings: the multiplier of the paper, by hand
    h = 1 / 240
    scene = lv.Scene(stepper="xpbd", dt=h, solver_iterations=1, gravity=0.0)
    a = scene.add_sphere(0.1, 2.0, position=(0, 0, 0))
    b = scene.add_sphere(0.1, 3.0, position=(1, 0, 0), velocity=(1, 0, 0))
    scene.add_joint("distance", a, b)
    seen = lv.Simulation(scene).step()[0]
    lam = -h * 1.0 / (1 / 2.0 + 1 / 3.0)  # kg m
    np.testing.assert_allclose(seen["positions"][:, 0], [-lam / 2.0, 1 + h + lam / 3.0], atol=1e-15)
    np.testing.assert_allclose(seen["velocities"][:, 0], [0.6, 0.6], atol=1e-12)  # centres travel together
    assert seen["joint_impulses"][0] == pytest.approx(lam / h, rel=1e-12)


# -- the engine around them ----------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scene", ["card_house", "bridge", "chain"])
def test_the_unit_of_mass_changes_no_bit_of_the_motion(name, scene):
    """Powers of four, whose roots are exact."""
    own = lv.Scene(scene, stepper=name)
    seen = run(own, 20)[1]
    for unit in (2.0**-40, 2.0**12, 2.0**40):
        other = lv.Scene(scene, stepper=name)
        other.bodies[:] = [replace(b, mass=unit * b.mass, inertia=unit * b.inertia) for b in own.bodies]
        scaled = run(other, 20)[1]
        for key in ("positions", "quaternions", "velocities"):
            assert seen[key].tobytes() == scaled[key].tobytes(), key
        assert (unit * seen["joint_impulses"]).tobytes() == scaled["joint_impulses"].tobytes()


@pytest.mark.parametrize("name", NAMES)
def test_the_eight_values_are_those_that_have_a_meaning(name):
    sim, seen = run(lv.Scene("stack", substeps=1), 10, stepper=name)
    spec, values = get_stepper(name), seen["solver"]
    assert list(values[:4]) == [16.0, 1.0, 24.0, 24.0]
    assert np.isfinite(values[4:]).all() == spec.residuals
    assert sim.scene.parameters.stepper == name
    problem = sim.constraint_problem()  # soft contacts have a compliance
    said = dict(zip(lv.SOLVER_FIELDS, sim.step()[0]["solver"], strict=True))
    if spec.residuals:
        judged, normal = lv.residual(problem, problem.guess), problem.cones.ptr[:-1]
        # w is a difference of velocities near 0.1 m/s, so it carries their rounding, some 1e-16 m/s.
        assert said["residual_initial"] == pytest.approx(
            np.abs(judged.error[normal]).max(), rel=1e-9, abs=1e-14
        )
        assert said["violation_initial"] == pytest.approx(-judged.slack[normal].min(), rel=1e-9, abs=1e-14)


@pytest.mark.parametrize("name", NAMES)
def test_what_a_stepper_cannot_do_is_refused_before_the_first_step(name):
    spec = STEPPERS[name]
    for can, more, word in (
        (spec.spin, {"patch_radius": 0.1}, "spin"),
        (spec.rolling, {"rolling_radius": 0.02}, "rolling friction"),
        (name not in ("xpbd", "avbd"), {"friction_shape": "box"}, "by a disk"),
        (spec.restitution, {"restitution": 0.5}, "restitution"),
        (spec.solvers, {"solver": "newton"}, "newton"),
    ):
        if can:
            lv.Simulation(lv.Scene("stack", stepper=name, **more)).step()
        else:
            with pytest.raises(lv.InputError, match=word):
                lv.Simulation(lv.Scene("stack", stepper=name, **more))
    low, high = spec.sweeps
    lv.Scene("stack", stepper=name, solver_iterations=low)
    for n in (low - 1, high + 1):
        with pytest.raises(lv.InputError, match="solver_iterations"):
            lv.Scene("stack", stepper=name, solver_iterations=n)
        with pytest.raises(lv.InputError, match="solver_iterations"):
            lv.Simulation("stack", stepper=name).set_solver_iterations(n)
    for option in spec.options:
        with pytest.raises(lv.InputError, match=option):
            lv.Scene("stack", stepper=name, stepper_options={option: -1})
    with pytest.raises(lv.UnknownName, match="nonsense"):
        lv.Scene("stack", stepper=name, stepper_options={"nonsense": 1})


def test_a_stopped_prepare_leaves_no_softness_behind():
    # prepared twice, as a look at the problem does: the second must not see what the first has softened
    sim = after(5, "stack", stepper="soft_step")
    state = sim.state.copy()
    state.kernel.prepare_substep()
    first = state.a["b"].copy(), state.a["d"].copy()
    state.kernel.prepare_substep()
    assert state.a["b"].tobytes() == first[0].tobytes() and state.a["d"].tobytes() == first[1].tobytes()
    assert state.head[HEAD["stepper"]] == STEPPERS["soft_step"].number


@pytest.mark.parametrize("shape", ["sphere", "box"])
@pytest.mark.parametrize("name", NAMES)
def test_what_moves_less_in_a_substep_than_docs_engine_says_passes_no_wall(name, shape):
    """Half of both thicknesses; where the margin acts half its own and that; at whatever distance a substep begins."""
    h, margin, acts = 1 / 240, 0.01, name in ("impulses", "soft_step")
    passed = {0.3: 0, 0.98: 0, 1.9: 0}  # shares of that bound; beyond it nothing is promised, and some pass
    for share, size, wall in product(passed, (0.02, 0.2), (0.001, 0.1, None)):
        far = share * (0.5 * size + (margin if acts or wall is None else 0.5 * wall))  # m a substep
        for phase in (0.0, 0.2, 0.4, 0.6, 0.8, 0.999):
            scene = lv.Scene(stepper=name, dt=h, substeps=1, gravity=0.0, margin=margin)
            if wall is None:
                scene.add_plane()
            else:
                scene.add_box((2, 2, wall), position=(0, 0, -wall / 2), static=True)
            place = {
                "position": (0.01, 0.02, 0.5 * size + margin + phase * far),
                "velocity": (0, 0, -far / h),
            }
            if shape == "sphere":
                scene.add_sphere(size / 2, **place)
            else:
                scene.add_box((size,) * 3, **place)
            sim = lv.Simulation(scene)
            for _ in range(12):
                seen = sim.step()[0]
                speed = np.linalg.norm(seen["velocities"][1][:3])
                assert speed <= far / h * (1 + 1e-9) or not acts, "no speed comes of a wall at rest"
            beyond = 0.0 if acts or wall is None else -wall / 2  # its middle
            passed[share] += bool(seen["positions"][1][2] <= beyond)
    assert passed[0.3] == passed[0.98] == 0 < passed[1.9]
