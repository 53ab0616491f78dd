"""brax in JAX on the CPU (float32): any of its pipelines, from MJCF; see `mjcf`."""

from __future__ import annotations

import importlib
from typing import Any

import jax
import numpy as np
from brax.io import mjcf

from benchmarks.score.adapters import CannotExpress, Options, Running, Scene, get_moving
from benchmarks.score.adapters.mjcf import get_start, make_xml

STEPS: dict[str, Any] = {}  # pipeline -> its compiled step


def build(scene: Scene, options: Options) -> Running:
    """Use `step` of `options["pipeline"]`; the other options are fields of the system."""
    pipeline = importlib.import_module(f"brax.{options['pipeline']}.pipeline")
    if any(any(b["force"]) for b in get_moving(scene)):
        raise CannotExpress("no external forces on bodies")
    if len(scene["joints"]) > len({joint["b"] for joint in scene["joints"]}):
        raise CannotExpress("no loops")
    system = mjcf.loads(make_xml(scene, options["dt"], {}))
    elasticity = np.full_like(system.elasticity, scene["restitution"])
    system = system.replace(elasticity=elasticity)
    replaced = {key: value for key, value in options.items() if key not in ("dt", "pipeline")}
    system = system.replace(**replaced) if replaced else system
    velocity, _, control = get_start(scene)
    if options["pipeline"] not in STEPS:
        STEPS[options["pipeline"]] = jax.jit(pipeline.step)
    advance = STEPS[options["pipeline"]]
    act = np.array(control, np.float32)
    data = [pipeline.init(system, system.init_q, np.array(velocity, np.float32))]
    # The first two steps compile, because the types of the first state are other than those of its successors.
    jax.block_until_ready(advance(system, advance(system, data[0], act), act))

    def step() -> None:
        data[0] = advance(system, data[0], act)

    def state() -> list[Any]:
        now = data[0]
        return [
            [*p, *q, *v, *w]
            for p, q, v, w in zip(
                *(np.array(a) for a in (now.x.pos, now.x.rot, now.xd.vel, now.xd.ang)), strict=True
            )
        ]

    def properties() -> list[Any]:
        mass, inertia = np.array(system.link.inertia.mass), np.array(system.link.inertia.i)
        friction = np.array(system.geom_friction)[-len(mass) :, 0]
        e = np.array(system.elasticity)[-len(mass) :]
        rows = zip(mass, inertia, friction, e, strict=True)
        return [[m, *np.diag(i), f, x] for m, i, f, x in rows]

    return Running(step, state, properties)
