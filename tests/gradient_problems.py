"""Small problems of every kind of block, law and operator, and the same with their data moved."""

from dataclasses import replace
from itertools import product

import numpy as np
from random_problems import random_bodies_and_contacts

import lavender as lv

KINDS = {
    "free": lambda rng: lv.Cones.free(2),
    "bounded": lambda rng: lv.Cones.bounded([-0.3, 0.0], [0.3, np.inf]),
    "equal": lambda rng: lv.Cones.bounded([0.2], [0.2]),
    "normal": lambda rng: lv.Cones.contacts(0.0, 0),
    "line": lambda rng: lv.Cones.contacts(rng.uniform(0.2, 1.0), 1),
    "disk": lambda rng: lv.Cones.contacts(rng.uniform(0.2, 1.0)),
    "smooth": lambda rng: lv.Cones.contacts(0.0),
    "spin": lambda rng: lv.Cones.contacts(rng.uniform(0.2, 1.0), 2, 0.3),
    "spin alone": lambda rng: lv.Cones.contacts(rng.uniform(0.2, 1.0), 0, 0.4),
    "ellipse": lambda rng: lv.Cones.contacts([rng.uniform(0.2, 1.0, 2)]),
    "box": lambda rng: lv.Cones.contacts([rng.uniform(0.2, 1.0, 2)], shape="box"),
    "rolling": lambda rng: lv.Cones.contacts(rng.uniform(0.2, 1.0), 2, rolling=0.2),
    "rolling and spin": lambda rng: lv.Cones.contacts(rng.uniform(0.2, 1.0), 2, 0.3, rolling=0.2),
    "round": lambda rng: lv.Cones.contacts(rng.uniform(0.2, 1.0), 5),
}
OPERATORS = ("dense", "csr", "asymmetric", "generalized", "bodies")


def combinations():
    """(kind, law, operator) that there are."""
    for kind, law, operator in product(KINDS, ("coulomb", "cone"), OPERATORS):
        if kind == "round" and (law != "cone" or operator != "generalized"):
            continue
        if operator == "bodies" and kind in ("free", "bounded", "equal", "round"):
            continue
        if operator != "asymmetric" or law == "coulomb":
            yield kind, law, operator


