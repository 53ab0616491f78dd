"""Random problems in generalised coordinates: forests, their mass matrices, rows on chains."""

import numpy as np

import lavender as lv


def random_tree(rng, n):
    """Parents (n,), each before its child, -1 at a root; about three trees."""
    return [-1 if i == 0 or rng.random() < 3.0 / n else int(rng.integers(0, i)) for i in range(n)]


def tree_mass(rng, parent):
    """A mass matrix of that tree: entries between a velocity and its ancestors alone, condition about 1e2."""
    n = len(parent)
    lower = np.eye(n)
    for i in range(n):
        a = parent[i]
        while a >= 0:
            lower[i, a] = rng.normal() * 0.4
            a = parent[a]
    return lower.T @ np.diag(rng.uniform(0.2, 3.0, n)) @ lower


def chain(parent, i):
    out = []
    while i >= 0:
        out.append(i)
        i = parent[i]
    return out


def random_general(seed, friction="cone", n=14, compliance=True, contacts=5, tangents=2, spin=False):
    """Free and bounded rows and contacts, each row on one or two chains of a random forest."""
    rng = np.random.default_rng(seed)
    parent = random_tree(rng, n)
    cones = lv.Cones.free(2) + lv.Cones.bounded(np.array([0.0, -0.3]), np.array([np.inf, 0.3]))
    more = {"patch_radius": rng.uniform(0.0, 0.4, contacts)} if spin else {}
    if contacts:
        cones = cones + lv.Cones.contacts(rng.uniform(0.0, 1.2, contacts), tangents, **more)
    jac = np.zeros((cones.n_rows, n))
    for first, last in zip(cones.ptr[:-1], cones.ptr[1:], strict=True):
        on = chain(parent, int(rng.integers(0, n))) + (
            chain(parent, int(rng.integers(0, n))) * (rng.random() < 0.5)
        )
        jac[first:last, sorted(set(on))] = rng.normal(size=(last - first, len(set(on))))
    m = cones.n_rows
    soft = rng.uniform(0.01, 0.3, m) if compliance else np.zeros(m)
    # Some velocities keep every constraint with room to spare, so that the rigid problem has a solution.
    room = np.zeros(m)
    room[2:][cones.lower[2:] == 0.0] = 0.5
    return lv.Problem.from_jacobian(
        jac, tree_mass(rng, parent), rng.normal(size=n), target=jac @ rng.normal(size=n) - room, cones=cones,
        compliance=soft, friction=friction, name=f"general {seed}",
    )  # fmt: skip
