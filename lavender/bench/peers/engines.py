"""The same scene stepped by LavenderSim, MuJoCo and PyBullet, in turns; time beside what each step leaves.

All engines of a scene are built from its bodies, settle on their own, and are then timed in alternating batches
of steps; the time is the CPU time of the least batch, as noise only adds. Speed and penetration left stand
beside it, and the judge's residual where the engine's problem is known: ours, and MuJoCo's through
`lavender.io.from_mujoco`. A soft contact model penetrates by design, so its depth is no error of its solver.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.engine import Simulation
from lavender.errors import CapabilityError, UnknownName
from lavender.external._running import quiet
from lavender.io import mujoco as mujoco_io
from lavender.problem import Problem
from lavender.residuals import residual
from lavender.scene import Body, Box, Plane, Scene, Sphere

__all__ = ["ENGINES", "SCENES", "Step", "export", "measure_scene"]

DT = 1.0 / 240.0
NAN = float("nan")
SETTLE = 480  # steps, 2 s
SETTLE_LIMIT = 20.0  # s of CPU; an engine that needs more is left out, and said
BATCH = 5e-3  # s of CPU of one batch: well above the clock's steps
#: Name -> scene of the gallery, its parameters.
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "stack6": ("stack", {}),
    "pyramid55": ("pyramid", {"base": 10}),
    "pyramid210": ("pyramid", {"base": 20}),
    "pile1000": ("pile", {"n": 1000}),
    "chain50": ("chain", {"n": 50}),
}


@dataclass(frozen=True)
class Step:
    """One engine on one scene, at steady contact."""

    scene: str
    engine: str
    accurate: bool  # iterates to its own tolerance; else a fixed number of sweeps
    time: float  # s of CPU of one step, least batch; nan: left out, `note` says why
    contacts: int
    depth: float  # m, deepest penetration; of a chain the largest gap of a joint, nan where it is not known
    speed: float  # m/s, largest of a body
    relative: float  # -, the judge's, of the last step; nan where the engine's problem is not known
    note: str = ""


class Engine:
    """One engine on one scene; `step` is what is timed."""

    accurate = False
    name = ""

    def step(self) -> None:
        """One step of DT."""
        raise NotImplementedError

    def left(self) -> dict[str, Any]:
        """Contacts, depth, speed and relative residual of the last step."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of what the engine holds."""


class Lavender(Engine):
    """`Simulation.step` with its observation."""

    def __init__(self, scene: str, sweeps: int, accurate: bool) -> None:
        self.accurate = accurate
        self.name = "lavender newton" if accurate else f"lavender, {sweeps} sweeps"
        name, parameters = SCENES[scene]
        solver: dict[str, Any] = {"solver": "newton"} if accurate else {"solver_iterations": sweeps}
        self.sim = Simulation(Scene(name, dt=DT, **solver, **parameters))
        self.step = self.sim.step  # type: ignore[method-assign,assignment]

    def left(self) -> dict[str, Any]:
        """See `Engine.left`."""
        seen = self.sim.step()[0]
        gap = np.abs(self.sim._state.a["joint_error"]).max(initial=0.0)
        return {
            "contacts": int(seen["solver"][2]),
            "depth": float(max(seen["contacts"]["depth"].max(initial=0.0), gap)),
            "speed": float(np.linalg.norm(seen["velocities"][:, :3], axis=1).max(initial=0.0)),
            "relative": float(self.sim.residual()["relative"]),
        }


class MuJoCo(Engine):
    """`mj_step`; PGS for a number of sweeps, Newton to a tolerance of 1e-8."""

    def __init__(self, scene: str, sweeps: int, accurate: bool, cone: str = "elliptic") -> None:
        import mujoco

        self.mj, self.accurate = mujoco, accurate
        self.name = f"mujoco Newton {cone}" if accurate else f"mujoco PGS {cone}, {sweeps} sweeps"
        name, parameters = SCENES[scene]
        self.scene = Scene(name, dt=DT, **parameters)
        solver, iterations, tolerance = ("Newton", 100, 1e-8) if accurate else ("PGS", sweeps, 0.0)
        self.model = mujoco.MjModel.from_xml_string(
            _mjcf(
                self.scene,
                f'solver="{solver}" iterations="{iterations}" tolerance="{tolerance}" cone="{cone}"',
            )
        )
        self.data = mujoco.MjData(self.model)

    def step(self) -> None:
        """See `Engine.step`."""
        self.mj.mj_step(self.model, self.data)

    def problem(self) -> Problem:
        """The constraint problem of the last step."""
        return mujoco_io.from_mujoco(self.model, self.data, name=f"mujoco {self.scene.name}")

    def left(self) -> dict[str, Any]:
        """See `Engine.left`."""
        d = self.data
        depth = max(0.0, -float(d.contact.dist[: d.ncon].min())) if d.ncon else 0.0
        if self.scene.joints:
            depth = float(np.abs(d.efc_pos[: d.nefc]).max(initial=0.0))
        judged = residual(self.problem(), mujoco_io.impulse(self.model, d)).relative
        speed = np.linalg.norm(np.array(d.qvel).reshape(-1, 6)[:, :3], axis=1).max(initial=0.0)
        return {"contacts": int(d.ncon), "depth": depth, "speed": float(speed), "relative": judged}


