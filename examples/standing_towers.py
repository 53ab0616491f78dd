"""Why a tower falls that should stand: eigenvalues of one substep of the engine about rest.

With few warm-started sweeps a substep takes only the share kappa of what is left of a tower's slow sway. The sway
then rings like a spring with little damping, |z| = sqrt(1 - kappa). A contact that asks for its whole gap to be closed
within one substep feeds the gap back with gain 1; all gains above about kappa drive the sway. The engine lets a
bearing contact be where it is within the slop: gain 0.

    python examples/standing_towers.py [FIGURE.png]
"""

import sys

import numpy as np

from lavender.bench.stability import critical_gain, figure, modes, slowest

TOWERS = ((2, 4), (4, 4), (6, 4))  # boxes, sweeps
ORDERS = ("given", "symmetric", "alternating")


def numbers(towers=TOWERS):
    """Per tower and order: kappa, frequency [Hz] at 1/60 and 1/240 s, largest |z| of a substep with gains 0 and 1."""
    found = []
    for n, sweeps in towers:
        for order in ORDERS:
            still = modes(n, sweeps, 1 / 60, order=order)
            fine = modes(n, sweeps, 1 / 240, order=order)
            whole = modes(n, sweeps, 1 / 60, order=order, gain=1.0)
            most = [np.abs(m.z[0]) ** (1 / m.substeps) for m in (still, whole)]
            kappa, hertz = slowest(still)
            found.append((n, sweeps, order, kappa, hertz, slowest(fine)[1], *most))
    return found


def main(path="standing_towers.png"):
    """Print the table, save the figure."""
    print(
        f"{'boxes':>5}{'sweeps':>8}  {'order':<12}{'kappa':>10}{'Hz, 1/60 s':>12}{'Hz, 1/240 s':>13}{'|z|, g=0':>11}"
        f"{'|z|, g=1':>10}"
    )
    for n, sweeps, order, *values in numbers():
        print(
            f"{n:>5}{sweeps:>8}  {order:<12}"
            + "{:>10.2e}{:>12.2f}{:>13.2f}{:>11.6f}{:>10.4f}".format(*values)
        )
    for n, sweeps in TOWERS[1:]:
        gain, (kappa, _) = critical_gain(n, sweeps, 1 / 60, digits=1), slowest(modes(n, sweeps, 1 / 60))
        print(
            f"{n} boxes, {sweeps} sweeps: the first mode leaves the unit circle at g = {gain:.1e} (kappa {kappa:.1e})"
        )
    figure(path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
