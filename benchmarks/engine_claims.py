"""Claims of newton's SolverKamino against verdicts on 14 scenes, each verdict compared with a second computation.

The second computation uses NumPy and the engine's own arrays only: its matrix D, v_f, the scaling P, bounds, friction
and impulses lambda, in the engine's order of rows. With A = (D - sigma I) / (P P^T), b = -v_f / P, w = A lambda - b and
d the diagonal of A, it measures for each world

    error           largest d |lambda - projection(lambda - w / d)| of a row [m/s]
    complementarity largest |lambda_n w_n| of a limit or contact [J]
    cone            largest excess of |lambda_t| over mu lambda_n [N s]
    momentum        largest difference of v* + M^-1 J^T lambda and the engine's velocity after the step [m/s, rad/s]

A verdict agrees if both errors are on the same side of the threshold, or differ by at most a factor of two: the judge
weights the error of a contact's block, this computation each of its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.output import markdown, out_option, write_json
from lavender.audit.audit import audit_steps
from lavender.audit.engine_scenes import NewtonScene, start_scene
from lavender.audit.result import Audit
from lavender.io.engine_step import EngineStep
from lavender.report.text import format_size

HALF_EDGE, FRICTION, PILE_SEED = 0.1, 0.7, 1
# Both errors differ by at most this factor: the judge weights the rows of a contact's block.
WEIGHT_RATIO = 2.0


def build_boxes(masses: list[float], restitution: float = 0.0, pile: bool = False) -> Any:
    """Build a newton.ModelBuilder with boxes of 0.2 m above a plane: a tower, or a pile of turned boxes."""
    import newton
    import warp as wp

    rng = np.random.default_rng(PILE_SEED)
    builder = newton.ModelBuilder()
    shape = newton.ModelBuilder.ShapeConfig(
        density=0.0, margin=0.0, gap=0.01, mu=FRICTION, restitution=restitution
    )
    for k, mass in enumerate(masses):
        moment = mass * (2.0 * HALF_EDGE) ** 2 / 6.0
        turn, shift, gap = (
            (rng.normal(size=4), rng.uniform(-0.08, 0.08, 2), 0.4)
            if pile
            else ([0, 0, 0, 1], [0, 0], 0.2)
        )
        turn = np.asarray(turn, float) / np.linalg.norm(turn)
        bounce_height = 0.1 if restitution else 0.0
        height = (0.25 if pile else HALF_EDGE) + gap * k + bounce_height
        body = builder.add_body(
            xform=wp.transformf(*map(float, (*shift, height, *turn))),
            mass=mass,
            inertia=wp.mat33f(np.diag([moment] * 3)),
            lock_inertia=True,
            label=f"box_{k}",
        )
        builder.add_shape_box(body, hx=HALF_EDGE, hy=HALF_EDGE, hz=HALF_EDGE, cfg=shape)
    builder.add_ground_plane(cfg=shape)
    return builder


def from_basics(name: str, **options: Any) -> Callable[[], Any]:
    """Return a function that builds a scene of `newton.tests.utils.basics`."""

    def build() -> Any:
        from newton.tests.utils import basics

        return getattr(basics, f"build_{name}")(**options)

    return build


SCENES: dict[str, Callable[[], Any]] = {
    "stack2": from_basics("boxes_stacked_on_plane"),
    "stack2_1000": from_basics("boxes_stacked_on_plane", mass_top=1000.0, mass_bottom=1.0),
    "fourbar": from_basics("boxes_fourbar"),
    "fourbar_pd": from_basics("boxes_fourbar", dynamic_joints=True, implicit_pd=True),
    "hinged": from_basics("boxes_hinged"),
    "nunchaku": from_basics("boxes_nunchaku"),
    "cartpole": from_basics("cartpole"),
    "tower5": lambda: build_boxes([1.0] * 5),
    "tower10_100": lambda: build_boxes([1.0] * 9 + [100.0]),
    "tower5_light": lambda: build_boxes([1e-3] * 5),
    "tower5_lightest": lambda: build_boxes([1e-5] * 5),
    "tower5_bounce": lambda: build_boxes([1.0] * 5, restitution=0.5),
    "pile8": lambda: build_boxes([1.0] * 8, pile=True),
    "pile8_light": lambda: build_boxes([1e-3] * 8, pile=True),
}


@dataclass
class Checks:
    """Results of the second computation, and its comparison with the verdicts."""

    threshold: float
    agree: int = 0
    total: int = 0
    largest: dict[str, float] = field(default_factory=dict)
    disagreements: list[tuple[int, float, float]] = field(default_factory=list)

    def note(self, name: str, value: float) -> None:
        """Store the largest value of a quantity."""
        self.largest[name] = max(self.largest.get(name, 0.0), value)

    def compare(self, world: int, own: float, judged: float) -> None:
        """Count whether two errors [m/s] lead to the same verdict."""
        self.total += 1
        low, high = sorted((own, judged))
        if (
            high <= self.threshold
            or low > self.threshold
            or high <= WEIGHT_RATIO * max(low, self.threshold)
        ):
            self.agree += 1
        else:
            self.disagreements.append((world, own, judged))


def read_engine(solver: Any) -> Callable[[int], tuple[Any, ...]]:
    """Return a function that returns D without sigma and P, b, lambda, row counts, bounds and mu of a world."""
    engine = solver._solver_kamino
    data, info = engine.problem_fd.data, engine.solver_fd.data
    arrays = {
        name: getattr(data, name).numpy()
        for name in (
            "dim",
            "mio",
            "vio",
            "P",
            "D",
            "v_f",
            "njc",
            "nbc",
            "nl",
            "nc",
            "bcio",
            "cio",
            "mu",
            "bound_lower",
            "bound_upper",
        )
        if getattr(data, name) is not None
    }
    lambdas, sigma = info.solution.lambdas.numpy(), info.state.sigma.numpy()

    def read_world(i: int) -> tuple[Any, ...]:
        size, start, first = (int(arrays[name][i]) for name in ("dim", "mio", "vio"))
        joints, bounded, limits, contacts = (
            int(arrays[name][i]) for name in ("njc", "nbc", "nl", "nc")
        )
        scale = arrays["P"][first : first + size].astype(float)
        matrix = arrays["D"][start : start + size**2].reshape(size, size).astype(float)
        matrix = (matrix - float(sigma[i][0]) * np.eye(size)) / np.outer(scale, scale)
        lower = np.full(size, -np.inf)
        upper = np.full(size, np.inf)
        rows = slice(joints, joints + bounded)
        at = slice(int(arrays["bcio"][i]), int(arrays["bcio"][i]) + bounded)
        lower[rows], upper[rows] = (
            scale[rows] * arrays["bound_lower"][at],
            scale[rows] * arrays["bound_upper"][at],
        )
        before = joints + bounded + limits
        lower[joints + bounded : before] = 0.0
        mu = arrays["mu"][int(arrays["cio"][i]) :][:contacts].astype(float)
        b = -arrays["v_f"][first : first + size] / scale
        lam = lambdas[first : first + size].astype(float)
        return matrix, b, lam, before, lower, upper, mu

    return read_world


def measure_errors(
    matrix: Any, b: Any, lam: Any, before: int, lower: Any, upper: Any, mu: Any
) -> tuple[float, float, float]:
    """Return error [m/s], complementarity [J] and cone [N s] of a world, from the engine's arrays."""
    w = matrix @ lam - b
    d = np.diag(matrix).copy()
    single = np.abs(d * (lam - np.clip(lam - w / d, lower, upper)))[:before]
    tangents = before + 3 * np.arange(len(mu))[:, None] + np.arange(2)
    normals = before + 3 * np.arange(len(mu)) + 2
    lam_n, w_n, lam_t, w_t = lam[normals], w[normals], lam[tangents], w[tangents]
    error_n = np.abs(d[normals] * (lam_n - np.maximum(0.0, lam_n - w_n / d[normals])))
    d_t = d[tangents].mean(
        axis=1, keepdims=True
    )  # With one d, w_t opposite to lambda_t stays on the edge of the disk.
    free = lam_t - w_t / d_t
    bound = mu * np.maximum(0.0, lam_n)
    size = np.linalg.norm(free, axis=1)
    projected = free * np.minimum(1.0, bound / np.maximum(size, 1e-300))[:, None]
    error_t = np.abs(d_t * (lam_t - projected))
    limits = slice(int(np.searchsorted(lower[:before] == 0.0, True)), before)
    products = np.abs(np.concatenate([lam_n * w_n, (lam * w)[limits] * (lower[limits] == 0.0)]))
    excess = np.linalg.norm(lam_t, axis=1) - mu * lam_n
    error = max(single.max(initial=0.0), error_n.max(initial=0.0), error_t.max(initial=0.0))
    return float(error), float(products.max(initial=0.0)), float(excess.max(initial=0.0))