def table():
    """A box on four corners, resting: three rows are enough to hold it."""
    corner = np.array([(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    jac = np.column_stack([np.ones(4), corner[:, 1], -corner[:, 0]])
    return lv.Problem.from_jacobian(
        jac, np.eye(3), [-1.0, 0.1, 0.0], cones=lv.Cones.bounded(np.zeros(4), np.full(4, np.inf))
    )


def drawn(seed, kind, law="coulomb", operator="dense", count=3):
    """Three blocks of one kind, a disk and a bounded row beside them; of bodies contacts alone."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), OPERATORS.index(operator)])
    cones = KINDS[kind](rng)
    for _ in range(count - 1):
        cones = cones + KINDS[kind](rng)
    if operator == "bodies":
        return _of_bodies(rng, cones, law)
    cones = lv.Cones.bounded([0.0], [0.8]) + cones + lv.Cones.contacts(rng.uniform(0.2, 1.0))
    m = cones.n_rows
    b = rng.standard_normal(m)
    b[cones.normal_rows] += rng.choice([-0.5, 1.5], len(cones.normal_rows), p=[0.25, 0.75])
    if operator == "generalized":
        nv = m + 2
        jac, root = (
            rng.standard_normal((m, nv)) / np.sqrt(nv),
            rng.standard_normal((nv, nv)) / np.sqrt(nv),
        )
        mass = root @ root.T + np.eye(nv)
        free = rng.standard_normal(nv)
        soft = rng.uniform(0.05, 0.2, m)
        return lv.Problem.from_jacobian(
            jac, mass, free, target=b + jac @ free, cones=cones, compliance=soft, friction=law
        )
    root = rng.standard_normal((m, 2 * m)) / np.sqrt(2 * m)
    a = root @ root.T + 0.1 * np.eye(m)
    if operator == "asymmetric":
        a += 0.02 * rng.standard_normal((m, m))
    if operator == "csr":
        import scipy.sparse as sp

        a = sp.csr_array(a * (rng.random((m, m)) < 2.0))
    return lv.Problem(b, cones, a, friction=law)


def _of_bodies(rng, cones, law):
    rows = random_bodies_and_contacts(rng, bodies=4, joints=1, contacts=cones.n_blocks)
    k = len(rows.jac)
    cones = lv.Cones([0, k], [lv.ROW], np.full(k, -0.5), np.full(k, np.inf), [0.0], [0.0]) + cones
    m = cones.n_rows
    b = rng.standard_normal(m)
    b[cones.normal_rows] += rng.choice([-0.5, 1.5], len(cones.normal_rows), p=[0.25, 0.75])
    return lv.Problem(b, cones, rows=rows, friction=law, compliance=rng.uniform(0.05, 0.3, m))


def directions(problem, rng):
    """A change of each of the data that the problem has, of its size."""
    c, m, k = problem.cones, problem.m, problem.n_blocks
    out = {"b": rng.standard_normal(m)}
    live = c.kind != lv.ROW
    if live.any():
        out["mu"] = np.where(live & (c.mu > 0.0), rng.standard_normal(k), 0.0)
        out["patch_radius"] = np.where(c.patch_radius > 0.0, rng.standard_normal(k), 0.0)
        out["rolling"] = np.where(c.rolling > 0.0, rng.standard_normal(k), 0.0)
        if np.isin(c.kind, (lv.CONTACT_BOX, lv.CONTACT_ELLIPSE)).any():
            both = np.where(live[:, None], rng.standard_normal((k, 2)), 0.0)
            one = ~np.isin(c.kind, (lv.CONTACT_BOX, lv.CONTACT_ELLIPSE))
            both[one, 1] = both[one, 0]
            out["mu of each tangent"] = both
    bounds = rng.standard_normal(m)
    equal = np.isfinite(c.lower) & (c.lower == c.upper)
    held = np.isfinite(c.lower) & np.repeat(~live, np.diff(c.ptr))
    out["bounds"] = (
        np.where(held, bounds, 0.0),
        np.where(
            np.isfinite(c.upper) & np.repeat(~live, np.diff(c.ptr)),
            np.where(equal, bounds, rng.standard_normal(m)),
            0.0,
        ),
    )
    if problem.matrix is not None:
        a = rng.standard_normal((m, m))
        out["A"] = a if problem.is_symmetric is False else a + a.T
        return out
    out |= {"target": rng.standard_normal(m), "compliance": rng.standard_normal(m)}
    if problem.generalized is not None:
        g = problem.generalized
        mass = rng.standard_normal((g.nv, g.nv))
        return out | {
            "v_free": rng.standard_normal(g.nv),
            "J": rng.standard_normal((m, g.nv)),
            "M": mass + mass.T,
        }
    return out | {"v_free": rng.standard_normal(problem.rows.v_free.shape)}


def named(name, change):
    """The changes as `jvp` takes them."""
    if name == "bounds":
        return {"lower": change[0], "upper": change[1]}
    return {"mu" if name == "mu of each tangent" else name: change}


def moved(problem, name, change, h):
    """The problem with h times the change added to its data."""
    p = problem
    c = problem.cones
    if name == "b":
        return replace(p, b=p.b + h * change)
    if name in ("mu", "patch_radius", "rolling"):
        return replace(p, cones=replace(c, **{name: getattr(c, name) + h * change}))
    if name == "mu of each tangent":
        both = c.coefficients + h * change
        two = np.isin(c.kind, (lv.CONTACT_BOX, lv.CONTACT_ELLIPSE))
        mu = np.where(c.kind == lv.ROW, c.mu, both[:, 0])
        ratio = np.where(two, both[:, 1] / np.where(mu > 0.0, mu, 1.0), c.patch_radius)
        return replace(p, cones=replace(c, mu=mu, patch_radius=ratio))
    if name == "bounds":
        return replace(
            p, cones=replace(c, lower=c.lower + h * change[0], upper=c.upper + h * change[1])
        )
    if name == "A":
        a = p.dense() + h * change
        return replace(p, matrix=a if isinstance(p.matrix, np.ndarray) else type(p.matrix)(a))
    if name == "compliance":
        return replace(p, compliance=p.compliance + h * change)
    free = (p.generalized or p.rows).v_free
    target = p.b + p.jacobian @ free.ravel()
    if name == "target":
        return replace(p, b=p.b + h * change)
    if p.generalized is not None:
        g = p.generalized
        jac, mass = g.jac.toarray(), g.mass.toarray()
        jac, mass = (x + h * change if name == word else x for word, x in (("J", jac), ("M", mass)))
        free = free + h * change if name == "v_free" else free
        made = lv.Generalized(jac, mass, free)
        return replace(p, generalized=made, b=target - jac @ free)
    rows = replace(p.rows, v_free=free + h * change)
    return replace(p, rows=rows, b=target - rows.jacobian(c) @ rows.v_free.ravel())
