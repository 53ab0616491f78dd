"""Experiment 2: a stack of eight boxes as an LCP: impulses, slacks and residual across sweeps, and two wrong methods.

Eight boxes of 1 kg are on each other; contact i is below box i. Box 5 was just hit from below and moves up, so
contact 5 opens while the boxes above it are pushed. With v* [m/s] the velocities before the impulses and J the
difference of neighbours,

    w = A l - b,   A = J J^T,   b = -J v*,       0 <= l  complementary to  w >= 0

The same as a quadratic program: minimise 1/2 l.A l - b.l over l >= 0. Its optimality conditions are the line above,
with w as the gradient, so a QP solver such as OSQP and an LCP solver have the same solution. At rest the eight
impulses are the weights above the contacts, and every slack is 0.

At contact 5 the ordinary residual |w| is 0 for A^-1 b, which pulls there, and is not 0 at the solution, where the
contact opens. r_p = |l - max(0, l - w)| is the other way round. Projected sweeps are therefore measured by r_p.

Wrong: solve A l = b and clamp the negative impulses to zero once. The clamped contacts no longer pull, but their
neighbours were computed as if they did. Also wrong: sweep without bounds and clamp after each sweep. Within a sweep
impulses are negative, the rows that follow read them, and the limit is not the solution.

A zero on the diagonal: a contact between two static bodies has an empty row, and w/A_ii is not a number. `d` then
uses the mean of the other diagonal entries. If such bodies approach, no solution exists, and the status is
INFEASIBLE.

A residual of 0 does not mean that nothing penetrates. The conditions are about velocities: a box 50 mm deep that does
not approach is a solution. The position projection reduces the depth step by step.

    python examples/toy_stack.py [FIGURE.png]

A file named after a panel shows it alone: impulses.png, slacks.png, by_sweep.png, residual.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv

N = 8
OPEN = 4  # index of the contact that opens
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step
KICK = 1.0  # m/s, box 5 upwards
SWEEPS = 400
SOLVERS = ("osqp", "direct", "pgs", "jacobi")
TOL = 1e-10  # relative residual
DEPTH = 0.05  # m, penetration of the deep box at the start
STEPS = 40


def compute_natural_map(problem, impulse):
    """Return |min(lambda, w)|, the natural map of impulses with the lower bound 0."""
    return float(np.linalg.norm(np.minimum(impulse, problem.slack(impulse))))


def make_problem(kick=KICK):
    """Return the toy stack: A (8, 8) [1/kg], b (8,) [m/s]; without a kick it is at rest."""
    jacobian = np.eye(N) - np.eye(N, k=-1)  # velocity of a box minus that of the box below it
    velocity = np.full(N, -GRAVITY_STEP)
    velocity[OPEN] += kick
    return lv.Problem.lcp(jacobian @ jacobian.T, -jacobian @ velocity, name="toy stack")


def sweep_by_hand(a, b, sweeps):
    """Return the impulse [N s] after so many sweeps of projected Gauss-Seidel, written as a loop."""
    impulse = np.zeros(len(b))
    for _ in range(sweeps):
        for i in range(len(b)):
            slack = sum(a[i] * impulse) - b[i]
            impulse[i] = max(0.0, impulse[i] - slack / a[i, i])
    return impulse


def clamp_after_each_sweep(toy):
    """Sweep without bounds and clamp at the end of each sweep: impulse (8,), lowest impulse within a sweep, [N s]."""
    free = lv.Problem.linear(toy.dense(), toy.b)
    impulse = np.zeros(N)
    lowest = 0.0
    for _ in range(SWEEPS):
        swept = lv.solve(free, "gauss_seidel", impulse=impulse, tol=0.0, max_iter=1).impulse
        impulse = np.maximum(swept, 0.0)
        lowest = min(lowest, swept.min())
    return impulse, lowest


def add_static_contact(toy):
    """Return the toy stack with a ninth contact, between static bodies that approach at 0.1 m/s."""
    a = np.zeros((N + 1, N + 1))
    a[:N, :N] = toy.dense()
    return lv.Problem.lcp(a, np.append(toy.b, 0.1), name="a zero on the diagonal")


def run_deep_box():
    """Return relative residual [-] and depth [m] of each step of a box that starts DEPTH in the ground."""
    scene = lv.Scene(solver="newton")
    scene.add_plane()
    scene.add_box(position=(0.0, 0.0, 0.5 - DEPTH))
    sim = lv.Simulation(scene, report_residual=True)
    out = []
    for _ in range(STEPS):
        observation, *_, info = sim.step()
        out.append((info["residual"]["relative"], observation["contacts"]["depth"].max()))
    return np.array(out)


def sweep_one_by_one():
    """Return the impulses (SWEEPS + 1, 8) [N s] after each sweep of `pgs` from zero."""
    toy = make_problem()
    impulse = np.zeros((SWEEPS + 1, N))
    for sweep in range(SWEEPS):
        impulse[sweep + 1] = lv.solve(
            toy, "pgs", impulse=impulse[sweep], tol=0.0, max_iter=1
        ).impulse
    return impulse


def solve_exactly(toy):
    """Return the impulse (8,) [N s] by the direct solver."""
    return lv.solve(toy, "direct", tol=1e-12).impulse


def largest_active_slack(found):
    """Return after each sweep the largest |w| [m/s] of the contacts that carry an impulse in the solution."""
    slack = found["impulse"] @ found["problem"].dense() - found["problem"].b
    return np.abs(slack[:, found["exact"] > 0.0]).max(axis=1)


def numbers():
    """Return the solutions at rest and hit, the impulses sweep by sweep, the wrong methods and the deep box."""
    found = Numbers(
        problem=make_problem,
        exact=lambda: solve_exactly(found["problem"]),
        resting=lambda: solve_exactly(make_problem(0.0)),
        as_qp=lambda: {
            n: lv.solve(make_problem(0.0), n, tol=TOL, max_iter=100_000) for n in SOLVERS
        },
        impulse=sweep_one_by_one,
        r_p=lambda: np.array([compute_natural_map(found["problem"], x) for x in found["impulse"]]),
        active_slack=lambda: largest_active_slack(found),
        equations=lambda: np.linalg.solve(found["problem"].dense(), found["problem"].b),
        clamped=lambda: np.maximum(found["equations"], 0.0),
        late=lambda: clamp_after_each_sweep(found["problem"]),
        static=lambda: add_static_contact(found["problem"]),
        deep=run_deep_box,
    )
    return found


def draw_bars(axes, found, values):
    """Draw a value of each contact, at rest and hit."""
    place = np.arange(1, N + 1)
    for shift, (name, key) in zip(
        (-0.2, 0.2), (("at rest", "resting"), ("hit from below", "exact")), strict=True
    ):
        axes.bar(place + shift, values(name, found[key]), 0.4, label=name)
    axes.axhline(0.0, color="k", linewidth=0.8)
    axes.set_xticks(place)
    put_legend_right(axes)


def draw_impulses(axes, found):
    """Draw the eight impulses of the solution, at rest with those of every solver."""
    draw_bars(axes, found, lambda _, impulse: impulse)
    for (name, solution), marker in zip(found["as_qp"].items(), "x+1|", strict=True):
        axes.plot(
            np.arange(1, N + 1) - 0.2, solution.impulse, "k" + marker, markersize=8, label=name
        )
    axes.set(
        title="eight impulses, none negative",
        xlabel="contact, from the ground",
        ylabel="impulse [N s]",
    )
    put_legend_right(axes)


def draw_slacks(axes, found):
    """Draw the eight slacks of the solution."""
    problems = {"at rest": make_problem(0.0), "hit from below": found["problem"]}
    draw_bars(axes, found, lambda name, impulse: problems[name].slack(impulse))
    title = "eight slacks: 0 where an impulse acts, positive where the contact opens"
    axes.set(
        title=title, xlabel="contact, from the ground", ylabel="slack w [m/s]", ylim=(-0.02, None)
    )


def draw_by_sweep(axes, found):
    """Draw the impulse of each contact against the sweeps."""
    for i in range(N):
        axes.plot(
            np.arange(SWEEPS + 1), found["impulse"][:, i], color=f"C{i}", label=f"contact {i + 1}"
        )
        axes.plot(SWEEPS, found["clamped"][i], "x", color=f"C{i}")
    axes.set(
        title="crosses: solved without bounds, then clamped once",
        xlabel="sweeps",
        ylabel="impulse [N s]",
        xscale="symlog",
    )
    put_legend_right(axes)


def draw_residual(axes, found):
    """Draw r_p and the largest slack of the loaded contacts against the sweeps."""
    sweeps = np.arange(SWEEPS + 1)
    axes.semilogy(sweeps, np.maximum(found["r_p"], 1e-17), label="$r_p$ [N s]")
    axes.semilogy(
        sweeps,
        np.maximum(found["active_slack"], 1e-17),
        "--",
        label="largest |w| of\nloaded contacts [m/s]",
    )
    opening = np.abs(
        found["impulse"] @ found["problem"].dense()[:, OPEN] - found["problem"].b[OPEN]
    )
    axes.semilogy(sweeps, opening, ":", color="k", label="|w| of contact 5,\nwhich opens [m/s]")
    axes.set(
        title="projected Gauss-Seidel, hit from below",
        xlabel="sweeps",
        xlim=(0, 200),
        ylim=(1e-16, 3),
    )
    put_legend_right(axes)


PANELS = {
    "impulses": draw_impulses,
    "slacks": draw_slacks,
    "by_sweep": draw_by_sweep,
    "residual": draw_residual,
}


def print_numbers(found):
    """Print the tables."""
    toy = found["problem"]
    resting = make_problem(0.0)
    print(f"{'contact':<20}" + "".join(f"{i + 1:>9}" for i in range(N)))
    for name, key, problem in (
        ("at rest", "resting", resting),
        ("hit from below", "exact", toy),
        ("clamped once", "clamped", toy),
    ):
        slack = problem.slack(found[key])
        print(f"{f'{name}, N s':<20}" + "".join(f"{x + 0.0:>9.4f}" for x in found[key]))
        print(f"{'  slack, m/s':<20}" + "".join(f"{x + 0.0:>9.4f}" for x in slack.round(9)))
    print(
        f"\nat rest, to {TOL:g}: largest difference from OSQP's optimum of the QP, and largest |slack|"
    )
    optimum = found["as_qp"]["osqp"].impulse
    for name, solution in found["as_qp"].items():
        distance = np.abs(solution.impulse - optimum).max()
        slack = np.abs(solution.slack).max()
        print(f"{name:<14}{distance:>9.1e} N s{slack:>9.1e} m/s   {solution.status.name.lower()}")
    for sweep in (0, 1, 4, 16, 64, SWEEPS):
        print(
            f"after {sweep:>3} sweeps  r_p {found['r_p'][sweep]:.2e}  largest |w| of loaded contacts "
            f"{found['active_slack'][sweep]:.2e} m/s"
        )
    differs = [
        n
        for n in (1, 4, 16, 64, SWEEPS)
        if (sweep_by_hand(toy.dense(), toy.b, n) != found["impulse"][n]).any()
    ]
    print(f"the loop of the page differs from pgs after {differs or 'no'} sweeps")
    clamped = toy.slack(found["clamped"])
    print(
        f"solved, then clamped once  r_p {compute_natural_map(toy, found['clamped']):.2e}: "
        f"boxes still approach at {-clamped.min():.3f} m/s"
    )
    late, lowest = found["late"]
    print(
        f"clamped after each of {SWEEPS} sweeps  r_p {compute_natural_map(toy, late):.2e}: down to {lowest:.3f} N s "
        f"within a sweep"
    )
    ninth = found["static"]
    with np.errstate(divide="ignore"):
        print(
            f"a zero on the diagonal: w/A_ii is {-ninth.b[-1] / ninth.dense()[-1, -1]}; "
            f"with d = {ninth.d[-1]:.3f} the status is {lv.solve(ninth, 'pgs').status.name}"
        )
    print(f"\n{'contact 5':<12}{'impulse':>10}{'|A l - b|':>12}{'r_p':>10}")
    for name, key in (("A^-1 b", "equations"), ("clamped", "clamped"), ("solution", "exact")):
        x = found[key][OPEN]
        w = toy.slack(found[key])[OPEN]
        print(f"{name:<12}{x + 0.0:>10.4f}{abs(w):>12.4f}{abs(x - max(0.0, x - w)):>10.4f}")
    first, last = found["deep"][0], found["deep"][-1]
    print(
        f"\na box {1e3 * DEPTH:.0f} mm in the ground: relative residual {first[0]:.0e} at {1e3 * first[1]:.1f} mm, "
        f"{last[0]:.0e} at {1e3 * last[1]:.1f} mm after {STEPS} steps"
    )


def main(path="toy_stack.png"):
    """Print the tables and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
