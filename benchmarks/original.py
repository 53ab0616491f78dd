"""What the chapter's own engine publishes once it is asked: lavendersim 0.2.0, with its residual added to a copy.

The release says no residual and has no switch for warm starts or for the order. Four places of `engine/physics.cpp`
are added to, in a temporary folder: before and after the sweeps of a substep the largest error of a normal,

    e_n = lam_n - max(0, lam_n - w_n/d_n) [N s],     w_n = v_n + bias [m/s]                          (1)

impulses of the cache are set to zero if asked, and every other substep visits the contacts from the last to the first
if asked. Six unit boxes of 1 kg stand on the ground, friction 0.5, as in the gallery's `stack`.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import click
import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError

# Where something is added: the text that is there once, and what stands there instead ({} is the text).
ADDED = (
    (
        "static void positional_point_correction(",
        """static int asked_warm = 1, asked_turn = 0, substep_number = 0;
static float error_before = 0, error_after = 0;
static float largest_error(float dt) {
  float most = 0;
  for (int i = 0; i < gContactCount; ++i) {
    Contact& c = gContacts[i];
    float v = dot(sub(get_point_velocity(c.b, c.point), get_point_velocity(c.a, c.point)), c.normal);
    float w = v - 0.19f / dt * maxf(c.penetration - 0.0012f, 0.0f);
    float d = point_effective_mass(c.a, c.b, c.point, c.normal);
    float e = c.normalImpulse - maxf(0.0f, c.normalImpulse - w / d);
    most = maxf(most, e < 0 ? -e : e);
  }
  return most;
}
{}""",
    ),
    (
        "warm_start_contacts();\n",
        """++substep_number;
  if (!asked_warm) for (int i = 0; i < gContactCount; ++i) {
    Contact& c = gContacts[i];
    c.normalImpulse = c.tangentImpulse1 = c.tangentImpulse2 = 0;
    c.twistImpulse = c.rollingImpulse1 = c.rollingImpulse2 = 0;
  }
  {}  error_before = largest_error(dt);
