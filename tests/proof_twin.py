"""The conditions of a solution once more, in rational numbers and from the data alone: nothing of `lavender.lab.proof`.

Solutions are planted in whole numbers and fractions by powers of two, so that b = A lambda - w is exact in float64;
what slides goes along vectors of whole length. An answer near a planted one is proven, and the centre of what was
proven, to 38 digits, must meet every condition to 1e-25 of its numbers: what is false by one bit of float64 fails.

    python tests/proof_twin.py 10000

tries that many, and says how many of each kind were proven and what was wrong.
"""

import sys
import time
from collections import Counter
from fractions import Fraction

import numpy as np
from kkt_truth import Exact, matrix_in

import lavender as lv
from lavender.lab.proof import prove
from lavender.lab.proof.search import Search

SLACK = Fraction(
    1, 10**25
)  # of the largest number of the problem: the centre is 1e-30 from the exact solution
KINDS = ("row", "contact", "spin", "round", "box", "ellipse", "rolling", "pair", "normal", "frictionless")
WHOLE = {1: ([5], 5), 2: ([3, 4], 5), 3: ([1, 2, 2], 3), 4: ([1, 2, 2, 4], 5), 5: ([1, 1, 1, 2, 3], 4)}


def cones_of(kind, rng):
    """(cones, [(offsets of a part, its reaches)])."""
    mu = 2.0 ** int(rng.integers(-2, 2))
    two = [([1, 2], [mu, mu])]
    if kind == "row":
        low, high = [(-np.inf, np.inf), (0.0, np.inf), (-64.0, 64.0), (3.0, 3.0), (-np.inf, 8.0)][
            rng.integers(5)
        ]
        return lv.Cones.bounded([low], [high]), []
    if kind == "normal":
        return lv.Cones.contacts(mu, tangents=0), []
    if kind == "frictionless":
        return lv.Cones.contacts(0.0), []
    if kind == "pair":
        return lv.Cones.contacts(mu, tangents=1), [([1], [mu])]
    if kind == "spin":
        return lv.Cones.contacts(mu, patch_radius=0.5), [*two, ([3], [mu * 0.5])]
    if kind == "round":
        n = int(rng.integers(3, 6))
        return lv.Cones.contacts(mu, tangents=n), [(list(range(1, n + 1)), [mu] * n)]
    if kind == "box":
        return lv.Cones.contacts([(mu, 2 * mu)], shape="box"), [([1], [mu]), ([2], [2 * mu])]
    if kind == "ellipse":
        return lv.Cones.contacts([(mu, 2 * mu)]), [([1, 2], [mu, 2 * mu])]
    if kind == "rolling":
        return lv.Cones.contacts(mu, rolling=0.25), [*two, ([3, 4], [0.25, 0.25])]
    return lv.Cones.contacts(mu), two


def block(kind, law, rng, border):
    """(cones, parts, lambda, w) of a block with an exact solution; `border`: perhaps between two cases."""
    cones, parts = cones_of(kind, rng)
    m = cones.n_rows
    x, w = np.zeros(m), np.zeros(m)
    if kind == "row":
        low, high = cones.lower[0], cones.upper[0]
        bounds = [(b, s) for b, s in ((low, 1.0), (high, -1.0)) if np.isfinite(b)]
        if low == high:
            x[0], w[0] = low, rng.integers(-4, 5)
        elif bounds and rng.random() < 0.5:
            x[0], side = bounds[rng.integers(len(bounds))]
            w[0] = side * (rng.integers(1, 9) if not border or rng.random() < 0.5 else 0)
        else:
            x[0] = max(low, -50) + 1.0 if np.isfinite(low) else min(high, 50) - rng.integers(1, 9)
        return cones, parts, x, w
    loaded = rng.random() < 0.7
    speed = 0.0
    if loaded:
        x[0] = 240.0 * rng.integers(1, 4)
    for rows, reach in parts:
        c = np.array(reach)
        z = np.array(WHOLE[len(rows)][0]) * rng.choice([-1.0, 1.0], len(rows)) * rng.integers(1, 4)
        size = float(np.sqrt(z @ z))
        if not loaded or rng.random() < 0.5:
            w[rows] = z / c
            x[rows] = -c * (z * (x[0] / size)) if loaded else 0.0
            speed += size
        elif border and rng.random() < 0.5:
            x[rows] = c * (z * (x[0] / size))
        else:
            x[rows] = c * x[0] * rng.integers(-3, 4, len(rows)) / 8.0
    if kind == "frictionless":
        w[1:] = rng.integers(-4, 5, m - 1)
    w[0] = speed if law == "cone" else 0.0
    if not loaded:
        w[0] += rng.integers(1, 9) if not border or rng.random() < 0.5 else 0.0
    return cones, parts, x, w


