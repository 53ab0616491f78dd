"""Scenes of the scorecard: what is built, a truth formula, one error in SI units, and its classes.

A scene is plain data, which adapters in Python and Node read. z points up, g = 9.81 m/s^2. Slopes are made by tilting
gravity, so that the ground is always the plane z = 0. `DIRECTION` turns horizontal directions by 30 degrees away from
the axes, because friction pyramids are exact along the axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray

GRAVITY = 9.81  # m/s^2
FRICTION = 0.5
DIRECTION = np.array([math.cos(math.pi / 6), 0.5, 0.0])
HEADINGS = tuple(7.5 * k for k in range(7))  # degrees
RATES = (240, 500, 1000, 2000, 4000)  # steps a second
SAMPLE = 0.05  # s between two states that are read
RATIOS = (1.0, 10.0, 100.0, 1e3, 1e4)
#: Way [m] and turn [rad] of the cube of `measure_spin` for all normal forces that its corners can have. The test
#: integrates them: 1.160 to 1.194 m, 1.144 to 1.473 rad.
SPIN_WAY = (1.155, 1.2)
SPIN_TURN = (1.14, 1.48)
Description = dict[str, Any]
#: Simulates a description for its time and returns the times (k,) [s] and states (k, n, 13) of the moving bodies:
#: position [m], quaternion w x y z, velocity [m/s], angular velocity [rad/s], in world axes. The arguments are the
#: description, the time step [s] and the time between samples [s].
Run = Callable[[Description, float, float], tuple[FloatArray, FloatArray]]


def make_body(size: Any, mass: float, position: Any, **more: Any) -> Description:
    """Describe a uniform box (three edges [m]) or sphere (radius [m]); `more` replaces entries of the description."""
    if isinstance(size, float):
        shape: Description = {"kind": "sphere", "radius": size}
        inertia = [0.4 * mass * size**2] * 3
    else:
        shape = {"kind": "box", "size": list(map(float, size))}
        squares = np.square(size)
        inertia = [mass / 12 * float(squares.sum() - x) for x in squares]
    body = {
        "shape": shape,
        "mass": mass,
        "inertia": inertia,
        "position": list(map(float, position)),
        "quaternion": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.0] * 3,
        "spin": [0.0] * 3,
        "force": [0.0] * 3,
        "kinematic": False,
    }
    return body | {k: v if isinstance(v, bool) else list(map(float, v)) for k, v in more.items()}


def describe(name: str, seconds: float, bodies: Sequence[Description], **more: Any) -> Description:
    """Describe a scene; the ground is the first body unless `ground` is False."""
    plane = {
        "shape": {"kind": "plane", "normal": [0.0, 0.0, 1.0], "offset": 0.0},
        "mass": 0.0,
        "inertia": [0.0] * 3,
        "position": [0.0] * 3,
        "quaternion": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.0] * 3,
        "spin": [0.0] * 3,
    }
    scene = {
        "name": name,
        "seconds": seconds,
        "gravity": [0.0, 0.0, -GRAVITY],
        "friction": FRICTION,
        "restitution": 0.0,
        "bodies": [*([plane] if more.pop("ground", True) else []), *bodies],
        "joints": [],
        "planar": True,
    }
    return scene | more


def make_hinge(a: int, b: int, anchor: Any, motor: Sequence[float] | None = None) -> Description:
    """Describe a hinge about the y axis between moving bodies a and b (-1: the world).

    `motor` is the speed [rad/s] and the largest torque [N m].
    """
    return {
        "a": a,
        "b": b,
        "anchor": list(map(float, anchor)),
        "axis": [0.0, 1.0, 0.0],
        "motor": None if motor is None else list(motor),
    }


def rotate(quaternion: FloatArray, vector: Any) -> FloatArray:
    """Rotate vectors by quaternions w x y z (..., 4), which need not be normalised."""
    q = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    u = q[..., 1:]
    v = np.broadcast_to(np.asarray(vector, float), q[..., 1:].shape)
    twice = 2.0 * np.cross(u, v)
    rotated: FloatArray = v + q[..., :1] * twice + np.cross(u, twice)
    return rotated


def get_tilted_gravity(slope: float, heading: float = math.pi / 6) -> list[float]:
    """Return gravity [m/s^2] on a slope (its tangent) that falls towards a heading [rad]."""
    angle = math.atan(slope)
    down = GRAVITY * math.sin(angle)
    return [down * math.cos(heading), down * math.sin(heading), -GRAVITY * math.cos(angle)]


SLAB, CUBE = (0.4, 0.4, 0.1), (0.5, 0.5, 0.5)
CRITICAL = math.atan(FRICTION)  # rad


def _make_slope(degrees: float, seconds: float) -> Description:
    gravity = get_tilted_gravity(math.tan(CRITICAL + math.radians(degrees)))
    return describe("slope", seconds, [make_body(SLAB, 1.0, (0, 0, 0.05))], gravity=gravity)


def _pick(t: FloatArray, x: FloatArray, time: float) -> FloatArray:
    state: FloatArray = x[int(np.argmin(np.abs(t - time)))]
    return state


def _measure_displacement(x: FloatArray) -> float:
    return float(np.linalg.norm(x[:, :, :3] - x[0, :, :3], axis=2).max())


def measure_stick(run: Run, dt: float) -> float:
    """Return the mean speed [m/s] from 2 s to 4 s one degree below the friction angle."""
    t, x = run(_make_slope(-1.0, 4.0), dt, SAMPLE)
    return float(np.linalg.norm((_pick(t, x, 4.0) - _pick(t, x, 2.0))[0, :3]) / 2.0)


def measure_slip(run: Run, dt: float) -> float:
    """Return the error of the acceleration [m/s^2] one degree above the friction angle."""
    t, x = run(_make_slope(1.0, 3.0), dt, SAMPLE)
    angle = CRITICAL + math.radians(1.0)
    truth = GRAVITY * (math.sin(angle) - FRICTION * math.cos(angle)) * DIRECTION
    return float(np.linalg.norm((_pick(t, x, 3.0) - _pick(t, x, 1.0))[0, 7:10] / 2.0 - truth))


def measure_slide(run: Run, dt: float) -> float:
    """Return the error of the stopping place [m] of a slab that starts with 3 m/s."""
    scene = describe("slide", 2.0, [make_body(SLAB, 1.0, (0, 0, 0.05), velocity=3.0 * DIRECTION)])
    _, x = run(scene, dt, SAMPLE)
    truth = 9.0 / (2 * FRICTION * GRAVITY) * DIRECTION
    return float(np.linalg.norm(x[-1, 0, :2] - truth[:2]))


def measure_spin(run: Run, dt: float) -> float:
    """Return the error [m] at a corner of where a cube stops that starts with 3 m/s and 5 rad/s.

    Coulomb's law at the four corners and the balance of moments leave one of the four normal forces undetermined, so
    that truth is a range (`SPIN_WAY`, `SPIN_TURN`); the error is that outside of it: of the way, or of the turn times
    the distance of a corner from the middle.
    """
    cube = make_body((1, 1, 1), 1.0, (0, 0, 0.5), velocity=3.0 * DIRECTION, spin=(0, 0, 5))
    _, x = run(describe("spin", 2.0, [cube], planar=False), dt, SAMPLE)
    q = x[:, 0, 3:7]
    yaw = np.unwrap(2.0 * np.arctan2(q[:, 3], q[:, 0]), period=2.0 * math.pi)
    way = float(np.linalg.norm((x[-1] - x[0])[0, :2]))
    turn = float(yaw[-1] - yaw[0])
    return max(
        _get_distance_outside(way, SPIN_WAY),
        math.sqrt(0.5) * _get_distance_outside(turn, SPIN_TURN),
    )


def _get_distance_outside(value: float, interval: tuple[float, float]) -> float:
    return max(interval[0] - value, value - interval[1], 0.0) if math.isfinite(value) else math.inf


def measure_roll(run: Run, dt: float) -> float:
    """Return the error of the final velocity [m/s] of a sphere that slides, then rolls."""
    ball = make_body(0.1, 1.0, (0, 0, 0.1), velocity=2.0 * DIRECTION)
    _, x = run(describe("roll", 1.5, [ball], friction=0.3), dt, SAMPLE)
    return float(np.linalg.norm(x[-1, 0, 7:10] - 2.0 * 5 / 7 * DIRECTION))


def measure_stack(run: Run, dt: float) -> float:
    """Return the largest displacement [m] of ten boxes of 10 kg after 5 s."""
    _, x = run(
        describe("stack", 5.0, [make_body(CUBE, 10.0, (0, 0, 0.25 + 0.5 * i)) for i in range(10)]),
        dt,
        0.5,
    )
    return _measure_displacement(x[[0, -1]])


def _measure_pair(run: Run, dt: float, ratio: float) -> float:
    pair = [make_body(CUBE, mass, (0, 0, 0.25 + 0.5 * i)) for i, mass in enumerate((1.0, ratio))]
    return _measure_displacement(run(describe("ratio", 3.0, pair), dt, SAMPLE)[1])


def measure_ratio(run: Run, dt: float) -> float:
    """Return the largest displacement [m] in 3 s of a cube of 1000 kg on one of 1 kg."""
    return _measure_pair(run, dt, 1e3)


def find_rebounds(z: FloatArray) -> list[float]:
    """Return the greatest height after each bounce, of the heights z of every step."""
    lows = [i for i in range(1, len(z) - 1) if z[i] < z[i - 1] and z[i] <= z[i + 1] and z[i] < 0.1]
    if not lows:
        return []
    return [float(z[i : j + 1].max()) for i, j in zip(lows, [*lows[1:], len(z) - 1], strict=True)]


def _drop(run: Run, dt: float, seconds: float, e: float) -> list[float]:
    ball = make_body(0.1, 1.0, (0, 0, 1.1))
    _, x = run(describe("bounce", seconds, [ball], restitution=e), dt, dt)
    return find_rebounds(x[:, 0, 2] - 0.1) if np.isfinite(x).all() else [math.inf] * 3


def measure_bounce(run: Run, dt: float) -> float:
    """Return the error of the third rebound [m] of a ball that falls 1 m with e = 0.8."""
    heights = _drop(run, dt, 2.2, 0.8)
    return abs((heights[2] if len(heights) > 2 else 0.0) - 0.8**6)


def measure_tumble(run: Run, dt: float) -> float:
    """Return the largest change [N m s] of the angular momentum of a free box in 10 s."""
    box = make_body((0.1, 0.2, 0.3), 1.0, (0, 0, 5), spin=(1, 4, 1))
    _, x = run(describe("tumble", 10.0, [box], gravity=[0.0] * 3, planar=False), dt, 0.1)
    q = x[:, 0, 3:7]
    inertia = np.array(box["inertia"])
    local = rotate(q * [1, -1, -1, -1], x[:, 0, 10:13])
    momentum = rotate(q, inertia * local)
    return float(np.linalg.norm(momentum - inertia * box["spin"], axis=1).max())


def measure_grip(run: Run, dt: float) -> float:
    """Return the creep [m/s] of a block between a plate and the ground at 0.9 times the load that friction can hold."""
    normal = 10.0
    load = 0.9 * 2 * FRICTION * 10.0  # N
    block = make_body((0.1, 0.1, 0.1), 1.0, (0, 0, 0.05), force=load * DIRECTION)
    plate = make_body(
        (0.1, 0.1, 0.05), 0.5, (0, 0, 0.125), force=-0.5 * load * DIRECTION - [0, 0, normal]
    )
    t, x = run(describe("grip", 3.0, [block, plate], gravity=[0.0] * 3), dt, SAMPLE)
    return float(np.linalg.norm((_pick(t, x, 3.0) - _pick(t, x, 1.0))[:, :3], axis=1).max() / 2.0)


def measure_cards(run: Run, dt: float) -> float:
    """Return the largest displacement [m] in 5 s of two cards that lean against each other at 15 degrees."""
    half = math.radians(7.5)
    c = math.cos(2 * half)
    s = math.sin(2 * half)
    (thick, _, high) = (0.02, 0.3, 0.5)
    aside, up = 0.5 * (thick * c + high * s), 0.5 * (thick * s + high * c)
    cards = [
        make_body(
            (thick, 0.3, high),
            0.5,
            (-k * aside, 0, up),
            quaternion=(math.cos(half), 0, k * math.sin(half), 0),
        )
        for k in (1, -1)
    ]
    return _measure_displacement(run(describe("cards", 5.0, cards), dt, SAMPLE)[1])


def measure_belt(run: Run, dt: float) -> float:
    """Return the error of the place [m] after 1.5 s of a slab that is laid on a belt at 1 m/s."""
    belt = make_body((20, 20, 1), 1000.0, (0, 0, -0.5), velocity=DIRECTION, kinematic=True)
    slab = make_body(SLAB, 1.0, (0, 0, 0.05))
    _, x = run(describe("belt", 1.5, [belt, slab], ground=False), dt, SAMPLE)
    truth = (1.5 - 1.0 / (2 * FRICTION * GRAVITY)) * DIRECTION
    return float(np.linalg.norm((x[-1, 1, :3] - x[0, 1, :3]) - truth))


def measure_pendulum(run: Run, dt: float) -> float:
    """Return the largest change [J] of the energy in 10 s of a pendulum that swings by 60 degrees."""
    at = np.array([0.5 * math.sin(math.pi / 3), 0, 5.0 - 0.5 * math.cos(math.pi / 3)])
    bob = make_body((0.1, 0.1, 0.1), 1.0, at)
    scene = describe("pendulum", 10.0, [bob], joints=[make_hinge(-1, 0, (0, 0, 5))])
    _, x = run(scene, dt, 0.05)
    kinetic = 0.5 * (x[:, 0, 7:10] ** 2).sum(axis=1) + 0.5 * bob["inertia"][1] * (
        x[:, 0, 10:13] ** 2
    ).sum(axis=1)
    energy = kinetic + GRAVITY * x[:, 0, 2]
    return float(np.abs(energy - GRAVITY * at[2]).max())


def measure_gaps(scene: Description, x: FloatArray) -> float:
    """Return the largest distance [m] between the two anchors of a joint of a scene without ground."""
    gaps = []
    for joint in scene["joints"]:
        ends = []
        for i in (joint["a"], joint["b"]):
            anchor = np.array(joint["anchor"])
            if i < 0:
                ends.append(np.broadcast_to(anchor, x[:, 0, :3].shape))
            else:
                ends.append(
                    x[:, i, :3] + rotate(x[:, i, 3:7], anchor - scene["bodies"][i]["position"])
                )
        gaps.append(np.linalg.norm(ends[0] - ends[1], axis=1))
    return float(np.max(gaps))


def measure_four_bar(run: Run, dt: float) -> float:
    """Return the largest gap [m] of a joint in 5 s of a four-bar linkage that swings by 60 degrees."""
    pivots = np.array([[0, 0, 5.0], [0.5, 0, 5.0]])
    ends = pivots + 0.3 * np.array([math.sin(math.pi / 3), 0, -math.cos(math.pi / 3)])
    middles = [(pivots[0] + ends[0]) / 2, (ends[0] + ends[1]) / 2, (pivots[1] + ends[1]) / 2]
    bodies = [make_body((0.08, 0.08, 0.08), 1.0, middle) for middle in middles]
    joints = [
        make_hinge(*h)
        for h in ((-1, 0, pivots[0]), (0, 1, ends[0]), (1, 2, ends[1]), (-1, 2, pivots[1]))
    ]
    scene = describe("four-bar", 5.0, bodies, joints=joints, ground=False)
    return measure_gaps(scene, run(scene, dt, 0.05)[1])


def measure_motor(run: Run, dt: float) -> float:
    """Return the largest error [rad/s] in 1 s of the speed of a rotor whose motor has a torque limit."""
    rotor = make_body((0.2, 0.2, 0.2), 1.5, (0, 0, 5))  # 0.01 kg m^2
    scene = describe("motor", 1.0, [rotor], joints=[make_hinge(-1, 0, (0, 0, 5), (5.0, 0.1))])
    t, x = run(scene, dt, 0.05)
    return float(np.abs(x[:, 0, 11] - np.minimum(10.0 * t, 5.0)).max())


def measure_heading(run: Run, dt: float) -> tuple[float, list[float]]:
    """Return the largest error of the effective friction coefficient, and the coefficient of each heading.

    It is the slope at which a slab starts: bisection in 0.25 to 0.75; it slides if it has 0.01 m/s after 2 s.
    """
    found = []
    for heading in HEADINGS:
        low, high = 0.25, 0.75
        for _ in range(9):
            slope = 0.5 * (low + high)
            gravity = get_tilted_gravity(slope, math.radians(heading))
            slab = make_body(SLAB, 1.0, (0, 0, 0.05))
            scene = describe("slope", 2.0, [slab], gravity=gravity, planar=False)
            speed = float(np.linalg.norm(run(scene, dt, 2.0)[1][-1, 0, 7:10]))
            low, high = (slope, high) if speed <= 0.01 else (low, slope)
        found.append(0.5 * (low + high))
    return max(abs(mu - FRICTION) for mu in found), found


def measure_rates(run: Run, dt: float) -> tuple[float, list[float]]:
    """Return the largest error [m] of the first rebound at the rates of `RATES`, and the rebound of each."""
    heights = [(_drop(run, 1.0 / rate, 1.0, 0.8) or [0.0])[0] for rate in RATES]
    return max(abs(height - 0.64) for height in heights), heights


def measure_ratios(run: Run, dt: float) -> tuple[float, list[float]]:
    """Return the largest displacement [m] at the mass ratios of `RATIOS`, and that of each."""
    found = [_measure_pair(run, dt, ratio) for ratio in RATIOS]
    return max(found), found


@dataclass(frozen=True)
class Scene:
    """A scene; its measure returns the error, or the error and the values of a curve."""

    measure: Callable[[Run, float], float | tuple[float, list[float]]]
    unit: str
    limits: tuple[float, float, float]  # largest error of the classes good, fair and poor
    truth: str
    reason: str  # of the limits
    floor: Callable[[float], float] = lambda dt: 0.0  # error of the integrator alone at a time step
    curve: bool = False  # whether it has many simulations
    own_rates: bool = (
        False  # whether it has rates of its own, so that it is measured in one column of each level
    )


def _get_pendulum_floor(dt: float) -> float:
    """Return the energy error [J] of symplectic Euler steps of the angle."""
    inertia = 0.25 + 0.01 / 6
    angle = math.pi / 3
    speed = 0.0
    worst = 0.0
    for _ in range(round(10.0 / dt)):
        speed -= dt * GRAVITY * 0.5 * math.sin(angle) / inertia
        angle += dt * speed
        energy = 0.5 * inertia * speed**2 - GRAVITY * 0.5 * math.cos(angle)
        worst = max(worst, abs(energy + GRAVITY * 0.5 * 0.5))
    return worst


_CREEP = "0.01 mm/s: a robot's grasp of a minute; 1 mm/s: not visible in a game"
_PLACE = "0.1 mm: a robot's repeatability; 1 cm: not visible in a game"
#: The classes were written before the first run of this command.
SCENES: Mapping[str, Scene] = {
    "stick": Scene(
        measure_stick, "m/s", (1e-5, 1e-3, 1e-2), "1° below the friction angle: v = 0", _CREEP
    ),
    "slip": Scene(
        measure_slip,
        "m/s²",
        (2e-3, 2e-2, 1e-1),
        "1° above it: a = g (sin t − μ cos t) = 0.191",
        "1 %, 10 % and 50 % of the truth",
    ),
    "slide": Scene(
        measure_slide,
        "m",
        (1e-2, 3e-2, 1e-1),
        "stops after v²/(2 μ g) = 0.917 m, straight",
        "1 %, 3 % and 10 % of the way",
        lambda dt: 1.5 * dt,
    ),
    "spin": Scene(
        measure_spin,
        "m",
        (2e-2, 6e-2, 2e-1),
        "a cube at 3 m/s and 5 rad/s stops after 1.16 to 1.2 m, 1.14 to 1.48 rad",
        "2 %, 5 % and 17 % of the way",
        lambda dt: 1.5 * dt,
    ),
    "roll": Scene(
        measure_roll,
        "m/s",
        (1e-2, 5e-2, 2e-1),
        "slides, then rolls at 5/7 v₀ = 1.429 m/s",
        "1 %, 3 % and 14 % of the truth",
    ),
    "stack": Scene(measure_stack, "m", (1e-4, 1e-2, 1e-1), "ten boxes stay for 5 s", _PLACE),
    "ratio": Scene(measure_ratio, "m", (1e-4, 1e-2, 1e-1), "1000 kg on 1 kg stays for 3 s", _PLACE),
    "bounce": Scene(
        measure_bounce,
        "m",
        (1e-2, 5e-2, 2e-1),
        "third rebound e⁶ h = 0.262 m, e = 0.8",
        "4 %, 20 % and 80 % of the truth",
    ),
    "tumble": Scene(
        measure_tumble,
        "N m s",
        (5e-5, 5e-4, 5e-3),
        "a free box keeps its angular momentum, 0.035 N m s",
        "0.1 %, 1 % and 10 % of it, rounded",
    ),
    "grip": Scene(
        measure_grip,
        "m/s",
        (1e-5, 1e-3, 1e-2),
        "at 0.9 of the load 2 μ N a gripped block rests",
        _CREEP,
    ),
    "cards": Scene(
        measure_cards,
        "m",
        (1e-3, 1e-2, 5e-2),
        "two cards that lean by 15° stay",
        "1 mm: nothing happened; 1 cm: they lean; 5 cm: they have fallen",
    ),
    "belt": Scene(
        measure_belt,
        "m",
        (5e-3, 2e-2, 5e-2),
        "a slab on a belt slips by u²/(2 μ g) = 0.102 m",
        "5 %, 20 % and 50 % of the slip",
        lambda dt: 0.5 * dt,
    ),
    "pendulum": Scene(
        measure_pendulum,
        "J",
        (0.03, 0.1, 0.5),
        "energy of a swing of 2.45 J stays for 10 s",
        "1 %, 4 % and 20 % of the swing",
        _get_pendulum_floor,
    ),
    "four-bar": Scene(
        measure_four_bar,
        "m",
        (1e-4, 1e-3, 1e-2),
        "joints stay closed",
        "0.1 mm: play of a robot's joint; 1 mm: seen in a close-up; 1 cm: seen",
    ),
    "motor": Scene(
        measure_motor,
        "rad/s",
        (0.05, 0.2, 1.0),
        "ω = min(τ t / I, 5 rad/s), τ is the torque limit",
        "1 %, 4 % and 20 % of the speed",
    ),
    "heading": Scene(
        measure_heading,
        "1",
        (1e-2, 5e-2, 0.15),
        "a slab starts at slope μ = 0.5 in every direction",
        "2 %, 10 % and 30 % of μ; a measured μ is uncertain by 10 %",
        curve=True,
    ),
    "rates": Scene(
        measure_rates,
        "m",
        (1e-2, 5e-2, 2e-1),
        "first rebound e² h = 0.64 m, 240 to 4000 steps a second",
        "as bounce",
        curve=True,
        own_rates=True,
    ),
    "ratios": Scene(
        measure_ratios,
        "m",
        (1e-4, 1e-2, 1e-1),
        "1 to 10⁴ kg on 1 kg stay for 3 s",
        _PLACE,
        curve=True,
    ),
}


def classify(scene: str, error: float) -> int:
    """Return the class of an error: 0 good, 1 fair, 2 poor, 3 wrong."""
    return sum(not error <= limit for limit in SCENES[scene].limits)


def count_steps(scene: str, dt: float) -> int:
    """Return the number of steps of a cell at a time step [s], of all its simulations."""
    total = 0

    def rest(description: Description, dt: float, every: float) -> tuple[FloatArray, FloatArray]:
        nonlocal total
        total += round(description["seconds"] / dt)
        t = np.append(np.arange(0.0, description["seconds"], every), description["seconds"])
        keys = ("position", "quaternion", "velocity", "spin")
        state = [
            [x for key in keys for x in b[key]] for b in description["bodies"] if b["mass"] > 0
        ]
        return t, np.tile(np.array(state), (len(t), 1, 1))

    SCENES[scene].measure(rest, dt)
    return total