def check_steps(running: NewtonScene, steps: int, checks: Checks) -> Iterator[EngineStep]:
    """Step a scene, yield the converted steps, and compare each verdict with the second computation."""
    from lavender.batch.residuals import residual_many

    for _ in range(steps):
        running.step()
        step = running.convert()
        yield step
        judged = residual_many(step.batch, step.impulse, errors="status").velocity_error
        world_of = read_engine(running.solver)
        velocity = running.before.body_qd.numpy().reshape(running.n, -1)
        for i in range(running.n):
            rows = step.batch.rows_of(i)
            if rows.stop == rows.start or not np.isfinite(judged[i]):
                continue
            problem = step.batch[i]
            arrays = world_of(i)
            matrix = arrays[0]
            before = arrays[3]
            contacts = len(arrays[6])
            order = [
                *range(before),
                *(before + 3 * k + j for k in range(contacts) for j in (2, 0, 1)),
            ]
            difference = (
                np.abs(problem.dense() - matrix[np.ix_(order, order)]).max() / np.abs(matrix).max()
            )
            error, complementarity, cone = measure_errors(*arrays)
            checks.note("A", float(difference))
            checks.note("complementarity", complementarity)
            checks.note("cone", cone)
            checks.note(
                "momentum", float(np.abs(problem.velocity(step.impulse[rows]) - velocity[i]).max())
            )
            checks.compare(i, error, float(judged[i]))


