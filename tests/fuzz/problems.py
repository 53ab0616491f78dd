"""Problems and how they are to be solved, as plain data (what JSON can hold): strategies and builders."""

from functools import cache

import hypothesis.strategies as st
import numpy as np
import scipy.sparse as sp
from crowds import joined
from strategies import LARGEST, chance, generators, numbers, optional, plain, positive, some

import lavender as lv

ORDERS = ("given", "reverse", "symmetric", "random", "bottom_up", "top_down", "colored", "local")
STYLES = ("tame", "tame", "scales", "wild", "special")
LAWS = st.sampled_from(("coulomb", "cone"))
# Kinds of contacts, plain ones most often, and how many rows each may have.
FRICTION = (
    *[lv.CONTACT] * 8, *[lv.CONTACT_SPIN] * 2, *[lv.CONTACT_BOX] * 2, *[lv.CONTACT_ROLLING] * 2, lv.CONTACT_ELLIPSE,
)  # fmt: skip
SIZES = {lv.CONTACT: (1, 2, 3, 3, 3), lv.CONTACT_SPIN: (2, 3, 4, 4), lv.CONTACT_BOX: (3,), lv.CONTACT_ROLLING: (5, 6),
         lv.CONTACT_ELLIPSE: (3,)}  # fmt: skip


def problem_specs(largest=12):
    """Problems of any law and operator; some 8 of 100 are many small ones side by side."""
    return st.integers(0, 99).flatmap(lambda x: crowds() if x >= 92 else parts(largest))


@cache
@st.composite
def crowds(draw):
    """Up to 40 side by side, most of them alike or of one operator and law, more than `auto` takes whole."""
    first = draw(parts(8))
    others = draw(st.lists(st.one_of(st.just(first), *[parts(8)] * 4), min_size=1, max_size=40))
    alike = [other if kind_of(other) == kind_of(first) else first for other in others]
    return joined([first, *alike], draw(st.none() | generators()))


def kind_of(spec):
    """Problems that agree in this can stand side by side in one."""
    return spec["operator"], spec["friction"], lv.ROUND in spec["cones"]["kind"]


@cache
def parts(largest=12):
    """Problems whose rows mostly hang together."""
    return st.one_of(*[bodies()] * 7, *[generalized(largest)] * 3, *[matrices(largest)] * 10).map(plain)


@cache
@st.composite
def matrices(draw, largest):
    """A of its entries."""
    blocks = draw(cones(draw(st.integers(0, largest))))
    m = blocks["ptr"][-1]
    a = draw(matrix(m))
    b = draw(st.sampled_from(("zero", "range", "range", "any", "any")))
    x = draw(numbers(m))
    with np.errstate(all="ignore"):
        x = finite(a @ x) if b == "range" else np.zeros(m) if b == "zero" else x
    spec = {"operator": draw(st.sampled_from(("dense", "csr"))), "A": a, "cones": blocks, "b": x}
    return spec | {"friction": draw(LAWS)} | draw(optional(guess=numbers(m)))


def finite(x):
    """What left the range of the door, as numbers."""
    return np.clip(np.nan_to_num(x, nan=0.0), -LARGEST, LARGEST)


@cache
@st.composite
def cones(draw, rows):
    """Blocks of about `rows` rows."""
    law = draw(st.sampled_from(("linear", "lcp", "lcp", "contacts", "contacts", "mixed")))
    kind, size = [], []
    while sum(size) < rows:
        contact = law == "contacts" or (law == "mixed" and draw(st.booleans()))
        shape = draw(st.sampled_from(FRICTION)) if contact else lv.ROW
        kind.append(shape)
        if contact:
            size.append(draw(st.sampled_from(SIZES[shape])))
        else:
            size.append(draw(st.sampled_from((1, 1, 1, 2, 3))) if law == "mixed" else 1)
    m, k = sum(size), len(size)
    style = "free" if law == "linear" else draw(st.sampled_from(("zero", "boxed", "any", "any")))
    lower, upper = np.full(m, 0.0 if style == "zero" else -np.inf), np.full(m, np.inf)
    if style in ("boxed", "any"):
        lower, upper = np.sort(np.stack([draw(numbers(m)), draw(numbers(m))]), axis=0)
    if style == "any":
        lower, upper = (
            np.where(draw(some(m, 0.3)), -np.inf, lower),
            np.where(draw(some(m, 0.3)), np.inf, upper),
        )
        upper = np.where(draw(some(m, 0.05)) & np.isfinite(lower), lower, upper)
    mu = draw(choices((0.0, 0.5, 1.0, 1e-12, 1e-60, 10.0, 1e8, 1e60), k))
    radius = draw(choices((0.0, 0.1, 1.0, 1e-30, 1e30), k))
    return {
        "ptr": np.cumsum([0, *size]).tolist(),
        "kind": [int(x) for x in kind],
        "lower": lower,
        "upper": upper,
        "mu": np.minimum(mu, 1.0) if draw(chance(0.7)) else mu,
        "patch_radius": radii(kind, np.minimum(radius, 1.0) if draw(chance(0.7)) else radius),
    } | draw(rolling(kind))


