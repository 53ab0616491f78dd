"""How long towers of boxes stand, how far they move, and what a step costs.

Every engine stacks the same n unit boxes of 1 kg on a plane, friction 0.5, without sleeping, and steps. With p(t) the
centres of the boxes,

    drift = max over boxes and t >= 2 s of |p(t) - p(2 s)|,                                     (1)

looked at ten times a second. Where a box is half an edge beside or below where it began the tower has fallen and the
run ends; soft contacts may throw it up at first. Lines of one tower and one letter spend equally many sweeps on a
second of simulation: sweeps x substeps / dt.

LavenderSim is stepped as a user steps it, with its observation; the others by their own call for a step. MuJoCo,
PyBullet and lavendersim are Python packages; Rapier (`@dimforge/rapier3d-compat`) and Jolt (`jolt-physics`) run under
Node, by the adapters of `lavender phenomena`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import process_time
from typing import Any, ClassVar

import click
import numpy as np

from benchmarks.output import folder_of, markdown, write_json
from lavender._arrays import FloatArray
from lavender.bench.machine import versions
from lavender.engine import Simulation
from lavender.errors import InputError, UnknownName
from lavender.external._running import quiet
from lavender.phenomena.engines import PACKAGES_OF_NODE, missing_in_node, versions_of_node
from lavender.phenomena.engines.node import Engine as Node
from lavender.scene import Scene
from lavender.scene.scene import SCENE_ORDERS

__all__ = [
    "ENGINES",
    "Engine",
    "Line",
    "Tower",
    "command",
    "installed",
    "lines",
    "measure",
    "missing",
    "table",
]

FRICTION = 0.5
SETTLE = 2.0  # s
LOOK = 0.1  # s
FELL = 0.5  # m, half an edge


@dataclass(frozen=True)
class Tower:
    """What is asked of an engine."""

    boxes: int
    dt: float  # s, of one call for a step
    sweeps: int | None = None  # None: the engine's own number
    substeps: int | None = None  # None: the engine's own number
    order: str | None = None  # of LavenderSim
    seconds: float = 60.0  # s, simulated


@dataclass(frozen=True)
class Line:
    """What an engine did of it."""

    engine: str
    boxes: int
    dt: float  # s
    sweeps: int  # of one substep; 0: solved to a tolerance
    substeps: int  # of one step
    seconds: float  # s, simulated at most
    stood: float  # s, until it fell; `seconds` where it did not
    drift: float  # m, equation (1), until it fell
    cost: float  # s of CPU for one step

    @property
    def stands(self) -> bool:
        """Whether the tower stood to the end."""
        return self.stood >= self.seconds

    @property
    def work(self) -> float:
        """Sweeps for a second of simulation; 0 to a tolerance."""
        return self.sweeps * self.substeps / self.dt


class Engine:
    """One engine with one tower."""

    name = ""
    sweeps = 0
    substeps = 1
    up = 2  # axis

    def step(self) -> Any:
        """One step of dt."""
        raise NotImplementedError

    def advance(self, steps: int) -> None:
        """So many steps."""
        for _ in range(steps):
            self.step()

    def clock(self) -> float:
        """CPU time that steps took, from any moment on [s]."""
        return process_time()

    def centres(self) -> FloatArray:
        """Centres of the boxes (n, 3) [m]."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of what the engine holds."""


class Lavender(Engine):
    """LavenderSim with its sweeps."""

    name = "lavender"
    solver = "sequential_impulses"
    stepper = "impulses"

    def __init__(self, tower: Tower) -> None:
        own = self.solver == "sequential_impulses"
        scene = Scene(
            "stack", n=tower.boxes, dt=tower.dt, friction=FRICTION, solver=self.solver, substeps=tower.substeps,
            solver_iterations=tower.sweeps if own else None, order=tower.order if own else None, stepper=self.stepper,
        )  # fmt: skip
        p = scene.parameters
        self.sim = Simulation(scene)
        self.step = self.sim.step  # type: ignore[method-assign]
        self.substeps = p.substeps
        self.sweeps = self.sim.solver_iterations if own else 0
        if own and tower.order is not None:
            self.name = f"{self.name}, {p.order}"

    def centres(self) -> FloatArray:
        """See `Engine.centres`."""
        x: FloatArray = self.sim._state.a["x"][1:]
        return x.copy()


