"""Residuals of the chapter's own engine: lavendersim 0.2.0, with lines added to a copy that compute them.

The release publishes no residual and has no switch for warm starts or for the sweep order. Lines are added at four
places of a temporary copy of `engine/physics.cpp`. They compute, before and after the sweeps of a substep, the largest
error of a normal,

    e_n = lam_n - max(0, lam_n - w_n/d_n) [N s],     w_n = v_n + bias [m/s]                          (1)

set the impulses of the cache to zero for a cold start, and reverse the order of the contacts in every other substep for
the order `alternating`. Six boxes of 1 kg with edges of 1 m are stacked on the ground, friction 0.5, as in the scene
`stack`.
"""

from __future__ import annotations

import ctypes
import shutil
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

# Each pair: a text that the source contains once, and its replacement ({} is the text).
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
EXPORTS = """
EXPORT void ask(int warm, int turn) { asked_warm = warm; asked_turn = turn; substep_number = 0; }
EXPORT float before() { return error_before; }
EXPORT float after() { return error_after; }
"""
TAILS, STARTS = ((20, 60), (180, 240)), ((20, 90), (90, 120))  # steps, as in examples/engine_sweeps.py


def instrumented(source: str) -> str:
    """Return the engine's source with the lines added; InputError if it is that of another version."""
    for text, instead in ADDED:
        if source.count(text) != 1:
            raise InputError(
                f"this is not physics.cpp of lavendersim 0.2.0: it has {text!r} {source.count(text)} times, not once"
            )
        source = source.replace(text, instead.replace("{}", text))
    return source + EXPORTS


def run(
    library: Path, sweeps: int, steps: int, dt: float, *, warm: bool = False, turn: bool = False
) -> FloatArray:
    """Return (steps, 3): the error before and after the sweeps of the last substep [N s], and the contacts."""
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
    """Draw max |e_n| of every step in both engines, cold; runs: (sweeps, alternating) -> (240, 3)."""
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
            label = f"{'alternating' if turn else 'one direction'}, {n} sweeps"
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
    "--figure", type=click.Path(dir_okay=False, path_type=Path), help="Draw every step of both engines."
)
def command(archive: Path, figure: Path | None) -> None:
    """Residuals of lavendersim 0.2.0, cold and warm, from its source archive; needs a C++ compiler (`c++`)."""
    if shutil.which("c++") is None:
        raise InputError("a C++ compiler is needed, under the name c++ (on Debian: apt-get install g++)")
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
            order = "alternating" if turn else "one direction"
            click.echo(
                f"{order}: 4 to 64 sweeps cold, then cold to warm on 4, steps {found}; contacts {warm[-1, 2]:.0f}"
            )
        if figure:
            draw(runs, figure)
            click.echo(f"figure: {figure}")