class PyBullet(Engine):
    """`stepSimulation`, sequential impulses; maximal coordinates where there are no joints."""

    def __init__(self, scene: str, sweeps: int) -> None:
        with quiet(noisy=True):  # it greets
            import pybullet as p

        self.p, self.name = p, f"pybullet, {sweeps} sweeps"
        name, parameters = SCENES[scene]
        self.scene = Scene(name, dt=DT, **parameters)
        self.client = p.connect(p.DIRECT)
        self.ids: list[int] = []
        p.setGravity(*self.scene.parameters.gravity, physicsClientId=self.client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=DT, numSolverIterations=sweeps, numSubSteps=1, solverResidualThreshold=0.0,
            physicsClientId=self.client,
        )  # fmt: skip
        for body in self.scene.bodies:
            self._add(body)
        for joint in self.scene.joints:
            # The world is body -1 and stands second; anchors are in the frames of their bodies.
            flip = joint.a < 0
            first, second = (joint.b, joint.a) if flip else (joint.a, joint.b)
            anchors = (joint.anchor_b, joint.anchor_a) if flip else (joint.anchor_a, joint.anchor_b)
            p.createConstraint(
                self.ids[first], -1, -1 if second < 0 else self.ids[second], -1, p.JOINT_POINT2POINT, [0, 0, 0],
                *(list(map(float, x)) for x in anchors), physicsClientId=self.client,
            )  # fmt: skip

    def _add(self, body: Body) -> None:
        p, client = self.p, {"physicsClientId": self.client}
        if isinstance(body.shape, Plane):
            shape = p.createCollisionShape(p.GEOM_PLANE, planeNormal=list(body.shape.normal), **client)
        elif isinstance(body.shape, Sphere):
            shape = p.createCollisionShape(p.GEOM_SPHERE, radius=body.shape.radius, **client)
        elif isinstance(body.shape, Box):
            shape = p.createCollisionShape(
                p.GEOM_BOX, halfExtents=[0.5 * x for x in body.shape.size], **client
            )
        else:
            raise CapabilityError(f"{body.name} has no shape that PyBullet could be given")
        w, x, y, z = map(float, body.quaternion)
        made = p.createMultiBody(
            body.mass, shape, basePosition=body.position.tolist(), baseOrientation=[x, y, z, w],
            useMaximalCoordinates=not self.scene.joints, **client,
        )  # fmt: skip
        # Bullet multiplies the coefficients of two bodies.
        friction = float(np.sqrt(self.scene.parameters.friction))
        p.changeDynamics(
            made, -1, lateralFriction=friction, rollingFriction=0, spinningFriction=0, linearDamping=0,
            angularDamping=0, **client,
        )  # fmt: skip
        p.changeDynamics(made, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING, **client)
        if self.scene.joints:
            p.setCollisionFilterGroupMask(made, -1, 0, 0, **client)
        self.ids.append(made)

    def step(self) -> None:
        """See `Engine.step`."""
        self.p.stepSimulation(physicsClientId=self.client)

    def left(self) -> dict[str, Any]:
        """See `Engine.left`."""
        points = self.p.getContactPoints(physicsClientId=self.client) or ()
        speed = [np.linalg.norm(self.p.getBaseVelocity(i, physicsClientId=self.client)[0]) for i in self.ids]
        depth = self._gap() if self.scene.joints else max((-c[8] for c in points), default=0.0)
        return {"contacts": len(points), "depth": max(0.0, float(depth)), "speed": float(max(speed)),
                "relative": float("nan")}  # fmt: skip

    def _gap(self) -> float:
        def point(body: int, anchor: FloatArray) -> FloatArray:
            if body < 0:
                return np.asarray(anchor, float)
            place, turn = self.p.getBasePositionAndOrientation(self.ids[body], physicsClientId=self.client)
            return np.asarray(place) + np.reshape(self.p.getMatrixFromQuaternion(turn), (3, 3)) @ anchor

        return max(
            float(np.linalg.norm(point(j.b, j.anchor_b) - point(j.a, j.anchor_a))) for j in self.scene.joints
        )

    def close(self) -> None:
        """See `Engine.close`."""
        self.p.disconnect(self.client)


#: What each engine needs installed, and how its two modes are made: sweeps, and to its own tolerance.
ENGINES: dict[str, tuple[str | None, tuple[Callable[[str, int], Engine], ...]]] = {
    "lavender": (None, (lambda s, n: Lavender(s, n, False), lambda s, n: Lavender(s, n, True))),
    "mujoco": (
        "mujoco",
        (
            lambda s, n: MuJoCo(s, n, False),
            lambda s, n: MuJoCo(s, n, True, "elliptic"),
            lambda s, n: MuJoCo(s, n, True, "pyramidal"),
        ),
    ),
    "pybullet": ("pybullet", (PyBullet,)),
}


