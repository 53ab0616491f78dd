"""Problems and how they are to be solved, as plain data (what JSON can hold): generators and builders."""

import numpy as np
import scipy.sparse as sp
from crowds import joined
from draw import numbers, positive

import lavender as lv

ORDERS = ("given", "reverse", "symmetric", "random", "bottom_up", "top_down", "colored", "local")


CROWDS = 0.08  # of problems, many small ones side by side


def problem_spec(draw, largest=12):
    """A problem of any law and operator."""
    if draw.chance(CROWDS):
        return crowd_spec(draw)
    return one_spec(draw, largest)


def crowd_spec(draw):
    """Up to 40 of them side by side, most of them alike or of one operator and law, more than `auto` takes whole."""
    first = one_spec(draw, 8)
    specs = [first]
    for _ in range(draw.whole(1, 40)):
        other = first if draw.chance(0.2) else one_spec(draw, 8)
        same = all(other[key] == first[key] for key in ("operator", "friction"))
        alike = (lv.ROUND in other["cones"]["kind"]) == (lv.ROUND in first["cones"]["kind"])
        specs.append(other if same and alike else first)
    return joined(draw, specs)


def one_spec(draw, largest=12):
    """A problem whose rows mostly hang together."""
    if draw.chance(0.35):
        return rows_spec(draw)
    if draw.chance(0.25):
        return general_spec(draw, largest)
    cones = cones_spec(draw, draw.whole(0, largest))
    m = cones["ptr"][-1]
    spec = {"operator": draw.pick(("dense", "csr")), "A": matrix(draw, m), "cones": cones}
    spec["friction"] = draw.pick(("coulomb", "cone"))
    spec["b"] = right_side(draw, np.array(spec["A"]).reshape(m, m)).tolist()
    if draw.chance(0.2):
        spec["guess"] = numbers(draw, m).tolist()
    return spec


def cones_spec(draw, rows):
    """Blocks of about `rows` rows."""
    law = draw.pick(("linear", "lcp", "lcp", "contacts", "contacts", "mixed"))
    kind, size = [], []
    left = rows
    while left > 0:
        contact = law == "contacts" or (law == "mixed" and draw.chance(0.5))
        if contact:
            spin = draw.chance(0.2)
            kind.append(1 + spin)
            size.append(1 + draw.pick((0, 1, 2, 2, 2)) + spin)
        else:
            kind.append(0)
            size.append(draw.whole(1, 3) if law == "mixed" and draw.chance(0.3) else 1)
        left -= size[-1]
    m, k = sum(size), len(size)
    lower, upper = np.full(m, -np.inf), np.full(m, np.inf)
    if law != "linear":
        style = draw.pick(("zero", "boxed", "any", "any"))
        if style == "zero":
            lower[:] = 0.0
        else:
            ends = np.sort(np.stack([numbers(draw, m), numbers(draw, m)]), axis=0)
            open_low, open_high = (np.array([draw.chance(0.3) for _ in range(m)], bool) for _ in range(2))
            lower, upper = ends
            if style == "any":
                lower, upper = np.where(open_low, -np.inf, lower), np.where(open_high, np.inf, upper)
                same = np.array([draw.chance(0.05) for _ in range(m)], bool) & np.isfinite(lower)
                upper = np.where(same, lower, upper)
    mu = np.array([draw.pick((0.0, 0.5, 1.0, 1e-12, 1e-300, 10.0, 1e8, 1e300)) for _ in range(k)], float)
    if draw.chance(0.7):
        mu = np.minimum(mu, 1.0)
    radius = np.array([draw.pick((0.0, 0.1, 1.0, 1e-200, 1e200)) for _ in range(k)], float)
    if draw.chance(0.7):
        radius = np.minimum(radius, 1.0)
    ptr = np.concatenate([[0], np.cumsum(size)]).astype(int)
    return {
        "ptr": ptr.tolist(),
        "kind": [int(x) for x in kind],
        "lower": lower.tolist(),
        "upper": upper.tolist(),
        "mu": mu.tolist(),
        "patch_radius": radius.tolist(),
    }


KINDS = (
    "definite", "definite", "definite", "singular", "diagonal", "chain", "asymmetric", "indefinite", "duplicate",
    "any", "zero",
)  # fmt: skip


