"""Draw problems and batches of J and M from axes in which faults have hidden: units, condition, ranges, structure.

`AXES` lists the values of each axis. `draw_choices` deals them so that each value is equally frequent and each world
has a combination of its own; `draw_world` makes the arrays of a combination, `World.make_problem` a problem of them and
`lay_out` a batch. Worlds of one law and one number of velocities may stand beside each other in one batch.
"""

import functools
import operator
from dataclasses import dataclass

import numpy as np
from random_problems import conditioned, random_tree_parents, tree_mass

import lavender as lv

AXES = {
    "mass_unit": (2.0**-30, 1.0, 2.0**30),
    "condition": ((0.0, 2.0), (2.0, 6.0), (6.0, 9.0), (9.0, 11.5)),  # Powers of 10.
    "structure": ("full M", "tree", "zeros of M", "one coupling"),
    "coupling": ("one island", "one island", "two islands", "an empty row"),
    "size": ("fewer rows than velocities", "as many", "more"),
    "softness": ("rigid", "soft", "both"),
    "limits": ("none", "near", "far", "without zero"),
    "motion": (
        "moving",
        "moving",
        "slow",
        "at rest",
        "separating and sliding",
        "touching and sliding",
    ),
    "friction": ("none", "sliding", "sticking"),
}
#: Precision of J, M and v* of a batch.
PRECISIONS = (("f8", "f8", "f8"), ("f4", "f4", "f4"), ("f4", "f8", "f8"), ("f8", "f4", "f8"))


@dataclass
class World:
    """Arrays of a problem of J (m, nv) and M (nv, nv) in SI units, and the values of the axes they were drawn from."""

    jac: np.ndarray
    mass: np.ndarray
    free: np.ndarray
    target: np.ndarray
    compliance: np.ndarray
    cones: lv.Cones
    law: str
    choice: dict

    def make_problem(self):
        """Return a problem of copies of the arrays."""
        return lv.Problem.from_jacobian(
            self.jac.copy(), self.mass.copy(), self.free.copy(), target=self.target.copy(), cones=self.cones,
            compliance=self.compliance.copy(), friction=self.law,
        )  # fmt: skip


def draw_choices(rng, n):
    """Return n combinations {axis: value}; the values of an axis occur equally often."""
    columns = {}
    for axis, values in AXES.items():
        dealt = [values[i % len(values)] for i in range(n)]
        columns[axis] = [dealt[i] for i in rng.permutation(n)]
    return [{axis: column[i] for axis, column in columns.items()} for i in range(n)]


def draw_mass(rng, nv, structure, condition):
    """Draw M (nv, nv) in kg: full, over a tree, or with zeros that its factor passes over, other ones in each world."""
    if structure == "tree":
        mass = tree_mass(rng, random_tree_parents(rng, nv))
        size = np.geomspace(
            1.0, condition**0.25, nv
        )  # Unequal links; the scaled M keeps its condition.
        return size[:, None] * mass * size
    if structure == "one coupling":
        mass = np.diag(np.geomspace(1.0, condition, nv)[rng.permutation(nv)])
        column = int(rng.integers(0, max(nv - 1, 1)))
        if nv > 1:
            mass[-1, column] = mass[column, -1] = 0.5 * np.sqrt(mass[-1, -1] * mass[column, column])
        return mass
    mass = conditioned(rng, nv, condition)
    if structure == "zeros of M":
        cut = int(rng.integers(1, nv)) if nv > 1 else 1
        mass[cut:, :cut] = mass[:cut, cut:] = 0.0
    return mass