def run_scene(
    build: Callable[[], Any], worlds: int, steps: int, spread: float, threshold: float
) -> tuple[Audit, Checks]:
    """Step one scene; return claims against verdicts, and the second computation."""
    running = start_scene(build, "kamino", worlds=worlds, spread=spread)
    assert isinstance(running, NewtonScene)
    checks = Checks(threshold)
    return audit_steps(
        check_steps(running, steps, checks), engine="kamino", threshold=threshold
    ), checks


@click.command()
@click.argument("names", nargs=-1, metavar="[SCENE]...")
@click.option("--worlds", default=8, show_default=True)
@click.option("--steps", default=50, show_default=True)
@click.option(
    "--spread",
    default=0.01,
    show_default=True,
    help="Noise of the velocities at the start [m/s, rad/s].",
)
@click.option(
    "--threshold",
    default=1e-4,
    show_default=True,
    help="Velocity error up to which an answer is right [m/s].",
)
@out_option("Write the numbers to a JSON file.")
def command(
    names: tuple[str, ...],
    worlds: int,
    steps: int,
    spread: float,
    threshold: float,
    out: Path | None,
) -> None:
    """Compare the claims of newton's SolverKamino with verdicts on 14 scenes, or on those named.

    Exit code 1: a verdict differs from the second computation.
    """
    rows: list[list[str]] = []
    lines: list[dict[str, Any]] = []
    disagreements = 0
    for name in names or SCENES:
        result, checks = run_scene(SCENES[name], worlds, steps, spread, threshold)
        counts = list(result.claim_counts.values())
        disagreements = disagreements + len(checks.disagreements)
        worst = float(np.nanmax(result.numbers[0], initial=0.0))
        numbers = [
            checks.largest.get(key, 0.0) for key in ("A", "complementarity", "cone", "momentum")
        ]
        rows.append(
            [
                name,
                str(result.verdict.size),
                *map(str, counts[:4]),
                str(sum(counts[4:])),
                format_size(worst),
                f"{checks.agree} of {checks.total}",
                *map(format_size, numbers),
            ]
        )
        lines.append(
            {
                "scene": name,
                "counts": result.claim_counts,
                "worst": worst,
                "agree": checks.agree,
                "judged": checks.total,
                "disagreements": checks.disagreements,
                **checks.largest,
            }
        )
        click.echo(" | ".join(rows[-1]), err=True)
    heads = [
        "scene",
        "answers",
        "claimed and right",
        "claimed and wrong",
        "right, not claimed",
        "wrong, not claimed",
        "not finite",
        "worst [m/s]",
        "verdicts agree",
        "A [-]",
        "complementarity [J]",
        "cone [N s]",
        "momentum [m/s]",
    ]
    click.echo(markdown(heads, rows))
    if out is not None:
        write_json(out, lines, worlds=worlds, steps=steps, spread=spread, threshold=threshold)
    if disagreements:
        raise click.exceptions.Exit(1)