def radii(kind, radius):
    """Patch radii; of ellipses, which have none, mu_2 / mu_1 above 0."""
    ellipse = np.array(kind) == lv.CONTACT_ELLIPSE
    return np.where(ellipse, np.clip(np.where(radius == 0.0, 2.0, radius), 1e-12, 1e12), radius)


@st.composite
def rolling(draw, kind):
    """mu_r of blocks, where one rolls."""
    if lv.CONTACT_ROLLING not in kind:
        return {}
    return {"rolling": draw(choices((0.0, 0.01, 0.5, 1e-12, 1e8), len(kind)))}


@cache
def choices(options, n):
    """n of the options (n,)."""
    return st.lists(st.sampled_from(options), min_size=n, max_size=n).map(np.array)


@cache
@st.composite
def matrix(draw, m):
    """(m, m)."""
    kind = draw(st.sampled_from((*["definite"] * 3, "singular", "diagonal", "chain", "asymmetric", "indefinite",
                                 "duplicate", "any", "zero")))  # fmt: skip
    if m == 0:
        return np.zeros((0, 0))
    g = draw(numbers(m * m, draw(st.sampled_from(("tame", "tame", "tame", "whole"))))).reshape(m, m)
    with np.errstate(all="ignore"):
        if kind in ("definite", "singular", "asymmetric", "duplicate"):
            g = g[:, : draw(st.integers(1, m))] if kind == "singular" else g
            a = g @ g.T + (0.0 if kind == "singular" else 0.01 * np.eye(m))
            if kind == "asymmetric":
                a = a + 10.0 ** draw(st.integers(-6, 1)) * draw(numbers(m * m, "tame")).reshape(m, m)
            if kind == "duplicate":
                index = draw(generators()).integers(0, m, m)
                a = a[index][:, index]
        elif kind == "diagonal":
            a = np.diag(draw(numbers(m)))
        elif kind == "chain":
            off = -draw(positive(m - 1, "tame"))
            a = np.diag(draw(positive(m, "tame")) + 2.0) + np.diag(off, 1) + np.diag(off, -1)
        elif kind == "indefinite":
            a = 0.5 * (g + g.T)
        elif kind == "zero":
            a = np.zeros((m, m))
        else:
            a = draw(numbers(m * m)).reshape(m, m)
        if draw(chance(0.25)):  # units of the rows
            scale = draw(positive(m, draw(st.sampled_from(("scales", "wild", "special")))))
            a = scale[:, None] * a * scale[None, :]
        elif draw(chance(0.1)):
            a = a * draw(positive(1, "special"))
        if draw(chance(0.1)):
            gone = draw(st.integers(0, m - 1))
            a[gone] = 0.0
            if draw(chance(0.7)):
                a[:, gone] = 0.0
    return finite(a)


# -- bodies, joints and contacts -----------------------------------------------------------------------------------


