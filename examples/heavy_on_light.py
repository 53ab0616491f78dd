"""Failure mode: a heavy body on a light one. Each sweep leaves R/(1 + R) of the error; how soon that is all one sees.

A box of 1 kg lies on the ground, a box of R kg on it, one contact row each. A Gauss-Seidel sweep sees in the lower
row what the upper one pushed in the sweep before, so that the impulse grows to its size by one part in 1 + R:

    A = [[1, -1], [-1, 1 + 1/R]],   (L + D)^-1 U has the one eigenvalue R/(1 + R) beside 0

so that n sweeps leave (R/(1 + R))^n of all. In a scene each face has four corners with friction, and sweeps have to
share the load among them first: what the judge sees rises before it falls, then by little less than R/(1 + R) a sweep
allows, and slower in the end, when friction is what is left. So the formula is a rate, and not what n sweeps leave.

    python examples/heavy_on_light.py [FIGURE.png]

The chapter shows it as left.png.
"""

import sys

import numpy as np
from panels import beside, save

import lavender as lv

RATIO = 100.0  # R: mass of the upper box over that of the lower one
SWEEPS = 512
SHOWN = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step


def two_rows():
    """One contact row for each box: A (2, 2) [1/kg], b (2,) [m/s]."""
    a = np.array([[1.0, -1.0], [-1.0, 1.0 + 1.0 / RATIO]])
    return lv.Problem.lcp(a, [GRAVITY_STEP, 0.0], name="two rows")


def scene():
    """First problem of the gallery's scene: eight contacts with friction."""
    return lv.Simulation(lv.Scene("heavy_on_light", ratio=RATIO, warm_start=False)).constraint_problem()


def history(problem):
    """Relative residual after each sweep from 0 on."""
    return np.array(
        [lv.solve(problem, "pgs", tol=0, max_iter=n).residual.relative for n in range(SWEEPS + 1)]
    )


def numbers():
    """Both histories."""
    return {"one row a face": history(two_rows()), "four corners and friction": history(scene())}


def draw_left(axes, found):
    """What is left after each sweep."""
    for name, left in found.items():
        axes.semilogy(left, label=name.replace(" and", "\nand"))
    rate = (RATIO / (1.0 + RATIO)) ** np.arange(SWEEPS + 1)
    axes.semilogy(rate, "k:", label="$(R/(1+R))^n$")
    axes.set(title=f"{RATIO:g} kg on 1 kg", xlabel="sweeps n", ylabel="relative residual [-]")
    beside(axes)


PANELS = {"left": draw_left}


def main(path="heavy_on_light.png"):
    """Print the table, save the figure."""
    found = numbers()
    rate = RATIO / (1.0 + RATIO)
    print(f"R/(1 + R) = {rate:.4f}; what is left after n sweeps")
    print(f"{'n':>5}{'formula':>10}" + "".join(f"{name:>28}" for name in found))
    for n in SHOWN:
        print(f"{n:>5}{rate**n:>10.3f}" + "".join(f"{left[n]:>28.3f}" for left in found.values()))
    most = {name: left.max() for name, left in found.items()}
    print(f"at most {most['four corners and friction']:.2f} on the way with four corners and friction")
    late = found["four corners and friction"]
    print(f"its mean factor a sweep from 64 to 256: {(late[256] / late[64]) ** (1.0 / 192.0):.4f}")
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
