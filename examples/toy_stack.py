"""Experiment 2: eight contacts of a stack as an LCP: what sweeps know, two residuals, two wrong conclusions.

Eight unit boxes stand on each other; contact i lies under box i. Box 5 has just been hit from below and
moves up, so contact 5 will open while the boxes above it are pushed. With v* the velocities before
the impulses and J the difference of neighbours,

    w = A l - b,   A = J J^T,   b = -J v*,       0 <= l  complementary to  w >= 0

The same as a quadratic program: minimise 1/2 l.A l - b.l over l >= 0. Its optimality conditions are the line above,
with w as the gradient, so a QP solver such as OSQP and a solver of the LCP have the same answer. At rest:
the eight impulses are the weights above each contact, and every slack is 0.

At contact 5 the ordinary residual |w| is 0 for A^-1 b, which pulls there, and is not 0 at the solution, where
the contact opens; r_p = |l - max(0, l - w)| is the other way round. That is why projections are measured by r_p.

Wrong: solve A l = b, then clamp the negative impulses to zero, once. The clamped contacts no longer pull, but
their neighbours were computed as if they did. Not much better: sweep as if nothing were bounded, and clamp after
each sweep. In mid-sweep impulses are negative, the rows that come after read them, and the end is not the solution.

A zero on the diagonal: a contact between two things that cannot move has an empty row, and w/A_ii is no number.
`d` falls back to the mean of the others; what approaches there has no solution, and the status says INFEASIBLE.

Wrong too: a residual of 0 means no penetration. The conditions are on velocities; a box that lies 50 mm
deep and does not approach is a solution. Depth is removed by the position projection, step by step.

    python examples/toy_stack.py [FIGURE.png]

A file named after a panel holds it alone: impulses.png, slacks.png, sweeps.png.
"""

import sys

import numpy as np
from panels import beside, save

import lavender as lv
from lavender.judge.measures import natural_map

N = 8
OPEN = 4  # index of the contact that opens
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step
KICK = 1.0  # m/s, box 5 upwards
SWEEPS = 400
SOLVERS = ("osqp", "direct", "pgs", "jacobi")
TOL = 1e-10  # relative residual
DEEP = 0.05  # m, penetration of the box at the start
STEPS = 40


def problem(kick=KICK):
    """The toy stack: A (8, 8) [1/kg], b (8,) [m/s]; at rest without the kick."""
    jacobian = np.eye(N) - np.eye(N, k=-1)  # velocity of a box minus that of the one below
    velocity = np.full(N, -GRAVITY_STEP)
    velocity[OPEN] += kick
    return lv.Problem.lcp(jacobian @ jacobian.T, -jacobian @ velocity, name="toy stack")


def clamped_after_each_sweep(toy):
    """Sweeps without bounds, each clamped at its end: impulse (8,), most negative impulse in mid-sweep, [N s]."""
    free = lv.Problem.linear(toy.dense(), toy.b)
    impulse, lowest = np.zeros(N), 0.0
    for _ in range(SWEEPS):
        swept = lv.solve(free, "gauss_seidel", impulse=impulse, tol=0.0, max_iter=1).impulse
        impulse, lowest = np.maximum(swept, 0.0), min(lowest, swept.min())
    return impulse, lowest


def immovable(toy):
    """The toy stack and a ninth contact, between things that cannot move and approach at 0.1 m/s."""
    a = np.zeros((N + 1, N + 1))
    a[:N, :N] = toy.dense()
    return lv.Problem.lcp(a, np.append(toy.b, 0.1), name="a zero on the diagonal")


def deep_box():
    """Relative residual over all rows [-] and depth [m] of each step of a box that starts DEEP in the ground."""
    scene = lv.Scene(solver="newton")
    scene.add_plane()
    scene.add_box(position=(0.0, 0.0, 0.5 - DEEP))
    sim = lv.Simulation(scene, report_residual=True)
    out = []
    for _ in range(STEPS):
        observation, *_, info = sim.step()
        out.append((info["residual"]["relative"], observation["contacts"]["depth"].max()))
    return np.array(out)


def numbers():
    """Impulse of every contact after each sweep, both residuals, the wrong way, and the deep box."""
    toy = problem()
    impulse = np.zeros((SWEEPS + 1, N))
    for sweep in range(SWEEPS):
        impulse[sweep + 1] = lv.solve(toy, "pgs", impulse=impulse[sweep], tol=0.0, max_iter=1).impulse
    equations = np.linalg.solve(toy.dense(), toy.b)
    clamped = np.maximum(equations, 0.0)
    exact = lv.solve(toy, "direct", tol=1e-12).impulse
    resting = lv.solve(problem(0.0), "direct", tol=1e-12)
    late, lowest = clamped_after_each_sweep(toy)
    points = {"A^-1 b": equations, "clamped": clamped, "solution": exact}
    return {
        "problem": toy,
        "resting": resting.impulse,
        "resting_slack": resting.slack,
        "as_qp": {name: lv.solve(problem(0.0), name, tol=TOL, max_iter=100_000) for name in SOLVERS},
        "late": late,
        "late_r_p": natural_map(toy, late),
        "lowest": lowest,
        "immovable": immovable(toy),
        "zero": lv.solve(immovable(toy), "pgs"),
        "impulse": impulse,  # (SWEEPS + 1, N) N s
        "r_p": np.array([natural_map(toy, x) for x in impulse]),
        "exact": exact,
        "exact_slack": toy.slack(exact),
        "clamped": clamped,
        "clamped_slack": toy.slack(clamped),
        "clamped_r_p": natural_map(toy, clamped),
        "points": points,
        # at the contact that opens: the ordinary residual [m/s] and r_p
        "ordinary": {k: abs(toy.slack(x)[OPEN]) for k, x in points.items()},
        "projected": {k: abs(x[OPEN] - max(0.0, x[OPEN] - toy.slack(x)[OPEN])) for k, x in points.items()},
        "deep": deep_box(),  # (STEPS, 2)
    }


