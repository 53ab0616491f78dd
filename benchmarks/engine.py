"""Cost of an engine's step at steady contact, with what the step leaves behind: LavenderSim, MuJoCo, PyBullet.

    python -m benchmarks engine [--sweeps 16] [--scenes stack6,pyramid55] [--out FILE]
    python -m benchmarks engine --detail        what each level of detail of one scene costs
    python -m benchmarks engine --model         what friction, spin and a joint far away cost, by sweeps

Every engine steps the same bodies (unit boxes, 1 kg; spheres of 0.5 m) with dt = 1/240 s, the same number of
solver iterations at tolerance 0, warm-started, friction 0.5. After a settling time, the time is the least
mean of many short batches of steps in a row (noise only adds), state changing all the while. Beside it stand
contacts, deepest penetration and the largest speed left; speed and penetration are compared because a
residual of other engines' problems is not published. For LavenderSim also the judge's relative residual
over all rows, and the share of each phase. MuJoCo: PGS, elliptic cones. PyBullet: maximal coordinates for
boxes and spheres. What is not installed is left out and said.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.output import folder_of, markdown, write_json
from lavender.errors import UnknownName
from lavender.scene import Box, Plane, Sphere

DT = 1.0 / 240.0
SCENES: dict[str, tuple[str, dict[str, Any], int]] = {  # name, parameters, steps to settle
    "box": ("stack", {"n": 1}, 480),
    "stack6": ("stack", {}, 480),
    "stack20": ("stack", {"n": 20}, 480),
    "pyramid55": ("pyramid", {"base": 10}, 480),
    "pyramid210": ("pyramid", {"base": 20}, 480),
    "pile1000": ("pile", {"n": 1000}, 480),
    "chain50": ("chain", {"n": 50}, 480),
}


@dataclass
class Row:
    """One engine on one scene."""

    scene: str
    engine: str
    sweeps: int
    step: float  # s
    contacts: int
    depth: float  # m, deepest penetration, or the largest joint error of a chain
    speed: float  # m/s, largest left
    residual: float = float("nan")  # -, the judge's, of the last step
    phases: dict[str, float] = field(default_factory=dict)  # s


def scene_of(name: str, sweeps: int) -> lv.Scene:
    """The scene as LavenderSim has it; the other engines are built from its bodies."""
    gallery, parameters, _ = SCENES[name]
    return lv.Scene(gallery, dt=DT, solver_iterations=sweeps, **parameters)


def least(step: Callable[[], Any], batches: int = 400, budget: float = 0.001) -> float:
    """Least mean time [s] of batches of about `budget` seconds."""
    start = perf_counter()
    step()
    n = max(1, min(200, int(budget / max(perf_counter() - start, 1e-6))))
    best = np.inf
    for _ in range(batches):
        start = perf_counter()
        for _ in range(n):
            step()
        best = min(best, (perf_counter() - start) / n)
    return best


# -- LavenderSim -----------------------------------------------------------------------------------


def lavender_row(name: str, sweeps: int) -> Row:
    """Whole `sim.step()` with its observation; phases by calling the kernels one by one."""
    sim = lv.Simulation(scene_of(name, sweeps))
    for _ in range(SCENES[name][2]):
        sim.step()
    state = sim.snapshot()
    seconds = least(sim.step)
    observation = sim.step()[0]
    residual = sim.residual()["relative"]
    sim.restore(state)
    return Row(
        name,
        "lavender",
        sweeps,
        seconds,
        int(observation["solver"][2]),
        max(
            observation["contacts"]["depth"].max(initial=0.0),
            np.abs(sim.state.a["joint_error"]).max(initial=0.0),
        ),
        float(np.abs(observation["velocities"][:, :3]).max()),
        residual,
        phases(sim),
    )


def phases(sim: lv.Simulation) -> dict[str, float]:
    """Time [s] of each phase: differences of least times from the same state."""
    state = sim.state.copy()
    kernel = state.kernel
    calls = (
        kernel.pairs,
        kernel.prepare,
        lambda: kernel.solve(False),
        kernel.prepare,
        kernel.solve,
        kernel.finish,
    )
    best = np.full(len(calls), np.inf)
    for _ in range(100):
        state.take(sim.state)
        for i, call in enumerate(calls):
            start = perf_counter()
            call()
            best[i] = min(best[i], perf_counter() - start)
    pairs, first, warm, again, solve, finish = best
    return {
        "broad phase": pairs,
        "narrow phase and rows": max(min(first, again) - pairs, 0.0),
        "warm start and measures": warm,
        "sweeps": solve - warm,
        "finish": finish,
    }


# -- MuJoCo ----------------------------------------------------------------------------------------


def mujoco_row(name: str, sweeps: int) -> Row:
    """PGS with elliptic cones; `mj_step` alone."""
    import mujoco

    scene = scene_of(name, sweeps)
    model = mujoco.MjModel.from_xml_string(_mjcf(scene, sweeps))
    data = mujoco.MjData(model)
    for i, body in enumerate(b for b in scene.bodies if not b.is_static):
        if not scene.joints:
            data.qpos[7 * i : 7 * i + 7] = [*body.position, *body.quaternion]
    for _ in range(SCENES[name][2]):
        mujoco.mj_step(model, data)
    seconds = least(lambda: mujoco.mj_step(model, data))
    depth = max((-c.dist for c in data.contact[: data.ncon]), default=0.0)
    if scene.joints:
        depth = float(np.abs(data.efc_pos[: data.nefc]).max(initial=0.0))
    speed = float(np.abs(data.qvel.reshape(-1, 6)[:, :3]).max()) if len(data.qvel) % 6 == 0 else float("nan")
    return Row(name, "mujoco PGS", sweeps, seconds, int(data.ncon), float(max(depth, 0.0)), speed)


def _mjcf(scene: lv.Scene, sweeps: int) -> str:
    parts, ties = [], []
    for i, b in enumerate(scene.bodies):
        place = f'pos="{_text(b.position)}" quat="{_text(b.quaternion)}"'
        match b.shape:
            case Plane():
                axis = np.cross([0.0, 0.0, 1.0], b.shape.normal)
                q = np.array([1.0 + b.shape.normal[2], *axis])
                q = q / np.linalg.norm(q)
                parts.append(f'<geom type="plane" size="0 0 1" pos="{_text(b.position)}" quat="{_text(q)}"/>')
                continue
            case Sphere():
                shape = f'type="sphere" size="{b.shape.radius}"'
            case Box():
                shape = f'type="box" size="{_text(0.5 * np.array(b.shape.size))}"'
        collide = ' contype="0" conaffinity="0"' if scene.joints else ""
        parts.append(f'<body name="b{i}" {place}><freejoint/><geom {shape} mass="{b.mass}"{collide}/></body>')
    for j in scene.joints:
        # anchors in the frame of body1, which must not be the world
        one, anchor = (j.b, j.anchor_b) if j.a < 0 else (j.a, j.anchor_a)
        two = "" if j.a < 0 else f'body2="b{j.b}"'
        ties.append(f'<connect body1="b{one}" {two} anchor="{_text(anchor)}"/>')
    return f"""<mujoco><option timestep="{DT}" solver="PGS" cone="elliptic" iterations="{sweeps}" tolerance="0"/>
    <size memory="400M"/><default><geom friction="0.5 0 0" condim="3"/></default>
    <worldbody>{"".join(parts)}</worldbody><equality>{"".join(ties)}</equality></mujoco>"""


def _text(x: Any) -> str:
    return " ".join(repr(float(v)) for v in x)


# -- PyBullet --------------------------------------------------------------------------------------


def pybullet_row(name: str, sweeps: int) -> Row:
    """Sequential impulses of Bullet; `stepSimulation` alone."""
    import pybullet as p

    scene = scene_of(name, sweeps)
    client = p.connect(p.DIRECT)
    try:
        p.setGravity(0, 0, -9.81)
        p.setPhysicsEngineParameter(
            fixedTimeStep=DT, numSolverIterations=sweeps, numSubSteps=1, solverResidualThreshold=0
        )
        ids = []
        for b in scene.bodies:
            q = [*b.quaternion[1:], b.quaternion[0]]
            match b.shape:
                case Plane():
                    shape = p.createCollisionShape(p.GEOM_PLANE, planeNormal=list(b.shape.normal))
                case Sphere():
                    shape = p.createCollisionShape(p.GEOM_SPHERE, radius=b.shape.radius)
                case Box():
                    shape = p.createCollisionShape(
                        p.GEOM_BOX, halfExtents=(0.5 * np.array(b.shape.size)).tolist()
                    )
            maximal = not scene.joints  # constraints need multibodies
            body = p.createMultiBody(
                b.mass,
                shape,
                basePosition=b.position.tolist(),
                baseOrientation=q,
                useMaximalCoordinates=maximal,
            )
            p.changeDynamics(
                body,
                -1,
                lateralFriction=0.5**0.5,
                rollingFriction=0,
                spinningFriction=0,
                linearDamping=0,
                angularDamping=0,
            )
            p.changeDynamics(body, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING)
            ids.append(body)
        for j in scene.joints:
            a = j.b if j.a < 0 else j.a
            anchors = (j.anchor_b, j.anchor_a) if j.a < 0 else (j.anchor_a, j.anchor_b)
            b = -1 if j.a < 0 else ids[j.b]
            p.createConstraint(
                ids[a], -1, b, -1, p.JOINT_POINT2POINT, [0, 0, 0], *(x.tolist() for x in anchors)
            )
        if scene.joints:
            for i in ids:
                p.setCollisionFilterGroupMask(i, -1, 0, 0)
        for _ in range(SCENES[name][2]):
            p.stepSimulation()
        seconds = least(p.stepSimulation)
        points = p.getContactPoints()
        depth = max((-c[8] for c in points), default=0.0)
        speed = max(np.abs(p.getBaseVelocity(i)[0]).max() for i in ids)
        if scene.joints:
            depth = float("nan")
        return Row(name, "pybullet", sweeps, seconds, len(points), float(depth), float(speed))
    finally:
        p.disconnect(client)


# -- levels of detail -------------------------------------------------------------------------------


def detail() -> None:
    """One pile, with more and more declared: rows, bytes and time that each level brings."""
    from lavender.engine.state import State

    levels = (
        ("frictionless spheres", {"friction": 0.0}),
        ("friction disk", {}),
        ("and patch friction", {"patch_radius": 0.05}),
        ("frictionless boxes", {"friction": 0.0, "kind": "boxes"}),
        ("boxes with friction disk", {"kind": "boxes"}),
        ("and patch friction", {"kind": "boxes", "patch_radius": 0.05}),
    )
    rows: list[tuple[Any, ...]] = []
    for label, more in levels:
        sim = lv.Simulation(lv.Scene("pile", n=200, dt=DT, **more))
        for _ in range(960):
            sim.step()
        seconds = least(lambda sim=sim: sim.state.kernel.substeps(1))
        sizes = []
        for bodies, contacts in ((0, 0), (0, 1000), (1000, 0)):
            size = sim.state.size.copy()
            size[[0, 1, 9]] += (bodies, bodies, contacts)
            size[6] += bodies if size[6] else 0
            sizes.append(State(size).nbytes)
        c = int(sim.state.head[0])
        rows.append(
            (
                label, int(sim.state.size[7]), (sizes[2] - sizes[0]) // 1000, (sizes[1] - sizes[0]) // 1000, c,
                f"{1e6 * seconds:.0f}", f"{1e9 * seconds / c:.0f}",
            )
        )  # fmt: skip
    head = ("pile of 200", "rows/contact", "bytes/body", "bytes/contact", "contacts", "µs/step", "ns/contact")
    click.echo(markdown(head, rows))


MODELS: dict[str, tuple[dict[str, Any], bool]] = {  # what is declared, and whether a joint hangs far away
    "no friction": ({"friction": 0.0}, False),
    "friction": ({}, False),
    "and spin": ({"patch_radius": 0.05}, False),
    "and a joint": ({}, True),
}
MODEL_SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "tower of 6": ("stack", {"n": 6}),
    "tower of 20": ("stack", {"n": 20}),
    "pyramid of 55": ("pyramid", {"base": 10}),
    "pyramid of 210": ("pyramid", {"base": 20}),
    "pile of 200 spheres": ("pile", {"n": 200}),
    "pile of 60 boxes": ("pile", {"n": 60, "kind": "boxes"}),
}


def models() -> None:
    """Towers, pyramids and piles by what they declare: least times of a step, the variants in turns."""
    rows: list[tuple[Any, ...]] = []
    chains = {f"chain of {n}": ("chain", {"n": n}) for n in (6, 50)}
    for label, (name, parameters) in (MODEL_SCENES | chains).items():
        for sweeps in (4, 16, 64):
            sims = []
            for more, joint in MODELS.values() if name != "chain" else [({}, False)]:
                scene = lv.Scene(name, dt=DT, solver_iterations=sweeps, **parameters, **more)
                if joint:
                    far = scene.add_sphere(position=(90.0, 0.0, 5.0))
                    scene.add_joint("ball", -1, far, anchor=(90.0, 0.0, 7.0))
                sims.append(lv.Simulation(scene))
            for sim in sims:
                for _ in range(240):
                    sim.step()
            best = np.full(len(sims), np.inf)
            for _ in range(20):
                for i, sim in enumerate(sims):
                    best[i] = min(best[i], least(sim.step, batches=10))
            cells = (f"{1e6 * t:.1f} ({int(s.state.head[0])})" for t, s in zip(best, sims, strict=True))
            rows.append((label, sweeps, *cells, *[""] * (len(MODELS) - len(sims))))
    click.echo(markdown(("µs a step (contacts)", "sweeps", *MODELS), rows))


ENGINES: dict[str, Callable[[str, int], Row]] = {
    "lavender": lavender_row,
    "mujoco": mujoco_row,
    "pybullet": pybullet_row,
}


def table(rows: list[Row]) -> str:
    """A line for each engine and scene, markdown."""
    head = (
        "scene",
        "engine",
        "sweeps",
        "ms a step",
        "contacts",
        "depth [mm]",
        "speed [m/s]",
        "residual",
        "phases [µs]",
    )
    return markdown(
        head,
        [
            (
                r.scene, r.engine, r.sweeps, f"{1e3 * r.step:.4f}", r.contacts, f"{1e3 * r.depth:.3f}",
                f"{r.speed:.1e}", f"{r.residual:.1e}", ", ".join(f"{k} {1e6 * v:.1f}" for k, v in r.phases.items()),
            )
            for r in rows
        ],
    )  # fmt: skip


def _words(text: str, known: Any, what: str) -> list[str]:
    found = text.replace(",", " ").split()
    for word in found:
        if word not in known:
            raise UnknownName(what, word, known)
    return found


@click.command("engine")
@click.option("--sweeps", type=click.IntRange(4, 64), multiple=True, default=(16,), show_default=True)
@click.option("--scenes", default=",".join(SCENES), show_default=True, help="Names with commas.")
@click.option("--engines", default=",".join(ENGINES), show_default=True, help="Names with commas.")
@click.option(
    "--detail",
    "levels",
    is_flag=True,
    help="What each level of detail of one scene costs; LavenderSim alone.",
)
@click.option(
    "--model", is_flag=True, help="What friction, spin and a joint far away cost; LavenderSim alone."
)
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON of the lines.")
def command(
    sweeps: tuple[int, ...], scenes: str, engines: str, levels: bool, model: bool, out: Path | None
) -> None:
    """Cost of an engine's step at steady contact, with what the step leaves behind."""
    folder_of(out)
    if model:
        return models()
    if levels:
        return detail()
    names = _words(engines, ENGINES, "engine")
    rows = []
    for scene in _words(scenes, SCENES, "scene"):
        for budget in sweeps:
            for name in names:
                if find_spec(name) is None:
                    continue
                rows.append(ENGINES[name](scene, budget))
                click.echo(f"{scene}, {name}: {1e3 * rows[-1].step:.4f} ms", err=True)
    click.echo(table(rows))
    left = [name for name in names if find_spec(name) is None]
    if left:
        click.echo(f"\nNot installed: {', '.join(left)}.")
    if out is not None:
        write_json(out, rows)
    return None
