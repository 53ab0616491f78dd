"""The judge once more, in long double and from the data alone: it imports nothing of lavender.

With w = A lambda - b and d as docs/concepts.md defines them, E = sqrt(sum d e^2), V = max sqrt(nu d) |e|, and

    relative = max(E / E0, V / V0),   floor = 2^-53 (|A| |lambda| + |b|) in the same two norms.

Long double has 11 more bits and 2^14 instead of 2^10 as its largest exponent, so nothing here overflows, and what
it rounds is far below what float64 may round. `Judgement.allowed` is what float64 may add: each of the m + 20
operations of a row rounds by 2^-53, or by the smallest denormal.
"""

from dataclasses import dataclass

import numpy as np

L = np.longdouble
ROW, CONTACT, CONTACT_SPIN, ROUND = 0, 1, 2, 3
NORMAL = L(2.0) ** -1022
DENORMAL = L(2.0) ** -1074
ZERO = L(0.0)
LARGEST = L(1.7976931348623157e308)  # of an impulse in float64


@dataclass
class Judgement:
    relative: float
    floor: float
    allowed: float  # relative residual that float64 may add
    energy: float
    velocity: float
    nothing: bool  # doing nothing is near the line below which the norms of b stand in
    range: float  # largest |log10| of the numbers on the way


