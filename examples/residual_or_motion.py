"""Residual and motion error disagree: a tall stack, a chain with a heavy end, a light body in a heavy scene.

The residual is the change of the impulse by one more update. In a tall stack this change is small while the whole stack
still has to slow down: its slowest mode has an eigenvalue of (pi / 2n)^2 / 2 in the metric of d, and an error in it
contributes with the square root of that. Relative to the zero impulse, which is wrong only at the ground, the factor
from residual to motion error is about 0.9 sqrt(n). A heavy weight on a chain is worse: after a few sweeps every joint
has a small residual, but the weight still falls. Conversely, a light body with a large error causes a large residual (V
is the maximum over rows) in a scene with most of its energy in other, correctly solved bodies.

    python examples/residual_or_motion.py [FIGURE.png]
"""

import sys

import numpy as np
import panels  # noqa: F401 - prints --help

import lavender as lv
from lavender import suite

HEIGHTS = (10, 30, 100)
BUDGETS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048)


def light_beside_heavy():
    """Return a solved stack of three tonnes together with an unsolved body of one gram that falls on the ground."""
    mass = np.array([1000.0, 1000.0, 1000.0, 1e-3])
    jac = np.array([[1.0, 0, 0, 0], [-1, 1, 0, 0], [0, -1, 1, 0], [0, 0, 0, 1]])
    b = np.array([0.16, 0.0, 0.0, 0.16])
    problem = lv.Problem.lcp(
        jac @ np.diag(1.0 / mass) @ jac.T, b, name="a gram beside three tonnes"
    )
    return problem, lv.solve(problem, "direct").impulse * [1, 1, 1, 0]


def curve(name):
    """Return sweeps, residual and motion error of `pgs` on one case."""
    problem = suite.case(name).problem
    found = []
    for budget in BUDGETS:
        end = lv.solve(problem, "pgs", tol=0.0, max_iter=budget)
        found.append((budget, end.residual.relative, end.motion_error().relative))
    return np.array(found)


def numbers():
    """Return the curves by case, and both errors of the light body's scene."""
    problem, impulse = light_beside_heavy()
    error = lv.motion_error(problem, impulse)
    return {
        "curves": {
            name: curve(name)
            for name in (*(f"stack(n={n})" for n in HEIGHTS), "hang(n=33, tip_mass=1e4)")
        },
        "gram": (lv.residual(problem, impulse), error),
    }


def figure(found, path):
    """Draw motion error over residual along the sweeps of each case."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(5.6, 4.4), layout="constrained")
    ax = canvas.subplots()
    for name, values in found["curves"].items():
        ax.loglog(values[:, 1], values[:, 2], ".-", label=name)
    residual, error = found["gram"]
    ax.loglog(residual.relative, error.relative, "k*", ms=10, label="a gram beside three tonnes")
    ends = np.array([1e-5, 1.0])
    ax.loglog(ends, ends, "k-", lw=0.8)
    ax.set(
        xlabel="relative residual [-]",
        ylabel="relative motion error [-]",
        xlim=(1e-5, 2),
        ylim=(1e-5, 2),
    )
    ax.legend(fontsize=9)
    canvas.savefig(path, dpi=150)


def main(path="residual_or_motion.png"):
    """Print both errors when the residual first passes 1e-1 (or the sweeps end) and 1e-3, and of the light body."""
    found = numbers()
    print(f"{'case':<28}{'sweeps':>8}{'residual':>12}{'motion error':>14}{'factor':>9}")
    for name, values in found["curves"].items():
        for level in (1e-1, 1e-3):
            below = np.flatnonzero(values[:, 1] <= level)
            if len(below) or level == 1e-1:
                sweeps, residual, motion = values[below[0] if len(below) else -1]
                print(
                    f"{name:<28}{sweeps:>8.0f}{residual:>12.1e}{motion:>14.1e}{motion / residual:>9.1f}"
                )
    residual, error = found["gram"]
    factor = error.relative / residual.relative
    print(
        f"{'a gram beside three tonnes':<28}{'':>8}{residual.relative:>12.1e}{error.relative:>14.1e}{factor:>9.1e}"
    )
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