class SoftStep(Lavender):
    """LavenderSim with `soft_step`: as many sweeps again as there are substeps relax."""

    name = "lavender soft_step"
    stepper = "soft_step"


class BlockDescent(Lavender):
    """LavenderSim with `avbd`."""

    name = "lavender avbd"
    stepper = "avbd"


class LavenderNewton(Lavender):
    """LavenderSim with `newton`."""

    name = "lavender newton"
    solver = "newton"


class Lavendersim(Engine):
    """The C++ engine of PyPI's lavendersim; it divides a step into substeps of 1/240 s by itself. y is up."""

    name = "lavendersim"
    up = 1

    def __init__(self, tower: Tower) -> None:
        import lavendersim

        self.sweeps = 22 if tower.sweeps is None else tower.sweeps
        self.substeps = max(1, int(np.ceil(240.0 * tower.dt - 1e-9)))
        material = {"static_friction": FRICTION, "dynamic_friction": FRICTION, "torsional_friction": 0.0}
        scene = lavendersim.Scene(
            "tower", gravity=-9.81, solver_iterations=self.sweeps, ground_rolling_friction=0.0,
            **{f"ground_{k}": v for k, v in material.items()},
        )  # fmt: skip
        for i in range(tower.boxes):
            scene.box(
                f"box {i}", size=(1.0, 1.0, 1.0), mass=1.0, position=(0.0, i + 0.5, 0.0), restitution=0.0,
                rolling_friction=0.0, **material,
            )  # fmt: skip
        self.env = lavendersim.CodeSceneEnv(scene, control_dt=tower.dt, horizon=None)
        self.env.reset()
        self.step = self.env.step  # type: ignore[method-assign]
        state = self.env.body_state()
        self.boxes = slice(len(state) - tower.boxes, len(state))

    def centres(self) -> FloatArray:
        """See `Engine.centres`."""
        return np.array(self.env.body_state()[self.boxes, :3], float)

    def close(self) -> None:
        """See `Engine.close`."""
        self.env.close()


def _mjcf(tower: Tower, option: str) -> str:
    boxes = "".join(
        f'<body pos="0 0 {i + 0.5}"><freejoint/><geom type="box" size=".5 .5 .5" mass="1"/></body>'
        for i in range(tower.boxes)
    )
    return (
        f'<mujoco><option timestep="{tower.dt!r}" cone="elliptic" {option}/>'
        f'<default><geom friction="{FRICTION} 0.005 0.0001" condim="3"/></default>'
        f'<worldbody><geom type="plane" size="50 50 1"/>{boxes}</worldbody></mujoco>'
    )


class MuJoCoNewton(Engine):
    """`mj_step` with Newton to 1e-8, elliptic cones."""

    name = "mujoco Newton"

    def __init__(self, tower: Tower) -> None:
        import mujoco

        model = mujoco.MjModel.from_xml_string(_mjcf(tower, self._option(tower)))
        self.data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)  # the centres before the first step
        self.step = lambda: mujoco.mj_step(model, self.data)  # type: ignore[method-assign]

    def _option(self, tower: Tower) -> str:
        return 'solver="Newton" tolerance="1e-8"'

    def centres(self) -> FloatArray:
        """See `Engine.centres`."""
        return np.array(self.data.xpos[1:], float)


class MuJoCoPGS(MuJoCoNewton):
    """`mj_step` with a number of sweeps."""

    name = "mujoco PGS"

    def _option(self, tower: Tower) -> str:
        self.sweeps = 100 if tower.sweeps is None else tower.sweeps
        return f'solver="PGS" tolerance="0" iterations="{self.sweeps}"'