def draw_blocks(rng, law):
    """Draw a function of the number of rows: rows before contacts, contacts, and rows behind them.

    Worlds of one function share groups of lanes.
    """
    share = 0.0 if law == "lcp" else float(rng.choice([0.5, 1.0]))
    place = float(rng.choice([0.0, 0.5, 1.0]))

    def divide(m):
        contacts = round(share * (m // 3))
        before = round(place * (m - 3 * contacts))
        return before, contacts, m - 3 * contacts - before

    return divide


def draw_world(rng, choice, nv, law, precision, divide):
    """Draw the arrays of a combination with nv velocities."""
    unit = choice["mass_unit"]
    m = {"fewer rows than velocities": max(1, nv // 2), "as many": nv, "more": nv + 3}[
        choice["size"]
    ]
    before, contacts, behind = divide(m)
    normals = before + 3 * np.arange(contacts)
    is_bounded = np.ones(m, bool)
    is_bounded[before : before + 3 * contacts] = False
    # Rounded to float32, M of a larger condition number need not be positive definite.
    condition = 10.0 ** min(
        rng.uniform(*choice["condition"]), 4.0 if precision[1] == "f4" else 12.0
    )
    mass = draw_mass(rng, nv, choice["structure"], condition)
    jac = rng.standard_normal((m, nv)) * (rng.random((m, nv)) < 0.7)
    jac[:, int(rng.integers(0, nv))] += 0.5  # Couples all rows.
    if choice["coupling"] == "two islands" and nv > 1:
        cut = nv // 2
        mass[cut:, :cut] = mass[:cut, cut:] = 0.0
        is_first = (
            np.arange(m) < before + 3 * (contacts // 2) if contacts else np.arange(m) % 2 == 0
        )
        jac[is_first, cut:] = 0.0
        jac[~is_first, :cut] = 0.0
    mass = (unit * 0.5 * (mass + mass.T)).astype(precision[1])
    if choice["coupling"] == "an empty row":
        first = int(normals[0]) if contacts else 0
        jac[first : first + (3 if contacts else 1)] = 0.0
    size = np.einsum("ij,ij->i", jac, np.linalg.solve(mass.astype(float), jac.T).T)
    is_soft = {"rigid": np.zeros(m, bool), "soft": np.ones(m, bool), "both": rng.random(m) < 0.5}[
        choice["softness"]
    ]
    compliance = np.where(is_soft, rng.uniform(1e-3, 0.2, m) * np.abs(size), 0.0)
    low = np.zeros(m)
    high = np.full(m, np.inf)
    if choice["limits"] != "none":
        # Near the impulses that stop 1 m/s, or far beyond.
        typical = 1.0 / np.where(size > 0.0, size, 1.0)
        high = rng.uniform(0.05, 0.5, m) * typical * (1e9 if choice["limits"] == "far" else 1.0)
    low = np.where(rng.random(m) < 0.3, -high, 0.0)
    if choice["limits"] == "without zero":
        low = 0.1 * high
    mu = {"none": 0.0, "sliding": 0.05, "sticking": 1.0}[choice["friction"]] * rng.uniform(
        0.5, 1.5, contacts
    )
    parts = [lv.Cones.bounded(low[:before], high[:before])] if before else []
    parts += [lv.Cones.contacts(mu)] if contacts else []
    parts += [lv.Cones.bounded(low[m - behind :], high[m - behind :])] if behind else []
    cones = functools.reduce(operator.add, parts)
    free = rng.standard_normal(nv)
    target = 0.1 * rng.standard_normal(m)
    if choice["motion"] == "slow":
        free *= 1e-7
        target *= 1e-7
    elif choice["motion"] == "at rest":
        free[:] = target[:] = 0.0
    elif choice["motion"] == "separating and sliding":
        # b = target - J v* < 0 in every row that pushes, and both tangents of a contact move.
        target = jac.astype(precision[0]).astype(float) @ free.astype(precision[2]).astype(float)
        target -= np.where(is_bounded & (low == 0.0), rng.uniform(0.1, 1.0, m), 0.0)
        target[normals] -= rng.uniform(0.1, 1.0, contacts)
        target[normals + 1] += 0.3
        target[normals + 2] -= 0.4
    elif choice["motion"] == "touching and sliding":
        # Zero solves contacts at rest along their normals, and b = target is exact.
        free[:] = target[:] = 0.0
        target[normals + 1] = rng.uniform(-1.0, 1.0, contacts)
        target[normals + 2] = rng.uniform(-1.0, 1.0, contacts)
    jac = jac.astype(precision[0])
    free = free.astype(precision[2])
    return World(
        jac, mass, free, target, compliance, cones, "coulomb" if law == "lcp" else law, choice
    )


def draw_worlds(seed, n, law, nv=None, precision=None):
    """Draw n worlds that fit in one batch."""
    rng = np.random.default_rng(seed)
    nv = int(rng.integers(1, 25)) if nv is None else nv
    precision = (
        PRECISIONS[int(rng.integers(0, len(PRECISIONS)))] if precision is None else precision
    )
    divide = draw_blocks(rng, law)
    return [draw_world(rng, choice, nv, law, precision, divide) for choice in draw_choices(rng, n)]


def lay_out(worlds, layout="rows"):
    """Return worlds as a batch: ragged by rows or by entries, padded, or views of wider arrays."""
    cones = [w.cones for w in worlds]
    count, nv = np.array([w.cones.n_rows for w in worlds]), len(worlds[0].free)
    ptr = np.concatenate([[0], np.cumsum(count)])
    mass, free = np.array([w.mass for w in worlds]), np.array([w.free for w in worlds])
    target, compliance = (
        np.concatenate([getattr(w, x) for w in worlds]) for x in ("target", "compliance")
    )
    jac = np.concatenate([w.jac for w in worlds])
    more = {"cones": cones, "friction": worlds[0].law}
    if layout == "rows":
        return lv.Batch(
            jac, mass, free.ravel(), target=target, compliance=compliance, row_ptr=ptr, **more
        )
    if layout == "triangles":
        i, j = np.tril_indices(nv)
        triangles = mass[:, i, j], j, np.searchsorted(i, np.arange(nv + 1))
        return lv.Batch(
            jac, triangles, free.ravel(), target=target, compliance=compliance, row_ptr=ptr, **more
        )
    if layout == "entries":
        return lv.Batch(
            jac.ravel(), mass.ravel(), free.ravel(), target=target, compliance=compliance, row_ptr=ptr,
            velocity_ptr=nv * np.arange(len(worlds) + 1), **more,
        )  # fmt: skip
    most = int(count.max())
    wide = np.full((len(worlds), most + 2, nv + 3), 7.0, jac.dtype)
    padded = np.zeros((2, len(worlds), most))
    for i, w in enumerate(worlds):
        wide[i, : count[i], :nv] = w.jac
        padded[0, i, : count[i]] = w.target
        padded[1, i, : count[i]] = w.compliance
    jac = wide[:, :most, :nv]
    return lv.Batch(
        jac if layout == "strided" else jac.copy(), mass, free, target=padded[0], compliance=padded[1], count=count,
        **more,
    )  # fmt: skip


LAYOUTS = ("rows", "triangles", "entries", "padded", "strided")