def matrix(draw, m):
    """(m, m) as lists."""
    kind = draw.pick(KINDS)
    if m == 0:
        return []
    g = numbers(draw, m * m, draw.pick(("tame", "tame", "tame", "whole"))).reshape(m, m)
    with np.errstate(all="ignore"):
        if kind in ("definite", "singular", "asymmetric", "duplicate"):
            g = g[:, : max(1, draw.whole(1, m))] if kind == "singular" else g
            a = g @ g.T + (0.0 if kind == "singular" else 0.01 * np.eye(m))
            if kind == "asymmetric":
                a = a + 10.0 ** draw.whole(-6, 1) * numbers(draw, m * m, "tame").reshape(m, m)
            if kind == "duplicate":
                index = [draw.whole(0, m - 1) for _ in range(m)]
                a = a[index][:, index]
        elif kind == "diagonal":
            a = np.diag(numbers(draw, m))
        elif kind == "chain":
            off = -positive(draw, max(m - 1, 0), "tame")
            a = np.diag(np.abs(numbers(draw, m, "tame")) + 2.0) + np.diag(off, 1) + np.diag(off, -1)
        elif kind == "indefinite":
            a = 0.5 * (g + g.T)
        elif kind == "zero":
            a = np.zeros((m, m))
        else:
            a = numbers(draw, m * m).reshape(m, m)
        if draw.chance(0.25):  # units of the rows
            scale = positive(draw, m, draw.pick(("scales", "wild", "special")))
            a = scale[:, None] * a * scale[None, :]
        elif draw.chance(0.1):
            a = a * float(positive(draw, 1, "special")[0])
        if draw.chance(0.1):
            gone = draw.whole(0, m - 1)
            a[gone] = 0.0
            if draw.chance(0.7):
                a[:, gone] = 0.0
    return np.nan_to_num(a, nan=0.0, posinf=1e300, neginf=-1e300).tolist()


def right_side(draw, a):
    """b (m,): zero, in the range of A, or any."""
    m = len(a)
    kind = draw.pick(("zero", "range", "range", "any", "any"))
    if kind == "zero":
        return np.zeros(m)
    x = numbers(draw, m)
    if kind == "range":
        with np.errstate(all="ignore"):
            x = np.nan_to_num(a @ x, nan=0.0, posinf=1e300, neginf=-1e300)
    return x


def rows_spec(draw):
    """A factored problem: bodies, joints, contacts."""
    n, joints, contacts = draw.whole(1, 4), draw.whole(0, 2), draw.whole(0, 4)
    mass_style = draw.pick(("tame", "tame", "scales", "wild", "special"))
    inverse = positive(draw, n, mass_style)
    heavy = np.array([draw.chance(0.05) for _ in range(n)], bool)
    inverse = np.where(heavy, 0.0, inverse)
    inertia = np.zeros((n, 3, 3))
    for i in range(n):
        diag = positive(draw, 3, mass_style)
        if draw.chance(0.5):
            q = np.linalg.qr(numbers(draw, 9, "tame").reshape(3, 3) + 3.0 * np.eye(3))[0]
            with np.errstate(all="ignore"):
                inertia[i] = np.nan_to_num(q * diag @ q.T, posinf=1e300, neginf=-1e300)
            inertia[i] = 0.5 * inertia[i] + 0.5 * inertia[i].T
        else:
            inertia[i] = np.diag(diag)

    def pair():
        b = draw.whole(0, n - 1)
        a = draw.whole(-1, n - 2)
        return [a if a < b else a + 1, b]

    sizes = [draw.whole(1, 4) for _ in range(joints)]
    joint_ptr = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    mj = int(joint_ptr[-1])
    jac = numbers(draw, mj * 12, draw.pick(("tame", "tame", "whole", "scales", "special"))).reshape(mj, 12)
    if mj and draw.chance(0.5):
        jac[: draw.whole(1, mj), [0, 1, 2, 6, 7, 8]] = 0.0
    normal, tangent = np.zeros((contacts, 3)), np.zeros((contacts, 3))
    for c in range(contacts):
        x = numbers(draw, 3, "tame") + np.array([0.0, 0.0, 1e-3])
        x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([0.0, 0.0, 1.0])
        t = np.cross(x, np.eye(3)[int(np.argmin(np.abs(x)))])
        normal[c], tangent[c] = x, t / np.linalg.norm(t)
    arm_style = draw.pick(("tame", "tame", "scales", "special"))
    tangents = [draw.pick((0, 1, 2, 2)) for _ in range(contacts)]
    spin = draw.chance(0.3)
    kind = [0] * joints + [1 + spin] * contacts
    size = [*sizes, *(1 + t + spin for t in tangents)]
    ptr = np.concatenate([[0], np.cumsum(size)]).astype(int)
    m, k = int(ptr[-1]), len(size)
    high = np.where(np.array([draw.chance(0.4) for _ in range(m)], bool), positive(draw, m), np.inf)
    mu = np.zeros(k)
    mu[joints:] = [draw.pick((0.0, 0.3, 0.8, 1.0, 10.0, 1e-12, 1e300)) for _ in range(contacts)]
    radius = np.zeros(k)
    radius[joints:] = [draw.pick((0.0, 0.1, 1.0)) for _ in range(contacts)]
    spec = {
        "operator": "rows",
        "friction": draw.pick(("coulomb", "cone")),
        "rows": {
            "inv_mass": inverse.tolist(),
            "inv_inertia": inertia.tolist(),
            "v_free": numbers(draw, 6 * n, "tame").reshape(n, 6).tolist(),
            "jac": jac.tolist(),
            "joint_ptr": joint_ptr.tolist(),
            "joint_body": [pair() if n > 1 else [-1, 0] for _ in range(joints)],
            "normal": normal.tolist(),
            "tangent": tangent.tolist(),
            "arm_a": numbers(draw, 3 * contacts, arm_style).reshape(-1, 3).tolist(),
            "arm_b": numbers(draw, 3 * contacts, arm_style).reshape(-1, 3).tolist(),
            "contact_body": [pair() if n > 1 else [-1, 0] for _ in range(contacts)],
        },
        "cones": {
            "ptr": ptr.tolist(),
            "kind": [int(x) for x in kind],
            "lower": np.where(np.isinf(high), -np.inf, -high).tolist(),
            "upper": high.tolist(),
            "mu": mu.tolist(),
            "patch_radius": radius.tolist(),
        },
        "b": numbers(draw, m).tolist() if draw.chance(0.9) else [0.0] * m,
    }
    if draw.chance(0.3):
        spec["compliance"] = np.abs(numbers(draw, m)).tolist()
    if draw.chance(0.2):
        spec["guess"] = numbers(draw, m).tolist()
    return spec


