"""Exercise 4: friction bounds added to the toy QP: fixed boxes on the tangents, filled in by the normals.

Six unit boxes stand on each other, a contact each with a normal and one tangent (no rotation, so the
two directions do not couple). The top box is hit sideways. As a QP the tangents are bounded by
|l_t| <= mu N with a number N given beforehand:

    min 1/2 l.A l - b.l,    0 <= l_n,   -mu N <= l_t <= mu N

N = 0 is no friction; N unbounded glues the stack; N from the normals of the solve before is right here,
where the tangents do not change the normals, and the iteration N <- l_n ends after one round.
Coulomb's law solves for both at once.

    python examples/friction_bounds.py [FIGURE.png]

A file named after a panel holds it alone: friction.png, motion.png.
"""

import sys

import numpy as np
from panels import beside, save

import lavender as lv

N = 6
MU = 0.5
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step
PUSH = 0.4  # m/s, top box sideways
TOL = 1e-10


def problem():
    """Normal and tangent of each contact in turn: A (12, 12), b (12,)."""
    jacobian = np.eye(N) - np.eye(N, k=-1)
    down, sideways = np.full(N, -GRAVITY_STEP), np.zeros(N)
    sideways[-1] = PUSH
    a = np.kron(jacobian @ jacobian.T, np.eye(2))  # rows of a contact: normal, tangent
    b = -np.stack([jacobian @ down, jacobian @ sideways], axis=1).ravel()
    return lv.Problem.contact(a, b, np.full(N, MU), name="toy stack with friction")


def sideways_velocity(impulse):
    """Velocity of each box after the step (N,) [m/s]."""
    jacobian = np.eye(N) - np.eye(N, k=-1)
    start = np.zeros(N)
    start[-1] = PUSH
    return start + jacobian.T @ impulse[1::2]


def numbers():
    """Impulses without friction, with glue, with bounds filled in round by round, and with Coulomb's law."""
    toy = problem()
    none = toy.boxed(0.0)
    rounds = [lv.solve(none, "direct", tol=TOL).impulse]
    for _ in range(3):
        rounds.append(lv.solve(toy.boxed(rounds[-1][0::2]), "direct", tol=TOL).impulse)
    bounded = toy.boxed(rounds[-1][0::2])
    return {
        "problem": toy,
        "rounds": rounds,
        "glued": lv.solve(toy.boxed(1e6), "direct", tol=TOL).impulse,
        "osqp": lv.solve(bounded, "osqp", tol=1e-9).impulse,
        "pgs": lv.solve(bounded, "pgs", tol=TOL, max_iter=100_000).impulse,
        "coulomb": lv.solve(toy, "pgs", tol=TOL, max_iter=100_000),
    }


WAYS = (("no friction", "o:"), ("glued", "s--"), ("bounded", "D-"), ("Coulomb", "x"))


def ways(found):
    """Impulses (12,) by name."""
    rounds = found["rounds"]
    return dict(
        zip(
            (name for name, _ in WAYS),
            (rounds[0], found["glued"], rounds[-1], found["coulomb"].impulse),
            strict=True,
        )
    )


def draw_friction(axes, found):
    """Tangential impulses against their bounds."""
    contacts = np.arange(1, N + 1)
    bound = MU * found["rounds"][-1][0::2]
    axes.fill_between(contacts, -bound, bound, alpha=0.2, label=r"$|\lambda_t| \leq \mu \lambda_n$")
    for name, style in WAYS:
        axes.plot(contacts, ways(found)[name][1::2], style, label=name)
    axes.set(title="friction", xlabel="contact, from the ground", ylabel="tangential impulse [N s]")
    beside(axes)


def draw_motion(axes, found):
    """What the boxes do."""
    for name, style in WAYS:
        axes.plot(np.arange(1, N + 1), sideways_velocity(ways(found)[name]), style, label=name)
    axes.set(title="what the boxes do", xlabel="box, from the ground", ylabel="velocity sideways [m/s]")
    beside(axes)


PANELS = {"friction": draw_friction, "motion": draw_motion}


def main(path="friction_bounds.png"):
    """Print the table, save the figure."""
    found = numbers()
    print(f"{'contact':<22}" + "".join(f"{i + 1:>9}" for i in range(N)))
    print(f"{'normal':<22}" + "".join(f"{x + 0.0:>9.5f}" for x in found["rounds"][-1][0::2]))
    rows = [(f"tangent, round {i}", x) for i, x in enumerate(found["rounds"])]
    for name, impulse in [
        *rows,
        ("tangent, glued", found["glued"]),
        ("tangent, Coulomb", found["coulomb"].impulse),
    ]:
        print(f"{name:<22}" + "".join(f"{x + 0.0:>9.5f}" for x in impulse[1::2]))
    print(
        f"the top box slides: its tangent takes {abs(found['rounds'][-1][-1]):.5f} N s, {MU:g} of its normal; "
        f"glued it would take {abs(found['glued'][-1]):.2f}"
    )
    gap = max(np.abs(found["rounds"][-1] - found[name]).max() for name in ("osqp", "pgs"))
    print(f"direct, OSQP and projected Gauss-Seidel agree on the bounded QP within {gap:.1e} N s")
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
