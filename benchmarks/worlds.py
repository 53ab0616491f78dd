"""Cost of worlds in a loop: starts, judgements and gradients, as ratios to a cold solve of the same worlds.

    python -m benchmarks worlds [--worlds 512] [--repeats 5] [--sheet batch ...] [--out FILE]

Sheets, all in CPU time of one thread, minima of calls that alternate:

    batch       random worlds of 12 and 30 rows, both laws: judge, start of the step before, the solution, other starts
    single      the same by `lavender.solve`, one problem at a time
    gradients   vector-Jacobian products of `lavender.derivatives` at 3, 12 and 30 rows
    sequences   50 recorded steps of the robots of gymnasium and dm_control, if installed, started from the step before
    motions     judging worlds that MuJoCo moves by forces and by accelerations
    loop        import, judge, solve and step of many worlds over 50 steps with changing contacts
    import      reading a step of four boxes (64 rows) with `from_mujoco`, and reading and solving it

The last lines of a table are the geometric means of its ratios, and the largest ratios that are wanted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.output import markdown, out_option, write_json
from benchmarks.pairs import run_timed, time_alternately

SIZES = ((4, 18), (10, 36))  # Contacts and velocities of random worlds.
LAWS = ("coulomb", "cone")
CHANGE = 1e-3  # Relative change of the velocities from step to step.
ROBOTS = {
    "gymnasium": (
        "envs/mujoco/assets",
        ("ant", "humanoid", "hopper", "walker2d_v5", "half_cheetah"),
    ),
    "dm_control": (
        "suite",
        ("humanoid", "quadruped", "walker", "hopper", "cheetah", "finger", "manipulator", "dog"),
    ),
}
STEPS_BEFORE, STEPS, STEPS_PER_CONTROL = 100, 50, 20
HOPPER = """<mujoco><option timestep="0.004"/><default><joint damping="1"/></default><worldbody>
<geom type="plane" size="0 0 1"/><body pos="0 0 0.65"><joint type="slide" axis="1 0 0" damping="0"/>
<joint type="slide" axis="0 0 1" damping="0"/><joint axis="0 1 0" damping="0"/>
<geom type="capsule" size=".06" fromto="0 0 0 0 0 .3"/><body>
<joint name="hip" axis="0 1 0" range="-60 60" limited="true"/>
<geom type="capsule" size=".04" fromto="0 0 0 0.1 0 -.3"/><body pos="0.1 0 -.3">
<joint name="knee" axis="0 1 0" range="0 120" limited="true"/>
<geom type="capsule" size=".04" fromto="0 0 0 -.1 0 -.3"/></body></body></body></worldbody>
<actuator><motor joint="hip" gear="20"/><motor joint="knee" gear="20"/></actuator></mujoco>"""

BOXES = "".join(
    f'<body pos="{0.5 * i} 0 .0999"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
    for i in range(4)
)
#: Wanted ratios of each sheet by column; times [us] of the sheet `import`.
WANTED = {
    "batch": {"next step": "0.80", "the solution": "0.90 at 12 rows, 0.60 at 30", "noise": "1.60"},
    "single": {"next step": "0.80", "the solution": "0.90 at 12 rows, 0.60 at 30"},
    "gradients": {"vjp": "10 us at 3 rows, then 5.00"},
    "sequences": {"next step": "0.80"},
    "motions": {"judge": "1.2 of the first row's"},
    "import": {"read [us]": "15.0", "read and solved": "30 us"},
}

Rows = Iterator[dict[str, Any]]


def measure(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Return the smallest CPU time [s] of each call; the calls alternate."""
    times = time_alternately(*calls.values(), rounds=repeats, before=int)
    return dict(zip(calls, times.min(axis=0).tolist(), strict=True))