SHAPES = {
    "inv_inertia": (-1, 3, 3), "v_free": (-1, 6), "jac": (-1, 12), "joint_body": (-1, 2), "contact_body": (-1, 2),
    "normal": (-1, 3), "tangent": (-1, 3), "arm_a": (-1, 3), "arm_b": (-1, 3),
}  # fmt: skip
WHOLE = ("joint_ptr", "joint_body", "contact_body")


# -- generalised coordinates ---------------------------------------------------------------------------------------


def general_spec(draw, largest):
    """J, M of a forest, v*, target: rows on chains of its trees, masses and rows of any size."""
    cones = cones_spec(draw, draw.whole(0, largest))
    round_cones = draw.chance(0.15)
    if round_cones:
        k = draw.whole(1, 2)
        tangents = draw.whole(3, 5)
        cones = {
            "ptr": [i * (1 + tangents) for i in range(k + 1)],
            "kind": [lv.ROUND] * k,
            "lower": [-np.inf] * (k * (1 + tangents)),
            "upper": [np.inf] * (k * (1 + tangents)),
            "mu": [draw.pick((0.0, 0.5, 1.0, 1e-3, 10.0)) for _ in range(k)],
            "patch_radius": [0.0] * k,
        }
    m, n = cones["ptr"][-1], draw.whole(1, 9)
    parent = [draw.whole(-1, i - 1) if i else -1 for i in range(n)]
    lower = np.eye(n)
    for i in range(n):
        j = parent[i]
        while j >= 0:
            lower[i, j] = float(numbers(draw, 1, "tame")[0]) * 0.4
            j = parent[j]
    mass = lower.T @ np.diag(positive(draw, n, "tame") + 0.1) @ lower
    style = "scales" if round_cones else draw.pick(("tame", "tame", "scales", "wild", "special"))
    with np.errstate(all="ignore"):
        if draw.chance(0.4):  # units of the velocities
            scale = positive(draw, n, style)
            mass = scale[:, None] * mass * scale[None, :]
        jac = numbers(draw, m * n, draw.pick(("tame", "tame", "whole"))).reshape(m, n)
        if draw.chance(0.3):
            jac = jac * positive(draw, m, style)[:, None]
    for i in range(m):
        on = draw.whole(0, n - 1)
        keep = {on}
        while parent[on] >= 0:
            on = parent[on]
            keep.add(on)
        if draw.chance(0.7):
            jac[i, [j for j in range(n) if j not in keep]] = 0.0
    numbers_of = "tame" if round_cones else None
    spec = {
        "operator": "general",
        "M": np.nan_to_num(mass, nan=0.0, posinf=1e300, neginf=-1e300).tolist(),
        "J": np.nan_to_num(jac, nan=0.0, posinf=1e300, neginf=-1e300).tolist(),
        "v_free": numbers(draw, n, numbers_of).tolist(),
        "target": (numbers(draw, m, numbers_of) if draw.chance(0.6) else np.zeros(m)).tolist(),
        "cones": cones,
        "friction": "cone" if round_cones else draw.pick(("coulomb", "cone")),
    }
    if draw.chance(0.4):
        spec["compliance"] = (positive(draw, m, numbers_of) * draw.pick((0.0, 1e-6, 1.0))).tolist()
    if draw.chance(0.2):
        spec["guess"] = numbers(draw, m, numbers_of).tolist()
    return spec


