"""The judge once more, in long double and from the data alone: it imports nothing of lavender.

With w = A lambda - b and d as docs/residual.md defines them, E = sqrt(sum d e^2), V = max sqrt(nu d) |e|, and

    relative = max(E / E0, V / V0),   floor = 2^-53 (|A| |lambda| + |b|) in the same two norms, at least
                                                2^-53 (d |lambda| + |b|) where a pair is cut to its bound

of each island, and of all of them the largest.

Long double has 11 more bits and 2^14 instead of 2^10 as its largest exponent, so nothing here overflows, and what
it rounds is far below what float64 may round. `Judgement.allowed` is what float64 may add: each of the m + 20
operations of a row rounds by 2^-53, or by the smallest denormal.

Over J and M, columns of M^-1 J^T are refined with residuals in exact integers, so that A has 64 bits whatever M's
condition is. The judge refines as well, unless its first pass is accurate to a tenth of the tolerance:
`Judgement.unrefined` bounds the error of such a pass, 10 n cond(M) roundings, and `Judgement.floor_most` is the largest
floor that such an M explains.
"""

import itertools
from dataclasses import dataclass, fields

import numpy as np

L = np.longdouble
ROW, CONTACT, CONTACT_SPIN, ROUND, CONTACT_BOX, CONTACT_ROLLING, CONTACT_ELLIPSE = (
    0,
    1,
    2,
    3,
    4,
    5,
    7,
)
NORMAL = L(2.0) ** -1022
LEAST = L(1e-60)  # below which a row of A is empty
U = L(2.0) ** -53
DENORMAL = L(2.0) ** -1074
ZERO = L(0.0)
LARGEST = L(1.7976931348623157e308)  # of an impulse in float64


@dataclass
class Judgement:
    relative: float
    roundoff_floor: float
    allowed: float  # relative residual that float64 may add
    unrefined: float  # and that a pass by the factor of M may add besides
    floor_most: float  # at most what the judge may call its floor
    energy: float
    velocity: float
    nothing: bool  # doing nothing is near the line below which the norms of b stand in
    range: float  # largest |log10| of the numbers on the way
    relatives: np.ndarray  # (n,) of each island
    floors: np.ndarray  # (n,)
    floors_most: np.ndarray  # (n,) `floor_most` of each


def norm(x, sqrt=np.sqrt):
    return abs(x[0]) if len(x) == 1 else sqrt(np.sum(x**2))


BITS = 1130  # of integers that hold any float64 exactly


def as_integers(x):
    """x 2^BITS as exact integers, x of float64 numbers or sums of two."""
    high = x.astype(float)
    out = np.zeros(x.shape, object)
    for part in (high, (x - high).astype(float)):
        digits, exponent = np.frexp(part)
        whole = (digits * 2.0**53).astype(np.int64).astype(object)
        out += whole << (exponent.astype(object) - 53 + BITS)
    return out


def as_long(whole):
    """Integers over 2^(2 BITS) in long double, cut off at 64 bits."""
    out = np.zeros(whole.shape, L)
    for at, x in np.ndenumerate(whole):
        cut = max(0, int(x).bit_length() - 64)
        x >>= cut
        out[at] = np.ldexp(L(x >> 32) * L(2.0) ** 32 + L(x & (2**32 - 1)), cut - 2 * BITS)
    return out


def refined_inverse(lower, mass, right):
    """mass^-1 right in long double by mass = lower lower^T; residuals, in integers, are exact."""

    def solve(r):
        x = r.copy()
        for i in range(len(x)):
            x[i] = (x[i] - lower[i, :i] @ x[:i]) / lower[i, i]
        for i in range(len(x) - 1, -1, -1):
            x[i] = (x[i] - lower[i + 1 :, i] @ x[i + 1 :]) / lower[i, i]
        return x

    x = solve(right)
    if not (np.isfinite(x).all() and np.abs(x).max(initial=ZERO) < 1e300):
        return x
    whole = as_integers(mass)
    given = as_integers(right) << BITS
    for _ in range(3):
        x += solve(as_long(given - whole @ as_integers(x)))
    return x