@cache
@st.composite
def bodies(draw):
    """A factored problem."""
    n, joints, contacts = draw(st.integers(1, 4)), draw(st.integers(0, 2)), draw(st.integers(0, 4))
    mass_style = draw(st.sampled_from(STYLES))
    inverse = np.where(draw(some(n, 0.05)), 0.0, draw(positive(n, mass_style)))
    joint_ptr = np.cumsum([0, *draw(st.lists(st.integers(1, 4), min_size=joints, max_size=joints))])
    mj = int(joint_ptr[-1])
    jac = draw(
        numbers(mj * 12, draw(st.sampled_from(("tame", "tame", "whole", "scales", "special"))))
    ).reshape(mj, 12)
    if mj and draw(st.booleans()):
        jac[: draw(st.integers(1, mj)), [0, 1, 2, 6, 7, 8]] = 0.0
    normal, tangent = draw(directions(contacts))
    shape = draw(st.sampled_from([k for k in FRICTION if k != lv.CONTACT_ELLIPSE]))
    sizes = draw(st.lists(st.sampled_from(SIZES[shape]), min_size=contacts, max_size=contacts))
    size, kind = [*np.diff(joint_ptr).tolist(), *sizes], [lv.ROW] * joints + [shape] * contacts
    m = sum(size)
    high = np.where(draw(some(m, 0.4)), draw(positive(m)), np.inf)
    arm_style = draw(st.sampled_from(("tame", "tame", "scales", "special")))
    spec = {
        "operator": "rows",
        "friction": draw(LAWS),
        "rows": {
            "inv_mass": inverse,
            "inv_inertia": [draw(inertia(mass_style)) for _ in range(n)],
            "v_free": draw(numbers(6 * n, "tame")).reshape(n, 6),
            "jac": jac,
            "joint_ptr": joint_ptr,
            "joint_body": draw(st.lists(pairs(n), min_size=joints, max_size=joints)),
            "normal": normal,
            "tangent": tangent,
            "arm_a": draw(numbers(3 * contacts, arm_style)).reshape(-1, 3),
            "arm_b": draw(numbers(3 * contacts, arm_style)).reshape(-1, 3),
            "contact_body": draw(st.lists(pairs(n), min_size=contacts, max_size=contacts)),
        },
        "cones": {
            "ptr": np.cumsum([0, *size]).tolist(),
            "kind": kind,
            "lower": -high,
            "upper": high,
            "mu": [0.0] * joints + draw(choices((0.0, 0.3, 0.8, 1.0, 10.0, 1e-12, 1e60), contacts)).tolist(),
            "patch_radius": [0.0] * joints + draw(choices((0.0, 0.1, 1.0), contacts)).tolist(),
        }
        | draw(rolling(kind)),
        "b": draw(numbers(m)) if draw(chance(0.9)) else np.zeros(m),
    }
    return spec | draw(optional(compliance=numbers(m).map(np.abs), guess=numbers(m)))


@cache
def pairs(n):
    """Two of n bodies, the first perhaps the world (-1)."""
    return st.tuples(st.integers(-1, n - 1), st.integers(0, n - 1)).filter(lambda pair: pair[0] != pair[1])


@cache
@st.composite
def inertia(draw, style):
    """An inverse inertia (3, 3), diagonal or turned."""
    diag, turned = np.diag(draw(positive(3, style))), draw(st.booleans())
    q = np.linalg.qr(draw(numbers(9, "tame")).reshape(3, 3) + 3.0 * np.eye(3))[0] if turned else np.eye(3)
    with np.errstate(all="ignore"):
        out = finite(q @ diag @ q.T)
    return 0.5 * out + 0.5 * out.T


@cache
@st.composite
def directions(draw, n):
    """Normals and tangents (n, 3)."""
    normal = draw(numbers(3 * n, "tame")).reshape(n, 3) + np.array([0.0, 0.0, 1e-3])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), np.array([0.0, 0.0, 1.0]))
    tangent = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    return normal, tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


SHAPES = {
    "inv_inertia": (-1, 3, 3), "v_free": (-1, 6), "jac": (-1, 12), "joint_body": (-1, 2), "contact_body": (-1, 2),
    "normal": (-1, 3), "tangent": (-1, 3), "arm_a": (-1, 3), "arm_b": (-1, 3),
}  # fmt: skip
WHOLE = ("joint_ptr", "joint_body", "contact_body")


# -- generalised coordinates ---------------------------------------------------------------------------------------


