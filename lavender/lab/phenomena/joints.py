"""Phenomena of joints and of free bodies: pendulum, free rotation, a chain under load."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.analytic_solutions import (
    compute_period_of_free_rotation,
    compute_period_of_pendulum,
)
from lavender.lab.phenomena.parts import GRAVITY, Parameter, Phenomenon, Quantity, Track, Values
from lavender.sim.scene import Scene
from lavender.sim.scene.parts import make_quaternion

ROD_SIZE = (0.1, 0.1, 1.0)  # [m] Edges of the pendulum's rod.
FREE_BODY_SIZE = (0.2, 0.6, 1.0)  # [m] Edges of the free body, a box with three different inertias.
FREE_ROTATION_PERIODS = 3  # The free rotation is simulated for this many periods of the flip.


def _find_sign_changes(time: FloatArray, x: FloatArray) -> FloatArray:
    """Compute the times at which x changes sign, by linear interpolation between samples."""
    i = np.flatnonzero(x[1:] * x[:-1] < 0.0)
    times: FloatArray = time[i] + (time[i + 1] - time[i]) * x[i] / (x[i] - x[i + 1])
    return times


def _build_pendulum(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a rod on a hinge, released at rest."""
    scene = Scene(**{"gravity": GRAVITY, **more})
    half = 0.5 * ROD_SIZE[2]
    position = (half * math.sin(p["angle"]), 0.0, -half * math.cos(p["angle"]))
    rod = scene.add_box(ROD_SIZE, position=position, quaternion=make_quaternion((0.0, 1.0, 0.0), -p["angle"]))
    scene.add_joint("hinge", -1, rod, anchor=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    return scene


def compute_pendulum_period(p: Values) -> float:
    """Compute the exact period [s] of the rod on a hinge."""
    inertia_about_hinge = (ROD_SIZE[0] ** 2 + ROD_SIZE[2] ** 2) / 12 + ROD_SIZE[2] ** 2 / 4
    return compute_period_of_pendulum(inertia_about_hinge, 0.5 * GRAVITY * ROD_SIZE[2], p["angle"])


def _measure_energy_and_period_errors(p: Values, track: Track) -> dict[str, float]:
    """Measure the errors of energy and period of the pendulum."""
    x, v = track.positions[:, 0], track.velocities[:, 0]
    zeros = _find_sign_changes(track.time, np.arctan2(x[:, 0], -x[:, 2]))[:11]
    period = 2.0 * float(np.diff(zeros).mean()) if len(zeros) > 1 else math.inf
    inertia = (ROD_SIZE[0] ** 2 + ROD_SIZE[2] ** 2) / 12
    energy = 0.5 * (v[:, :3] ** 2).sum(axis=1) + 0.5 * inertia * v[:, 4] ** 2
    energy += GRAVITY * (x[:, 2] + 0.5 * ROD_SIZE[2])
    start = 0.5 * GRAVITY * ROD_SIZE[2] * (1.0 - math.cos(p["angle"]))
    late = track.time >= track.time[-1] - 2.0 * compute_pendulum_period(p)
    return {
        "period": abs(period / compute_pendulum_period(p) - 1.0),
        "energy": abs(float(energy[late].mean()) / start - 1.0),
    }


def _build_free_body(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a free body that spins."""
    scene = Scene(**{"gravity": 0.0, **more})
    scene.add_box(FREE_BODY_SIZE, angular_velocity=get_initial_spin(p))
    return scene


def get_initial_spin(p: Values) -> tuple[float, float, float]:
    """Return the initial angular velocity of the free body [rad/s]."""
    return (p["aside"] * p["spin"], p["spin"], 0.0)


def get_moments_of_inertia() -> FloatArray:
    """Return the moments of inertia of the free body, of mass 1, about its axes [kg m^2]."""
    x, y, z = (s * s for s in FREE_BODY_SIZE)
    return np.array([y + z, x + z, x + y]) / 12.0


def compute_flip_period(p: Values) -> float:
    """Compute the exact period [s] in which the free body flips over and back."""
    return compute_period_of_free_rotation(get_moments_of_inertia(), np.array(get_initial_spin(p)))


def _measure_free_rotation_errors(p: Values, track: Track) -> dict[str, float]:
    """Measure the errors of momentum, energy and period of the free rotation."""
    axes = np.stack([track.compute_body_axis(0, i) for i in range(3)], axis=1)  # Shape (k, axis, world).
    omega = np.einsum("kaw,kw->ka", axes, track.velocities[:, 0, 3:])
    energy = 0.5 * omega**2 @ get_moments_of_inertia()
    momentum = np.einsum("ka,kaw->kw", omega * get_moments_of_inertia(), axes)
    zeros = _find_sign_changes(track.time, omega[:, 1])
    flips = 2.0 * float(np.diff(zeros).mean()) if len(zeros) > 1 else math.inf
    momentum_error = np.linalg.norm(momentum - momentum[0], axis=1).max() / np.linalg.norm(momentum[0])
    return {
        "period": abs(flips / compute_flip_period(p) - 1.0),
        "energy": float(np.abs(energy / energy[0] - 1.0).max()),
        "momentum": float(momentum_error),
    }


def _build_chain(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a chain that hangs at rest."""
    more = {"gravity": GRAVITY, **more}
    return Scene("chain", n=int(p["links"]), tip_mass=p["ratio"], angle=0.0, **more)


def _measure_hanging_chain(p: Values, track: Track) -> dict[str, float]:
    """Measure the largest gap of a joint, and the error of the tension in the first joint."""
    scene = _build_chain(p, {})
    late = np.flatnonzero(track.time >= track.time[-1] - 1.0)

    def point(body: int, anchor: FloatArray) -> FloatArray:
        """Return the world positions of an anchor in the last second."""
        if body < 0:
            return np.broadcast_to(anchor, (len(late), 3))
        rotated = sum(track.compute_body_axis(body, i)[late] * anchor[i] for i in range(3))
        return np.asarray(track.positions[late, body] + rotated)

    gap = max(
        float(np.linalg.norm(point(j.b, j.anchor_b) - point(j.a, j.anchor_a), axis=1).max())
        for j in scene.joints
    )
    weight = GRAVITY * sum(b.mass for b in scene.bodies)
    return {"gap": gap, "tension": abs(track.force / weight - 1.0)}


JOINT_PHENOMENA = (
    Phenomenon(
        name="pendulum",
        title="a rod on a hinge",
        why="a stepper that adds or removes energy changes every mechanism",
        truth="period 4 sqrt(I/(m g l)) K(sin(phi0/2)) from the integral of energy, which is constant",
        parameters={
            "angle": Parameter(1.0, 0.05, 3.0, "initial angle from below [rad]"),
            "swings": Parameter(100, 1, 1000, "number of them"),
        },
        cases=({}, {"angle": 2.5, "swings": 20}),
        quantities=(
            Quantity("energy", "", 0.01, "relative, over the last two swings"),
            Quantity("period", "", 0.01, "relative, over the first five swings"),
        ),
        needs=frozenset({"hinge"}),
        build=_build_pendulum,
        seconds=lambda p: p["swings"] * compute_pendulum_period(p),
        measure=_measure_energy_and_period_errors,
    ),
    Phenomenon(
        name="free_rotation",
        title="a free asymmetric body near its middle axis",
        why="drones, satellites and thrown rackets; the explicit step gains energy, the implicit one loses it",
        truth="energy and momentum are constant; the period of flips by elliptic functions (Landau, Lifshitz, 37)",
        parameters={
            "spin": Parameter(5.0, 0.1, 50.0, "about the middle axis [rad/s]"),
            "aside": Parameter(0.05, 1e-3, 0.5, "spin about the axis of the largest moment, over it [-]"),
        },
        cases=({}, {"spin": 15.0}),
        quantities=(
            Quantity("momentum", "", 0.01, "relative, largest distance"),
            Quantity("energy", "", 0.01, "relative, largest distance"),
            Quantity("period", "", 0.01, "relative, of the flips in three periods"),
        ),
        needs=frozenset({"box"}),
        build=_build_free_body,
        seconds=lambda p: FREE_ROTATION_PERIODS * compute_flip_period(p),
        measure=_measure_free_rotation_errors,
    ),
    Phenomenon(
        name="chain_load",
        title="a chain that carries a load of many links",
        why="cranes and ropes: sweeps update one link at a time, so heavy loads tear chains apart",
        truth="no gap, and the first joint bears the weight of all links, sum of m g",
        parameters={
            "ratio": Parameter(100.0, 1.0, 1e4, "mass of the load over that of a link [-]"),
            "links": Parameter(10, 2, 100, "number of them"),
        },
        cases=({"ratio": 1.0}, {"ratio": 100.0}, {"ratio": 1e4}),
        quantities=(
            Quantity("gap", "m", 1e-3, "largest gap of a joint in the last of 5 s; the slop of contacts"),
            Quantity("tension", "", 0.01, "relative, at the end; nan if an engine does not return it"),
        ),
        needs=frozenset({"ball joint"}),
        build=_build_chain,
        seconds=lambda p: 5.0,
        measure=_measure_hanging_chain,
    ),
)