class PyBullet(Engine):
    """`stepSimulation`, sequential impulses in maximal coordinates."""

    name = "pybullet"

    def __init__(self, tower: Tower) -> None:
        with quiet(noisy=True):  # it greets
            import pybullet as p

        self.p, self.client = p, p.connect(p.DIRECT)
        at = {"physicsClientId": self.client}
        self.sweeps = 50 if tower.sweeps is None else tower.sweeps
        self.substeps = 1 if tower.substeps is None else tower.substeps
        p.setGravity(0.0, 0.0, -9.81, **at)
        p.setPhysicsEngineParameter(
            fixedTimeStep=tower.dt, numSolverIterations=self.sweeps, numSubSteps=self.substeps,
            solverResidualThreshold=0.0, **at,
        )  # fmt: skip
        plane = p.createCollisionShape(p.GEOM_PLANE, **at)
        box = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.5, 0.5, 0.5], **at)
        ground = p.createMultiBody(0.0, plane, **at)
        self.boxes = [
            p.createMultiBody(1.0, box, basePosition=[0.0, 0.0, i + 0.5], useMaximalCoordinates=True, **at)
            for i in range(tower.boxes)
        ]
        for body in (ground, *self.boxes):  # Bullet multiplies the coefficients of two bodies
            p.changeDynamics(
                body, -1, lateralFriction=FRICTION**0.5, rollingFriction=0, spinningFriction=0, linearDamping=0,
                angularDamping=0, **at,
            )  # fmt: skip
            p.changeDynamics(body, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING, **at)
        self.step = lambda: p.stepSimulation(**at)  # type: ignore[method-assign]

    def centres(self) -> FloatArray:
        """See `Engine.centres`."""
        return np.array(
            [self.p.getBasePositionAndOrientation(b, physicsClientId=self.client)[0] for b in self.boxes]
        )

    def close(self) -> None:
        """See `Engine.close`."""
        self.p.disconnect(self.client)


class Rapier(Engine):
    """`World.step`, iterations of which each is a substep."""

    name = "rapier"
    default = 4
    option = "iterations"
    more: ClassVar[dict[str, float]] = {}

    def __init__(self, tower: Tower) -> None:
        self.sweeps = self.default if tower.sweeps is None else tower.sweeps
        scene = Scene("stack", n=tower.boxes, friction=FRICTION)
        options = {self.option: self.sweeps, **self.more}
        self.made = made = Node(scene, self.name, dt=tower.dt, **options)
        self.advance, self.clock, self.close = made.advance, made.clock, made.close  # type: ignore[method-assign]

    def centres(self) -> FloatArray:
        """See `Engine.centres`."""
        return self.made.state()[0][1:]


class Jolt(Rapier):
    """`Step` with velocity steps."""

    name = "jolt"
    default = 10
    option = "sweeps"
    more: ClassVar[dict[str, float]] = {"substeps": 1, "gyroscopic": False}


@dataclass(frozen=True)
class Contestant:
    """How an engine is made, what it needs, and what it lets one choose."""

    make: Callable[[Tower], Engine]
    needs: str | None = None  # Python package, or npm package
    sweeps: bool = True
    substeps: bool = False


#: Engines by the name that `--engines` takes.
ENGINES: dict[str, Contestant] = {
    "lavender": Contestant(Lavender, substeps=True),
    "newton": Contestant(LavenderNewton, sweeps=False),
    "soft_step": Contestant(SoftStep, substeps=True),
    "avbd": Contestant(BlockDescent, substeps=True),
    "lavendersim": Contestant(Lavendersim, "lavendersim"),
    "mujoco_newton": Contestant(MuJoCoNewton, "mujoco", sweeps=False),
    "mujoco_pgs": Contestant(MuJoCoPGS, "mujoco"),
    "pybullet": Contestant(PyBullet, "pybullet", substeps=True),
    "rapier": Contestant(Rapier, PACKAGES_OF_NODE["rapier"]),
    "jolt": Contestant(Jolt, PACKAGES_OF_NODE["jolt"]),
}


def missing(name: str) -> str:
    """What the engine of that name lacks here; empty where it can run."""
    found = ENGINES[name]
    if found.needs is None:
        return ""
    if found.needs in PACKAGES_OF_NODE.values():
        return missing_in_node(found.needs)
    return "" if find_spec(found.needs) else f"pip install {found.needs}"


