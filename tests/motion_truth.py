"""Truth for motion errors: small problems solved in long double, and the bound held beside it.

The conditions that hold at a solution (free, at a bound, open, sticking, sliding) are read off a float64 solution;
their equations are solved in extended precision and every condition is then checked. Run as a program,

    python tests/motion_truth.py 100000

tries that many random problems and says how many bounds are broken, and how loose they are.
"""

import sys
import time

import numpy as np
from random_problems import as_matrix, random_contact_problem, random_lcp

import lavender as lv
from lavender.cones import CONTACT_SPIN, ROW
from lavender.motion.bound import difference, witness
from lavender.motion.operator import make

WIDE = np.longdouble
HAS_WIDE = np.finfo(WIDE).eps < 1e-18
CLOSE = 1e-15  # of the problem's size: what a condition may miss in float64's last place


def wide_matrix(problem):
    """A (m, m) and its kinetic part in long double, of the numbers as they are stored."""
    if problem.operator == "matrix":
        a = problem.dense().astype(WIDE)
        return (a + a.T) / 2, None
    jac = problem.jacobian.toarray().astype(WIDE)
    if problem.generalized is not None:
        moving = jac @ wide_solve(problem.generalized.mass.toarray(), jac.T)
        return moving + np.diag(problem.compliance.astype(WIDE)), moving
    moving = jac @ problem.rows.inverse_mass_matrix().toarray().astype(WIDE) @ jac.T
    return moving + np.diag(problem.compliance.astype(WIDE)), moving


def wide_solve(m, x):
    """M^-1 x in long double, M positive definite, by elimination."""
    m, x = m.astype(WIDE), x.astype(WIDE).copy()
    for k in range(len(m)):
        for i in range(k + 1, len(m)):
            f = m[i, k] / m[k, k]
            m[i] -= f * m[k]
            x[i] -= f * x[k]
    for k in reversed(range(len(m))):
        x[k] = (x[k] - m[k, k + 1 :] @ x[k + 1 :]) / m[k, k]
    return x


def solve_wide(problem, a, b):
    """(lambda, w) of the problem with right-hand side b, all in long double; None where it is not to be had."""
    plain = lv.Problem(b.astype(float), problem.cones, a.astype(float), friction=problem.friction)
    rough = lv.solve(plain, "auto", tol=1e-15)
    if not rough.residual.relative <= max(1e-12, 2 * rough.residual.floor):
        return None
    x = rough.impulse.astype(WIDE)
    modes = _modes(problem, rough.impulse, rough.slack, plain.d)
    scale = float(np.abs(rough.impulse).max(initial=0.0)) or 1.0
    for _ in range(6):
        f = _equations(problem, modes, x, a @ x - b)
        slope = np.empty((len(x), len(x)))
        for j in range(len(x)):
            y = x.copy()
            y[j] += WIDE(1e-8) * scale
            slope[:, j] = ((_equations(problem, modes, y, a @ y - b) - f) / (WIDE(1e-8) * scale)).astype(
                float
            )
        x = x - np.linalg.lstsq(slope, f.astype(float), rcond=1e-13)[0]
    w = a @ x - b
    return (x, w) if _holds(problem, modes, x, w, a, b) else None


def _modes(problem, x, w, d):
    c, modes = problem.cones, {}
    for i in range(c.n_blocks):
        s = range(c.ptr[i], c.ptr[i + 1])
        if c.kind[i] == ROW or len(s) == 1:
            for j in s:
                low, high = (c.lower[j], c.upper[j]) if c.kind[i] == ROW else (0.0, np.inf)
                y = x[j] - w[j] / d[j]
                modes[j] = low if y < low else high if y > high else None
        else:
            nt, spin = c.n_tangents[i], c.kind[i] == CONTACT_SPIN
            n = x[s[0]]
            y = x[list(s)] - w[list(s)] / d[list(s)]
            rim = c.mu[i] * n
            # A share of the rim decides: on it, what is left of w moves the projection's argument outwards.
            t = np.hypot.reduce(y[1 : 1 + nt]) > rim * (1 + 1e-12) if nt else False
            r = abs(y[-1]) > rim * c.patch_radius[i] * (1 + 1e-12) if spin else False
            modes[s[0]] = "open" if n <= 0.0 else (bool(t), bool(r))
    return modes