def _mjcf(scene: Scene, options: str) -> str:
    g, mu = scene.parameters.gravity, scene.parameters.friction
    free, ties = [], []
    for i, body in enumerate(scene.bodies):
        collide = ' contype="0" conaffinity="0"' if scene.joints else ""
        pose = f'pos="{_text(body.position)}" quat="{_text(body.quaternion)}"'
        if isinstance(body.shape, Plane):
            normal = np.asarray(body.shape.normal, float)
            free.append(
                f'<geom type="plane" size="0 0 1" pos="{_text(body.shape.offset * normal)}" '
                f'zaxis="{_text(normal)}"/>'
            )
            continue
        if isinstance(body.shape, Sphere):
            shape = f'type="sphere" size="{body.shape.radius!r}"'
        elif isinstance(body.shape, Box):
            shape = f'type="box" size="{_text(0.5 * np.asarray(body.shape.size))}"'
        else:
            raise CapabilityError(f"{body.name} has no shape that MuJoCo could be given")
        moves = "<freejoint/>" if body.mass > 0.0 else ""
        free.append(f'<body name="b{i}" {pose}>{moves}<geom {shape} mass="{body.mass}"{collide}/></body>')
    for joint in scene.joints:
        # The first body must not be the world; the anchor is in its frame.
        first, second, anchor = (
            (joint.b, joint.a, joint.anchor_b) if joint.a < 0 else (joint.a, joint.b, joint.anchor_a)
        )
        other = "" if second < 0 else f'body2="b{second}"'
        ties.append(f'<connect body1="b{first}" {other} anchor="{_text(anchor)}"/>')
    return (
        f'<mujoco><option timestep="{DT!r}" gravity="{_text(g)}" {options}/><size memory="1G"/>'
        f'<default><geom friction="{mu} 0 0" condim="3"/></default><worldbody>{"".join(free)}</worldbody>'
        f"<equality>{''.join(ties)}</equality></mujoco>"
    )


def _text(x: Any) -> str:
    return " ".join(repr(float(v)) for v in x)


def export(scene: str, cone: str = "elliptic", settle: int = 120) -> Problem:
    """MuJoCo's problem of a scene after some steps; cone "elliptic" (law "cone") or "pyramidal" ("lcp").

    Raises
    ------
    UnknownName
        No such scene.
    """
    _check(scene)
    engine = MuJoCo(scene, 16, False, cone)
    for _ in range(settle):
        engine.step()
    engine.mj.mj_forward(engine.model, engine.data)
    return engine.problem()


def _check(scene: str) -> None:
    if scene not in SCENES:
        raise UnknownName("scene", scene, SCENES)


@contextmanager
def _engines(scene: str, sweeps: int, names: Sequence[str]) -> Iterator[list[Engine]]:
    made: list[Engine] = []
    try:
        for name in names:
            needs, ways = ENGINES[name]
            if needs is None or importlib.util.find_spec(needs) is not None:
                made += [way(scene, sweeps) for way in ways]
        yield made
    finally:
        for engine in made:
            engine.close()


def measure_scene(
    scene: str,
    sweeps: int = 16,
    *,
    engines: Sequence[str] = tuple(ENGINES),
    settle: int = SETTLE,
    rounds: int = 30,
) -> list[Step]:
    """Every installed engine on one scene, in turns.

    Parameters
    ----------
    scene : str
        Of `SCENES`.
    sweeps : int
        Of every engine that takes a number of them, at tolerance 0.
    engines : names of `ENGINES`
    settle : int
        Steps before the clock starts.
    rounds : int
        Batches of each engine, one after another in turn.

    Raises
    ------
    UnknownName
        No such scene or engine.
    """
    _check(scene)
    for name in engines:
        if name not in ENGINES:
            raise UnknownName("engine", name, ENGINES)
    notes: dict[int, str] = {}
    with _engines(scene, sweeps, engines) as made:
        size = np.ones(len(made), int)
        for i, engine in enumerate(made):
            start = process_time()
            for done in range(settle):
                engine.step()
                if process_time() - start > SETTLE_LIMIT:
                    notes[i] = f"did not settle: {done + 1} of {settle} steps in {SETTLE_LIMIT:g} s of CPU"
                    break
            size[i] = max(1, min(200, int(BATCH / max((process_time() - start) / max(settle, 1), 1e-6))))
        best = np.full(len(made), np.inf)
        for _ in range(rounds):
            for i, engine in enumerate(made):
                if i in notes:
                    continue
                start = process_time()
                for _ in range(size[i]):
                    engine.step()
                best[i] = min(best[i], (process_time() - start) / size[i])
        return [
            Step(
                scene=scene,
                engine=e.name,
                accurate=e.accurate,
                time=NAN,
                contacts=0,
                depth=NAN,
                speed=NAN,
                relative=NAN,
                note=notes[i],
            )
            if i in notes
            else Step(scene, e.name, e.accurate, float(best[i]), **e.left())
            for i, e in enumerate(made)
        ]
