"""Order of the sweep and warm start: what each is worth at a fixed budget of sweeps.

Eight boxes on each other, projected Gauss-Seidel, 8 sweeps. b is zero but where boxes approach: at the ground
when all of them fall, at the top when only the top one comes down. A sweep that starts there and goes
on carries the impulse through all contacts in one pass; the opposite one moves it on by one contact.
Where each box stands on a heavier one, little comes back, and few passes are enough; among equal boxes most
comes back, and the order matters little. A random order does it in pieces, each seed otherwise.

Warm start: a small change of load, from the exact impulses before it, against a cold start.

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


def error(problem, impulse=None, sweeps=BUDGET, **order):
    """Relative residual after the budget."""
    return lv.solve(problem, "pgs", tol=0.0, max_iter=sweeps, impulse=impulse, **order).residual.relative


def numbers():
    """Residuals by order for three stacks, and warm against cold over budgets."""
    orders = {}
    for name, problem in cases().items():
        orders[name] = {
            "bottom up": error(problem, order="given"),
            "top down": error(problem, order="reverse"),
            "random": [error(problem, order="random", seed=seed) for seed in SEEDS],
        }
    before = lv.solve(falling(np.ones(N)), "direct", tol=1e-12).impulse
    changed = falling(np.ones(N), 1.0 + CHANGE)
    sweeps = (1, 2, 4, 8, 16, 32)
    return {
        "orders": orders,
        "sweeps": sweeps,
        "cold": [error(changed, np.zeros(N), n) for n in sweeps],
        "warm": [error(changed, before, n) for n in sweeps],
    }


def figure(found, path):
    """Orders on the left, warm start on the right."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(10, 4), layout="constrained")
    left, right = canvas.subplots(1, 2)
    for x, by in enumerate(found["orders"].values()):
        left.plot(
            [x] * len(by["random"]),
            by["random"],
            "o",
            color="0.6",
            label=f"random, {len(SEEDS)} seeds" if x == 0 else None,
        )
        left.plot(x, by["bottom up"], "^", color="C0", label="bottom up" if x == 0 else None)
        left.plot(x, by["top down"], "v", color="C1", label="top down" if x == 0 else None)
    left.set(yscale="log", ylabel=f"relative residual after {BUDGET} sweeps", xlim=(-0.5, 2.5))
    left.set_xticks(range(3), list(found["orders"]))
    left.legend()
    for name in ("cold", "warm"):
        right.loglog(found["sweeps"], found[name], "o-", label=name)
    right.set(xlabel="sweeps", ylabel="relative residual", title=f"load changed by {100 * CHANGE:g} %")
    right.legend()
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
    for n, cold, warm in zip(found["sweeps"], found["cold"], found["warm"], strict=True):
        print(f"{n:>3} sweeps   cold {cold:.2e}   warm {warm:.2e}   {cold / warm:.1f} times closer")
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