def project_cone(z, d, bounds, sqrt=np.sqrt):
    """Nearest point of {|z_g| <= a_g n for each part g} in the metric of d; bounds: (places, a_g) of the parts.

    Its normal part n is where the slope of 1/2 d_n (n - z_n)^2 + sum_g 1/2 d_g (|z_g| - a_g n)+^2 vanishes: each part
    counts or does not, and the slope of all that do, a line, is the largest there is at its root.
    """
    size = [norm(z[at], sqrt) for at, _ in bounds]
    n = max(0 * d[0], z[0])
    for counts in list(itertools.product((0, 1), repeat=len(bounds)))[1:]:
        pull = d[0] * z[0]
        weight = d[0]
        for use, (at, reach), t in zip(counts, bounds, size, strict=True):
            pull = pull + use * d[at[0]] * reach * t
            weight = weight + use * d[at[0]] * reach**2
        n = max(n, pull / weight)
    out = z.copy()
    out[0] = n
    for (at, reach), t in zip(bounds, size, strict=True):
        if t > reach * n:
            out[at] = out[at] * (reach * n / t)
    return out


def spec_of(problem):
    """A problem of lavender as plain data."""
    spec = {"operator": problem.operator, "friction": problem.friction, "b": problem.b.tolist()}
    keys = ("ptr", "kind", "lower", "upper", "mu", "patch_radius", "rolling")
    spec["cones"] = {key: getattr(problem.cones, key).tolist() for key in keys}
    if problem.operator == "matrix":
        return spec | {"operator": "dense", "A": problem.dense().tolist()}
    spec["compliance"] = problem.compliance.tolist()
    if problem.operator == "generalized":
        g = problem.generalized
        given = {
            "J": g.jac.toarray(),
            "M": g.mass.toarray(),
            "v_free": g.v_free,
            "target": np.zeros(problem.m),
        }
        return spec | {"operator": "general"} | {key: x.tolist() for key, x in given.items()}
    rows = {f.name: getattr(problem.rows, f.name) for f in fields(problem.rows)}
    return spec | {
        "rows": {key: x.tolist() for key, x in rows.items() if isinstance(x, np.ndarray)}
    }


