"""Where residual and motion error disagree: a tall stack, a heavy end, and light things beside heavy ones.

The residual asks how far one more update would move an impulse. A tall stack answers "hardly", while the whole
stack still has to slow down: its slowest mode has an eigenvalue of (pi / 2n)^2 / 2 in the metric of d, and an
error in it shows with the square root of that; measured by doing nothing, which is wrong at the ground alone, the
factor from residual to motion error comes to about 0.9 sqrt(n). A heavy weight on a chain is worse: after a few
sweeps each joint is nearly content, and the weight falls all the same. The other way round, a light body far from
rest makes a large residual (V looks at the worst row) in a scene whose energy is elsewhere and right.

    python examples/residual_or_motion.py [FIGURE.png]
"""

import sys

import numpy as np

import lavender as lv
from lavender import suite

HEIGHTS = (10, 30, 100)
BUDGETS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048)


def light_beside_heavy():
    """A stack of three tonnes, solved, beside one gram that falls on the ground and is not."""
    mass = np.array([1000.0, 1000.0, 1000.0, 1e-3])
    jac = np.array([[1.0, 0, 0, 0], [-1, 1, 0, 0], [0, -1, 1, 0], [0, 0, 0, 1]])
    b = np.array([0.16, 0.0, 0.0, 0.16])
    problem = lv.Problem.lcp(jac @ np.diag(1.0 / mass) @ jac.T, b, name="a gram beside three tonnes")
    return problem, lv.solve(problem, "direct").impulse * [1, 1, 1, 0]


def curve(name):
    """Sweeps, residual and motion error of `pgs` on one case."""
    problem = suite.case(name).problem
    found = []
    for budget in BUDGETS:
        end = lv.solve(problem, "pgs", tol=0.0, max_iter=budget)
        found.append((budget, end.residual.relative, end.motion_error().relative))
    return np.array(found)


def numbers():
    """Curves by case, and both errors of the gram."""
    problem, impulse = light_beside_heavy()
    error = lv.motion_error(problem, impulse)
    return {
        "curves": {
            name: curve(name) for name in (*(f"stack(n={n})" for n in HEIGHTS), "hang(n=33, tip_mass=1e4)")
        },
        "gram": (lv.residual(problem, impulse), error),
    }


def figure(found, path):
    """Motion error over residual along the sweeps of each case."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(5.6, 4.4), layout="constrained")
    ax = canvas.subplots()
    for name, values in found["curves"].items():
        ax.loglog(values[:, 1], values[:, 2], ".-", label=name)
    residual, error = found["gram"]
    ax.loglog(residual.relative, error.relative, "k*", ms=10, label="a gram beside three tonnes")
    ends = np.array([1e-5, 1.0])
    ax.loglog(ends, ends, "k-", lw=0.8)
    ax.set(xlabel="relative residual [-]", ylabel="relative motion error [-]", xlim=(1e-5, 2), ylim=(1e-5, 2))
    ax.legend(fontsize=8)
    canvas.savefig(path)


def main(path="residual_or_motion.png"):
    """Print both errors where the residual first passes 1e-1 (or where the sweeps end) and 1e-3, and of the gram."""
    found = numbers()
    print(f"{'case':<28}{'sweeps':>8}{'residual':>12}{'motion error':>14}{'factor':>9}")
    for name, values in found["curves"].items():
        for level in (1e-1, 1e-3):
            below = np.flatnonzero(values[:, 1] <= level)
            if len(below) or level == 1e-1:
                sweeps, residual, motion = values[below[0] if len(below) else -1]
                print(f"{name:<28}{sweeps:>8.0f}{residual:>12.1e}{motion:>14.1e}{motion / residual:>9.1f}")
    residual, error = found["gram"]
    factor = error.relative / residual.relative
    print(
        f"{'a gram beside three tonnes':<28}{'':>8}{residual.relative:>12.1e}{error.relative:>14.1e}{factor:>9.1e}"
    )
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
