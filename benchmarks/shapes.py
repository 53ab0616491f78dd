"""What bounds friction: a disk, a box (each tangent by itself), or the edges of a pyramid, on ten scenes.

    disk    |t| <= mu n          box    |t_1| <= mu n, |t_2| <= mu n          edges    |t_1| + |t_2| <= mu n

Disk and box are Coulomb's law; edges are those of simulators that give each contact rows n +- mu t_i, and so the convex
relaxation. One substep's problem of each scene, solved under all three to 1e-9: what tangents hold beside what the
normals bear, how fast the contacts that bear slide along each axis, and what a solve and a sweep cost. `--engines`
drags a slab down a slope in the engines that are installed, along an axis and on the diagonal, where a box holds
sqrt(2) mu.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from time import process_time
from typing import Any

import click
import numpy as np
import scipy.sparse as sp

from benchmarks.output import markdown
from lavender import solve
from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.engines import engine
from lavender.problem import Problem
from lavender.problem.cones import ROW
from lavender.sim.engine import Simulation
from lavender.sim.scene import Scene

MU = 0.5
STEEP = 1.2  # tan of the slope over mu: more than a disk holds, less than a box on its diagonal
TIGHT = 1e-9  # relative residual of the answers that are compared
SECONDS = 1.0  # s of sliding
STANDING = ("stack", "pyramid", "card_house", "pile", "heavy_on_light", "table", "ramp")


@dataclass(frozen=True)
class Law:
    """One substep of a scene under one bound."""

    scene: str
    shape: str
    contacts: int
    relative: float  # - of the answer, by the judge
    grip: float  # -, |t| / (mu n), the largest of the contacts that bear
    share: float  # -, sum of |t| over sum of mu n
    first: float  # m/s, fastest sliding along the first tangent of a contact that bears
    second: float  # m/s, along the second
    newton: float  # s, CPU time of newton to 1e-6
    sweep: float  # s, of one of 200 sweeps over A


def slab(turned: float, shape: str = "disk") -> Scene:
    """A slab on a slope, the first axis `turned` [rad] from the way down."""
    angle, g = np.arctan(STEEP * MU), 9.81
    down = g * np.sin(angle)
    gravity = (down * np.cos(turned), down * np.sin(turned), -g * np.cos(angle))
    scene = Scene(gravity=gravity, friction=MU, friction_shape=shape)
    scene.add_plane()
    scene.add_box((1.0, 1.0, 0.2), position=(0.0, 0.0, 0.1))
    return scene


def scenes() -> dict[str, Callable[[], Scene]]:
    """Ten scenes by name."""
    gallery: dict[str, Callable[[], Scene]] = {name: (lambda name=name: Scene(name)) for name in STANDING}  # type: ignore[misc]
    return {
        "slope, along": lambda: slab(0.0),
        "slope, diagonal": lambda: slab(np.pi / 4),
        **gallery,
        "pyramid, slippery": lambda: Scene("pyramid", friction=0.1),
    }


def edges_of(problem: Problem) -> tuple[Problem, sp.csr_array]:
    """The problem of edges z >= 0, and lambda = E z: n and +- mu t_i in four of them a contact."""
    c = problem.cones
    columns: list[FloatArray] = []
    row, column, value, lower, upper = [], [], [], [], []  # type: ignore[var-annotated]
    for i in range(c.n_blocks):
        j, end = int(c.ptr[i]), int(c.ptr[i + 1])
        if c.kind[i] == ROW or end - j == 1:
            parts = [{k: 1.0} for k in range(j, end)]
            lower += c.lower[j:end].tolist()
            upper += c.upper[j:end].tolist()
        else:
            parts = [{j: 1.0, t: s * c.mu[i]} for t in range(j + 1, end) for s in (1.0, -1.0)]
            lower += [0.0] * len(parts)
            upper += [np.inf] * len(parts)
        for part in parts:
            row += list(part)
            value += list(part.values())
            column += [len(columns)] * len(part)
            columns.append(part)  # type: ignore[arg-type]
    e = sp.csr_array((value, (row, column)), shape=(problem.m, len(columns)))
    a = sp.csr_array(e.T @ problem.csr @ e)
    return Problem.lcp(a, e.T @ problem.b, np.array(lower), np.array(upper)), e


def _timed(run: Callable[[], Any]) -> float:
    """s, the median CPU time of five."""
    found = []
    for _ in range(5):
        start = process_time()
        run()
        found.append(process_time() - start)
    return float(np.median(found))


def laws(name: str, scene: Scene, steps: int = 60) -> Iterator[Law]:
    """The problem of the substep after so many steps, under each bound."""
    sim = Simulation(scene)
    for _ in range(steps):
        sim.step()
    given = replace(sim.constraint_problem(), guess=None)
    for shape in ("disk", "box", "edges"):
        problem, back = given, None
        if shape == "box":
            problem = replace(given, cones=given.cones.shaped("box"))
        elif shape == "edges":
            problem, back = edges_of(given)
        answer = solve(problem, "newton", tol=TIGHT)
        lam = answer.impulse if back is None else back @ answer.impulse
        w, c = given.slack(lam), given.cones
        first, mu = c.ptr[:-1][c.n_tangents == 2], c.mu[c.n_tangents == 2]
        loaded = lam[first] > 1e-6 * lam[first].max(initial=0.0)
        bears = first[loaded]
        size, bound = np.hypot(lam[bears + 1], lam[bears + 2]), mu[loaded] * lam[bears]
        over_a = Problem(problem.b, problem.cones, problem.csr)
        yield Law(
            name,
            shape,
            len(first),
            answer.residual.relative,
            float(np.max(size / bound, initial=0.0)),
            float(size.sum() / bound.sum()) if len(bears) else 0.0,
            float(np.abs(w[bears + 1]).max(initial=0.0)),
            float(np.abs(w[bears + 2]).max(initial=0.0)),
            _timed(lambda p=problem: solve(replace(p, copy=False), "newton", tol=1e-6)),  # type: ignore[misc]
            _timed(lambda p=over_a: solve(p, "pgs", tol=0.0, max_iter=200)) / 200.0,  # type: ignore[misc]
        )


def _speed(v: float) -> str:
    return f"{1e3 * v:.3g}" if v > 1e-9 else "0"  # m/s: below it rounding, or what 1e-9 leaves


def table(found: list[Law]) -> str:
    """One line for each scene and bound."""
    head = ("scene", "bound", "contacts", "residual", "largest grip", "share", "along 1 [mm/s]", "along 2 [mm/s]",
            "newton [ms]", "sweep [us]")  # fmt: skip
    rows = [
        (x.scene, x.shape, x.contacts, f"{x.relative:.0e}", f"{x.grip:.3f}", f"{x.share:.3f}", _speed(x.first),
         _speed(x.second), f"{1e3 * x.newton:.2f}", f"{1e6 * x.sweep:.1f}")
        for x in found
    ]  # fmt: skip
    return markdown(head, rows)


# -- engines -----------------------------------------------------------------------------------------------------------


def drag(turned: float) -> Iterator[tuple[str, float]]:
    """(engine, m/s) of the slab of `slab` after a second, in every engine here; other engines take the same slope."""
    steps = int(120 * SECONDS)
    for shape in ("disk", "box"):
        sim = Simulation(slab(turned, shape))
        for _ in range(steps):
            observation = sim.step()[0]
        yield f"lavender, {shape}", float(np.linalg.norm(observation["velocities"][1, :2]))
    gravity = slab(turned).parameters.gravity
    if find_spec("pybullet") is not None:
        yield from _bullet(turned, steps)
    if find_spec("dartpy") is not None:
        yield from _dart(gravity, steps)


def _bullet(turned: float, steps: int) -> Iterator[tuple[str, float]]:
    import pybullet as bullet

    kinds = [("sweeps, its cone", 1, "SI"), ("sweeps, its pyramid", 0, "SI")]
    kinds += [(f"{name.lower()}, its pyramid", 0, name) for name in ("PGS", "DANTZIG")]
    for name, cone, kind in kinds:
        made: Any = engine("bullet", slab(turned), sweeps=100, dt=1.0 / 120.0)
        bullet.setPhysicsEngineParameter(
            enableConeFriction=cone, constraintSolverType=getattr(bullet, f"CONSTRAINT_SOLVER_LCP_{kind}"),
            **made.at,
        )  # fmt: skip
        made.advance(steps)
        yield f"Bullet, {name}", float(np.linalg.norm(made.state()[2][1, :2]))
        made.close()


def _dart(gravity: tuple[float, float, float], steps: int) -> Iterator[tuple[str, float]]:
    import dartpy as dart

    for name in ("Dantzig", "PGS"):
        world = dart.simulation.World()
        world.setGravity(list(gravity))
        world.setTimeStep(1.0 / 120.0)
        solver = world.getConstraintSolver()
        if name == "PGS":  # no solver can be made or called from Python, but the second one put first
            second = solver.getSecondaryBoxedLcpSolver()
            solver.setSecondaryBoxedLcpSolver(None)
            solver.setBoxedLcpSolver(second)
        for moves, size, height in ((False, (10.0, 10.0, 1.0), -0.5), (True, (1.0, 1.0, 0.2), 0.1)):
            body = dart.dynamics.Skeleton("slab" if moves else "ground")
            joint, node = (
                body.createFreeJointAndBodyNodePair() if moves else body.createWeldJointAndBodyNodePair()
            )
            shape = dart.dynamics.BoxShape(list(size))
            part = node.createShapeNode(shape)
            part.createVisualAspect()
            part.createCollisionAspect()
            part.createDynamicsAspect().setFrictionCoeff(MU)
            place = dart.math.Isometry3()
            place.set_translation([0.0, 0.0, height])
            if moves:
                node.setInertia(dart.dynamics.Inertia(200.0, [0.0] * 3, np.diag([17.3, 17.3, 33.3])))
                body.setPositions([0.0, 0.0, 0.0, 0.0, 0.0, height])
            else:
                joint.setTransformFromParentBodyNode(place)
            world.addSkeleton(body)
        for _ in range(steps):
            world.step()
        yield f"DART, {name}", float(np.linalg.norm(node.getLinearVelocity()[:2]))


@click.command()
@click.argument("names", nargs=-1)
@click.option("--engines", is_flag=True, help="Drag a slab down a slope in every engine here instead.")
def command(names: tuple[str, ...], engines: bool) -> None:
    """Friction in a disk, a box and the edges of a pyramid."""
    if engines:
        g = 9.81 * (np.sin(np.arctan(STEEP * MU)) - MU * np.cos(np.arctan(STEEP * MU)))
        click.echo(
            f"sliding at {g * SECONDS:.3f} m/s by Coulomb's disk, and by a box along its axes; a box holds the diagonal"
        )
        along, across = dict(drag(0.0)), dict(drag(np.pi / 4))
        click.echo(markdown(("engine", "along [m/s]", "diagonal [m/s]"),
                            [(e, f"{along[e]:.3f}", f"{across[e]:.3f}") for e in along]))  # fmt: skip
        return
    known = scenes()
    found: list[Law] = []
    for name in names or known:
        found += laws(name, known[name]())
    click.echo(table(found))