def describe(name: str, best: dict[str, float], worlds: int, first: str = "cold") -> dict[str, Any]:
    """Return a row: the time of the first call [us] of a world, and the ratios of the others to it."""
    row: dict[str, Any] = {"worlds": name, f"{first} [us]": f"{1e6 * best[first] / worlds:.1f}"}
    return row | {k: f"{x / best[first]:.2f}" for k, x in best.items() if k != first}


def make_random(contacts: int, nv: int, n: int, law: str, change: float = 0.0) -> lv.Batch:
    """Return random worlds; `change` moves the velocities as the next step does."""
    rng = np.random.default_rng(contacts)
    jac = rng.standard_normal((n, 3 * contacts, nv))
    free = rng.standard_normal((n, nv))
    free += change * rng.standard_normal((n, nv))
    mass = np.broadcast_to(np.eye(nv), (n, nv, nv))
    return lv.Batch(jac, mass, free, cones=lv.Cones.contacts(0.5, count=contacts), friction=law)


def make_arbitrary_starts(exact: np.ndarray) -> dict[str, np.ndarray]:
    """Return starts (n, m) of other worlds, other contacts, noise, and with wrong signs and sizes."""
    rng = np.random.default_rng(0)
    n, m = exact.shape
    normal = np.arange(m) % 3 == 0
    return {
        "other world": np.roll(exact, 1, axis=0),
        "other contact": np.roll(exact.reshape(n, -1, 3), 1, axis=1).reshape(n, m),
        "noise": np.abs(exact).mean() * rng.standard_normal(exact.shape),
        "half": 0.5 * exact,
        "double": 2.0 * exact,
        "friction turned": np.where(normal, exact, -exact),
        "normals": np.where(normal, exact, 0.0),
        "huge": 1e6 * exact,
    }


def list_batches(worlds: int, repeats: int) -> Rows:
    """Yield the sheet `batch`."""
    for contacts, nv in SIZES:
        for law in LAWS:
            batch = make_random(contacts, nv, worlds, law)
            after = make_random(contacts, nv, worlds, law, CHANGE)
            start = lv.solve_many(batch).impulse.copy()
            calls: dict[str, Any] = {
                "cold": partial(lv.solve_many, after),
                "judge": partial(lv.residual_many, batch, start),
                "next step": partial(lv.solve_many, after, impulse=start),
                "the solution": partial(lv.solve_many, batch, impulse=start),
            }
            for name, given in make_arbitrary_starts(start).items():
                calls[name] = partial(lv.solve_many, after, impulse=given)
            best = measure(calls, repeats)
            yield describe(f"{3 * contacts} rows, {nv} velocities, {law}", best, worlds)


def list_singles(worlds: int, repeats: int) -> Rows:
    """Yield the sheet `single`; problems are made anew for each call, which is not timed."""
    n = min(worlds, 64)
    for contacts, nv in SIZES:
        for law in LAWS:
            batch = make_random(contacts, nv, n, law)
            after = make_random(contacts, nv, n, law, CHANGE)
            start = lv.solve_many(batch).impulse.copy()
            best = dict.fromkeys(("cold", "next step", "the solution"), np.inf)
            for _ in range(repeats):
                for name, of, given in zip(
                    best, (after, after, batch), (None, start, start), strict=True
                ):
                    starts = [None] * n if given is None else given
                    both = list(zip(of, starts, strict=True))
                    solves = partial(list, (lv.solve(p, impulse=x) for p, x in both))
                    best[name] = min(best[name], run_timed(solves)[1])
            yield describe(f"{3 * contacts} rows, {nv} velocities, {law}", best, n)


def differentiate(batch: lv.Batch, solutions: Any, name: str) -> Any:
    """Return a gradient of the sum of all velocities after the step."""
    cotangent = np.ones(batch.velocity_shape)
    return getattr(lv.derivatives(batch, solutions).vjp(velocity=cotangent), name)