""",
    ),
    (
        "solve_contact_velocity(gContacts[c],dt)",
        "solve_contact_velocity(gContacts[asked_turn && substep_number % 2 == 0 ? gContactCount - 1 - c : c], dt)",
    ),
    ("for(int j=0;j<gJointCount;++j)gJoints[j].appliedEffort=", "error_after = largest_error(dt);\n  {}"),
)
DOORS = """
EXPORT void ask(int warm, int turn) { asked_warm = warm; asked_turn = turn; substep_number = 0; }
EXPORT float before() { return error_before; }
EXPORT float after() { return error_after; }
"""
TAILS, STARTS = ((20, 60), (180, 240)), ((20, 90), (90, 120))  # steps, as in examples/engine_sweeps.py


def instrumented(source: str) -> str:
    """The engine's source with the lines added; InputError where it is another version's."""
    for text, instead in ADDED:
        if source.count(text) != 1:
            raise InputError(
                f"this is not physics.cpp of lavendersim 0.2.0: {text!r} stands there {source.count(text)} times"
            )
        source = source.replace(text, instead.replace("{}", text))
    return source + DOORS


def run(
    library: Path, sweeps: int, steps: int, dt: float, *, warm: bool = False, turn: bool = False
) -> FloatArray:
    """(steps, 3): of the last substep of each step the error before and after its sweeps [N s], and contacts."""
    from lavendersim import Scene
    from lavendersim.runtime import CodeSceneEnv

    rubbing = {
        "static_friction": 0.5,
        "dynamic_friction": 0.5,
        "torsional_friction": 0.0,
        "rolling_friction": 0.0,
    }
    scene = Scene("stack", solver_iterations=sweeps, **{f"ground_{name}": x for name, x in rubbing.items()})
    for i in range(6):
        scene.box(f"box {i}", size=(1, 1, 1), position=(0, i + 0.5, 0), mass=1.0, **rubbing)
    env = CodeSceneEnv(scene, library=library, control_dt=dt)
    engine: Any = ctypes.CDLL(str(library))
    engine.before.restype = engine.after.restype = ctypes.c_float
    engine.ask(int(warm), int(turn))
    rows = []
    for _ in range(steps):
        env.step()
        rows.append((engine.before(), engine.after(), env.api.sim_contact_count()))
    return np.array(rows)


def draw(runs: dict[tuple[int, bool], FloatArray], path: Path) -> None:
    """max |e_n| of every step beside that of LavenderSim, from examples/engine_sweeps.py."""
    sys.path.append(str(Path(__file__).resolve().parent.parent / "examples"))
    import engine_sweeps
    from matplotlib.figure import Figure

    ours = {
        (n, turn): engine_sweeps.run(n, "alternating" if turn else "bottom_up", False) for n, turn in runs
    }
    canvas = Figure(figsize=(10, 4.2), layout="constrained")
    titles = ("lavendersim 0.2.0, residual added", "here")
    for axes, title, by in zip(canvas.subplots(1, 2, sharey=True), titles, (runs, ours), strict=True):
        for (n, turn), rows in by.items():
            label = f"{'turned round' if turn else 'one way'}, {n} sweeps"
            axes.semilogy(
                np.arange(1, 241), rows[:, 1], "C0" if turn else "C1", ls="--" if n == 4 else "-", label=label
            )
        axes.set(title=title, xlabel="step of 1/120 s")
    canvas.axes[0].set_ylabel("max $|e_n|$ [N s]")
    canvas.legend(*canvas.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    canvas.savefig(path)


@click.command("original")
@click.argument("archive", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--figure", type=click.Path(dir_okay=False, path_type=Path), help="Draw every step, beside LavenderSim's."
)
def command(archive: Path, figure: Path | None) -> None:
    """Cold and warm residuals of lavendersim, from its source distribution lavendersim-0.2.0.tar.gz; needs c++."""
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(archive) as held:
            held.extractall(folder, filter="data")
        root = next(Path(folder).iterdir())
        cpp, library = (
            root / "engine" / "asked.cpp",
            root / f"asked{sysconfig.get_config_var('SHLIB_SUFFIX')}",
        )
        cpp.write_text(
            instrumented((root / "engine" / "physics.cpp").read_text(encoding="utf-8")), encoding="utf-8"
        )
        subprocess.run(["c++", "-O3", "-std=c++17", "-shared", "-fPIC", "-o", library, cpp], check=True)
        sys.path.insert(0, str(root / "python"))
        few, many = (run(library, n, 4, 1 / 240)[:, 1] for n in (4, 64))
        click.echo(
            f"first solve, cold: 4 sweeps {few[0]:.2e}, 64 sweeps {many[0]:.2e} N s, {few[0] / many[0]:.1f} times"
        )
        for n, values in ((4, few), (64, many)):
            click.echo(f"substeps 1 to 4, cold, {n:>2} sweeps: " + " ".join(f"{e:.1e}" for e in values))
        runs = {
            (n, turn): run(library, n, 240, 1 / 120, turn=turn) for turn in (False, True) for n in (4, 64)
        }
        for turn in (False, True):
            warm = run(library, 4, 120, 1 / 120, warm=True, turn=turn)
            cold = runs[4, turn]
            times = [np.median(cold[a:b, 1]) / np.median(runs[64, turn][a:b, 1]) for a, b in TAILS]
            times += [np.median(cold[a:b, 0]) / np.median(warm[a:b, 0]) for a, b in STARTS]
            found = ", ".join(f"{a}-{b} {x:.0f}" for (a, b), x in zip((*TAILS, *STARTS), times, strict=True))
            way = "turned round" if turn else "one way"
            click.echo(f"{way}: 4 to 64, then cold to warm, steps {found}; contacts {warm[-1, 2]:.0f}")
        if figure:
            draw(runs, figure)
            click.echo(f"figure: {figure}")