def build(spec):
    """The Problem of a spec; what lavender refuses, it raises."""
    c = spec["cones"]
    cones = lv.Cones(
        np.array(c["ptr"], np.int32),
        np.array(c["kind"], np.int32),
        *(np.array(c[key], float) for key in ("lower", "upper", "mu", "patch_radius")),
    )
    more = {"friction": spec["friction"], "guess": spec.get("guess")}
    if spec["operator"] == "general":
        n = len(spec["v_free"])
        jac = np.array(spec["J"], float).reshape(-1, n)
        more |= {"target": np.array(spec["target"], float), "compliance": spec.get("compliance")}
        return lv.Problem.from_jacobian(jac, np.array(spec["M"], float), spec["v_free"], cones=cones, **more)
    b = np.array(spec["b"], float)
    if spec["operator"] == "rows":
        rows = {
            key: np.array(value, np.int32 if key in WHOLE else float).reshape(SHAPES.get(key, (-1,)))
            for key, value in spec["rows"].items()
        }
        return lv.Problem(b, cones, rows=lv.Rows(**rows), compliance=spec.get("compliance"), **more)
    a = np.array(spec["A"], float).reshape(len(b), len(b))
    return lv.Problem(b, cones, sp.csr_array(a) if spec["operator"] == "csr" else a, **more)


# -- how it is solved ------------------------------------------------------------------------------------------


def own_solvers():
    """This project's solvers."""
    return [name for name, reason in lv.known().items() if reason is None and not lv.get(name).external]


_OWN = []
MANY = 20  # blocks, from which a problem is one of several side by side


def solve_spec(draw):
    """A problem, a solver and options."""
    spec = {"kind": "solve", "problem": problem_spec(draw)}
    if not _OWN:
        _OWN.extend(own_solvers())
    c = spec["problem"]["cones"]
    free = (
        not any(c["kind"]) and all(x == -np.inf for x in c["lower"]) and all(x == np.inf for x in c["upper"])
    )
    plain = all(
        kind == 0 or b - a == 1 for kind, a, b in zip(c["kind"], c["ptr"], c["ptr"][1:], strict=False)
    )
    law = "linear" if free else "lcp" if plain else spec["problem"]["friction"]
    names = [
        name
        for name in _OWN
        if law in lv.get(name).laws
        and (name != "sequential_impulses" or spec["problem"]["operator"] == "rows")
    ]
    many = len(c["kind"]) > MANY
    solver = "auto" if many and draw.chance(0.7) else draw.pick(names)  # it takes them apart
    s = lv.get(solver)
    options = {"tol": draw.pick((1e-6, 1e-6, 1e-9, 1e-12, 1e-3, 0.0, 1e-300, 2.0))}
    if draw.chance(0.7):
        options["max_iter"] = draw.pick((1, 2, 20, 50, 200))
    m = spec["problem"]["cones"]["ptr"][-1]
    if draw.chance(0.4):
        options["impulse"] = numbers(draw, m).tolist()
    if s.order and draw.chance(0.4):
        options["order"] = draw.pick(ORDERS)
        if s.seed and options["order"] == "random":
            options["seed"] = draw.whole(0, 2**32)
        if s.threads and options["order"] == "colored" and draw.chance(0.1):
            options["threads"] = 2
    if s.history and draw.chance(0.05):
        options["history"] = True
    if draw.chance(0.02):
        options["time_limit"] = draw.pick((0.0, 1e-6, 1e-3, 1.0))
    if "time_limit" not in options and draw.chance(0.2):
        spec["threads"] = draw.pick((1, 1, 1, 2))
        spec["others"] = [numbers(draw, m).tolist() for _ in range(draw.whole(0, 3))]
    spec |= {"solver": solver, "options": options, "again": draw.chance(0.25), "prepared": draw.chance(0.1)}
    return spec
