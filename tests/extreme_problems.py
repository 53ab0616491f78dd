"""Problems with extreme numbers, as plain data that JSON can hold: random problems, changed in up to three arrays."""

import json

import hypothesis.strategies as st
import numpy as np
import scipy.sparse as sp
from judge_twin import spec_of
from random_problems import (
    CONTACTS,
    FORMS,
    as_matrix,
    nearly_singular,
    random_contact_problem,
    random_generalized_problem,
    random_lcp,
    seeds,
    side_by_side,
)

import lavender as lv

# The largest number that a problem may have.
LARGEST = 1e60
SPECIAL = (
    0.0,
    5e-324,
    1e-300,
    1e-61,
    1e-60,
    1e-59,
    1e-30,
    1e-20,
    1.0,
    1.0 + 2.0**-52,
    1e20,
    1e30,
    1e59,
    LARGEST,
)
SHAPES = {
    "inv_inertia": (-1, 3, 3),
    "v_free": (-1, 6),
    "jac": (-1, 12),
    "joint_body": (-1, 2),
    "contact_body": (-1, 2),
    "normal": (-1, 3),
    "tangent": (-1, 3),
    "arm_a": (-1, 3),
    "arm_b": (-1, 3),
}
INDICES = ("joint_ptr", "joint_body", "contact_body", "ptr", "kind")


def plain_data(problem):
    """Return a problem as dictionaries and lists of numbers."""
    data = spec_of(problem)
    if data["operator"] == "general":
        target = np.array(data.pop("b")) + problem.jacobian @ problem.generalized.v_free
        data["target"] = target.tolist()
    return data


def build_problem(data):
    """Build the problem of plain data; InputError if it is not valid."""
    cones = lv.Cones(
        **{
            key: np.array(x, np.int32 if key in INDICES else float)
            for key, x in data["cones"].items()
        }
    )
    more = {"friction": data["friction"], "guess": data.get("guess")}
    if data["operator"] == "general":
        n = len(data["v_free"])
        return lv.Problem.from_jacobian(
            np.array(data["J"], float).reshape(-1, n),
            np.array(data["M"], float).reshape(n, n),
            data["v_free"],
            target=data["target"],
            compliance=data.get("compliance"),
            cones=cones,
            **more,
        )
    b = np.array(data["b"], float)
    if data["operator"] == "rows":
        arrays = {
            key: np.array(x, np.int32 if key in INDICES else float).reshape(SHAPES.get(key, -1))
            for key, x in data["rows"].items()
        }
        return lv.Problem(
            b, cones, rows=lv.Rows(**arrays), compliance=data.get("compliance"), **more
        )
    a = np.array(data["A"], float).reshape(len(b), len(b))
    return lv.Problem(b, cones, sp.csr_array(a) if data["operator"] == "csr" else a, **more)


