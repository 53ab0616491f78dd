"""Experiment 3: order of the sweep and warm start: what each is worth.

Eight boxes on each other, projected Gauss-Seidel. b is zero but where boxes approach: at the ground
when all of them fall, at the top when only the top one comes down. A sweep that starts there and goes
on carries the impulse through all contacts in one pass; the opposite one moves it on by one contact.
Where each box stands on a heavier one, little comes back, and few passes are enough; among equal boxes most
comes back, and the order matters little. A random order does it in pieces, each seed otherwise.

Warm start: a small change of load, from the exact impulses before it, begins as much closer as the load has
changed little: 20 times for 5 %, before the first sweep. Stale impulses hurt: the same numbers, matched to the
wrong contacts (in reverse), begin 9 times further off than nothing at all, and stay behind for some sweeps.

    python examples/order_and_warm_start.py [FIGURE.png]
"""

import sys

import numpy as np

import lavender as lv

N = 8
BUDGET = 8
SEEDS = range(20)
GRAVITY_STEP = 9.81 / 60.0  # m/s
BLOW = 1.0  # m/s, top box downwards
RATIO = 3.0  # mass of a box over that of the one on it
CHANGE = 0.05  # relative change of the load
SWEEPS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
ORDERS = {"bottom up": "given", "top down": "reverse", "colored": "colored"}


def stack(mass, velocity):
    """N contacts of boxes with masses (N,) [kg] and velocities (N,) [m/s] upwards, lowest first."""
    jacobian = np.eye(N) - np.eye(N, k=-1)
    return lv.Problem.lcp(jacobian @ np.diag(1.0 / mass) @ jacobian.T, -jacobian @ velocity)


