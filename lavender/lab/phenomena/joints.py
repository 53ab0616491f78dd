"""Phenomena of joints and of free bodies: pendulum, free rotation, a chain under load."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.analytic_solutions import flip_period, pendulum_period
from lavender.lab.phenomena.parts import GRAVITY, Parameter, Phenomenon, Quantity, Track, Values
from lavender.sim.scene import Scene
from lavender.sim.scene.parts import quaternion

ROD = (0.1, 0.1, 1.0)  # m
BLOCK = (0.2, 0.6, 1.0)  # m, of the free body
TURNS = 3  # periods of it


def _zeros(time: FloatArray, x: FloatArray) -> FloatArray:
    """Times at which x changes sign, between two samples by a straight line."""
    i = np.flatnonzero(x[1:] * x[:-1] < 0.0)
    found: FloatArray = time[i] + (time[i + 1] - time[i]) * x[i] / (x[i] - x[i + 1])
    return found


def _pendulum(p: Values, more: Mapping[str, Any]) -> Scene:
    scene = Scene(**{"gravity": GRAVITY, **more})
    half = 0.5 * ROD[2]
    place = (half * math.sin(p["angle"]), 0.0, -half * math.cos(p["angle"]))
    rod = scene.add_box(ROD, position=place, quaternion=quaternion((0.0, 1.0, 0.0), -p["angle"]))
    scene.add_joint("hinge", -1, rod, anchor=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    return scene


def period_of(p: Values) -> float:
    """Of a rod on a hinge, from its angle at rest [s]."""
    about = (ROD[0] ** 2 + ROD[2] ** 2) / 12 + ROD[2] ** 2 / 4
    return pendulum_period(about, 0.5 * GRAVITY * ROD[2], p["angle"])


def _swings(p: Values, track: Track) -> dict[str, float]:
    x, v = track.positions[:, 0], track.velocities[:, 0]
    zeros = _zeros(track.time, np.arctan2(x[:, 0], -x[:, 2]))[:11]
    period = 2.0 * float(np.diff(zeros).mean()) if len(zeros) > 1 else math.inf
    own = (ROD[0] ** 2 + ROD[2] ** 2) / 12
    energy = 0.5 * (v[:, :3] ** 2).sum(axis=1) + 0.5 * own * v[:, 4] ** 2
    energy += GRAVITY * (x[:, 2] + 0.5 * ROD[2])
    start = 0.5 * GRAVITY * ROD[2] * (1.0 - math.cos(p["angle"]))
    late = track.time >= track.time[-1] - 2.0 * period_of(p)
    return {
        "period": abs(period / period_of(p) - 1.0),
        "energy": abs(float(energy[late].mean()) / start - 1.0),
    }


def _free(p: Values, more: Mapping[str, Any]) -> Scene:
    scene = Scene(**{"gravity": 0.0, **more})
    scene.add_box(BLOCK, angular_velocity=spin_of(p))
    return scene


def spin_of(p: Values) -> tuple[float, float, float]:
    """First angular velocity of the free body."""
    return (p["aside"] * p["spin"], p["spin"], 0.0)


def moments_of_inertia() -> FloatArray:
    """Of the free body, of mass 1, about its axes."""
    x, y, z = (s * s for s in BLOCK)
    return np.array([y + z, x + z, x + y]) / 12.0


def flip_of(p: Values) -> float:
    """Period in which the free body turns over and back [s]."""
    return flip_period(moments_of_inertia(), np.array(spin_of(p)))


def _rotation(p: Values, track: Track) -> dict[str, float]:
    axes = np.stack([track.axis(0, i) for i in range(3)], axis=1)  # (k, axis, world)
    omega = np.einsum("kaw,kw->ka", axes, track.velocities[:, 0, 3:])
    energy = 0.5 * omega**2 @ moments_of_inertia()
    momentum = np.einsum("ka,kaw->kw", omega * moments_of_inertia(), axes)
    zeros = _zeros(track.time, omega[:, 1])
    flips = 2.0 * float(np.diff(zeros).mean()) if len(zeros) > 1 else math.inf
    away = np.linalg.norm(momentum - momentum[0], axis=1).max() / np.linalg.norm(momentum[0])
    return {
        "period": abs(flips / flip_of(p) - 1.0),
        "energy": float(np.abs(energy / energy[0] - 1.0).max()),
        "momentum": float(away),
    }


def _chain(p: Values, more: Mapping[str, Any]) -> Scene:
    more = {"gravity": GRAVITY, **more}
    return Scene("chain", n=int(p["links"]), tip_mass=p["ratio"], angle=0.0, **more)


def _hangs(p: Values, track: Track) -> dict[str, float]:
    scene = _chain(p, {})
    late = np.flatnonzero(track.time >= track.time[-1] - 1.0)

    def point(body: int, anchor: FloatArray) -> FloatArray:
        if body < 0:
            return np.broadcast_to(anchor, (len(late), 3))
        turned = sum(track.axis(body, i)[late] * anchor[i] for i in range(3))
        return np.asarray(track.positions[late, body] + turned)

    gap = max(
        float(np.linalg.norm(point(j.b, j.anchor_b) - point(j.a, j.anchor_a), axis=1).max())
        for j in scene.joints
    )
    weight = GRAVITY * sum(b.mass for b in scene.bodies)
    return {"gap": gap, "tension": abs(track.force / weight - 1.0)}


JOINTS = (
    Phenomenon(
        name="pendulum",
        title="a rod on a hinge",
        why="what a stepper adds or takes of energy is heard in every mechanism",
        truth="period 4 sqrt(I/(m g l)) K(sin(phi0/2)) from the integral of energy, which stays",
        parameters={
            "angle": Parameter(1.0, 0.05, 3.0, "of the start, from below [rad]"),
            "swings": Parameter(100, 1, 1000, "number of them"),
        },
        cases=({}, {"angle": 2.5, "swings": 20}),
        quantities=(
            Quantity("energy", "", 0.01, "relative, over the last two swings"),
            Quantity("period", "", 0.01, "relative, over the first five swings"),
        ),
        needs=frozenset({"hinge"}),
        build=_pendulum,
        seconds=lambda p: p["swings"] * period_of(p),
        measure=_swings,
    ),
    Phenomenon(
        name="free_rotation",
        title="a free asymmetric body near its middle axis",
        why="drones, satellites and thrown rackets; the explicit step gains energy, the implicit one loses it",
        truth="energy and momentum stay; the flip has the period of Jacobi's elliptic functions (Landau, Lifshitz, 37)",
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
        build=_free,
        seconds=lambda p: TURNS * flip_of(p),
        measure=_rotation,
    ),
    Phenomenon(
        name="chain_load",
        title="a chain that carries a load of many links",
        why="cranes and ropes: sweeps see one link at a time, so heavy loads tear chains apart",
        truth="no gap, and the first joint bears the weight of all links, sum of m g",
        parameters={
            "ratio": Parameter(100.0, 1.0, 1e4, "mass of the load over that of a link [-]"),
            "links": Parameter(10, 2, 100, "number of them"),
        },
        cases=({"ratio": 1.0}, {"ratio": 100.0}, {"ratio": 1e4}),
        quantities=(
            Quantity("gap", "m", 1e-3, "largest of a joint over the last of 5 s; the slop of contacts"),
            Quantity("tension", "", 0.01, "relative, at the end; nan where an engine does not tell it"),
        ),
        needs=frozenset({"ball joint"}),
        build=_chain,
        seconds=lambda p: 5.0,
        measure=_hangs,
    ),
)
