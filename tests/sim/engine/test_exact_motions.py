"""LavenderSim against the exact motions of simple scenes: sliding, rolling, swinging, tipping and hanging bodies."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import lavender as lv
from lavender.sim.scene.parts import convert_to_rotation_matrix, make_quaternion

G = 9.81
DT = 1 / 60
SWEEPS = {}
NEWTON = {"solver": "newton", "substeps": 4}
SOLVERS = pytest.mark.parametrize("solver", [SWEEPS, NEWTON], ids=["sweeps", "newton"])


def record(scene, seconds):
    """Step a scene; return times (k,), positions, quaternions and velocities (k, n, ...), with the start."""
    sim = lv.Simulation(scene)
    seen = [sim.reset()[0]]
    for _ in range(math.ceil(seconds / DT - 1e-9)):
        observation, _, terminated, *_ = sim.step()
        assert not terminated
        seen.append(observation)
    return DT * np.arange(len(seen)), *(
        np.array([o[key] for o in seen]) for key in ("positions", "quaternions", "velocities")
    )


def make_scene(gravity=G, **parameters):
    return lv.Scene(gravity=gravity, dt=DT, **parameters)


def make_slope(angle, **parameters):
    """A level plane under inclined gravity, so that no pose is rounded."""
    scene = make_scene((G * math.sin(angle), 0.0, -G * math.cos(angle)), **parameters)
    scene.add_plane()
    return scene


def find_crossing_time(time, x, level):
    """Time at which x first falls below `level`, by linear interpolation."""
    i = np.flatnonzero(x < level)[0]
    return time[i - 1] + (x[i - 1] - level) / (x[i - 1] - x[i]) * (time[i] - time[i - 1])


def find_period(time, x):
    """Twice the mean distance of the sign changes of x."""
    i = np.flatnonzero(x[1:] * x[:-1] < 0.0)
    return 2.0 * np.diff(time[i] + (time[i + 1] - time[i]) * x[i] / (x[i] - x[i + 1])).mean()


@SOLVERS
@pytest.mark.parametrize("mu", [0.2, 1.0])
@pytest.mark.parametrize("ratio", [0.5, 0.98, 1.02, 1.5])
def test_block_on_slope_sticks_below_friction_angle_and_accelerates_above(solver, mu, ratio):
    angle = math.atan(ratio * mu)
    scene = make_slope(angle, friction=mu, **solver)
    scene.add_box((1.0, 1.0, 0.2), position=(0.0, 0.0, 0.1))
    time, x, _, v = record(scene, 2.0)
    late = time >= 0.25
    if ratio < 1.0:
        # 1e-6 m/s is 9 cm a day.
        assert np.linalg.norm(x[-1, 1] - x[late][0, 1]) < 1e-6 * time[-1]
    else:
        exact = G * (math.sin(angle) - mu * math.cos(angle))
        # The discrete velocity grows linearly; 1e-3 m/s^2 is a ten-thousandth of g.
        assert np.polyfit(time[late], v[late, 1, 0], 1)[0] == pytest.approx(exact, abs=1e-3)


@SOLVERS
@pytest.mark.parametrize(("mu", "speed"), [(0.5, 3.0), (0.2, 1.0), (1.0, 5.0)])
def test_sliding_block_stops_after_exact_distance_and_time_without_lift(solver, mu, speed):
    scene = make_slope(0.0, friction=mu, **solver)
    scene.add_box((1.0, 1.0, 0.2), position=(0.0, 0.0, 0.1), velocity=(speed, 0.0, 0.0))
    time, x, _, v = record(scene, speed / (mu * G) + 1.0)
    # First order in a substep of 1/240 s: half a substep at the initial speed.
    assert x[-1, 1, 0] == pytest.approx(speed**2 / (2 * mu * G), abs=speed / 480 + 1e-6)
    stopped = find_crossing_time(time, v[:, 1, 0], 0.1 * speed) / 0.9
    assert stopped == pytest.approx(speed / (mu * G), abs=1 / 240)
    # A tenth of the slop; the convex relaxation of friction would lift the block by centimetres.
    assert x[:, 1, 2].max() - 0.1 < 1e-4
    assert np.ptp(x[time >= time[-1] - 0.5, 1, 0]) < 1e-5


@SOLVERS
@pytest.mark.parametrize(("mu", "speed"), [(0.5, 3.0), (0.1, 3.0), (1.0, 10.0)])
def test_sliding_ball_rolls_with_five_sevenths_of_its_speed(solver, mu, speed):
    scene = make_slope(0.0, friction=mu, **solver)
    scene.add_sphere(0.5, position=(0.0, 0.0, 0.5), velocity=(speed, 0.0, 0.0))
    exact = 2 * speed / (7 * mu * G)
    time, _, _, v = record(scene, exact + 1.0)
    slip = v[:, 1, 0] - 0.5 * v[:, 1, 4]
    # Angular momentum about the contact point is conserved by each substep.
    assert v[-1, 1, 0] == pytest.approx(5 / 7 * speed, rel=1e-6)
    assert find_crossing_time(time, slip, 0.1 * speed) / 0.9 == pytest.approx(exact, abs=1 / 240)


@pytest.mark.parametrize(("mu", "spin"), [(0.5, 10.0), (1.0, 30.0)])
def test_spinning_ball_slows_linearly_by_torsional_friction(mu, spin):
    patch = 0.1
    scene = make_slope(0.0, friction=mu, patch_radius=patch)
    scene.add_sphere(0.5, position=(0.0, 0.0, 0.5), angular_velocity=(0.0, 0.0, spin))
    seconds = spin * 0.4 * 0.25 / (mu * patch * G)  # Inertia 2/5 m R^2, torque mu r m g.
    time, _, _, v = record(scene, seconds + 0.5)
    np.testing.assert_allclose(
        v[:, 1, 5], spin * np.maximum(0.0, 1.0 - time / seconds), rtol=0, atol=1e-9 * spin
    )


def test_pendulum_period_is_exact_and_energy_loss_falls_with_substep():
    side, start = 0.1, 1.0
    inertia = (1 + side**2) / 12 + 0.25  # About the hinge, of a rod of 1 kg and 1 m.
    exact = 4.0 * math.sqrt(inertia / (0.5 * G)) * ellipk(math.sin(0.5 * start) ** 2)
    losses = []
    for substeps in (4, 16):
        scene = make_scene(substeps=substeps)
        rod = scene.add_box(
            (side, side, 1.0),
            position=(0.5 * math.sin(start), 0.0, -0.5 * math.cos(start)),
            quaternion=make_quaternion((0.0, 1.0, 0.0), -start),
        )
        scene.add_joint("hinge", -1, rod, anchor=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
        time, x, _, v = record(scene, 5 * exact)
        # The period falls with the amplitude, which the lost energy reduces: by 1 % in five swings.
        assert find_period(time, np.arctan2(x[:, 0, 0], -x[:, 0, 2])) == pytest.approx(
            exact, rel=0.02
        )
        energy = 0.5 * (v[:, 0, :3] ** 2).sum(axis=1) + G * x[:, 0, 2]
        energy += 0.5 * (1 + side**2) / 12 * v[:, 0, 4] ** 2
        losses.append(energy[0] - energy[-1])
    # First order in the substep: a quarter of the length loses about a quarter of the energy.
    assert 0.0 < losses[1] < 0.35 * losses[0]


@pytest.mark.parametrize("spin", [5.0, 15.0])
def test_free_body_flips_with_exact_period_and_keeps_energy_and_momentum(spin):
    edges = np.array([0.2, 0.6, 1.0])
    inertia = (edges @ edges - edges**2) / 12
    omega0 = np.array([0.05 * spin, spin, 0.0])
    # Jacobi's elliptic functions (Landau, Lifshitz, Mechanics, section 37), with 1 and 3 exchanged if L^2 < 2 E I2.
    energy = inertia @ omega0**2
    squared = ((inertia * omega0) ** 2).sum()
    i1, i2, i3 = np.sort(inertia)
    if squared < energy * i2:
        i1, i3 = i3, i1
    scale = (i3 - i2) * (squared - energy * i1)
    exact = (
        4.0 * ellipk((i2 - i1) * (energy * i3 - squared) / scale) * math.sqrt(i1 * i2 * i3 / scale)
    )

    scene = make_scene(0.0)
    scene.add_box(tuple(edges), angular_velocity=tuple(omega0))
    time, _, q, v = record(scene, 3 * exact)
    rotations = np.array([convert_to_rotation_matrix(one) for one in q[:, 0]])
    omega = np.einsum("kji,kj->ki", rotations, v[:, 0, 3:])
    momentum = np.einsum("kij,kj->ki", rotations, inertia * omega)
    assert find_period(time, omega[:, 1]) == pytest.approx(exact, rel=0.01)
    np.testing.assert_allclose(omega**2 @ inertia, energy, rtol=0.01)
    np.testing.assert_allclose(
        momentum, np.tile(momentum[0], (len(time), 1)), atol=0.01 * math.sqrt(squared)
    )


@pytest.mark.parametrize("ratio", [1.0, 100.0, 1e4])
def test_chain_under_load_has_no_gap_and_first_joint_carries_all_weight(ratio):
    scene = lv.Scene("chain", n=10, tip_mass=ratio, angle=0.0, gravity=G, dt=DT, **NEWTON)
    sim = lv.Simulation(scene)
    for _ in range(60):
        observation = sim.step()[0]
    tension = np.linalg.norm(observation["joint_impulses"][:3]) / (DT / 4)
    assert tension == pytest.approx(G * sum(b.mass for b in scene.bodies), rel=1e-3)
    # A tenth of the slop of contacts; sweeps open a gap of centimetres at the largest ratio.
    assert np.abs(sim.state.a["joint_error"]).max() < 1e-4


@SOLVERS
@pytest.mark.parametrize("ratio", [0.95, 1.02, 1.1])
def test_tall_box_tips_after_exact_time_if_slope_exceeds_its_base(solver, ratio):
    width, angle = 0.5, 0.5
    theta = math.atan(ratio * width)
    scene = make_slope(theta, friction=2.0, **solver)
    scene.add_box((width, width, 1.0), position=(0.0, 0.0, 0.5))
    if ratio < 1.0:
        up = np.array([convert_to_rotation_matrix(q) for q in record(scene, 3.0)[2][:, 1]])[:, 2, 2]
        assert np.arccos(up.clip(-1, 1)).max() < 0.01
        return

    def accelerate(_, y):
        # Torque of the weight about the lower edge of a box turned by y[0], over m (w^2 + h^2)/3.
        x = 0.5 * math.sin(y[0]) - 0.5 * width * math.cos(y[0])
        z = 0.5 * math.cos(y[0]) + 0.5 * width * math.sin(y[0])
        return [y[1], 3 * G * (math.sin(theta) * z + math.cos(theta) * x) / (width**2 + 1)]

    def exceed(_, y):
        return y[0] - angle

    exceed.terminal = True
    exact = solve_ivp(
        accelerate, (0, 20), [0.0, 0.0], events=exceed, rtol=1e-10, atol=1e-13
    ).t_events[0][0]
    time, _, q, _ = record(scene, exact + 0.5)
    tilt = np.arccos(
        np.array([convert_to_rotation_matrix(one)[2, 2] for one in q[:, 1]]).clip(-1, 1)
    )
    # Three samples.
    assert find_crossing_time(time, -tilt, -angle) == pytest.approx(exact, abs=0.05)


def make_overhang(reach, bricks, **parameters):
    """Bricks of length 1: from the top down, brick k overhangs the next one by reach/(2 k)."""
    scene = make_scene(friction=0.5, **parameters)
    scene.add_plane()
    x = 0.0
    for i in range(bricks):
        scene.add_box((1.0, 0.5, 0.25), position=(x, 0.0, (i + 0.5) * 0.25))
        if i < bricks - 1:
            x += reach / (2 * (bricks - 1 - i))
    return scene


def compute_min_arch_thickness(stones, lean):
    """Thickness [stone lengths] below which no thrust H at the apex keeps a pointed arch upright.

    A joint at distance D from the top carries the weight of D stones. With the leg at a = `lean` from upright and
    thickness t, moments about the inner and the outer edge of each joint bound the thrust [weights of a stone]:

        H >= (D tan a - t)/2,        H (D cos a - t sin a) <= D (D sin a + t cos a)/2
    """
    s = math.sin(lean)
    c = math.cos(lean)
    d = np.arange(1.0, stones + 1)
    low = 0.0
    high = float(stones)
    for _ in range(60):
        t = 0.5 * (low + high)
        arm = d * c - t * s
        largest = (d * (d * s + t * c) / 2)[arm > 0] / arm[arm > 0]
        stands = max(0.0, ((d * s / c - t) / 2).max()) <= largest.min(initial=np.inf)
        low, high = (low, t) if stands else (t, high)
    return high


def make_arch(thickness, stones=4, slope=0.5, **parameters):
    """A pointed arch of two legs on skewbacks; `thickness` is a multiple of the minimum."""
    lean = math.atan(slope)
    thick = thickness * compute_min_arch_thickness(stones, lean)
    s, c = math.sin(lean), math.cos(lean)
    scene = make_scene(friction=1.0, **parameters)
    scene.add_plane((s, 0.0, c))
    scene.add_plane((-s, 0.0, c))
    foot = stones * s + 0.5 * thick * c
    for side in (-1.0, 1.0):
        for i in range(stones):
            x = side * (foot - (i + 0.5) * s)
            z = foot * s / c + (i + 0.5) * c
            turned = make_quaternion((0.0, 1.0, 0.0), -side * lean)
            scene.add_box((thick, 1.0, 1.0), position=(x, 0.0, z), quaternion=turned)
    return scene


@pytest.mark.parametrize(
    ("scene", "stands"),
    [
        (lambda: make_overhang(0.98, 10, **NEWTON), True),
        (lambda: make_overhang(1.02, 10, **NEWTON), False),
        (lambda: make_overhang(0.98, 5), True),
        (lambda: make_arch(1.05), True),
        (lambda: make_arch(0.95), False),
        (
            lambda: lv.Scene(
                "heavy_on_light", n=3, ratio=1e4, gravity=G, dt=DT, friction=0.5, **NEWTON
            ),
            True,
        ),
        (
            lambda: lv.Scene("heavy_on_light", n=3, ratio=100.0, gravity=G, dt=DT, friction=0.5),
            True,
        ),
    ],
    ids=[
        "overhang 10",
        "too far 10",
        "overhang 5, sweeps",
        "arch",
        "too thin",
        "heavy newton",
        "heavy sweeps",
    ],
)
def test_scene_structure_stands_exactly_if_statics_allows(scene, stands):
    _, x, _, _ = record(scene(), 8.0)
    drop = (x[0] - x[-1])[:, 2].max()
    assert drop < 0.01 if stands else drop > 0.1