def linear(seed):
    """Build equations with a symmetric, perhaps indefinite matrix."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(0, 10))
    a = rng.normal(size=(m, m))
    return lv.Problem.linear(a @ a.T if seed % 3 else a + a.T, rng.normal(size=m))


def bounded_blocks(seed):
    """Build blocks of one to three rows with finite, infinite, equal or zero bounds."""
    rng = np.random.default_rng(seed)
    size = rng.integers(1, 4, rng.integers(1, 6))
    m = size.sum()
    a = rng.normal(size=(m, rng.integers(1, m + 3)))
    lower, upper = np.sort(rng.normal(size=(2, m)), axis=0)
    lower = np.where(rng.random(m) < 0.3, -np.inf, lower)
    upper = np.where(rng.random(m) < 0.3, np.inf, upper)
    upper = np.where((rng.random(m) < 0.1) & np.isfinite(lower), lower, upper)
    nothing = np.zeros(len(size))
    cones = lv.Cones(np.cumsum([0, *size]), nothing.astype(int), lower, upper, nothing, nothing)
    return lv.Problem(rng.normal(size=m), cones, a @ a.T)


def many_islands(seed):
    """Build 10 to 24 small problems beside each other, more than `auto` solves as one."""
    rng = np.random.default_rng(seed)
    law = ("coulomb", "cone")[seed % 2]
    parts = [random_lcp(seed + i, m=int(rng.integers(1, 4))) for i in range(rng.integers(9, 23))]
    contacts = as_matrix(random_contact_problem(seed, law, bodies=2, joints=1, contacts=2))
    return side_by_side([contacts, *parts])


def contacts(kind, form):
    """Return the maker of small problems with these contacts, given in this form."""

    def make(seed):
        rng = np.random.default_rng(seed)
        law = ("coulomb", "cone")[seed % 2]
        sizes = {
            "bodies": int(rng.integers(2, 5)),
            "joints": int(rng.integers(0, 3)),
            "contacts": int(rng.integers(0, 4)),
        }
        return FORMS[form](CONTACTS[kind](seed, law, **sizes))

    return make


MAKERS = {
    **{f"{kind}, {form}": contacts(kind, form) for kind in CONTACTS for form in FORMS},
    "lcp": lambda seed: random_lcp(seed, m=1 + seed % 12),
    "singular lcp": lambda seed: random_lcp(seed, m=4 + seed % 9, rank=1 + seed % 3),
    "linear": linear,
    "bounded blocks": bounded_blocks,
    "nearly singular M": nearly_singular,
    "many islands": many_islands,
    "round cones": lambda seed: random_generalized_problem(
        seed, "cone", 1 + seed % 9, seed % 4 > 0, contacts=1 + seed % 2, tangents=3 + seed % 3
    ),
}


def replaced(x, how, rng):
    """Return an array some of whose numbers are extreme."""
    if how == "scaled entries":
        return x * 10.0 ** rng.integers(-6, 7, x.shape)
    if how == "scaled":
        return x * 10.0 ** rng.integers(-60, 60)
    if how == "a zero row":
        x[rng.integers(0, len(x))] = 0.0
    elif how == "a copied row":
        x[rng.integers(0, len(x))] = x[rng.integers(0, len(x))]
    else:
        chosen = rng.random(x.shape) < rng.choice([0.1, 0.5])
        x[chosen] = rng.choice(SPECIAL, x.shape)[chosen] * np.where(x[chosen] < 0.0, -1.0, 1.0)
    return x


def change(data, name, how, seed):
    """Replace numbers of one array of plain data; those of A and M stay symmetric, or rows get another unit."""
    rng = np.random.default_rng(seed)
    home = next((d for d in (data, data["cones"], data.get("rows", {})) if name in d), None)
    if home is None or not len(home[name]):
        return
    x = np.array(home[name], float)
    if name in ("A", "M") and how != "special numbers":
        scale = (
            10.0 ** rng.integers(-12, 12, len(x))
            if how.startswith("scaled")
            else rng.integers(0, 2, len(x))
        )
        x = scale[:, None] * x * scale
    else:
        with np.errstate(all="ignore"):
            x = replaced(x, how, rng)
        if name == "inv_inertia":
            x = 0.5 * x + 0.5 * x.transpose(0, 2, 1)
    sign = (
        np.abs
        if name in ("inv_mass", "mu", "patch_radius", "rolling", "compliance")
        else np.asarray
    )
    home[name] = np.clip(sign(x), -LARGEST, LARGEST).tolist()


ARRAYS = (
    "b",
    "A",
    "J",
    "M",
    "v_free",
    "target",
    "compliance",
    "mu",
    "patch_radius",
    "rolling",
    "lower",
    "upper",
    "inv_mass",
    "inv_inertia",
    "jac",
    "arm_a",
    "arm_b",
)
CHANGES = ("scaled entries", "scaled", "a zero row", "a copied row", "special numbers")


@st.composite
def problem_data(draw):
    """A problem of any law and form; in most, numbers of up to three arrays are extreme."""
    data = plain_data(MAKERS[draw(st.sampled_from(sorted(MAKERS)))](draw(seeds)))
    present = [
        name
        for name in ARRAYS
        if any(name in d for d in (data, data["cones"], data.get("rows", {})))
    ]
    changes = st.tuples(st.sampled_from(present), st.sampled_from(CHANGES), seeds)
    for name, how, seed in draw(st.lists(changes, max_size=3)):
        change(data, name, how, seed)
    if data["operator"] == "dense" and draw(st.booleans()):
        data["operator"] = "csr"
    return json.loads(json.dumps(data))