def installed() -> list[str]:
    """Names of the engines that can run here."""
    return [name for name in ENGINES if not missing(name)]


def measure(engine: str, tower: Tower) -> Line:
    """Step one tower in one engine, at most `tower.seconds`.

    Raises
    ------
    UnknownName
        No such engine.
    InputError
        It is not installed; the message says what is missing.
    """
    if engine not in ENGINES:
        raise UnknownName("engine", engine, ENGINES)
    lack = missing(engine)
    if lack:
        raise InputError(f"{engine} cannot run here: {lack}")
    made = ENGINES[engine].make(tower)
    try:
        return _watch(made, tower)
    finally:
        made.close()


def _watch(engine: Engine, tower: Tower) -> Line:
    every = max(1, round(LOOK / tower.dt))
    looks = max(1, round(tower.seconds / (every * tower.dt)))
    spent, drift, start, stood, steps = 0.0, 0.0, None, tower.seconds, 0
    first = engine.centres()
    for _ in range(looks):
        begin = engine.clock()
        engine.advance(every)
        spent += engine.clock() - begin
        steps += every
        time = steps * tower.dt
        now = engine.centres()
        away = now - first
        away[:, engine.up] = np.minimum(away[:, engine.up], 0.0)
        if not np.linalg.norm(away, axis=1).max() <= FELL:
            stood = time
            break
        if time >= SETTLE - 1e-9:
            start = now if start is None else start
            drift = max(drift, float(np.linalg.norm(now - start, axis=1).max()))
    return Line(
        engine=engine.name,
        boxes=tower.boxes,
        dt=tower.dt,
        sweeps=engine.sweeps,
        substeps=engine.substeps,
        seconds=tower.seconds,
        stood=stood,
        drift=drift,
        cost=spent / steps,
    )


def lines(
    engines: Iterable[str],
    boxes: Sequence[int],
    sweeps: Sequence[int],
    rates: Sequence[float],
    substeps: Sequence[int],
    *,
    seconds: float = 60.0,
    orders: Sequence[str | None] = (None,),
) -> Iterator[Line]:
    """The map, tower by tower; `substeps` 0 means the engine's own number.

    Engines that iterate to a tolerance have one line for each tower and step; those of others that sweep also one with
    their own number of sweeps.
    """
    for n in boxes:
        for rate in rates:
            for name in engines:
                c = ENGINES[name]
                own = isinstance(c.make, type) and c.make in (Lavender, SoftStep, BlockDescent)
                budgets: list[int | None] = [*sweeps] if c.sweeps else []
                if not own:
                    budgets.append(None)
                seen = set()
                for budget in budgets:
                    for part in substeps if c.substeps else (0,):
                        for order in orders if own else (None,):
                            tower = Tower(
                                boxes=n,
                                dt=1.0 / rate,
                                sweeps=budget,
                                substeps=part or None,
                                order=order,
                                seconds=seconds,
                            )
                            line = measure(name, tower)
                            key = (line.engine, line.sweeps, line.substeps)
                            if key not in seen:
                                seen.add(key)
                                yield line


def _letters(found: Sequence[Line]) -> dict[tuple[int, float], str]:
    # towers and sweeps a second that more than one line has
    count: dict[tuple[int, float], int] = {}
    for line in found:
        if line.sweeps:
            key = (line.boxes, round(line.work, 6))
            count[key] = count.get(key, 0) + 1
    out: dict[tuple[int, float], str] = {}
    for n in {key[0] for key in count}:
        shared = sorted(key for key, times in count.items() if key[0] == n and times > 1)
        out |= {key: chr(ord("a") + i) if i < 26 else f"a{i}" for i, key in enumerate(shared)}
    return out