def list_gradients(worlds: int, repeats: int) -> Rows:
    """Yield the sheet `gradients`, relative to `solve_many` of the same worlds."""
    for contacts, nv in ((1, 6), *SIZES):
        batch = make_random(contacts, nv, worlds, "coulomb")
        solutions = lv.solve_many(batch, tol=1e-10)
        calls: dict[str, Any] = {
            "solve": partial(lv.solve_many, batch, tol=1e-10),
            "vjp": partial(differentiate, batch, solutions, "v_free"),
            "vjp by J": partial(differentiate, batch, solutions, "J"),
        }
        yield describe(f"{3 * contacts} rows", measure(calls, repeats), worlds, "solve")


def iterate_robots() -> Iterator[tuple[str, Any]]:
    """Yield (name, MjModel) of the robots of installed packages."""
    import mujoco

    for package, (folder, names) in ROBOTS.items():
        spec = find_spec(package)
        for name in names if spec is not None and spec.origin is not None else ():
            path = Path(spec.origin).parent / folder / f"{name}.xml"  # type: ignore[union-attr,arg-type]
            try:
                yield f"{package} {name}", mujoco.MjModel.from_xml_path(str(path))
            except (ValueError, mujoco.FatalError) as error:
                click.echo(f"{path.name}: {error}", err=True)


def record_states(model: Any) -> np.ndarray:
    """Return consecutive states (STEPS + 1, size) under random controls."""
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    states = np.empty((STEPS + 1, mujoco.mj_stateSize(model, kind)))
    for step in range(STEPS_BEFORE + STEPS + 1):
        if model.nu and step % STEPS_PER_CONTROL == 0:
            data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
        if step >= STEPS_BEFORE:
            mujoco.mj_getState(model, data, states[step - STEPS_BEFORE], kind)
        mujoco.mj_step(model, data)
    return states


def list_sequences(worlds: int, repeats: int) -> Rows:
    """Yield the sheet `sequences`: all steps of a robot as one batch, each with the start of the step before."""
    for name, model in iterate_robots():
        states = record_states(model)
        before, _ = lv.io.from_mujoco_many(model, states[:-1])
        batch, answer = lv.io.from_mujoco_many(model, states[1:])
        if not batch.row_counts.any():
            continue
        start = batch.make_start(lv.solve_many(before))
        exact = lv.solve_many(batch).impulse.copy()
        cold, warm = lv.solve_many(batch), lv.solve_many(batch, impulse=start)
        calls: dict[str, Any] = {
            "cold after judging": partial(lv.solve_many, batch),  # with caches that hold other data
            "cold": partial(lv.solve_many, batch),
            "next step": partial(lv.solve_many, batch, impulse=start),
            "the solution": partial(lv.solve_many, batch, impulse=exact),
            "judge": partial(lv.residual_many, batch, answer),
        }
        row = describe(
            f"{name}, {np.median(batch.row_counts):.0f} rows", measure(calls, repeats), STEPS
        )
        for kind in ("sweeps", "factorisations"):
            counts = [np.mean([s.work.get(kind, 0) for s in many]) for many in (cold, warm)]
            row[kind] = " -> ".join(f"{x:.1f}" for x in counts)
        yield row


def list_motions(worlds: int, repeats: int) -> Rows:
    """Yield the sheet `motions`: a hopper by integrators that use forces, or accelerations."""
    import mujoco

    for name, integrator, off in (("Euler", 0, 0), ("RK4", 1, 0), ("Euler, eulerdamp off", 0, 1)):
        model = mujoco.MjModel.from_xml_string(HOPPER)
        model.opt.integrator = integrator
        model.opt.disableflags |= off * int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        states = record_states(model)[:STEPS]
        batch, answer = lv.io.from_mujoco_many(model, states)
        calls: dict[str, Any] = {
            "solve": partial(lv.solve_many, batch, tol=1e-9),
            "judge": partial(lv.residual_many, batch, answer),
        }
        yield describe(name, measure(calls, repeats), STEPS, "solve")


def step_worlds(model: Any, datas: list[Any], states: np.ndarray) -> None:
    """Step each world and copy its state."""
    import mujoco

    for data, state in zip(datas, states, strict=True):
        mujoco.mj_step(model, data)
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)