def _equations(problem, modes, x, w):
    c, f = problem.cones, np.empty_like(x)
    for i in range(c.n_blocks):
        j, end = c.ptr[i], c.ptr[i + 1]
        if c.kind[i] == ROW or end - j == 1:
            for k in range(j, end):
                f[k] = w[k] if modes[k] is None else x[k] - WIDE(modes[k])
            continue
        if modes[j] == "open":
            f[j:end] = x[j:end]
            continue
        nt, mu = c.n_tangents[i], WIDE(c.mu[i])
        slides, turns = modes[j]
        f[j:end] = w[j:end]
        if slides:
            t = slice(j + 1, j + 1 + nt)
            size = np.sqrt(np.sum(w[t] ** 2))
            f[j] -= mu * size
            f[t] = x[t] + mu * x[j] * w[t] / size if size > 0 else x[t]
        if turns:
            r = WIDE(c.patch_radius[i])
            f[j] -= mu * r * abs(w[end - 1])
            f[end - 1] = x[end - 1] + mu * r * x[j] * np.sign(w[end - 1])
    return f


def _holds(problem, modes, x, w, a, b):
    c = problem.cones
    slow = CLOSE * float((np.abs(a) @ np.abs(x)).max(initial=0.0) + np.abs(b).max(initial=0.0))
    small = CLOSE * float(np.abs(x).max(initial=0.0))
    if np.abs(_equations(problem, modes, x, w)).max(initial=0.0) > 1e-3 * min(slow, small):
        return False
    for i in range(c.n_blocks):
        j, end = c.ptr[i], c.ptr[i + 1]
        if c.kind[i] == ROW or end - j == 1:
            for k in range(j, end):
                low, high = (c.lower[k], c.upper[k]) if c.kind[i] == ROW else (0.0, np.inf)
                if x[k] < low - small or x[k] > high + small:
                    return False
                if low < high and ((modes[k] == low and w[k] < -slow) or (modes[k] == high and w[k] > slow)):
                    return False
            continue
        nt, mu, r = c.n_tangents[i], c.mu[i], c.patch_radius[i] if c.kind[i] == CONTACT_SPIN else 0.0
        t = slice(j + 1, j + 1 + nt)
        turn = (w[end - 1], x[end - 1]) if c.kind[i] == CONTACT_SPIN else (0.0, 0.0)
        if (
            x[j] < -small
            or np.sqrt(np.sum(x[t] ** 2)) > mu * x[j] + small
            or abs(turn[1]) > mu * r * x[j] + small
        ):
            return False
        if w[j] < mu * np.sqrt(np.sum(w[t] ** 2)) + mu * r * abs(turn[0]) - slow:
            return False
    return True


def random_problem(rng):
    """A small problem of a convex law: rows or a matrix, joints, contacts, compliance, redundancy, mass ratios."""
    seed = int(rng.integers(2**31))
    kind = rng.integers(4)
    if kind == 0:
        return random_lcp(seed, m=int(rng.integers(1, 9)), rank=int(rng.integers(1, 9)))
    sizes = {
        "bodies": int(rng.integers(1, 4)) + 1,
        "joints": int(rng.integers(0, 3)),
        "contacts": int(rng.integers(0, 4)),
    }
    problem = random_contact_problem(
        seed,
        friction="cone",
        tangents=0 if kind == 1 else int(rng.integers(1, 3)),
        spin=bool(rng.integers(2)) and kind != 1,
        **sizes,
    )
    return as_matrix(problem) if rng.random() < 0.25 else problem


def random_impulse(rng, problem, solution):
    """An impulse at any distance from the solution: perturbed, half solved, doing nothing, outside the bounds."""
    kind = rng.integers(4)
    size = float(np.abs(solution).max(initial=0.0)) or 1.0
    if kind == 0:
        return solution + size * 10.0 ** rng.uniform(-16, 1) * rng.normal(size=problem.m)
    if kind == 1:
        return solution * (1.0 + 10.0 ** rng.uniform(-16, 0) * rng.normal(size=problem.m))
    if kind == 2:
        return np.array(lv.solve(problem, "anderson", tol=0.0, max_iter=int(rng.integers(0, 40))).impulse)
    return problem.start()