class Problem:
    """A, |A| (as sums of absolute products), d and nu of a problem given as plain arrays."""

    def __init__(self, spec):
        general = spec["operator"] == "general"
        jac = np.array(spec["J"], L).reshape(-1, len(spec["v_free"])) if general else None
        if general:
            v, target = np.array(spec["v_free"], L), np.array(spec["target"], L)
            self.b, self.b_size = target - jac @ v, np.abs(target) + np.abs(jac) @ np.abs(v)
            if "b" in spec:  # of an update
                self.b, self.b_size = np.array(spec["b"], L), np.abs(np.array(spec["b"], L))
        else:
            self.b = np.array(spec["b"], L)
            self.b_size = np.abs(self.b)
        self.cones = {key: np.array(value) for key, value in spec["cones"].items()}
        self.law = spec["friction"]
        self.m = len(self.b)
        self.roundings = self.m + 20
        if general:
            self._of_general(
                jac, np.array(spec["M"], L), np.array(spec.get("compliance", np.zeros(self.m)), L)
            )
        elif "rows" in spec:
            self._of_rows(spec)
        else:
            self.A = np.array(spec["A"], L).reshape(self.m, self.m)
            self.size = np.abs(self.A)
            self._of_matrix()
        self._pairs()

    # -- the operator ------------------------------------------------------------------------------

    def _of_matrix(self):
        diag, big = np.diag(self.A).copy(), self.size.max(axis=1, initial=ZERO)
        d = np.where(diag > L(1e-10) * big, diag, big)
        self.d = self._filled(d)
        self.nu = self.d.copy()
        self.d_edge = bool(np.any(np.abs(diag - L(1e-10) * big) <= L(1e-14) * big))

    def _filled(self, d):
        positive = d[d > 0]
        return np.where(d > 0, d, positive.mean() if len(positive) else L(1.0))

    def _of_rows(self, spec):
        r = {key: np.array(value) for key, value in spec["rows"].items()}
        n, m = len(r["inv_mass"]), self.m
        ptr, kind = self.cones["ptr"], self.cones["kind"]
        joints = len(r["joint_ptr"]) - 1
        jac, size = np.zeros((m, n, 6), L), np.zeros((m, n, 6), L)
        angular = np.zeros(m, bool)
        for j in range(joints):
            for row in range(r["joint_ptr"][j], r["joint_ptr"][j + 1]):
                line = np.array(r["jac"][row], L)
                angular[row] = not line[[0, 1, 2, 6, 7, 8]].any()
                for side, body in enumerate(r["joint_body"][j]):
                    if body >= 0:
                        jac[row, body] = line[6 * side : 6 * side + 6]
                        size[row, body] = np.abs(jac[row, body])
        for c in range(len(kind) - joints):
            k = joints + c
            normal, tangent = np.array(r["normal"][c], L), np.array(r["tangent"][c], L)
            axes = [normal, tangent, np.cross(normal, tangent)]
            spin = kind[k] == CONTACT_SPIN
            rows = range(ptr[k], ptr[k + 1])
            for q, row in enumerate(rows):
                for sign, arm, body in (
                    (-1, r["arm_a"][c], r["contact_body"][c][0]),
                    (1, r["arm_b"][c], r["contact_body"][c][1]),
                ):
                    if body < 0:
                        continue
                    if spin and q == len(rows) - 1:
                        jac[row, body, 3:] = sign * normal
                        size[row, body, 3:] = np.abs(normal)
                    else:
                        arm = np.array(arm, L)
                        jac[row, body, :3], jac[row, body, 3:] = sign * axes[q], sign * np.cross(arm, axes[q])
                        # a cross product may cancel, and its float64 keeps only the digits of its terms
                        reach = np.sqrt(arm @ arm)
                        size[row, body, :3] = 1.0
                        size[row, body, 3:] = reach
        minv, minv_size = np.zeros((n, 6, 6), L), np.zeros((n, 6, 6), L)
        for i in range(n):
            minv[i, [0, 1, 2], [0, 1, 2]] = r["inv_mass"][i]
            minv[i, 3:, 3:] = np.array(r["inv_inertia"][i], L)
        minv_size = np.abs(minv)
        soft = np.array(spec.get("compliance", np.zeros(m)), L)
        half = np.einsum("mni,nij->mnj", jac, minv)
        half_size = np.einsum("mni,nij->mnj", size, minv_size)
        self.A = half.reshape(m, 6 * n) @ jac.reshape(m, 6 * n).T + np.diag(soft)
        self.size = half_size.reshape(m, 6 * n) @ size.reshape(m, 6 * n).T + np.diag(soft)
        d = np.diag(self.A).copy()
        self.d = self._filled(d)
        self.d_edge = bool(np.any((d > 0) & (d < L(1e-12) * np.diag(self.size))))
        self.nu = self.d.copy()
        for j in range(joints):
            for row in range(r["joint_ptr"][j], r["joint_ptr"][j + 1]):
                inverse = sum(L(r["inv_mass"][body]) for body in r["joint_body"][j] if body >= 0)
                if angular[row] and inverse > 0:
                    self.nu[row] = inverse
        self.rows = True

    def _of_general(self, jac, mass, soft):
        """M = C C^T, Y = J C^-T, A = Y Y^T + compliance; |Y| |Y|^T for the sums of absolute products."""
        n = len(mass)
        lower, y = np.zeros((n, n), L), np.zeros((self.m, n), L)
        for i in range(n):
            for j in range(i):
                lower[i, j] = (mass[i, j] - lower[i, :j] @ lower[j, :j]) / lower[j, j]
            lower[i, i] = np.sqrt(mass[i, i] - lower[i, :i] @ lower[i, :i])
            y[:, i] = (jac[:, i] - y[:, :i] @ lower[i, :i]) / lower[i, i]
        self.A = y @ y.T + np.diag(soft)
        self.size = np.abs(y) @ np.abs(y.T) + np.diag(soft)
        d = np.diag(self.A).copy()
        self.d = self._filled(d)
        self.nu = self.d.copy()
        # A solve by the factor of M is as exact as M in the best units of its velocities allows.
        unit = 1 / np.sqrt(np.diag(mass))
        scaled = (unit[:, None] * mass * unit[None, :]).astype(float)
        condition = np.linalg.cond(scaled) if np.isfinite(scaled).all() else np.inf
        self.roundings += 10 * n * L(condition)
        self.d_edge = not np.isfinite(self.A).all() or bool(
            np.any((d > 0) & (d < L(1e-12) * np.diag(self.size)))
        )

    def _pairs(self):
        ptr, kind = self.cones["ptr"], self.cones["kind"]
        for k in range(len(kind)):
            j, nt = ptr[k], self.tangents(k)
            if nt == 2:
                same = self.nu[j + 1] == self.d[j + 1]
                self.d[j + 1 : j + 3] = L(0.5) * (self.d[j + 1] + self.d[j + 2])
                if same:
                    self.nu[j + 1 : j + 3] = self.d[j + 1]
            if kind[k] == CONTACT_SPIN:
                self.nu[ptr[k + 1] - 1] = self.d[j]

            if kind[k] == ROUND and ptr[k + 1] - j == 6:
                self.d[j + 4 : j + 6] = self.nu[j + 4 : j + 6] = L(0.5) * (self.d[j + 4] + self.d[j + 5])

    def tangents(self, k):
        """Rows behind the normal that share a limit; of a round cone those that slide."""
        kind, ptr = self.cones["kind"], self.cones["ptr"]
        if kind[k] == ROUND:
            return 2
        return 0 if kind[k] == ROW else int(ptr[k + 1] - ptr[k] - kind[k])

    # -- the error of an impulse -------------------------------------------------------------------

    def slack(self, lam):
        return self.A @ lam - self.b

    def error(self, lam, w):
        """e (m,), by the law; w / d as it is where no bound acts, since lam - (lam - w / d) has fewer digits."""
        e = np.zeros(self.m, L)
        c, step = self.cones, w / self.d
        for k in range(len(c["kind"])):
            part = slice(c["ptr"][k], c["ptr"][k + 1])
            if c["kind"][k] == ROW:
                low, high = np.array(c["lower"][part], L), np.array(c["upper"][part], L)
                e[part] = np.minimum(np.maximum(step[part], lam[part] - high), lam[part] - low)
            elif c["kind"][k] == ROUND:
                e[part] = self._round(k, lam[part], step[part])
            elif self.law == "cone" and c["ptr"][k + 1] - c["ptr"][k] > 1:
                e[part] = self._cone(k, lam[part], step[part])
            else:
                e[part] = self._coulomb(k, lam[part], step[part])
        return e

    def _coulomb(self, k, lam, step):
        c, nt = self.cones, self.tangents(k)
        e = step.copy()
        e[0] = min(step[0], lam[0])
        rim = L(c["mu"][k]) * max(ZERO, lam[0])
        if nt:
            y = lam[1 : 1 + nt] - step[1 : 1 + nt]
            size = np.sqrt(y @ y)
            if size > rim:
                e[1 : 1 + nt] = lam[1 : 1 + nt] - y * (rim / size)
        if c["kind"][k] == CONTACT_SPIN:
            edge = rim * L(c["patch_radius"][k])
            e[-1] = min(max(step[-1], lam[-1] - edge), lam[-1] + edge)
        return e

    def _cone(self, k, lam, step):
        """Error of the projection in the metric of d, by the formula of the five candidates."""
        c, nt, j = self.cones, self.tangents(k), self.cones["ptr"][k]
        root = np.sqrt(self.d[j : c["ptr"][k + 1]])
        y = root * (lam - step)
        spin = c["kind"][k] == CONTACT_SPIN
        mu, radius = L(c["mu"][k]), L(c["patch_radius"][k])
        t = np.sqrt(y[1 : 1 + nt] @ y[1 : 1 + nt]) if nt else ZERO
        s = abs(y[-1]) if spin else ZERO
        at = mu * root[1] / root[0] if nt else ZERO
        a_s = mu * radius * root[-1] / root[0] if spin else ZERO
        top = max(
            ZERO,
            y[0],
            (y[0] + at * t) / (1 + at * at),
            (y[0] + a_s * s) / (1 + a_s * a_s),
            (y[0] + at * t + a_s * s) / (1 + at * at + a_s * a_s),
        )
        e = step.copy()
        if top != y[0]:
            e[0] = lam[0] - top / root[0]
        if nt and t > at * top:
            e[1 : 1 + nt] = lam[1 : 1 + nt] - y[1 : 1 + nt] * (at * top / t) / root[1 : 1 + nt]
        if spin and s > a_s * top:
            e[-1] = lam[-1] - np.copysign(a_s * top, y[-1]) / root[-1]
        return e

    def _round(self, k, lam, step):
        """Error of the projection on sum (|y_g| / a_g)^2 <= y_n^2 by bisection on its multiplier."""
        c, j = self.cones, self.cones["ptr"][k]
        d, mu = self.d[j : c["ptr"][k + 1]], L(c["mu"][k])
        root = np.sqrt(d)
        y = root * (lam - step)
        normal, y = y[0], y[1:]
        a = mu * root[1:] / root[0]
        size = np.abs(y)
        if mu == 0:
            inside, top, scale = not y.any() and normal >= 0, max(ZERO, normal), np.zeros(len(y), L)
        else:
            inside = normal >= 0 and ((size / a) ** 2).sum() <= normal * normal
            top, scale = ZERO, np.zeros(len(y), L)
            if not inside and normal + np.sqrt(((a * size) ** 2).sum()) > 0:
                # top = base + rise: a narrow cone's (1 + a a) top - normal would lose its digits
                base = max(ZERO, normal)
                rest = a * a * normal if normal > 0 else np.full(len(y), -normal)

                def excess(rise):
                    return ((a * size / ((1 + a * a) * rise + rest)) ** 2).sum() - 1

                low = max(ZERO, ((a * size - rest) / (1 + a * a)).max())
                high = low + size.sum() + abs(normal) + NORMAL
                for _ in range(130):
                    if not excess(high) > 0:
                        break
                    high = 2 * high
                for _ in range(200):
                    rise = (low + high) / 2
                    low, high = (rise, high) if excess(rise) > 0 else (low, rise)
                top = base + rise
                scale = a * a * top / ((1 + a * a) * rise + rest)
                loss = (top - normal if normal <= 0 else rise) / ((1 + a * a) * rise + rest)
        if inside:
            return step.copy()
        e = np.empty(len(lam), L)
        e[0] = step[0] - rise / root[0] if scale.any() and normal > 0 else lam[0] - top / root[0]
        e[1:] = lam[1:] - y * scale / root[1:]
        if scale.any():
            e[1:] = np.where(scale > 0.5, step[1:] + loss * (lam[1:] - step[1:]), e[1:])
        return e

    def norms(self, e):
        """E and V."""
        c, weight = self.cones, np.sqrt(self.nu * self.d)
        size = np.abs(e)
        for k in range(len(c["kind"])):
            nt, j = self.tangents(k), c["ptr"][k]
            if nt == 2:
                size[j + 1 : j + 3] = np.sqrt(e[j + 1] ** 2 + e[j + 2] ** 2)
            if c["kind"][k] == ROUND and c["ptr"][k + 1] - j == 6:
                size[j + 4 : j + 6] = np.sqrt(e[j + 4] ** 2 + e[j + 5] ** 2)
        return np.sqrt((self.d * e * e).sum()), (weight * size).max(initial=ZERO)

    def judge(self, impulse):
        """Judgement of an impulse (m,) float64."""
        lam = np.array(impulse, L)
        if not np.isfinite(lam).all():
            return Judgement(np.inf, 0.0, 0.0, np.inf, np.inf, False, np.inf)
        with np.errstate(all="ignore"):
            return self._judge(lam)

    def _judge(self, lam):
        w = self.slack(lam)
        size = self.size @ np.abs(lam) + self.b_size
        energy, velocity = self.norms(self.error(lam, w))
        start = np.where(self._bounded(), np.clip(ZERO, self._low(), self._high()), ZERO).astype(L)
        energy0, velocity0 = self.norms(self.error(start, self.slack(start)))
        rhs_energy, rhs_velocity = self.norms(self.b / self.d)
        line = L(2.0) ** -48 * rhs_energy
        below = energy0 <= line
        nothing = bool(line / 16 <= energy0 <= line * 16)
        if below:
            energy0, velocity0 = rhs_energy, rhs_velocity
        # An error w / d of the start that float64 holds no number for: there is nothing to be better than.
        nothing |= bool(energy0 <= 2 * NORMAL * np.sqrt(self.d.sum()))
        nothing |= bool(velocity0 <= 2 * NORMAL * np.sqrt(self.nu * self.d).max(initial=ZERO))
        f = L(2.0) ** -53 * size
        rounded = L(2.0) ** -53 * self.d * np.abs(lam)  # of lambda - Pi, where d is not A_ii
        more = self.roundings * (f + rounded + DENORMAL * (1 + np.abs(lam).max(initial=ZERO)))
        floor = self._ratio(*self._floor(f), energy0, velocity0)
        allowed = self._ratio(*self._floor(more), energy0, velocity0)
        seen = np.abs(np.concatenate([lam, w, self.d, self.b, [energy, velocity, energy0, velocity0]]))
        seen = seen[(seen > 0) & np.isfinite(seen)]
        span = float(np.abs(np.log10(seen)).max(initial=0.0))
        return Judgement(
            float(self._ratio(energy, velocity, energy0, velocity0)),
            float(floor),
            float(allowed),
            float(energy),
            float(velocity),
            nothing,
            span,
        )

    def _floor(self, f):
        return np.sqrt((f * f / self.d).sum()), (f * np.sqrt(self.nu / self.d)).max(initial=ZERO)

    def _ratio(self, x, y, x0, y0):
        return max(ZERO if a == 0 else (a / a0 if a0 > 0 else L(np.inf)) for a, a0 in ((x, x0), (y, y0)))

    def _bounded(self):
        c = self.cones
        return np.repeat(c["kind"] == ROW, np.diff(c["ptr"]))

    def _low(self):
        return np.array(self.cones["lower"], L)

    def _high(self):
        return np.array(self.cones["upper"], L)

    # -- no solution -------------------------------------------------------------------------------

    def refutes(self, y):
        """Why y (m,) does not prove that there is no solution, or None where it does.

        Wanted: y in the recession cone of the bounds, and b.y > max (A^T y).lambda over the bounds.
        """
        y = np.array(y, L)
        if y.shape != (self.m,) or not np.isfinite(y).all():
            return "not finite numbers"
        c = self.cones
        gain, most = self.b @ y, np.abs(self.b) @ np.abs(y)
        if not gain > 0:
            return "b.y is not positive"
        z, scale = self.A.T @ y, self.size.T @ np.abs(y)
        z = np.where(np.abs(z) <= L(1e-9) * (gain / most) * scale, ZERO, z)
        pull = ZERO
        for k in range(len(c["kind"])):
            part = slice(c["ptr"][k], c["ptr"][k + 1])
            nt = self.tangents(k) if c["kind"][k] != ROUND else c["ptr"][k + 1] - c["ptr"][k] - 1
            if c["kind"][k] == ROW:
                low, high = np.array(c["lower"][part], L), np.array(c["upper"][part], L)
                if np.any((y[part] > 0) & np.isfinite(high)) or np.any((y[part] < 0) & np.isfinite(low)):
                    return "y leaves the bounds"
                low, high = np.maximum(low, -LARGEST), np.minimum(high, LARGEST)
                pull += sum(
                    x * (h if x > 0 else lo) for x, lo, h in zip(z[part], low, high, strict=True) if x != 0
                )
                continue
            mu = L(c["mu"][k])
            spin = L(c["patch_radius"][k]) if c["kind"][k] == CONTACT_SPIN else ZERO
            yk, zk = y[part], z[part]
            limit = mu * yk[0] * (1 + L(1e-11))
            if (
                yk[0] < 0
                or np.sqrt(yk[1 : 1 + nt] @ yk[1 : 1 + nt]) > limit
                or (spin and abs(yk[-1]) > limit * spin)
            ):
                return "y leaves a cone"
            if self.law == "coulomb" and yk[1:].any():
                return "y is not along a normal"
            rim = np.sqrt(zk[1 : 1 + nt] @ zk[1 : 1 + nt]) + (
                spin * abs(zk[-1]) if c["kind"][k] == CONTACT_SPIN else ZERO
            )
            pull += max(ZERO, zk[0] + mu * rim) * LARGEST
        return None if gain > pull else "impulses within the bounds can meet b.y"