def list_loops(worlds: int, repeats: int) -> Rows:
    """Yield the sheet `loop`: every world is stepped, imported, judged and solved, without or with starts."""
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    model = mujoco.MjModel.from_xml_string(HOPPER)
    for name, is_warm in (("without starts", False), ("from the step before", True)):
        rng = np.random.default_rng(0)
        datas = [mujoco.MjData(model) for _ in range(worlds)]
        for data in datas:
            data.qvel[:] = 0.1 * rng.standard_normal(model.nv)
        scratch = lv.io.MujocoScratch(model)
        states = np.empty((worlds, mujoco.mj_stateSize(model, kind)))
        times = dict.fromkeys(("loop", "step", "import", "judge", "solve"), 0.0)
        solutions = None
        for _ in range(STEPS):
            start = solutions if is_warm else None
            _, stepped = run_timed(partial(step_worlds, model, datas, states))
            (batch, answer), read = run_timed(
                partial(lv.io.from_mujoco_many, model, states, scratch=scratch)
            )
            _, judged = run_timed(partial(lv.residual_many, batch, answer))
            solutions, solved = run_timed(partial(lv.solve_many, batch, impulse=start))
            parts = stepped, read, judged, solved
            for part, seconds in zip(times, (sum(parts), *parts), strict=True):
                times[part] += seconds
        yield describe(name, times, worlds * STEPS, "loop")


def list_imports(worlds: int, repeats: int) -> Rows:
    """Yield the sheet `import`."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="0 0 1"/>{BOXES}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
    read = partial(lv.io.from_mujoco, model, data)
    times = time_alternately(read, lambda: lv.solve(read()), rounds=repeats).min(axis=0)
    best = dict(zip(("read", "read and solved"), times.tolist(), strict=True))
    yield describe(f"four boxes, {read().m} rows", best, 1, "read")


def summarize(name: str, rows: list[dict[str, Any]]) -> Rows:
    """Yield the geometric means of the ratios of a sheet, and the wanted ones."""
    means = {}
    for column in rows[0]:
        texts = [row[column] for row in rows]
        if column != "worlds" and "[" not in column and not any("->" in x for x in texts):
            means[column] = f"{np.exp(np.mean(np.log(np.array(texts, float)))):.2f}"
    for line, cells in (("geometric mean", means), ("wanted", WANTED.get(name, {}))):
        yield {column: cells.get(column, "") for column in rows[0]} | {"worlds": line}


SHEETS = {
    "batch": list_batches,
    "single": list_singles,
    "gradients": list_gradients,
    "sequences": list_sequences,
    "motions": list_motions,
    "loop": list_loops,
    "import": list_imports,
}


@click.command()
@click.option("--worlds", default=512, show_default=True, help="Worlds of a batch.")
@click.option("--repeats", default=5, show_default=True, help="Calls of which the fastest counts.")
@click.option(
    "--sheet", "sheets", multiple=True, type=click.Choice(list(SHEETS)), help="All by default."
)
@out_option("Write the rows as JSON.")
def command(worlds: int, repeats: int, sheets: tuple[str, ...], out: Path | None) -> None:
    """Print the costs of starts, judgements and gradients of worlds; see the module."""
    lines: list[dict[str, Any]] = []
    for name in sheets or SHEETS:
        if name in ("sequences", "motions", "loop", "import") and find_spec("mujoco") is None:
            click.echo(f"{name}: MuJoCo is not installed", err=True)
            continue
        rows = list(SHEETS[name](worlds, repeats))
        lines += [{"sheet": name, **row} for row in rows]
        click.echo(f"\n## {name}\n")
        if rows:
            printed = [*rows, *summarize(name, rows)]
            click.echo(markdown(list(rows[0]), [list(row.values()) for row in printed]))
    if out is not None:
        write_json(out, lines)
