"""Failure mode: a heavy body on a light one. Each sweep leaves R/(1 + R) of the error.

A box of 1 kg lies on the ground and a box of R kg on it, one contact row each. In a Gauss-Seidel sweep the lower row
reads the impulse of the upper row from the sweep before, so the impulse approaches its size by one part in 1 + R:

    A = [[1, -1], [-1, 1 + 1/R]],   (L + D)^-1 U has the one eigenvalue R/(1 + R) beside 0

so n sweeps leave (R/(1 + R))^n of the error. In a scene each face has four corners with friction, and the sweeps
share the load among them first. The relative residual rises before it falls; then it falls by nearly R/(1 + R) per
sweep, and more slowly in the end, when the error is in the friction. So the formula is a rate, not the error after n
sweeps.

    python examples/heavy_on_light.py [FIGURE.png]

The chapter shows it as left.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv

RATIO = 100.0  # R: mass of the upper box over that of the lower one
SWEEPS = 512
SHOWN = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step


def make_two_rows():
    """Return one contact row for each box: A (2, 2) [1/kg], b (2,) [m/s]."""
    a = np.array([[1.0, -1.0], [-1.0, 1.0 + 1.0 / RATIO]])
    return lv.Problem.lcp(a, [GRAVITY_STEP, 0.0], name="two rows")


def make_scene_problem():
    """Return the first problem of the gallery's scene: eight contacts with friction."""
    return lv.Simulation(
        lv.Scene("heavy_on_light", ratio=RATIO, warm_start=False)
    ).constraint_problem()


def measure_history(problem):
    """Return the relative residual after each sweep from 0 on."""
    return np.array(
        [lv.solve(problem, "pgs", tol=0, max_iter=n).residual.relative for n in range(SWEEPS + 1)]
    )


def numbers():
    """Return both histories."""
    return Numbers(
        **{
            "one row a face": lambda: measure_history(make_two_rows()),
            "four corners and friction": lambda: measure_history(make_scene_problem()),
        }
    )


def draw_left(axes, found):
    """Draw the residual after each sweep."""
    for name, left in found.items():
        axes.semilogy(left, label=name.replace(" and", "\nand"))
    rate = (RATIO / (1.0 + RATIO)) ** np.arange(SWEEPS + 1)
    axes.semilogy(rate, "k:", label="$(R/(1+R))^n$")
    axes.set(title=f"{RATIO:g} kg on 1 kg", xlabel="sweeps n", ylabel="relative residual [-]")
    put_legend_right(axes)


PANELS = {"left": draw_left}


def print_numbers(found):
    """Print the table."""
    rate = RATIO / (1.0 + RATIO)
    print(f"R/(1 + R) = {rate:.4f}; relative residual after n sweeps")
    print(f"{'n':>5}{'formula':>10}" + "".join(f"{name:>28}" for name in found))
    for n in SHOWN:
        print(f"{n:>5}{rate**n:>10.3f}" + "".join(f"{left[n]:>28.3f}" for left in found.values()))
    most = {name: left.max() for name, left in found.items()}
    print(f"with four corners and friction it rises to {most['four corners and friction']:.2f}")
    late = found["four corners and friction"]
    print(
        f"its mean factor per sweep from 64 to 256 sweeps: {(late[256] / late[64]) ** (1.0 / 192.0):.4f}"
    )


def main(path="heavy_on_light.png"):
    """Print the table and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
