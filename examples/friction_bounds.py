"""Exercise 4: friction bounds in the toy QP: fixed bounds on the tangents, computed from the normals.

Six boxes of 1 kg are on each other. Each contact has a normal and one tangent; without rotation the two directions do
not couple. The top box is hit sideways. As a QP the tangents are bounded by |l_t| <= mu N with numbers N given
beforehand:

    min 1/2 l.A l - b.l,    0 <= l_n,   -mu N <= l_t <= mu N

N = 0 is no friction. A very large N makes the stack one piece. With N from the normals of the previous solve the
iteration N <- l_n ends after one round here, because the tangents do not change the normals. Coulomb's law solves for
both at once.

    python examples/friction_bounds.py [FIGURE.png]

A file named after a panel shows it alone: friction.png, motion.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv

N = 6
MU = 0.5
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step
PUSH = 0.4  # m/s, top box sideways
TOL = 1e-10


def make_problem():
    """Return normal and tangent of each contact, one after the other: A (12, 12) [1/kg], b (12,) [m/s]."""
    jacobian = np.eye(N) - np.eye(N, k=-1)
    down = np.full(N, -GRAVITY_STEP)
    sideways = np.zeros(N)
    sideways[-1] = PUSH
    a = np.kron(jacobian @ jacobian.T, np.eye(2))  # rows of a contact: normal, tangent
    b = -np.stack([jacobian @ down, jacobian @ sideways], axis=1).ravel()
    return lv.Problem.contact(a, b, np.full(N, MU), tangents=1, name="toy stack with friction")


def get_sideways_velocity(impulse):
    """Return the velocity of each box after the step (N,) [m/s]."""
    jacobian = np.eye(N) - np.eye(N, k=-1)
    start = np.zeros(N)
    start[-1] = PUSH
    return start + jacobian.T @ impulse[1::2]


def solve_in_rounds():
    """Return the impulses [N s] without friction, then with bounds from the normals of the round before."""
    toy = make_problem()
    rounds = [lv.solve(toy.boxed(0.0), "direct", tol=TOL).impulse]
    for _ in range(3):
        rounds.append(lv.solve(toy.boxed(rounds[-1][0::2]), "direct", tol=TOL).impulse)
    return rounds


def numbers():
    """Return the impulses [N s] of the rounds, with huge bounds, by other solvers, and by Coulomb's law."""
    toy = make_problem()
    found = Numbers(
        rounds=solve_in_rounds,
        glued=lambda: lv.solve(toy.boxed(1e6), "direct", tol=TOL).impulse,
        bounded=lambda: toy.boxed(found["rounds"][-1][0::2]),
        osqp=lambda: lv.solve(found["bounded"], "osqp", tol=1e-9).impulse,
        pgs=lambda: lv.solve(found["bounded"], "pgs", tol=TOL, max_iter=100_000).impulse,
        coulomb=lambda: lv.solve(toy, "pgs", tol=TOL, max_iter=100_000),
    )
    return found


STYLES = {"no friction": "o:", "huge bounds": "s--", "bounds from normals": "D-", "Coulomb": "x"}


def get_impulses(found):
    """Return the impulses (12,) [N s] by the names of STYLES."""
    rounds = found["rounds"]
    return dict(
        zip(STYLES, (rounds[0], found["glued"], rounds[-1], found["coulomb"].impulse), strict=True)
    )


def draw_friction(axes, found):
    """Draw the tangential impulses and their bounds."""
    contacts = np.arange(1, N + 1)
    bound = MU * found["rounds"][-1][0::2]
    axes.fill_between(contacts, -bound, bound, alpha=0.2, label=r"$|\lambda_t| \leq \mu \lambda_n$")
    for name, impulse in get_impulses(found).items():
        axes.plot(contacts, impulse[1::2], STYLES[name], label=name)
    axes.set(title="friction", xlabel="contact, from the ground", ylabel="tangential impulse [N s]")
    put_legend_right(axes)


def draw_motion(axes, found):
    """Draw the velocities of the boxes."""
    for name, impulse in get_impulses(found).items():
        axes.plot(np.arange(1, N + 1), get_sideways_velocity(impulse), STYLES[name], label=name)
    axes.set(title="motion", xlabel="box, from the ground", ylabel="velocity sideways [m/s]")
    put_legend_right(axes)


PANELS = {"friction": draw_friction, "motion": draw_motion}


def print_numbers(found):
    """Print the table."""
    print(f"{'contact':<22}" + "".join(f"{i + 1:>9}" for i in range(N)))
    print(f"{'normal':<22}" + "".join(f"{x + 0.0:>9.5f}" for x in found["rounds"][-1][0::2]))
    rows = [(f"tangent, round {i}", x) for i, x in enumerate(found["rounds"])]
    for name, impulse in [
        *rows,
        ("tangent, huge bounds", found["glued"]),
        ("tangent, Coulomb", found["coulomb"].impulse),
    ]:
        print(f"{name:<22}" + "".join(f"{x + 0.0:>9.5f}" for x in impulse[1::2]))
    print(
        f"the top box slides: its tangent takes {abs(found['rounds'][-1][-1]):.5f} N s, {MU:g} of its normal; "
        f"with huge bounds it takes {abs(found['glued'][-1]):.2f}"
    )
    gap = max(np.abs(found["rounds"][-1] - found[name]).max() for name in ("osqp", "pgs"))
    print(f"direct, OSQP and projected Gauss-Seidel agree on the bounded QP within {gap:.1e} N s")


def main(path="friction_bounds.png"):
    """Print the table and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
