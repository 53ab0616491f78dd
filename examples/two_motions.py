"""One problem with several solutions: Coulomb's law does not always determine the motion.

A pyramid of boxes slides over the ground. Solvers reach residuals at the round-off floor of float64 and disagree: their
motions differ by decimetres per second, and each satisfies every condition of the law. A higher accuracy cannot decide
between them; a named selection rule can: nearest to the warm start, maximum dissipation by friction, or the limit of
vanishing compliance. The convex cone law has a unique motion, at the price of lifting sliding bodies.

    python examples/two_motions.py [FIGURE.png]
"""

import sys

import numpy as np

import lavender as lv
from lavender import suite

CASE = "pyramidF(k=4, sliding=0.5)"
RULES = ("nearest", "dissipation", "compliant")


def places(problem):
    """Return the centres (n, 3) [m] of the bodies from the arms of their contacts: x_a + arm_a = x_b + arm_b."""
    rows = problem.rows
    at = np.full((rows.n_bodies, 3), np.nan)
    at[0] = 0.0
    for _ in range(rows.n_bodies):
        for (a, b), arm_a, arm_b in zip(rows.contact_body, rows.arm_a, rows.arm_b, strict=True):
            if min(a, b) < 0:
                continue
            if np.isnan(at[b, 0]):
                at[b] = at[a] + arm_a - arm_b
            elif np.isnan(at[a, 0]):
                at[a] = at[b] + arm_b - arm_a
    return at


def numbers():
    """Return the motions, the solvers' and the rules' choices, and the motion of the cone law."""
    problem = suite.case(CASE).problem
    found = lv.find_solutions(problem)
    cone = lv.find_solutions(problem.relaxed("cone"))[0]
    return {
        "problem": problem,
        "motions": found,
        "rules": {rule: found.motions.index(found.select(rule)) for rule in RULES},
        "picks": found.picks(),
        "cone": cone,
        "cone distance": lv.motion_error(problem, cone.impulse, reference=found[0].impulse),
    }


def furthest(motions):
    """Return the two motions with the largest distance."""
    p = motions.problem
    pairs = [(i, j) for i in range(len(motions)) for j in range(i)]
    return min(
        pairs, key=lambda ij: -lv.motion.measure_motion_distance(p, *(motions[k].impulse for k in ij)).speed
    )[::-1]


def figure(found, path):
    """Draw a side view of the two most distant motions: velocities in this plane, and their difference."""
    from matplotlib.figure import Figure

    problem, motions = found["problem"], found["motions"]
    at = places(problem)[:, [0, 2]]
    half = np.abs(problem.rows.arm_b[problem.rows.contact_body[:, 1] >= 0][0][[0, 2]])
    i, j = furthest(motions)
    velocities = [problem.velocity(motions[k].impulse)[:, [0, 2]] for k in (i, j)]
    apart = velocities[1] - velocities[0]
    shown = [
        (f"motion {i}", velocities[0]),
        (f"motion {j}", velocities[1]),
        (f"motion {j} minus motion {i}", apart),
    ]
    canvas = Figure(figsize=(7.2, 3.0), layout="constrained")
    panels = canvas.subplots(1, 3, sharex=True, sharey=True)
    for ax, (name, v) in zip(panels, shown, strict=True):
        for centre in at:
            ax.add_patch(_box(centre, half))
        size = float(np.hypot(*v.T).max())
        ax.quiver(
            *at.T, *v.T, angles="xy", scale_units="xy", scale=size / half.min() / 1.6, color="C3", width=0.009
        )
        ax.set(xlabel="x [m]", aspect="equal")
        ax.set_title(f"{name}\nup to {size:.2g} m/s", fontsize=10)
    panels[0].set(ylabel="height [m]")
    panels[0].autoscale_view()
    canvas.savefig(path, dpi=150)


def _box(centre, half):
    from matplotlib.patches import Rectangle

    return Rectangle(centre - half, *(2.0 * half), facecolor="0.9", edgecolor="0.4", lw=0.8)


def main(path="two_motions.png"):
    """Print the motions and the choices of rules and solvers, and save the figure."""
    found = numbers()
    print(found["motions"])
    for rule, i in found["rules"].items():
        print(f"rule {rule:<12} motion {i}")
    for solver, pick in found["picks"].items():
        where = (
            "not solved within 20000 sweeps"
            if pick is None
            else f"motion {pick.motion}, {pick.distance:.0e} m/s off"
        )
        print(f"{solver:<20} {where}")
    cone, error = found["cone"], found["cone distance"]
    print(f"cone law: one motion, lift {cone.separation_speed:.2g} m/s, {error.speed:.2g} m/s from motion 0")
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
