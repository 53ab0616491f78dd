"""One problem with three solutions: Coulomb's law does not always determine the motion.

A rod slides on its tip over rough ground (Painleve). Its contact can leave, stick or slide, and each satisfies every
condition of the law, in closed form. With A the Delassus matrix, b the target, mu the coefficient of friction and
w = A l - b the velocity of the tip:

    open     l = 0                                           needs w_n >= 0
    sticks   A l = b                                         needs |l_t| <= mu l_n
    slides   l_t = -s mu l_n,  l_n = b_n / (A_nn - s mu A_nt)   needs l_n >= 0 and s w_t >= 0, s = +-1

A higher accuracy cannot decide between them: each has the residual of rounding. Which one a solver finds depends on its
method and its start. The convex cone law has a unique motion, at the price of lifting bodies that slide.

    python examples/two_motions.py
"""

import numpy as np

import lavender as lv
from lavender import suite

STARTS = ("open", "sticks")  # Motions whose impulse is a start.


def motions(problem):
    """Return {mode: impulse (2,) [N s]} of every solution of a problem of one contact with one tangent."""
    (a_nn, a_nt), (_, a_tt) = problem.dense()
    (b_n, b_t) = problem.b
    mu = problem.cones.mu[0]
    found = {"open": np.zeros(2)} if b_n <= 0.0 else {}
    sticks = np.linalg.solve(problem.dense(), problem.b)
    if abs(sticks[1]) <= mu * sticks[0]:
        found["sticks"] = sticks
    for s, name in ((1.0, "slides forwards"), (-1.0, "slides backwards")):
        normal = b_n / (a_nn - s * mu * a_nt)
        slides = np.array([normal, -s * mu * normal])
        if normal > 0.0 and s * (a_nt * slides[0] + a_tt * slides[1] - b_t) >= 0.0:
            found[name] = slides
    return found


def numbers():
    """Return the problem, its motions, and the motion that each solver finds from each start."""
    problem = suite.case("painleve").problem
    found = motions(problem)
    picks = {}
    for solver in lv.available(problem):
        for start in STARTS if lv.get(solver).impulse else ():
            end = lv.solve(problem, solver, impulse=found[start], tol=1e-9)
            off = {
                name: lv.motion_error(problem, end.impulse, reference=x).rows
                for name, x in found.items()
            }
            picks[solver, start] = min(off, key=off.get) if end.success else "not solved"
    return {"problem": problem, "motions": found, "picks": picks}


def main():
    """Print the motions, the motion that each solver finds, and the motion of the cone law."""
    found = numbers()
    problem = found["problem"]
    for name, impulse in found["motions"].items():
        normal, tangent = problem.slack(impulse)
        relative = lv.residual(problem, impulse).relative
        print(
            f"{name:<18} tip at {normal:5.2f}, {tangent:5.2f} m/s, relative residual {relative:.0e}"
        )
    for (solver, start), name in found["picks"].items():
        print(f"{solver:<20} from the impulse of {start!r}: {name}")
    cone = lv.solve(problem.relaxed("cone"), tol=1e-12)
    print(
        "cone law: one motion, tip at {:.2f}, {:.2f} m/s".format(*(cone.slack.round(2) + 0.0))
    )  # no -0.00


if __name__ == "__main__":
    main()