def planted(seed, border=False):
    """(problem, exact lambda): a matrix (perhaps singular), J and M, or bodies, of every kind of block."""
    rng = np.random.default_rng(seed)
    law = ("coulomb", "cone")[seed % 2]
    kinds = [k for k in KINDS if law == "cone" or k != "round"]  # which has no Coulomb law
    blocks = [block(kinds[rng.integers(len(kinds))], law, rng, border) for _ in range(rng.integers(1, 5))]
    cones = blocks[0][0]
    for more in blocks[1:]:
        cones = cones + more[0]
    x, w = (np.concatenate([b[k] for b in blocks]) for k in (2, 3))
    m = len(x)
    form = rng.integers(3)
    n = m if form == 0 else int(rng.integers(max(1, m // 2), m + 4))
    j = rng.integers(-3, 4, (m, n)).astype(float)
    if rng.random() < 0.3 and m > 1:
        j[rng.integers(m)] = j[rng.integers(m)]
    if form < 2:
        a = j @ j.T + np.eye(m) * (4.0 if rng.random() < 0.6 else 0.0)
        return lv.Problem(a @ x - w, cones, a, friction=law), x
    inverse = 2.0 ** rng.integers(-2, 2, n)
    theta = 0.5 * (rng.random(m) < rng.choice([0.0, 0.5, 1.0]))
    free = rng.integers(-3, 4, n).astype(float)
    target = j @ (inverse * (j.T @ x)) + theta * x - w + j @ free
    return lv.Problem.from_jacobian(
        j, np.diag(1.0 / inverse), free, target=target, cones=cones, compliance=theta, friction=law
    ), x


def exact_slack(problem, x):
    """w = A lambda - b of Fractions, from the data."""
    return (matrix_in(problem, Exact)[0] @ np.array(x, object) - Exact.array(problem.b)).tolist()


def violation(problem, x):
    """Largest amount by which exact numbers miss a condition, as (words, amount)."""
    c, w, out = problem.cones, exact_slack(problem, x), []
    for i, (first, end) in enumerate(zip(c.ptr[:-1].tolist(), c.ptr[1:].tolist(), strict=True)):
        if c.kind[i] == lv.cones.ROW:
            low, high = float(c.lower[first]), float(c.upper[first])
            step = x[first] - w[first]
            if np.isfinite(low):
                step = max(step, Fraction(low))
            if np.isfinite(high):
                step = min(step, Fraction(high))
            out.append((f"row {first}", abs(step - x[first])))
            continue
        speed = Fraction(0)
        for rows, reach in groups(c, i, first, end):
            c2 = [Fraction(r) for r in reach]
            z = [q * w[r] for q, r in zip(c2, rows, strict=True)]
            y = [x[r] / q for q, r in zip(c2, rows, strict=True)]
            size = Exact.sqrt(sum((q * q for q in z), Fraction(0)))
            speed += size
            out.append((f"cone {i}", Exact.sqrt(sum((q * q for q in y), Fraction(0))) - x[first]))
            out += [(f"slides {i}", abs(p * size + q * x[first])) for p, q in zip(y, z, strict=True)]
        own = w[first] - (speed if problem.law == "cone" else 0)
        out.append((f"normal {i}", abs(min(x[first], own))))
        held = {r for rows, _ in groups(c, i, first, end) for r in rows}
        out += [(f"no friction {i}", abs(x[r])) for r in range(first + 1, end) if r not in held]
    return max(out, key=lambda q: q[1])


def groups(c, i, first, end):
    """(rows, reaches) of the bounds of a contact, by its kind."""
    kind, mu, q = int(c.kind[i]), float(c.mu[i]), float(c.patch_radius[i])
    rows = list(range(first + 1, end))
    roll = float(c.rolling[i])
    out = {
        1: [(rows, [mu] * len(rows))],
        2: [(rows[:-1], [mu] * (len(rows) - 1)), (rows[-1:], [mu * q])],
        3: [(rows, [mu] * len(rows))],
        4: [(rows[:1], [mu]), (rows[1:], [mu * q])],
        5: [(rows[:2], [mu] * 2), (rows[2:-2], [mu * q]), (rows[-2:], [roll] * 2)],
        7: [(rows, [mu, mu * q])],
    }[kind]
    return [(r, reach) for r, reach in out if r and max(reach) > 0.0]


class Centre:
    """Catches the balls that a proof ends with, as Fractions of their middles."""

    def __enter__(self):
        self.make_enclosure = Search.make_enclosure

        def record_balls(search, lam, w):
            self.x = [
                Fraction(int(m)) * Fraction(2) ** int(e) for m, e in (_parts(search.flint, q) for q in lam)
            ]
            self.radius = max((float(q.rad()) for q in lam if isinstance(q, search.flint.arb)), default=0.0)
            return self.make_enclosure(search, lam, w)

        Search.make_enclosure = record_balls
        return self

    def __exit__(self, *_):
        Search.make_enclosure = self.make_enclosure


def _parts(flint, q):
    return (q.mid() if isinstance(q, flint.arb) else flint.arb(q).mid()).man_exp()


def attack(seed):
    """(kind, what is wrong or None) of one random problem and answer."""
    rng = np.random.default_rng(seed + 10**6)
    border = bool(rng.random() < 0.4)
    problem, exact = planted(seed, border)
    given = exact.copy()
    way = ("exact", "near", "far", "rounded", "noise")[rng.integers(5)]
    if way == "near":
        given[rng.integers(problem.m)] += 10.0 ** rng.integers(-14, -3)
    elif way == "far":
        given += rng.normal(size=problem.m) * 10.0
    elif way == "noise":
        given += rng.normal(size=problem.m) * 1e-9
    if way == "rounded":  # numbers changed by a bit: nothing planted, borders broken to either side
        b = problem.b * (1 + rng.integers(-1, 2, problem.m) * 2.0**-52)
        problem = problem.updated(b=b) if problem.operator == "matrix" else problem
    with Centre() as centre:
        found = prove(problem, given)
    label = f"{'border' if border else 'strict'} {way}"
    if not found.proven:
        return label, False, None if found.reason else "no reason"
    size = 1 + max(map(abs, centre.x), default=0) ** 2
    words, amount = violation(problem, centre.x)
    off = max(
        (abs(p - Fraction(q)) for p, q in zip(centre.x, given.tolist(), strict=True)), default=Fraction(0)
    )
    own = exact_slack(problem, [Fraction(q) for q in given.tolist()])
    moved = max(
        (abs(p - q) for p, q in zip(exact_slack(problem, centre.x), own, strict=True)), default=Fraction(0)
    )
    if amount > SLACK * size:
        return label, True, f"{words} is off by {float(amount):.1e}"
    if found.impulse_radius > off * (1 + 1e-9) + SLACK * size:
        return label, True, f"{found.impulse_radius:.3e} where {float(off):.3e} is enough"
    if (
        off > Fraction(found.impulse_radius) + SLACK * size
        or moved > Fraction(found.velocity_radius) + SLACK * size
    ):
        return label, True, f"{float(off):.3e} outside {found.impulse_radius:.3e}"
    if found.unique and way != "rounded":
        gap = max(abs(p - q) for p, q in zip(exact_slack(problem, [Fraction(q) for q in exact.tolist()]),
                                             exact_slack(problem, centre.x), strict=True))  # fmt: skip
        if gap > SLACK * size:
            return label, True, f"unique, but velocities of the planted one are {float(gap):.1e} off"
    return label, True, None


if __name__ == "__main__":
    start, count, tally, proven = time.monotonic(), int(sys.argv[1]), Counter(), Counter()
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    for seed in range(first, first + count):
        try:
            label, held, wrong = attack(seed)
        except Exception as error:
            label, held, wrong = "raised", False, repr(error)
        tally[label] += 1
        proven[label] += held
        if wrong:
            print(f"seed {seed} {label}: {wrong}", flush=True)
    print({k: f"{proven[k]} of {tally[k]}" for k in sorted(tally)}, f"{time.monotonic() - start:.0f} s")