def falling(mass, load=1.0):
    """All boxes after one step of gravity, `load` times as much on the upper half."""
    velocity = np.full(N, -GRAVITY_STEP)
    velocity[N // 2 :] *= load
    return stack(mass, velocity)


def struck(mass):
    """At rest, but the top box comes down."""
    return stack(mass, np.where(np.arange(N) == N - 1, -BLOW, 0.0))


def cases():
    """Name -> problem."""
    lighter_above = RATIO ** -np.arange(float(N))
    return {
        "falling, lighter above": falling(lighter_above),
        "falling, equal": falling(np.ones(N)),
        "struck, lighter above": struck(lighter_above),
    }


def error(problem, impulse=None, sweeps=BUDGET, solver="pgs", **order):
    """Relative residual after that many sweeps, from `impulse` or from zero."""
    return lv.solve(problem, solver, tol=0.0, max_iter=sweeps, impulse=impulse, **order).residual.relative


def histories(problem):
    """Residual after each of SWEEPS by order, of Jacobi, and of random orders (seeds, sweeps)."""
    out = {name: [error(problem, sweeps=n, order=order) for n in SWEEPS] for name, order in ORDERS.items()}
    out["Jacobi"] = [error(problem, sweeps=n, solver="jacobi") for n in SWEEPS]
    out["random"] = np.array(
        [[error(problem, sweeps=n, order="random", seed=seed) for n in SWEEPS] for seed in SEEDS]
    )
    return out


def numbers():
    """Residuals by order for three stacks, histories of two of them, and warm, stale and cold over sweeps."""
    orders = {}
    for name, problem in cases().items():
        orders[name] = {
            "bottom up": error(problem, order="given"),
            "top down": error(problem, order="reverse"),
            "random": [error(problem, order="random", seed=seed) for seed in SEEDS],
        }
    before = lv.solve(falling(np.ones(N)), "direct", tol=1e-12).impulse
    changed = falling(np.ones(N), 1.0 + CHANGE)
    starts = {"cold": np.zeros(N), "warm": before, "stale": before[::-1].copy()}
    return {
        "orders": orders,
        "histories": {
            name: histories(cases()[name]) for name in ("falling, lighter above", "falling, equal")
        },
        **{name: np.array([error(changed, start, n) for n in SWEEPS]) for name, start in starts.items()},
        "behind": np.array([[error(changed, starts[k], n) for n in range(16)] for k in ("cold", "stale")]),
    }


def beside(axes):
    """The legend beside the axes, where it covers nothing."""
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


def against_sweeps(axes):
    """Sweeps from 0 on, even steps from 1 to 64."""
    axes.set_xscale("symlog", linthresh=1.0)
    axes.set_yscale("log")
    axes.set_xticks([0, 1, 4, 8, 16, 32, 64], ["0", "1", "4", "8", "16", "32", "64"])
    axes.minorticks_off()
    axes.set(xlabel="sweeps", ylabel="relative residual")


def figure(found, path):
    """Histories by order, the orders of three stacks at one budget, and where a solve begins."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(8, 11), layout="constrained")
    axes = canvas.subplots(4, 1)
    for ax, (name, by) in zip(axes, found["histories"].items(), strict=False):
        ax.fill_between(
            SWEEPS,
            by["random"].min(axis=0),
            by["random"].max(axis=0),
            color="0.85",
            label=f"random, {len(SEEDS)} seeds",
        )
        for (key, style), color in zip(
            (("bottom up", "^-"), ("top down", "v-"), ("colored", "s-"), ("Jacobi", "x--")),
            ("C0", "C1", "C2", "k"),
            strict=True,
        ):
            ax.plot(SWEEPS, by[key], style, color=color, markersize=4, label=key)
        ax.set_title(f"eight boxes {name}")
        against_sweeps(ax)
        beside(ax)
    places = axes[2]
    for x, by in enumerate(found["orders"].values()):
        first = x == 0
        places.plot(
            [x] * len(by["random"]), by["random"], "o", color="0.7", label="random" if first else None
        )
        places.plot(x, by["bottom up"], "^", color="C0", label="bottom up" if first else None)
        places.plot(x, by["top down"], "v", color="C1", label="top down" if first else None)
    places.set(yscale="log", title=f"after {BUDGET} sweeps", ylabel="relative residual", xlim=(-0.5, 2.5))
    places.set_xticks(range(3), list(found["orders"]))
    beside(places)
    start = axes[3]
    for (name, label), style in zip(
        (("stale", "matched to the\nwrong contacts"), ("cold", "cold"), ("warm", "warm")),
        ("rs-", "ko-", "C0^-"),
        strict=True,
    ):
        start.plot(SWEEPS, found[name], style, markersize=4, label=label)
    start.set_title(f"the load has changed by {100 * CHANGE:g} %")
    against_sweeps(start)
    beside(start)
    canvas.savefig(path)


def main(path="order_and_warm_start.png"):
    """Print the numbers, save the figure."""
    found = numbers()
    for name, by in found["orders"].items():
        random = by["random"]
        print(
            f"{name:<23} bottom up {by['bottom up']:.2e}   top down {by['top down']:.2e}   "
            f"random {min(random):.2e} to {max(random):.2e} ({max(random) / min(random):.1f} times)"
        )
    falling, equal, struck = found["orders"].values()
    print(
        f"after {BUDGET} sweeps bottom up is {falling['top down'] / falling['bottom up']:.1f} times closer where boxes "
        f"fall, lighter above,\n{100 * (equal['top down'] / equal['bottom up'] - 1):.1f} % among equal ones; "
        f"struck from above, top down is {struck['bottom up'] / struck['top down']:.1f} times closer"
    )
    print(f"\n{'sweeps':>6}{'cold':>12}{'warm':>12}{'stale':>12}")
    for i, n in enumerate(SWEEPS):
        print(f"{n:>6}" + "".join(f"{found[k][i]:>12.2e}" for k in ("cold", "warm", "stale")))
    cold, stale = found["behind"]
    behind = np.argmax(stale <= cold) - 1
    print(
        f"before the first sweep: warm {found['cold'][0] / found['warm'][0]:.0f} times closer than cold, "
        f"stale {found['stale'][0] / found['cold'][0]:.0f} times further, and behind for {behind} sweeps"
    )
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
