"""Experiment 3: the order of a sweep and the start of a solve: how much each changes the error.

Eight boxes are on each other, solved by projected Gauss-Seidel. b is not zero where bodies approach: at the ground if
all boxes fall, at the top if only the top box comes down. A sweep that starts there carries the impulse through all
contacts in one pass. A sweep in the opposite direction carries it one contact further. A random order carries the
impulse piece by piece, differently for every seed. If each box stands on a heavier one, the slowest part of the error
shrinks by 0.676 per sweep in every order, and a few sweeps are enough. Of equal boxes it shrinks by 0.962 per sweep
in every order, and the order matters little.

Which order is ahead, and by how much, depends on the measure of the error. The relative residual is the larger of an
energy and a velocity; r_p, max |e_n| and the distance to the solution, sqrt(x.A x), are printed beside it.

Warm start: if the load changes by 5 %, a solve that starts from the exact impulses before the change starts 20 times
closer than from zero.

Stale impulses. The error has parts that shrink at different rates. Differences between neighbours disappear in a few
sweeps. An excess or lack of impulse in all contacts together shrinks by cos^2(pi / 2n) per sweep (n = 8: 0.962), the
slowest part. If the impulses are matched to the wrong contacts (in reverse), the start is 9 times worse than zero,
but hardly any of this error is in the slow part: after some sweeps it is better than the cold start. If they are ten
times too large, as in a step that is ten times shorter, nearly all of the error is in the slow part, and it stays
worse.

    python examples/order_and_warm_start.py [FIGURE.png]

A file named after a panel shows it alone: lighter.png, starts.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv

N = 8
BUDGET = 8  # sweeps
SEEDS = range(20)
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step
BLOW = 1.0  # m/s, top box downwards
RATIO = 3.0  # mass of a box over that of the box on it
CHANGE = 0.05  # relative change of the load of the upper half
SWEEPS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
ORDERS = {"bottom up": "given", "top down": "reverse", "colored": "colored"}


def make_stack(mass, velocity):
    """Return the LCP of N boxes with masses (N,) [kg] and upward velocities (N,) [m/s], lowest first."""
    jacobian = np.eye(N) - np.eye(N, k=-1)
    return lv.Problem.lcp(jacobian @ np.diag(1.0 / mass) @ jacobian.T, -jacobian @ velocity)


def make_falling(mass, load=1.0):
    """Return the stack after one step of gravity, which is `load` times as large on the upper half."""
    velocity = np.full(N, -GRAVITY_STEP)
    velocity[N // 2 :] *= load
    return make_stack(mass, velocity)


def make_struck(mass):
    """Return the stack at rest, with a top box that comes down."""
    return make_stack(mass, np.where(np.arange(N) == N - 1, -BLOW, 0.0))


def make_cases():
    """Return the problems by name."""
    lighter_above = RATIO ** -np.arange(float(N))
    return {
        "falling, lighter above": make_falling(lighter_above),
        "falling, equal": make_falling(np.ones(N)),
        "struck, lighter above": make_struck(lighter_above),
    }


def measure_error(problem, impulse=None, sweeps=BUDGET, solver="pgs", **order):
    """Return the relative residual after so many sweeps, from `impulse` or from zero."""
    return lv.solve(
        problem, solver, tol=0.0, max_iter=sweeps, impulse=impulse, **order
    ).residual.relative


def measure_slowest_factors():
    """Return the factors by which a sweep shrinks the slowest part, of the orders above, by case [-]."""
    orders = [
        np.arange(N),
        np.arange(N)[::-1],
        *(np.random.default_rng(seed).permutation(N) for seed in SEEDS),
    ]

    def factor(a):
        return np.abs(np.linalg.eigvals(np.eye(N) - np.linalg.solve(np.tril(a), a))).max()

    return {
        name: [factor(problem.dense()[np.ix_(order, order)]) for order in orders]
        for name, problem in make_cases().items()
    }


def measure_all(problem, order):
    """Return the error after BUDGET sweeps over that of zero impulses, by measure [-]."""
    a = problem.dense()
    exact = lv.solve(problem, "direct", tol=1e-12).impulse
    swept = lv.solve(problem, "pgs", tol=0.0, max_iter=BUDGET, order=order).impulse

    def measure(impulse):
        error = impulse - np.maximum(0.0, impulse - problem.slack(impulse) / problem.d)
        distance = impulse - exact
        return {
            "energy": np.sqrt(problem.d @ error**2),
            "velocity": np.abs(problem.d * error).max(),
            "r_p": np.linalg.norm(np.minimum(impulse, problem.slack(impulse))),
            "max |e_n|": np.abs(error).max(),
            "distance": np.sqrt(distance @ a @ distance),
        }

    start = measure(np.zeros(N))
    return {name: size / start[name] for name, size in measure(swept).items()}


def compare_measures(problem):
    """Return the error of sweeps from the top over that of sweeps from the bottom, by measure [-]."""
    up, down = (measure_all(problem, order) for order in ("given", "reverse"))
    return {name: down[name] / up[name] for name in up}


def measure_slow_part(problem, impulse, exact):
    """Return the slowest part of an impulse's error over that of the zero impulse [-].

    A sweep from the bottom up multiplies the error by G = I - L^-1 A, L the lower triangle of A with its diagonal. The
    left eigenvector of G for its largest eigenvalue selects the slowest part.
    """
    a = problem.dense()
    values, vectors = np.linalg.eig((np.eye(N) - np.linalg.solve(np.tril(a), a)).T)
    slow = np.real(vectors[:, np.argmax(np.abs(values))])
    return abs(slow @ (impulse - exact)) / abs(slow @ exact)


def measure_orders():
    """Return the residual after BUDGET sweeps by case and order."""
    return {
        name: {
            "bottom up": measure_error(problem, order="given"),
            "top down": measure_error(problem, order="reverse"),
            "random": [measure_error(problem, order="random", seed=seed) for seed in SEEDS],
        }
        for name, problem in make_cases().items()
    }


def measure_histories(problem):
    """Return the residual after each of SWEEPS by order, of Jacobi, and of random orders (seeds, sweeps)."""
    out = {
        name: [measure_error(problem, sweeps=n, order=order) for n in SWEEPS]
        for name, order in ORDERS.items()
    }
    out["Jacobi"] = [measure_error(problem, sweeps=n, solver="jacobi") for n in SWEEPS]
    out["random"] = np.array(
        [
            [measure_error(problem, sweeps=n, order="random", seed=seed) for n in SWEEPS]
            for seed in SEEDS
        ]
    )
    return out


def make_starts():
    """Return the changed problem, its exact impulse, and the impulses from which its solve starts, by name."""
    before = lv.solve(make_falling(np.ones(N)), "direct", tol=1e-12).impulse
    changed = make_falling(np.ones(N), 1.0 + CHANGE)
    starts = {
        "cold": np.zeros(N),
        "warm": before,
        "in reverse": before[::-1],
        "10 x too large": 10.0 * before,
    }
    return changed, lv.solve(changed, "direct", tol=1e-12).impulse, starts


def measure_starts():
    """Return the residual after each of SWEEPS, the slow part of each start, and cold and reversed over 16 sweeps."""
    changed, exact, starts = make_starts()
    return {
        "residual": {
            name: np.array([measure_error(changed, start, n) for n in SWEEPS])
            for name, start in starts.items()
        },
        "slow": {name: measure_slow_part(changed, start, exact) for name, start in starts.items()},
        "cold and reversed": np.array(
            [
                [measure_error(changed, starts[k], n) for n in range(16)]
                for k in ("cold", "in reverse")
            ]
        ),
    }


def numbers():
    """Return residuals by order for three stacks, histories of one of them, and the starts over the sweeps."""
    return Numbers(
        orders=measure_orders,
        factors=measure_slowest_factors,
        measures=lambda: {
            name: compare_measures(problem) for name, problem in make_cases().items()
        },
        lighter=lambda: measure_histories(make_cases()["falling, lighter above"]),
        starts=measure_starts,
    )


def set_sweep_axis(axes):
    """Show the sweeps from 0 on, with even steps from 1 to 64."""
    axes.set_xscale("symlog", linthresh=1.0)
    axes.set_yscale("log")
    axes.set_xticks([0, 1, 4, 8, 16, 32, 64], ["0", "1", "4", "8", "16", "32", "64"])
    axes.minorticks_off()
    axes.set(xlabel="sweeps", ylabel="relative residual [-]")
    put_legend_right(axes)


def draw_lighter(axes, found):
    """Draw the residual by order; each box stands on one that is three times as heavy."""
    by = found["lighter"]
    low, high = by["random"].min(axis=0), by["random"].max(axis=0)
    axes.fill_between(SWEEPS, low, high, color="0.85", label=f"random, {len(SEEDS)} seeds")
    for (key, style), color in zip(
        (("bottom up", "^-"), ("top down", "v-"), ("colored", "s-"), ("Jacobi", "x--")),
        ("C0", "C1", "C2", "k"),
        strict=True,
    ):
        axes.plot(SWEEPS, by[key], style, color=color, markersize=4, label=key)
    axes.set_title("eight boxes falling, lighter above")
    set_sweep_axis(axes)


def draw_starts(axes, found):
    """Draw the residual from each start."""
    looks = {"10 x too large": "C3D-", "in reverse": "C1s-", "cold": "ko-", "warm": "C0^-"}
    for name, style in looks.items():
        axes.plot(SWEEPS, found["starts"]["residual"][name], style, markersize=4, label=name)
    axes.set_title(f"the load of the upper half has changed by {100 * CHANGE:g} %")
    set_sweep_axis(axes)


PANELS = {"lighter": draw_lighter, "starts": draw_starts}


def print_numbers(found):
    """Print the tables."""
    for name, by in found["orders"].items():
        random = by["random"]
        print(
            f"{name:<23} bottom up {by['bottom up']:.2e}   top down {by['top down']:.2e}   "
            f"random {min(random):.2e} to {max(random):.2e} ({max(random) / min(random):.1f} times)"
        )
    falling, equal, struck = found["orders"].values()
    print(
        f"after {BUDGET} sweeps bottom up is {falling['top down'] / falling['bottom up']:.1f} times closer "
        f"if boxes fall, lighter above,\n{100 * (equal['top down'] / equal['bottom up'] - 1):.1f} % if they are equal; "
        f"struck from above, top down is {struck['bottom up'] / struck['top down']:.1f} times closer"
    )
    print()
    for name, by in found["factors"].items():
        print(
            f"{name:<23} a sweep shrinks the slowest part by {min(by):.3f} to {max(by):.3f}, by the order"
        )
    print("\nerror of top down over that of bottom up, by measure")
    for name, by in found["measures"].items():
        print(f"{name:<23}" + "".join(f"   {measure} {ratio:.2f}" for measure, ratio in by.items()))
    starts = found["starts"]["residual"]
    print(f"\n{'sweeps':>9}" + "".join(f"{name:>16}" for name in starts))
    for i, n in enumerate(SWEEPS):
        print(f"{n:>9}" + "".join(f"{by[i]:>16.3g}" for by in starts.values()))
    print("slow part" + "".join(f"{x:>16.3g}" for x in found["starts"]["slow"].values()))
    cold, stale = found["starts"]["cold and reversed"]
    print(
        f"before the first sweep: warm {starts['cold'][0] / starts['warm'][0]:.0f} times closer than cold, in reverse "
        f"{starts['in reverse'][0] / starts['cold'][0]:.0f} times further; in reverse is behind for "
        f"{np.argmax(stale <= cold) - 1} sweeps"
    )
    last = {name: by[-1] for name, by in starts.items()}
    print(
        f"after {SWEEPS[-1]} sweeps: 10 x too large {last['10 x too large']:.3f} against {last['cold']:.3f} cold, "
        f"in reverse {last['in reverse']:.5f} against {last['warm']:.5f} warm"
    )


def main(path="order_and_warm_start.png"):
    """Print the tables and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