def trial(rng):
    """(bound, truth, kinetic truth, where) of one random problem, witness and impulse, or None without a truth.

    The witness is the reference four times out of five, else an impulse at random: the bound asks nothing of it.
    """
    problem = random_problem(rng)
    a, moving = wide_matrix(problem)
    reference = lv.motion.reference(problem)
    good = rng.random() < 0.8
    if good and not reference.accepted:
        return None
    y = reference.impulse if good else random_impulse(rng, problem, reference.impulse)
    operator = make(problem)
    if operator.refusal():
        return None
    proof = witness(problem, operator, y)
    x = random_impulse(rng, problem, reference.impulse)
    bound = difference(operator, x, y)[1].most + proof.radius
    # The problem whose targets are moved by what the witness needs, in long double: w - (y - p) d with w = A y - b.
    shift = _shift(problem, a, y)
    if np.abs(shift).max(initial=WIDE(0)) > proof.moved:
        return bound, np.inf, np.inf, good, problem
    truth = solve_wide(problem, a, problem.b.astype(WIDE) + shift)
    if truth is None:
        return None
    delta = x.astype(WIDE) - truth[0]
    energy = np.sqrt(max(delta @ a @ delta, WIDE(0)) / 2)
    kinetic = None if moving is None else np.sqrt(max(delta @ moving @ delta, WIDE(0)) / 2)
    return bound, energy, kinetic, good, problem


def _shift(problem, a, y):
    """d (y - Pi(y - w / d)) in long double: the same projection as the judge's, written apart."""
    d, c = problem.d.astype(WIDE), problem.cones
    y = y.astype(WIDE)
    w = a @ y - problem.b.astype(WIDE)
    z = y - w / d
    p = np.empty_like(y)
    for i in range(c.n_blocks):
        j, end = c.ptr[i], c.ptr[i + 1]
        if c.kind[i] == ROW or end - j == 1:
            for k in range(j, end):
                low, high = (c.lower[k], c.upper[k]) if c.kind[i] == ROW else (0.0, np.inf)
                p[k] = min(max(z[k], WIDE(low)), WIDE(high))
            continue
        p[j:end] = project_cone(
            z[j:end],
            d[j:end],
            WIDE(c.mu[i]),
            WIDE(c.patch_radius[i]),
            int(c.n_tangents[i]),
            c.kind[i] == CONTACT_SPIN,
        )
    return d * (y - p)


def project_cone(z, d, mu, radius, nt, spin):
    """Nearest point of {|t| <= mu n, |s| <= mu r n} in the metric of d, by bisection on its normal part n."""
    t = np.sqrt(np.sum(z[1 : 1 + nt] ** 2)) if nt else WIDE(0)
    s = abs(z[-1]) if spin else WIDE(0)
    dt, ds = d[1] if nt else WIDE(1), d[-1]

    def slope(n):  # of 1/2 d_n (n - z_n)^2 + 1/2 d_t (t - mu n)+^2 + 1/2 d_s (s - mu r n)+^2
        return (
            d[0] * (n - z[0])
            - dt * mu * max(t - mu * n, WIDE(0))
            - ds * mu * radius * max(s - mu * radius * n, WIDE(0))
        )

    low, high = WIDE(0), abs(z[0]) + mu * dt / d[0] * t + mu * radius * ds / d[0] * s
    if slope(low) >= 0:
        high = low
    for _ in range(90):
        n = (low + high) / 2
        low, high = (n, high) if slope(n) < 0 else (low, n)
    n = (low + high) / 2
    out = z.copy()
    out[0] = n
    if nt and t > mu * n:
        out[1 : 1 + nt] *= mu * n / t
    if spin:
        out[-1] = min(max(z[-1], -mu * radius * n), mu * radius * n)
    return out


def main(count):
    rng = np.random.default_rng(20261120)
    start, ratios, broken, moved, without = time.perf_counter(), {True: [], False: []}, 0, 0, 0
    for i in range(count):
        found = trial(rng)
        if found is None:
            without += 1
            continue
        bound, energy, kinetic, good, _ = found
        broken += bool(energy > bound) or (kinetic is not None and bool(kinetic > bound))
        moved += energy == np.inf
        if 0 < energy < np.inf:
            ratios[good].append(float(bound / energy))
        if (i + 1) % 5000 == 0:
            print(f"{i + 1} problems, {time.perf_counter() - start:.0f} s, {broken} broken", flush=True)
    print(
        f"{count} problems: {count - without} with a truth, {broken} bounds broken ({moved} moved further than said)"
    )
    for good, name in ((True, "witness at the floor"), (False, "witness at random")):
        r = np.array(ratios[good])
        print(
            f"bound / truth, {name}: {len(r)} times, median {np.median(r):.4g}, 95% {np.quantile(r, 0.95):.4g}"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
