"""What an engine's step costs by what its scene declares: LavenderSim alone; beside others it is `peers`.

    python -m benchmarks engine --detail        what each level of detail of one scene costs
    python -m benchmarks engine --model         what friction, spin and a joint far away cost, by sweeps

Unit boxes and spheres of 1 kg, dt = 1/240 s, tolerance 0, warm-started, friction 0.5. After a settling time, the time
is the least of many short batches of steps in a row (noise only adds), state changing all the while.
"""

from __future__ import annotations

from typing import Any

import click

import lavender as lv
from benchmarks.clock import least
from benchmarks.output import markdown
from lavender.sim.engine.state import State

DT = 1.0 / 240.0


def settled(scene: lv.Scene, steps: int) -> lv.Simulation:
    """A simulation after so many steps."""
    sim = lv.Simulation(scene)
    for _ in range(steps):
        sim.step()
    return sim


def detail(steps: int = 960) -> str:
    """One pile, with more and more declared: rows, bytes and time that each level brings."""
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
        state = settled(lv.Scene("pile", n=200, dt=DT, **more), steps).state
        (seconds,) = least(lambda state=state: state.kernel.substeps(1))
        sizes = []
        for bodies, contacts in ((0, 0), (0, 1000), (1000, 0)):
            size = state.size.copy()
            size[[0, 1, 9]] += (bodies, bodies, contacts)
            size[6] += bodies if size[6] else 0
            sizes.append(State(size).nbytes)
        c = int(state.head[0])
        rows.append(
            (
                label, int(state.size[7]), (sizes[2] - sizes[0]) // 1000, (sizes[1] - sizes[0]) // 1000, c,
                f"{1e6 * seconds:.0f}", f"{1e9 * seconds / c:.0f}",
            )
        )  # fmt: skip
    head = ("pile of 200", "rows/contact", "bytes/body", "bytes/contact", "contacts", "µs/step", "ns/contact")
    return markdown(head, rows)


MODELS: dict[str, tuple[dict[str, Any], bool]] = {  # what is declared, and whether a joint hangs far away
    "no friction": ({"friction": 0.0}, False),
    "friction": ({}, False),
    "and spin": ({"patch_radius": 0.05}, False),
    "and a joint": ({}, True),
}
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "tower of 6": ("stack", {"n": 6}),
    "tower of 20": ("stack", {"n": 20}),
    "pyramid of 55": ("pyramid", {"base": 10}),
    "pyramid of 210": ("pyramid", {"base": 20}),
    "pile of 200 spheres": ("pile", {"n": 200}),
    "pile of 60 boxes": ("pile", {"n": 60, "kind": "boxes"}),
    "chain of 6": ("chain", {"n": 6}),
    "chain of 50": ("chain", {"n": 50}),
}


def models(names: tuple[str, ...] = tuple(SCENES), steps: int = 240, seconds: float = 1.0) -> str:
    """Towers, pyramids and piles by what they declare: least times of a step, the variants in turns."""
    rows: list[tuple[Any, ...]] = []
    for label in names:
        name, parameters = SCENES[label]
        for sweeps in (4, 16, 64):
            sims = []
            for more, joint in MODELS.values() if name != "chain" else [({}, False)]:
                scene = lv.Scene(name, dt=DT, solver_iterations=sweeps, **parameters, **more)
                if joint:
                    far = scene.add_sphere(position=(90.0, 0.0, 5.0))
                    scene.add_joint("ball", -1, far, anchor=(90.0, 0.0, 7.0))
                sims.append(settled(scene, steps))
            best = least(*(sim.step for sim in sims), seconds=seconds)
            cells = (f"{1e6 * t:.1f} ({int(s.state.head[0])})" for t, s in zip(best, sims, strict=True))
            rows.append((label, sweeps, *cells, *[""] * (len(MODELS) - len(sims))))
    return markdown(("µs a step (contacts)", "sweeps", *MODELS), rows)


@click.command("engine")
@click.option(
    "--detail/--model", "by_detail", default=True, help="Levels of detail, or friction, spin and joints."
)
def command(by_detail: bool) -> None:
    """What each level of detail of a scene costs, or what friction, spin and a joint far away cost."""
    click.echo(detail() if by_detail else models())