def table(found: Sequence[Line]) -> str:
    """The map as a markdown table, by tower and step; lines of one tower and letter spend equally many sweeps."""
    letters = _letters(found)
    head = (
        "boxes",
        "dt [s]",
        "engine",
        "sweeps",
        "substeps",
        "sweeps a second",
        "stood [s]",
        "drift [mm]",
        "µs a step",
    )
    rows = []
    for line in sorted(found, key=lambda x: (x.boxes, -x.dt)):
        sweeps = str(line.sweeps) if line.sweeps else "to a tolerance"
        work = (
            f"{line.work:,.0f} {letters.get((line.boxes, round(line.work, 6)), '')}".strip()
            if line.sweeps
            else "–"
        )
        stood = f"{line.seconds:g}" if line.stands else f"**fell at {line.stood:.1f}**"
        drift = f"{1e3 * line.drift:.2g}" if line.stands else "–"
        rows.append(
            (
                line.boxes, f"1/{round(1 / line.dt)}", line.engine, sweeps, line.substeps, work, stood, drift,
                f"{1e6 * line.cost:,.3g}",
            )
        )  # fmt: skip
    return markdown(head, rows)


def _numbers(text: str, what: str, low: int) -> list[int]:
    words = text.replace(",", " ").split()
    if not words or not all(w.isdecimal() and int(w) >= low for w in words):
        raise InputError(f"{what} {text!r}: whole numbers of at least {low} are needed, with commas between")
    return [int(w) for w in words]


@click.command("stand")
@click.option("--engines", default=None, help="Names with commas; default: all that are installed.")
@click.option("--boxes", default="6,10,20", show_default=True, help="Heights of the towers.")
@click.option(
    "--sweeps", default="4,8,16", show_default=True, help="Sweeps of a substep, for whoever takes a number."
)
@click.option("--rates", default="60,120", show_default=True, help="Steps a second.")
@click.option(
    "--substeps", default="0,1,2,4", show_default=True, help="Substeps of a step; 0: the engine's own number."
)
@click.option("--orders", default=None, help="Sweep orders of LavenderSim; default: that of the scene.")
@click.option(
    "--seconds", type=click.FloatRange(min=3.0), default=60.0, show_default=True, help="Simulated at most."
)
@click.option("--out", type=click.Path(path_type=Path), help="JSON of the lines.")
def command(
    engines: str | None,
    boxes: str,
    sweeps: str,
    rates: str,
    substeps: str,
    orders: str | None,
    seconds: float,
    out: Path | None,
) -> None:
    """How long towers of boxes stand, how far they move and what a step costs, in every engine that is installed.

    Rapier and Jolt take part where npm has installed them in this folder: npm install @dimforge/rapier3d-compat
    jolt-physics.
    """
    names = installed() if engines is None else engines.replace(",", " ").split()
    for name in names:
        if name not in ENGINES:
            raise UnknownName("engine", name, ENGINES)
        if missing(name):
            raise InputError(f"{name} cannot run here: {missing(name)}")
    asked: list[str | None] = [None] if orders is None else [*orders.replace(",", " ").split()]
    for order in asked:
        if order is not None and order not in SCENE_ORDERS:
            raise UnknownName("order", order, SCENE_ORDERS)
    folder_of(out)
    plan = (
        _numbers(boxes, "--boxes", 1), _numbers(sweeps, "--sweeps", 1), _numbers(rates, "--rates", 1),
        _numbers(substeps, "--substeps", 0),
    )  # fmt: skip
    found = []
    for line in lines(names, *plan, seconds=seconds, orders=asked):
        found.append(line)
        how = (
            f"stood {line.seconds:g} s, {1e3 * line.drift:.3g} mm"
            if line.stands
            else f"fell at {line.stood:.1f} s"
        )
        click.echo(
            f"{line.boxes} boxes, 1/{round(1 / line.dt)} s, {line.engine}, {line.sweeps} x {line.substeps}: {how}",
            err=True,
        )
        if out is not None:
            write_json(out, found, engines=_versions(names))
    click.echo(table(found))
    left = [f"{name} ({missing(name)})" for name in ENGINES if missing(name)] if engines is None else []
    if left:
        click.echo(f"\nNot installed: {', '.join(left)}.")


def _versions(names: Sequence[str]) -> dict[str, str]:
    needed = {p for n in names if (p := ENGINES[n].needs)}
    return {p: v for p, v in (versions(needed) | versions_of_node()).items() if p in needed}