@cache
@st.composite
def generalized(draw, largest):
    """J, M of a forest, v*, target: rows on chains of its trees, masses and rows of any size."""
    is_round = draw(chance(0.15))
    blocks = draw(round_cones() if is_round else cones(draw(st.integers(0, largest))))
    m, n = blocks["ptr"][-1], draw(st.integers(1, 9))
    parent = [draw(st.integers(-1, i - 1)) for i in range(n)]
    chains = np.eye(n, dtype=bool)  # i hangs on j
    for i, j in enumerate(parent):
        chains[i] |= chains[j] if j >= 0 else False
    lower = np.where(np.eye(n), 1.0, 0.4 * chains * draw(numbers(n * n, "tame")).reshape(n, n))
    mass = lower.T @ np.diag(draw(positive(n, "tame")) + 0.1) @ lower
    mass = 0.5 * (mass + mass.T)
    style = "scales" if is_round else draw(st.sampled_from(STYLES))
    with np.errstate(all="ignore"):
        if draw(chance(0.4)):  # units of the velocities
            scale = draw(positive(n, style))
            mass = scale[:, None] * mass * scale[None, :]
        jac = draw(numbers(m * n, draw(st.sampled_from(("tame", "tame", "whole"))))).reshape(m, n)
        if draw(chance(0.3)):
            jac = jac * draw(positive(m, style))[:, None]
    on = chains[draw(generators()).integers(0, n, m)]
    jac[~on & draw(some(m, 0.7))[:, None]] = 0.0
    sizes = "tame" if is_round else None
    soft = positive(m, sizes).flatmap(lambda x: st.sampled_from((0.0, 1e-6, 1.0)).map(lambda s: s * x))
    spec = {
        "operator": "general",
        "M": finite(mass),
        "J": finite(jac),
        "v_free": draw(numbers(n, sizes)),
        "target": draw(numbers(m, sizes)) if draw(chance(0.6)) else np.zeros(m),
        "cones": blocks,
        "friction": "cone" if is_round else draw(LAWS),
    }
    return spec | draw(optional(compliance=soft, guess=numbers(m, sizes)))


@cache
@st.composite
def round_cones(draw):
    """One or two cones with three to five rows behind the normal."""
    k, size = draw(st.integers(1, 2)), draw(st.integers(4, 6))
    bounds = {"lower": [-np.inf] * (k * size), "upper": [np.inf] * (k * size)}
    mu = draw(choices((0.0, 0.5, 1.0, 1e-3, 10.0), k))
    kinds = {"ptr": [i * size for i in range(k + 1)], "kind": [lv.ROUND] * k}
    return kinds | bounds | {"mu": mu, "patch_radius": [0.0] * k}


def build(spec):
    """The Problem of a spec; what lavender refuses, it raises."""
    c = spec["cones"]
    cones = lv.Cones(
        np.array(c["ptr"], np.int32),
        np.array(c["kind"], np.int32),
        *(np.array(c[key], float) for key in ("lower", "upper", "mu", "patch_radius")),
        rolling=np.array(c.get("rolling", np.zeros(len(c["kind"]))), float),
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

MANY = 20  # blocks, from which a problem is one of several side by side


def law_of(spec):
    """The narrowest law of a problem."""
    c = spec["cones"]
    if not any(c["kind"]) and set(c["lower"]) <= {-np.inf} and set(c["upper"]) <= {np.inf}:
        return "linear"
    rows_alone = all(kind == 0 or size == 1 for kind, size in zip(c["kind"], np.diff(c["ptr"]), strict=True))
    return "lcp" if rows_alone else spec["friction"]


@st.composite
def solve_specs(draw):
    """A problem, a solver (one in ten of another package) and options."""
    problem = draw(problem_specs())
    ours, others = (lv.available(external=other, law=law_of(problem)) for other in (False, True))
    names = [
        name
        for name in (others if others and draw(chance(0.1)) else ours)
        if name != "sequential_impulses" or problem["operator"] == "rows"
    ]
    many = len(problem["cones"]["kind"]) > MANY and names[0] in ours
    solver = "auto" if many and draw(chance(0.7)) else draw(st.sampled_from(names))  # it takes them apart
    s, m = lv.get(solver), problem["cones"]["ptr"][-1]
    options = {"tol": draw(st.sampled_from((1e-6, 1e-6, 1e-9, 1e-12, 1e-3, 0.0, 1e-300, 2.0)))}
    options |= draw(optional(0.7, max_iter=st.sampled_from((1, 2, 20, 50, 200))))
    options |= draw(optional(0.4, impulse=numbers(m)))
    if s.order and draw(chance(0.4)):
        options["order"] = draw(st.sampled_from(ORDERS))
        if s.seed and options["order"] == "random":
            options["seed"] = draw(st.integers(0, 2**32))
    if s.history:
        options |= draw(optional(0.05, history=st.just(True)))
    options |= draw(optional(0.02, time_limit=st.sampled_from((0.0, 1e-6, 1e-3, 1.0))))
    spec = {"kind": "solve", "problem": problem, "solver": solver, "options": options}
    if s.external:  # what it repeats is its own affair
        return plain(spec | {"again": False, "prepared": False})
    if "time_limit" not in options and draw(chance(0.2)):
        spec["threads"] = draw(st.sampled_from((1, 1, 1, 2)))
        spec["others"] = draw(st.lists(numbers(m), max_size=3))
    return plain(spec | {"again": draw(chance(0.25)), "prepared": draw(chance(0.1))})
