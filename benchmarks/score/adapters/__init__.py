"""Engines of the scorecard: one file each with a function `build`.

`build(scene, options)` creates a scene with the time step `options["dt"]` [s]; the other options are the settings of
`benchmarks.score.settings`, and a missing one is left as the engine ships. A file is imported in the engine's own
environment, without lavender.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Scene = dict[str, Any]
Options = dict[str, Any]


class CannotExpress(Exception):
    """The engine, or its adapter, has no means to express a scene; the message is the reason."""


@dataclass
class Running:
    """A scene in an engine.

    The state has 13 numbers of each moving body: position, quaternion w x y z, velocity, angular velocity (world).
    The properties are the values that the engine stores for each: mass, moments of inertia, friction and restitution
    of a contact of two such bodies; None if it cannot be read. The residual [m/s] is the judge's, if lavender reads
    the engine. `read_step`, if there is one, makes the next step and returns it as a `lavender.io.StepRecord`, or None.
    """

    step: Callable[[], Any]
    get_state: Callable[[], list[Any]]
    get_properties: Callable[[], list[Any]]
    get_residual: Callable[[], float | None] = lambda: None
    close: Callable[[], Any] = lambda: None
    read_step: Callable[[], Any] | None = None


def get_moving(scene: Scene) -> list[dict[str, Any]]:
    """Return the bodies that are not the ground."""
    return [body for body in scene["bodies"] if body["mass"] > 0]


def has_ground(scene: Scene) -> bool:
    """Return whether a scene has the plane z = 0."""
    return len(get_moving(scene)) < len(scene["bodies"])


def get_half(body: dict[str, Any]) -> list[float] | None:
    """Return the half edges [m] of a box, None of a sphere."""
    edges = body["shape"].get("size")
    return [0.5 * edge for edge in edges] if edges else None


def get_radius(body: dict[str, Any]) -> float:
    """Return the radius [m] of a sphere, 0 of a box."""
    radius: float = body["shape"].get("radius", 0.0)
    return radius


def subtract(a: Any, b: Any) -> list[float]:
    """Return a - b."""
    return [x - y for x, y in zip(a, b, strict=True)]


def shift(quaternion: Any) -> list[float]:
    """Return a quaternion w x y z as x y z w."""
    return [*quaternion[1:], quaternion[0]]


@dataclass
class Link:
    """A moving body that is tied to its parent: by a hinge, or a belt by a slide joint to the world."""

    body: int
    parent: int  # moving body, -1: the world
    anchor: list[float]  # m, world
    axis: list[float]
    slides: bool
    drive: tuple[float, float] | None  # speed [rad/s, m/s] and largest torque or force [N m, N]
    loops: list[list[float]]  # m, world; points at which the body is tied to the world as well


def make_tree(scene: Scene) -> list[Link]:
    """Return the links of a scene, parents first; a body's first hinge is its joint, further ones close loops."""
    links = []
    for i, b in enumerate(get_moving(scene)):
        hinges = [joint for joint in scene["joints"] if joint["b"] == i]
        if b["kinematic"]:
            speed = sum(v * v for v in b["velocity"]) ** 0.5
            links.append(
                Link(
                    i, -1, b["position"], [v / speed for v in b["velocity"]], True, (speed, 1e9), []
                )
            )
        elif hinges:
            first = hinges[0]
            loops = [hinge["anchor"] for hinge in hinges[1:]]
            links.append(
                Link(i, first["a"], first["anchor"], first["axis"], False, first["motor"], loops)
            )
    return links


def get_parent_anchor(tree: list[Link], link: Link) -> list[float]:
    """Return the anchor [m] of the parent of a link, zero for the world."""
    return next((other.anchor for other in tree if other.body == link.parent), [0.0] * 3)
