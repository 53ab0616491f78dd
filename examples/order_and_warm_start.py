"""Experiment 3: order of the sweep and warm start: what each is worth.

Eight boxes on each other, projected Gauss-Seidel. b is zero but where boxes approach: at the ground
when all of them fall, at the top when only the top one comes down. A sweep that starts there and goes
on carries the impulse through all contacts in one pass; the opposite one moves it on by one contact.
Where each box stands on a heavier one, little comes back, and few passes are enough; among equal boxes most
comes back, and the order matters little. A random order does it in pieces, each seed otherwise.

Warm start: a small change of load, from the exact impulses before it, begins as much closer as the load has
changed little: 20 times for 5 %, before the first sweep.

Stale impulses hurt for as long as sweeps take to remove what is wrong with them. The error has parts that die at
different rates: neighbours that disagree are put right in a few sweeps, an impulse that is missing or too much in all
contacts together shrinks by cos^2(pi / 2n) a sweep (n = 8: 0.962), the slowest part of all. Matched to the wrong
contacts (in reverse), the same numbers begin 9 times further off than nothing at all, but hardly any of that is of the
slow part: they are behind for some sweeps and then ahead. Ten times too large, as after a load that is gone or in a
step that is ten times shorter, they begin as far off, all of it of the slow part: behind nothing at all for good.

    python examples/order_and_warm_start.py [FIGURE.png]

A file named after a panel holds it alone: lighter.png, starts.png.
"""

import sys

import numpy as np
from panels import beside, save

import lavender as lv

N = 8
BUDGET = 8
SEEDS = range(20)
GRAVITY_STEP = 9.81 / 100.0  # m/s, gravity over one step
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


def slow_part(problem, impulse, exact):
    """The slowest part of an impulse's error, of that of no impulse [-]: as that part is left, sweep after sweep.

    A sweep from the bottom up multiplies the error by G = I - (L + D)^-1 A; a left eigenvector of G picks one part.
    """
    a = problem.dense()
    values, vectors = np.linalg.eig((np.eye(N) - np.linalg.solve(np.tril(a), a)).T)
    slow = np.real(vectors[:, np.argmax(np.abs(values))])
    return abs(slow @ (impulse - exact)) / abs(slow @ exact)


def histories(problem):
    """Residual after each of SWEEPS by order, of Jacobi, and of random orders (seeds, sweeps)."""
    out = {name: [error(problem, sweeps=n, order=order) for n in SWEEPS] for name, order in ORDERS.items()}
    out["Jacobi"] = [error(problem, sweeps=n, solver="jacobi") for n in SWEEPS]
    out["random"] = np.array(
        [[error(problem, sweeps=n, order="random", seed=seed) for n in SWEEPS] for seed in SEEDS]
    )
    return out


def numbers():
    """Residuals by order for three stacks, histories of one of them, and warm, stale and cold over sweeps."""
    orders = {}
    for name, problem in cases().items():
        orders[name] = {
            "bottom up": error(problem, order="given"),
            "top down": error(problem, order="reverse"),
            "random": [error(problem, order="random", seed=seed) for seed in SEEDS],
        }
    before = lv.solve(falling(np.ones(N)), "direct", tol=1e-12).impulse
    changed = falling(np.ones(N), 1.0 + CHANGE)
    exact = lv.solve(changed, "direct", tol=1e-12).impulse
    starts = {
        "cold": np.zeros(N),
        "warm": before,
        "in reverse": before[::-1],
        "10 x too large": 10.0 * before,
    }
    return {
        "orders": orders,
        "lighter above": histories(cases()["falling, lighter above"]),
        "starts": {
            name: np.array([error(changed, start, n) for n in SWEEPS]) for name, start in starts.items()
        },
        "slow": {name: slow_part(changed, start, exact) for name, start in starts.items()},
        "behind": np.array(
            [[error(changed, starts[k], n) for n in range(16)] for k in ("cold", "in reverse")]
        ),
    }


def against_sweeps(axes):
    """Sweeps from 0 on, even steps from 1 to 64."""
    axes.set_xscale("symlog", linthresh=1.0)
    axes.set_yscale("log")
    axes.set_xticks([0, 1, 4, 8, 16, 32, 64], ["0", "1", "4", "8", "16", "32", "64"])
    axes.minorticks_off()
    axes.set(xlabel="sweeps", ylabel="relative residual [-]")
    beside(axes)


def draw_lighter(axes, found):
    """Each box stands on one that is three times as heavy."""
    by = found["lighter above"]
    low, high = by["random"].min(axis=0), by["random"].max(axis=0)
    axes.fill_between(SWEEPS, low, high, color="0.85", label=f"random, {len(SEEDS)} seeds")
    for (key, style), color in zip(
        (("bottom up", "^-"), ("top down", "v-"), ("colored", "s-"), ("Jacobi", "x--")),
        ("C0", "C1", "C2", "k"),
        strict=True,
    ):
        axes.plot(SWEEPS, by[key], style, color=color, markersize=4, label=key)
    axes.set_title("eight boxes falling, lighter above")
    against_sweeps(axes)


def draw_starts(axes, found):
    """Where a solve begins, and what becomes of it."""
    looks = {"10 x too large": "C3D-", "in reverse": "C1s-", "cold": "ko-", "warm": "C0^-"}
    for name, style in looks.items():
        axes.plot(SWEEPS, found["starts"][name], style, markersize=4, label=name)
    axes.set_title(f"the load has changed by {100 * CHANGE:g} %")
    against_sweeps(axes)


PANELS = {"lighter": draw_lighter, "starts": draw_starts}


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
    starts = found["starts"]
    print(f"\n{'sweeps':>9}" + "".join(f"{name:>16}" for name in starts))
    for i, n in enumerate(SWEEPS):
        print(f"{n:>9}" + "".join(f"{by[i]:>16.3g}" for by in starts.values()))
    print("slow part" + "".join(f"{x:>16.3g}" for x in found["slow"].values()))
    cold, stale = found["behind"]
    print(
        f"before the first sweep: warm {starts['cold'][0] / starts['warm'][0]:.0f} times closer than cold, in reverse "
        f"{starts['in reverse'][0] / starts['cold'][0]:.0f} times further, and behind for "
        f"{np.argmax(stale <= cold) - 1} sweeps"
    )
    last = {name: by[-1] for name, by in starts.items()}
    print(
        f"after {SWEEPS[-1]} sweeps: 10 x too large {last['10 x too large']:.3f} against {last['cold']:.3f} cold, "
        f"in reverse {last['in reverse']:.5f} against {last['warm']:.5f} warm"
    )
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