def bars(axes, found, values):
    """A value of each contact, at rest and hit."""
    place = np.arange(1, N + 1)
    for shift, (name, impulse) in zip(
        (-0.2, 0.2), (("at rest", "resting"), ("hit from below", "exact")), strict=True
    ):
        axes.bar(place + shift, values(name, found[impulse]), 0.4, label=name)
    axes.axhline(0.0, color="k", linewidth=0.8)
    axes.set_xticks(place)
    beside(axes)


def draw_impulses(axes, found):
    """The solution's eight impulses, at rest with every solver's beside them."""
    bars(axes, found, lambda _, impulse: impulse)
    for (name, solution), marker in zip(found["as_qp"].items(), "x+1|", strict=True):
        axes.plot(np.arange(1, N + 1) - 0.2, solution.impulse, "k" + marker, markersize=8, label=name)
    axes.set(title="eight impulses, none negative", xlabel="contact, from the ground", ylabel="impulse [N s]")
    beside(axes)


def draw_slacks(axes, found):
    """The solution's eight slacks."""
    problems = {"at rest": problem(0.0), "hit from below": found["problem"]}
    bars(axes, found, lambda name, impulse: problems[name].slack(impulse))
    title = "eight slacks: 0 where an impulse acts, positive where the contact opens"
    axes.set(title=title, xlabel="contact, from the ground", ylabel="slack w [m/s]", ylim=(-0.02, None))


def draw_sweeps(axes, found):
    """Impulse of each contact against sweeps."""
    for i in range(N):
        axes.plot(np.arange(SWEEPS + 1), found["impulse"][:, i], color=f"C{i}", label=f"contact {i + 1}")
        axes.plot(SWEEPS, found["clamped"][i], "x", color=f"C{i}")
    axes.set(title="crosses: solved, then clamped", xlabel="sweeps", ylabel="impulse [N s]", xscale="symlog")
    beside(axes)


PANELS = {"impulses": draw_impulses, "slacks": draw_slacks, "sweeps": draw_sweeps}


def main(path="toy_stack.png"):
    """Print the tables, save the figure."""
    found = numbers()
    print(f"{'contact':<20}" + "".join(f"{i + 1:>9}" for i in range(N)))
    for name, what in (("at rest", "resting"), ("hit from below", "exact"), ("clamped once", "clamped")):
        print(f"{f'{name}, N s':<20}" + "".join(f"{x + 0.0:>9.4f}" for x in found[what]))
        print(f"{'  slack, m/s':<20}" + "".join(f"{x + 0.0:>9.4f}" for x in found[f"{what}_slack"].round(9)))
    print(f"\nat rest, to {TOL:g}: largest difference from OSQP's optimum of the QP, and largest |slack|")
    optimum = found["as_qp"]["osqp"].impulse
    for name, solution in found["as_qp"].items():
        apart = np.abs(solution.impulse - optimum).max()
        still = np.abs(solution.slack).max()
        print(f"{name:<14}{apart:>9.1e} N s{still:>9.1e} m/s   {solution.status.name.lower()}")
    for sweep in (0, 1, 4, 16, 64, SWEEPS):
        print(f"after {sweep:>3} sweeps  r_p {found['r_p'][sweep]:.2e}")
    print(
        f"solved, then clamped once  r_p {found['clamped_r_p']:.2e}: "
        f"boxes still approach at {-found['clamped_slack'].min():.3f} m/s"
    )
    print(
        f"clamped after each of {SWEEPS} sweeps  r_p {found['late_r_p']:.2e}: down to {found['lowest']:.3f} N s "
        f"in mid-sweep"
    )
    ninth = found["immovable"]
    with np.errstate(divide="ignore"):
        print(
            f"a zero on the diagonal: w/A_ii is {-ninth.b[-1] / ninth.dense()[-1, -1]}; "
            f"with d = {ninth.d[-1]:.3f} the status is {found['zero'].status.name}"
        )
    print(f"\n{'contact 5':<12}{'impulse':>10}{'|A l - b|':>12}{'r_p':>10}")
    for name, x in found["points"].items():
        print(
            f"{name:<12}{x[OPEN] + 0.0:>10.4f}{found['ordinary'][name]:>12.4f}{found['projected'][name]:>10.4f}"
        )
    first, last = found["deep"][0], found["deep"][-1]
    print(
        f"\na box {1e3 * DEEP:.0f} mm in the ground: relative residual {first[0]:.0e} at {1e3 * first[1]:.1f} mm, "
        f"{last[0]:.0e} at {1e3 * last[1]:.1f} mm after {STEPS} steps"
    )
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