class Problem:
    """A, |A| (as sums of absolute products), d and nu of a problem given as plain arrays."""

    def __init__(self, spec):
        general = spec["operator"] == "general"
        jac = np.array(spec["J"], L).reshape(-1, len(spec["v_free"])) if general else None
        if general:
            v, target = np.array(spec["v_free"], L), np.array(spec["target"], L)
            self.b = target - jac @ v
            self.b_size = np.abs(target) + np.abs(jac) @ np.abs(v)
            if "b" in spec:  # of an update
                self.b = np.array(spec["b"], L)
                self.b_size = np.abs(np.array(spec["b"], L))
            self.terms = np.abs(self.b + jac @ v) + np.abs(jac) @ np.abs(v)
        else:
            self.b = np.array(spec["b"], L)
            self.b_size = self.terms = np.abs(self.b)
        self.cones = {key: np.array(value) for key, value in spec["cones"].items()}
        self.cones.setdefault("rolling", np.zeros(len(self.cones["kind"])))
        self.law = spec["friction"]
        self.operator = "general" if general else "rows" if "rows" in spec else "matrix"
        self.m = len(self.b)
        self.stretch = self._stretch()
        self.roundings = self.m + 20
        self.of_factor = ZERO
        if general:
            self._of_general(
                jac, np.array(spec["M"], L), np.array(spec.get("compliance", np.zeros(self.m)), L)
            )
        elif "rows" in spec:
            self._of_rows(spec)
        else:
            self.A = np.array(spec["A"], L).reshape(self.m, self.m)
            self.A *= np.outer(self.stretch, self.stretch)
            self.size = np.abs(self.A)
            self.touches = self.A != 0  # (m, m) rows that a row's impulse changes
            self._of_matrix()
        self.b, self.b_size = self.stretch * self.b, self.stretch * self.b_size
        self._pairs()
        self.islands = self._islands()

    def _stretch(self):
        """An ellipse is measured as the disk of its larger coefficient in rows that are so long (m,)."""
        c = self.cones
        out = np.ones(self.m, L)
        self.mu = np.array(c["mu"], L)
        for k in np.flatnonzero(c["kind"] == CONTACT_ELLIPSE):
            sides = np.array([1.0, c["patch_radius"][k]], L)
            self.mu[k] *= sides.max()
            out[c["ptr"][k] + 1 : c["ptr"][k + 1]] = sides / sides.max()
        return out

    # -- the operator ------------------------------------------------------------------------------

    def _of_matrix(self):
        diag = np.diag(self.A).copy()
        big = self.size.max(axis=1, initial=ZERO)
        d = np.where(diag > L(1e-10) * big, diag, big)
        self.empty = big < LEAST
        self.d = self._filled(d, ~self.empty)
        self.nu = self.d.copy()
        self.d_edge = bool(
            np.any(np.abs(diag - L(1e-10) * big) <= L(1e-14) * big)
        ) or self._at_least(big)

    def _filled(self, d, held):
        # where a row counts as empty, the mean of those that are held
        return np.where(held, d, d[held].mean() if held.any() else L(1.0))

    def _at_least(self, d):
        return bool(np.any(np.abs(d - LEAST) <= L(1e-9) * LEAST))

    def _of_rows(self, spec):
        r = {key: np.array(value) for key, value in spec["rows"].items()}
        n = len(r["inv_mass"])
        m = self.m
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
            rows = range(ptr[k], ptr[k + 1])
            slides = len(rows) - (kind[k] == CONTACT_SPIN)
            if kind[k] == CONTACT_ROLLING:
                slides = 3
            turns = (
                axes
                if len(rows) - slides == 3
                else axes[:1]
                if len(rows) - slides == 1
                else axes[1:]
            )
            for q, row in enumerate(rows):
                for sign, arm, body in (
                    (-1, r["arm_a"][c], r["contact_body"][c][0]),
                    (1, r["arm_b"][c], r["contact_body"][c][1]),
                ):
                    if body < 0:
                        continue
                    if q >= slides:
                        jac[row, body, 3:] = sign * turns[q - slides]
                        size[row, body, 3:] = np.abs(turns[q - slides])
                    else:
                        arm = np.array(arm, L)
                        jac[row, body, :3] = sign * axes[q]
                        jac[row, body, 3:] = sign * np.cross(arm, axes[q])
                        # a cross product may cancel, and its float64 keeps only the digits of its terms
                        reach = np.sqrt(arm @ arm)
                        size[row, body, :3] = 1.0
                        size[row, body, 3:] = reach
        free = np.array(r["v_free"], L).ravel()
        self.terms = np.abs(self.b + jac.reshape(m, 6 * n) @ free) + np.abs(
            jac.reshape(m, 6 * n)
        ) @ np.abs(free)
        self.touches = np.zeros((m, n), bool)  # bodies of each row
        for k, pair in enumerate(
            [*r["joint_body"].reshape(-1, 2), *r["contact_body"].reshape(-1, 2)]
        ):
            moving = [
                i
                for i in pair
                if i >= 0 and (r["inv_mass"][i] != 0 or np.any(r["inv_inertia"][i] != 0))
            ]
            self.touches[ptr[k] : ptr[k + 1], moving] = True
        minv, minv_size = np.zeros((n, 6, 6), L), np.zeros((n, 6, 6), L)
        for i in range(n):
            minv[i, [0, 1, 2], [0, 1, 2]] = r["inv_mass"][i]
            minv[i, 3:, 3:] = np.array(r["inv_inertia"][i], L)
        minv_size = np.abs(minv)
        soft = self.soft = np.array(spec.get("compliance", np.zeros(m)), L)
        self.jac_minv = self.stretch[:, None] * jac.reshape(m, 6 * n), minv
        self.jac = jac.reshape(m, 6 * n)
        half = np.einsum("mni,nij->mnj", jac, minv)
        half_size = np.einsum("mni,nij->mnj", size, minv_size)
        self.A = half.reshape(m, 6 * n) @ self.jac.T + np.diag(soft)
        self.size = half_size.reshape(m, 6 * n) @ size.reshape(m, 6 * n).T + np.diag(soft)
        self.A *= np.outer(self.stretch, self.stretch)
        self.size *= np.outer(self.stretch, self.stretch)
        d = np.diag(self.A).copy()
        self.empty = d < LEAST
        self.d = self._filled(d, ~self.empty)
        self.d_edge = bool(np.any((d > 0) & (d < L(1e-12) * np.diag(self.size)))) or self._at_least(
            d
        )
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
        tree = mass != 0
        for _ in range(n.bit_length()):
            tree = tree @ tree  # velocities that M connects, through at most 2, 4, 8, ... entries
        self.touches = (jac != 0) @ tree
        jac = self.stretch[:, None] * jac
        soft = self.stretch**2 * soft
        lower = np.zeros((n, n), L)
        y = np.zeros((self.m, n), L)
        for i in range(n):
            for j in range(i):
                lower[i, j] = (mass[i, j] - lower[i, :j] @ lower[j, :j]) / lower[j, j]
            lower[i, i] = np.sqrt(mass[i, i] - lower[i, :i] @ lower[i, :i])
            y[:, i] = (jac[:, i] - y[:, :i] @ lower[i, :i]) / lower[i, i]
        self.half, self.soft = y, soft
        unit = 1 / np.sqrt(np.diag(mass))
        scaled = (unit[:, None] * mass * unit[None, :]).astype(float)
        condition = np.linalg.cond(scaled) if np.isfinite(scaled).all() else np.inf
        self.of_factor = 10 * n * L(condition)
        inner = y @ y.T if condition < 1e3 else jac @ refined_inverse(lower, mass, jac.T)
        self.A = inner + np.diag(soft)
        self.size = np.abs(y) @ np.abs(y.T) + np.diag(soft)
        d = np.diag(self.A).copy()
        self.empty = d < LEAST
        self.d = self._filled(d, ~self.empty)
        self.nu = self.d.copy()
        self.d_edge = not np.isfinite(self.A).all() or bool(
            np.any((d > 0) & (d < L(1e-12) * np.diag(self.size))) or self._at_least(d)
        )

    def _pairs(self):
        ptr, kind = self.cones["ptr"], self.cones["kind"]
        for k in range(len(kind)):
            j = ptr[k]
            for at in self.pairs(k):
                same = (self.nu[at] == self.d[at]).all()
                self.d[at] = L(0.5) * self.d[at].sum()
                if same:
                    self.nu[at] = self.d[at]
            if kind[k] in (CONTACT_SPIN, CONTACT_ROLLING):
                self.nu[j + self.slide(k) + 1 : ptr[k + 1]] = self.d[j]

    def slide(self, k):
        """Rows behind the normal of a contact that slide."""
        size = int(self.cones["ptr"][k + 1] - self.cones["ptr"][k])
        kind = self.cones["kind"][k]
        if kind == ROW:
            return 0
        return 2 if kind in (ROUND, CONTACT_ROLLING) else size - 1 - (kind == CONTACT_SPIN)

    def pairs(self, k):
        """Two rows that have one d, and count by their norm: those that slide in a disk, those that roll."""
        j = self.cones["ptr"][k]
        end = self.cones["ptr"][k + 1]
        kind = self.cones["kind"][k]
        found = [slice(j + 1, j + 3)] if self.slide(k) == 2 and kind != CONTACT_BOX else []
        rolls = kind == CONTACT_ROLLING or (kind == ROUND and end - j == 6)
        return [*found, slice(end - 2, end)] if rolls else found

    def parts(self, k):
        """(places, most of their norm over lam_n) of all that a contact bounds by itself; no round cone."""
        c = self.cones
        slide = self.slide(k)
        mu = self.mu[k]
        size = int(c["ptr"][k + 1] - c["ptr"][k])
        kind = c["kind"][k]
        apart = mu * L(c["patch_radius"][k])
        if kind == CONTACT_BOX:
            return [([1], mu), ([2], apart)]
        found = [(list(range(1, 1 + slide)), mu)] if slide else []
        if kind == CONTACT_SPIN or (kind == CONTACT_ROLLING and size == 6):
            found.append(([1 + slide], apart))
        if kind == CONTACT_ROLLING:
            found.append(([size - 2, size - 1], L(c["rolling"][k])))
        return found

    def _islands(self):
        """Masks (n, m) of rows whose blocks share what they touch, directly or through others."""
        ptr = self.cones["ptr"]
        touch = np.array(
            [self.touches[ptr[k] : ptr[k + 1]].any(axis=0) for k in range(len(ptr) - 1)]
        )
        label = np.full(len(ptr) - 1, -1)
        for k in range(len(label)):
            if label[k] >= 0:
                continue
            label[k] = label.max() + 1
            reached = touch[k].copy()
            while (found := (label < 0) & (touch & reached).any(axis=1)).any():
                label[found] = label[k]
                reached |= touch[found].any(axis=0)
        rows = np.repeat(label, np.diff(ptr))
        return [rows == i for i in range(label.max(initial=-1) + 1)]

    # -- the error of an impulse -------------------------------------------------------------------

    def slack(self, lam):
        return self.A @ lam - self.b

    def error(self, lam, w):
        """e (m,), by the law; w / d as it is where no bound acts, since lam - (lam - w / d) has fewer digits."""
        e = np.zeros(self.m, L)
        c = self.cones
        step = w / self.d
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
        e = step.copy()
        e[0] = min(step[0], lam[0])
        for at, reach in self.parts(k):
            y = lam[at] - step[at]
            rim = reach * max(ZERO, lam[0])
            if len(at) == 1:
                e[at] = np.minimum(np.maximum(step[at], lam[at] - rim), lam[at] + rim)
            elif np.sqrt(y @ y) > rim:
                e[at] = lam[at] - y * (rim / np.sqrt(y @ y))
        return e

    def _cone(self, k, lam, step):
        """Error of the projection in the metric of d."""
        z = lam - step
        d = self.d[self.cones["ptr"][k] : self.cones["ptr"][k + 1]]
        nearest = project_cone(z, d, self.parts(k))
        return np.where(nearest == z, step, lam - nearest)

    def _round(self, k, lam, step):
        """Error of the projection on sum (|y_g| / a_g)^2 <= y_n^2 by bisection on its multiplier."""
        c = self.cones
        j = self.cones["ptr"][k]
        d = self.d[j : c["ptr"][k + 1]]
        mu = self.mu[k]
        root = np.sqrt(d)
        y = root * (lam - step)
        normal = y[0]
        y = y[1:]
        a = mu * root[1:] / root[0]
        size = np.abs(y)
        if mu == 0:
            inside = not y.any() and normal >= 0
            top = max(ZERO, normal)
            scale = np.zeros(len(y), L)
        else:
            inside = normal >= 0 and ((size / a) ** 2).sum() <= normal * normal
            top = ZERO
            scale = np.zeros(len(y), L)
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
                rise = high
                while (
                    low < (half := (low + high) / 2) < high
                ):  # to the last bit, however small it is beside `high`
                    rise = half
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

    def speeds(self, e):
        """(m,) what each row moves wrong, those that count by their norm alike."""
        size = np.abs(e)
        for k in range(len(self.cones["kind"])):
            for at in self.pairs(k):
                size[at] = np.sqrt((e[at] ** 2).sum())
        return np.sqrt(self.nu * self.d) * size

    def norms(self, e):
        """E and V."""
        return np.sqrt((self.d * e * e).sum()), self.speeds(e).max(initial=ZERO)

    def judge(self, impulse):
        """Judgement of an impulse (m,) float64."""
        lam = np.array(impulse, L) / self.stretch
        if not np.isfinite(lam).all():
            return Judgement(
                np.inf,
                0.0,
                0.0,
                0.0,
                np.inf,
                np.inf,
                np.inf,
                False,
                np.inf,
                np.zeros(0),
                np.zeros(0),
                np.zeros(0),
            )
        with np.errstate(all="ignore"):
            return self._judge(lam)

    def _judge(self, lam):
        w = self.slack(lam)
        error = self.error(lam, w)
        size = self.size @ np.abs(lam)
        size = np.maximum(size, self._own(error, lam, w)) + self.b_size
        energy, velocity = self.norms(error)
        start = np.where(self._bounded(), np.clip(ZERO, self._low(), self._high()), ZERO).astype(L)
        slack0 = self.slack(start)
        error0 = self.error(start, slack0)
        line = L(2.0) ** -48 * np.abs(self.b)
        # Errors of the start at the line below which they are rounding, or so small that a product of them vanishes.
        at_line = (
            (self.d * np.abs(error0) >= line / 16)
            & (self.d * np.abs(error0) <= 16 * line)
            & (line > 0)
        )
        nothing = bool(at_line.any())
        f = L(2.0) ** -53 * size
        held = self._held(lam, w, L(2.0) ** -53 * (self.size @ np.abs(lam) + np.abs(self.b)))
        rounded = L(2.0) ** -53 * self.d * np.abs(lam)  # of lambda - Pi, where d is not A_ii
        more = self.roundings * (f + rounded + DENORMAL * (1 + np.abs(lam).max(initial=ZERO)))
        references = [self._reference(rows, start, slack0, error0) for rows in self.islands]
        whole = (
            np.sqrt(sum((x * x for x, _ in filter(None, references)), ZERO)),
            max((y for _, y in filter(None, references)), default=ZERO),
        )
        relatives, floors, allows, losses = [], [], [], []
        scale, is_edge = self._scale_of_unmoved_rows(error0)
        nothing |= is_edge
        for rows, reference in zip(self.islands, references, strict=True):
            if not np.isnan(scale[rows]).any():
                relatives.append(self._by_scale(rows, error, scale))
                for out in (floors, allows, losses):
                    out.append(self._by_scale(rows, f / self.d, scale))
                continue
            if reference is None:  # no row acts: each is compared with its own terms
                own = (
                    self._own_floor(~held * f, k, row, whole[0]) for k, row in self._rows_of(rows)
                )
                relatives.append(self._by_rows(rows, error, whole[0]))
                floors.append(max(own, default=ZERO))
                allows.append(self._by_rows(rows, more / self.d, whole[0]))
                losses.append(
                    self._by_rows(rows, self.of_factor * (f + rounded) / self.d, whole[0])
                )
                continue
            nothing |= bool(0 < reference[0] <= LEAST * np.sqrt(self.d.sum()))
            nothing |= bool(0 < reference[1] <= LEAST * np.sqrt(self.nu * self.d).max(initial=ZERO))
            floor = self._ratio(*self._floor(rows * ~held * f), *reference)
            relative = self._ratio(*self.norms(rows * error), *reference)
            shares = (self.d * np.abs(error) / scale)[rows & ~np.isnan(scale)]
            relative = max(relative, min(L(1.0), shares.max(initial=ZERO)))
            if floor > max(relative, 1e-3) and np.isfinite(floor):
                relative = floor  # rounding hides a thousandth of the zero impulse's error
            relatives.append(relative)
            floors.append(floor)
            allows.append(self._ratio(*self._floor(rows * more), *reference))
            losses.append(
                self._ratio(*self._floor(rows * self.of_factor * (f + rounded)), *reference)
            )
        relative, allowed, unrefined = (max(x, default=ZERO) for x in (relatives, allows, losses))
        floor = floors[int(np.argmax(relatives))] if relatives else ZERO
        scales = [x for reference in references if reference is not None for x in reference]
        seen = np.abs(np.concatenate([lam, w, self.d, self.b, [energy, velocity], scales]))
        seen = seen[(seen > 0) & np.isfinite(seen)]
        span = float(np.abs(np.log10(seen)).max(initial=0.0))
        return Judgement(
            float(relative),
            float(floor),
            float(allowed),
            float(unrefined),
            float(100 * floor + unrefined),
            float(energy),
            float(velocity),
            nothing,
            span,
            np.array(relatives, float),
            np.array(floors, float),
            np.array(
                [100 * floor + loss for floor, loss in zip(floors, losses, strict=True)], float
            ),
        )

    def _reference(self, rows, start, slack, error):
        """(E0, V0) of the rows of an island from the zero impulse, its slack and error; None if no row acts."""
        rounding = L(2.0) ** -48 * np.abs(self.b)
        if not np.all(self.d[rows] * np.abs(error[rows]) <= rounding[rows]):
            return self.norms(rows * error)
        low, high = self._low(), self._high()
        pushed = ((start == low) & (slack > rounding)) | ((start == high) & (-slack > rounding))
        acts = rows & ~(self._bounded() & (pushed | (low == high)))
        for part, parts in self._contacts():
            gap = slack[part][0]
            line = np.abs(self.b[part][0])
            if self.law == "cone":
                gap -= sum(reach * norm(slack[part][at]) for at, reach in parts)
                line += sum(reach * norm(self.b[part][at]) for at, reach in parts)
            acts[part] &= not gap > L(2.0) ** -48 * line
        found = self.norms(acts * self.b / self.d)
        return found if found[0] > 0 else None

    def _scale_of_unmoved_rows(self, error0):
        """(m,) s of rows that no impulse moves, NaN on others; and whether one is near a line between two cases.

        A row: its error at the zero impulse above 2^-48 of its terms, otherwise its terms. A contact: likewise, of all
        rows together. With tangents that move, b of the normal, if that approaches.
        """
        c = self.cones
        out = np.full(self.m, np.nan, L)
        is_edge = False
        tiny = L(2.0) ** -51 * np.abs(self.b).max(initial=ZERO)
        for k in range(len(c["kind"])):
            part = slice(c["ptr"][k], c["ptr"][k + 1])
            own = self.d[part] * np.abs(error0[part])
            terms, empty = self.terms[part].copy(), self.empty[part].copy()
            if c["kind"][k] != ROW and not empty[0]:
                continue
            if c["kind"][k] != ROW and empty.all():
                own[:] = np.sqrt(self.d[part][0] * (self.d[part] * error0[part] ** 2).sum())
                terms[:] = terms.max()
            elif c["kind"][k] != ROW:
                empty[1:] = False
                empty[0] = self.b[part][0] > 0
                own[0] = self.b[part][0]
            line = L(2.0) ** -48 * np.where(np.isfinite(terms), terms, ZERO)
            is_edge |= bool(np.any(empty & (line > 0) & (own > line / 16) & (own < 16 * line)))
            s = np.where(own > line, own, terms)
            is_edge |= bool(
                np.any(
                    empty & (np.abs(self.b[part]) > tiny / 4) & (np.abs(self.b[part]) < 4 * tiny)
                )
            )
            out[part] = np.where(
                empty, np.where(np.abs(self.b[part]) <= tiny, L(np.inf), s), np.nan
            )
        return out, is_edge

    def _by_scale(self, rows, error, scale):
        """Largest error of the rows of an island over their scale, of a contact all rows together."""
        ptr = self.cones["ptr"]
        kind = self.cones["kind"]
        worst = ZERO
        for k in range(len(kind)):
            part = slice(ptr[k], ptr[k + 1])
            if not rows[ptr[k]]:
                continue
            size = self.d[part] * np.abs(error[part])
            if kind[k] != ROW:
                size = np.sqrt(self.d[part][0] * (self.d[part] * error[part] ** 2).sum())[None]
            for x, y in zip(size, scale[part], strict=False):
                share = ZERO if x == 0 else x / y if y > 0 else L(np.inf)
                worst = max(worst, share if kind[k] == ROW else min(share, L(1.0)))
        return worst

    def _rows_of(self, rows):
        """(row whose b counts, row) of the rows of an island: of a contact b of its normal."""
        ptr, kind = self.cones["ptr"], self.cones["kind"]
        for k in range(len(kind)):
            for row in range(ptr[k], ptr[k + 1]) if rows[ptr[k]] else ():
                yield (row if kind[k] == ROW else ptr[k]), row

    def _own_floor(self, f, first, row, whole):
        own = np.abs(self.b[first]) if self.b[first] != 0 else self.terms[first]
        if own > 0:
            return f[row] * np.sqrt(self.d[first] / self.d[row]) / own
        return (
            ZERO
            if f[row] == 0
            else f[row] / np.sqrt(self.d[row]) / (4 * U * whole)
            if whole > 0
            else L(np.inf)
        )

    def _held(self, lam, w, rounding):
        """(m,) rows whose slack holds them at their bound, a contact at zero impulse, by more than its rounding."""
        low, high = self._low(), self._high()
        out = ((lam == low) & (w > rounding)) | ((lam == high) & (-w > rounding))
        for part, parts in self._contacts():
            gap, line = w[part][0], rounding[part][0]
            if self.law == "cone":
                gap -= sum(reach * norm(w[part][at]) for at, reach in parts)
                line += sum(reach * rounding[part][at].sum() for at, reach in parts)
            out[part] = gap > line and not lam[part].any()
        return out

    def _contacts(self):
        """(rows, parts) of each contact; a round cone is one part."""
        ptr = self.cones["ptr"]
        for k in np.flatnonzero(self.cones["kind"] != ROW):
            parts = self.parts(k)
            if self.cones["kind"][k] == ROUND:
                parts = [(list(range(1, ptr[k + 1] - ptr[k])), self.mu[k])]
            yield slice(ptr[k], ptr[k + 1]), parts

    def _by_rows(self, rows, error, whole):
        """Largest error of the rows of an island, each over its own b, a contact's over that of its normal.

        Without b over the terms of b, and without these over 2^-51 of E0 of all rows.
        """
        ptr = self.cones["ptr"]
        kind = self.cones["kind"]
        worst = ZERO
        for k in range(len(kind)):
            part = slice(ptr[k], ptr[k + 1])
            if not rows[ptr[k]]:
                continue
            size = np.sqrt(self.d[part]) * np.abs(error[part])
            own = np.where(self.b[part] != 0, np.abs(self.b[part]), self.terms[part]) / np.sqrt(
                self.d[part]
            )
            if kind[k] != ROW:
                size = np.sqrt((size**2).sum())[None]
                own = own[:1]
            for x, y in zip(size, np.where(own > 0, own, 4 * U * whole), strict=True):
                worst = max(worst, ZERO if x == 0 else x / y if y > 0 else L(np.inf))
        return worst

    def _own(self, e, lam, w):
        """(m,) d |lambda| of pairs whose norm is cut to its bound."""
        out = np.zeros(self.m, L)
        for at in (at for k in range(len(self.cones["kind"])) for at in self.pairs(k)):
            out[at] = np.where(e[at] != w[at] / self.d[at], self.d[at] * np.abs(lam[at]), 0)
        return out

    def _floor(self, f):
        return np.sqrt((f * f / self.d).sum()), (f * np.sqrt(self.nu / self.d)).max(initial=ZERO)

    def _ratio(self, x, y, x0, y0):
        return max(
            ZERO if a == 0 else (a / a0 if a0 > 0 else L(np.inf)) for a, a0 in ((x, x0), (y, y0))
        )

    def _bounded(self):
        c = self.cones
        return np.repeat(c["kind"] == ROW, np.diff(c["ptr"]))

    def _low(self):
        return np.array(self.cones["lower"], L)

    def _high(self):
        return np.array(self.cones["upper"], L)

    # -- no solution -------------------------------------------------------------------------------

    def _rounds(self, y, z, share):
        """(m,) where rounding of the data by `share` explains A^T y: of A by its rows, of J as a whole; never of R."""
        length = np.sqrt(self.d)
        size = length @ np.abs(y)
        least = ZERO
        if self.operator == "matrix":
            return np.abs(z) <= share * length * size
        if self.operator == "general":
            square = np.sum((self.half.T @ y) ** 2)
        else:
            jac, minv = self.jac_minv
            r = (jac.T @ y).reshape(-1, 6)
            square = np.einsum("ni,nij,nj->", r, minv, r)
            # An inertia that is flat to rounding: what J has along it counts for nothing.
            least = L(4.0) * U * np.einsum("ni,nij,nj->", np.abs(r), np.abs(minv), np.abs(r))
        off = np.abs(z - self.soft * y)
        explained = square <= max((share * size) ** 2, least)
        return (self.soft * y == 0) & explained & (off <= share * length * size)

    def _rim_rounds(self, y, slack, share, part, parts):
        """Whether rounding of the data explains what A^T y pulls along a contact's cone."""
        if self.operator == "matrix":
            limit = share * np.sqrt(self.d[part]) * (np.sqrt(self.d) @ np.abs(y))
            return slack <= limit[0] + sum(
                reach * np.sqrt(limit[at] @ limit[at]) for at, reach in parts
            )
        along = np.zeros(self.m, L)
        along[part.start] = slack
        return bool(self._rounds(y, along, share)[part.start])

    def refutes(self, y):
        """Why y (m,) does not prove that there is no solution, or None where it does.

        Wanted: y in the recession cone of the bounds, and b.y > max (A^T y).lambda over the bounds, for data
        within rounding of these.
        """
        y = np.array(y, L)
        if y.shape != (self.m,) or not np.isfinite(y).all():
            return "not finite numbers"
        y /= self.stretch
        c = self.cones
        gain = self.b @ y
        most = np.abs(self.b) @ np.abs(y)
        if not gain > 0:
            return "b.y is not positive"
        z = self.A.T @ y
        share = min(L(4.0) * (self.m + 2) * U, L(1e-9) * gain / most)
        z = np.where(self._rounds(y, z, share), ZERO, z)
        pull = ZERO
        for k in range(len(c["kind"])):
            part = slice(c["ptr"][k], c["ptr"][k + 1])
            if c["kind"][k] == ROW:
                low, high = np.array(c["lower"][part], L), np.array(c["upper"][part], L)
                if np.any((y[part] > 0) & np.isfinite(high)) or np.any(
                    (y[part] < 0) & np.isfinite(low)
                ):
                    return "y leaves the bounds"
                low = np.maximum(low, -LARGEST)
                high = np.minimum(high, LARGEST)
                pull += sum(
                    x * (h if x > 0 else lo)
                    for x, lo, h in zip(z[part], low, high, strict=True)
                    if x != 0
                )
                continue
            yk, zk = y[part], z[part]
            parts = self.parts(k)
            if c["kind"][k] == ROUND:
                parts = [(list(range(1, len(yk))), self.mu[k])]
            limit = yk[0] * (1 + L(1e-11))
            if yk[0] < 0 or any(np.sqrt(yk[at] @ yk[at]) > reach * limit for at, reach in parts):
                return "y leaves a cone"
            if self.law == "coulomb" and yk[1:].any():
                return "y is not along a normal"
            rim = sum(reach * np.sqrt(zk[at] @ zk[at]) for at, reach in parts)
            if not self._rim_rounds(y, zk[0] + rim, share, part, parts):
                pull += max(ZERO, zk[0] + rim) * LARGEST
        return None if gain > pull else "impulses within the bounds can meet b.y"


def sweep(problem, twin, lam, blocks):
    """One sweep over blocks under Coulomb's law, in place; A, d and bounds are those of the judge's twin."""
    c = problem.cones
    s = twin.stretch
    (a, b, d) = (x.astype(float) for x in (twin.A, twin.b, twin.d))
    given = lam
    lam = lam / s
    for i in blocks:
        j = c.ptr[i]
        end = c.ptr[i + 1]
        if c.kind[i] == ROW:
            for q in range(j, end):
                lam[q] = np.clip(lam[q] - (a[q] @ lam - b[q]) / d[q], c.lower[q], c.upper[q])
            continue
        lam[j] = max(0.0, lam[j] - (a[j] @ lam - b[j]) / d[j])
        for rows, bound in twin.parts(i):
            t = j + np.array(rows)
            block = a[np.ix_(t, t)]
            y = lam[t] - (a[t] @ lam - b[t]) / np.linalg.eigvalsh(0.5 * (block + block.T)).max()
            size = np.linalg.norm(y)
            lam[t] = y if size <= bound * lam[j] else y * (bound * lam[j] / size)
    given[:] = s * lam
