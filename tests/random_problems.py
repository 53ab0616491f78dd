"""Small random problems for property tests: rows with joints and contacts of every kind, and plain matrices."""

from dataclasses import replace
from functools import partial

import hypothesis.strategies as st
import numpy as np
import scipy.sparse as sp

import lavender as lv


def rotation(q):
    """Body to world, of a unit quaternion w x y z."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def unit(rng, n=3):
    x = rng.normal(size=n)
    return x / np.linalg.norm(x)


def random_rows(rng, bodies=5, joints=3, contacts=8):
    """Bodies of mixed mass, joints of 1 to 3 rows (some angular), contacts; some against the ground."""
    mass = rng.uniform(0.5, 3.0, bodies)
    inertia = [
        r @ np.diag(rng.uniform(5.0, 12.0, 3)) @ r.T / m
        for m, r in zip(mass, (rotation(unit(rng, 4)) for _ in mass), strict=True)
    ]

    def pair():
        a, b = rng.choice(bodies, 2, replace=False)
        return (-1, b) if rng.random() < 0.4 else (a, b)

    sizes = rng.integers(1, 4, joints)
    ptr = np.concatenate([[0], np.cumsum(sizes)])
    joint_body = np.array([pair() for _ in range(joints)], np.int32).reshape(-1, 2)
    jac = rng.normal(size=(ptr[-1], 12))
    if joints:
        jac[ptr[:-1][::2], :3] = jac[ptr[:-1][::2], 6:9] = 0.0  # angular rows
    jac[np.repeat(joint_body[:, 0], sizes) < 0, :6] = 0.0
    normal = np.array([unit(rng) for _ in range(contacts)]).reshape(-1, 3)
    tangent = np.array([np.cross(n, unit(rng)) for n in normal]).reshape(-1, 3)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return lv.Rows(
        inv_mass=1.0 / mass,
        inv_inertia=np.array(inertia),
        v_free=rng.normal(size=(bodies, 6)),
        jac=jac,
        joint_ptr=ptr,
        joint_body=joint_body,
        normal=normal,
        tangent=tangent,
        arm_a=rng.normal(size=(contacts, 3)) * 0.5,
        arm_b=rng.normal(size=(contacts, 3)) * 0.5,
        contact_body=np.array([pair() for _ in range(contacts)], np.int32).reshape(-1, 2),
    )


def touching(contact_body, **given):
    """Bodies at rest of 1 kg and 1 kg m^2 that touch at their centres along z; `given`: what of it is otherwise."""
    body = np.reshape(contact_body, (-1, 2)).astype(np.int32)
    c, n = len(body), len(given.get("inv_mass", range(body.max(initial=-1) + 1)))
    fields = {
        "inv_mass": np.ones(n), "inv_inertia": np.tile(np.eye(3), (n, 1, 1)), "v_free": np.zeros((n, 6)),
        "normal": np.tile([0.0, 0.0, 1.0], (c, 1)), "tangent": np.tile([1.0, 0.0, 0.0], (c, 1)),
        "arm_a": np.zeros((c, 3)), "arm_b": np.zeros((c, 3)), "contact_body": body,
    }  # fmt: skip
    return lv.Rows(**fields | given)


def random_contact_problem(seed, friction="coulomb", tangents=None, spin=True, rolling=False, **sizes):
    """A factored problem with free and bounded joint rows and contacts; `tangents` None mixes 0, 1, 2."""
    rng = np.random.default_rng(seed)
    rows = random_rows(rng, **sizes)
    tangents = 2 if rolling else tangents
    c, mj = rows.n_contacts, len(rows.jac)
    if tangents is None:
        tangents = rng.integers(0, 3, c)
    bounded = rng.random(mj) < 0.4
    high = np.where(bounded, rng.uniform(0.0, 0.5, mj), np.inf)
    m = mj + int(np.sum(np.broadcast_to(tangents, c))) + c * (1 + spin + 2 * rolling)
    return lv.Problem.from_rows(
        rows,
        target=rng.normal(size=m) * 0.1,
        lower=-high,
        upper=high,
        mu=rng.uniform(0.0, 1.2, c) * (np.broadcast_to(tangents, c) > 0 if not spin else 1.0),
        tangents=tangents,
        patch_radius=rng.uniform(0.0, 0.4, c) if spin else None,
        rolling=rng.uniform(0.0, 0.3, c) * (rng.random(c) < 0.8) if rolling else None,
        friction=friction,
        compliance=rng.uniform(0.0, 0.2, m) * (rng.random(m) < 0.5),
        name=f"random {seed}",
    )


def as_matrix(problem):
    """The same problem given by its matrix."""
    return lv.Problem(
        problem.b,
        problem.cones,
        problem.delassus(),
        friction=problem.friction,
        guess=problem.guess,
        name=problem.name,
    )


def side_by_side(parts):
    """Problems given by their matrices as one, of which each is an island."""
    cones = parts[0].cones
    for part in parts[1:]:
        cones = cones + part.cones
    b, a = (
        np.concatenate([part.b for part in parts]),
        sp.block_diag([part.csr for part in parts], format="csr"),
    )
    return lv.Problem(b, cones, a, friction=parts[0].friction)


def general(problem):
    """The same problem by J and M."""
    minv, free = problem.rows.inverse_mass_matrix().toarray(), problem.rows.v_free.ravel()
    return lv.Problem.from_jacobian(
        problem.jacobian, np.linalg.inv(minv), free, target=problem.b + problem.jacobian @ free,
        cones=problem.cones, compliance=problem.compliance, friction=problem.friction,
    )  # fmt: skip


def random_boxes(seed, friction="coulomb", **sizes):
    """Joints and contacts that bound each tangent by itself, two coefficients on most."""
    base = random_contact_problem(seed, friction, tangents=2, spin=False, **sizes)
    c, rng = base.cones.shaped("box"), np.random.default_rng(seed + 7)
    radius = np.where(c.kind == lv.CONTACT_BOX, rng.uniform(0.2, 3.0, c.n_blocks), 0.0)
    return replace(base, cones=replace(c, patch_radius=radius))


def random_ellipses(seed, friction="coulomb", **sizes):
    """The same whose two tangents share an ellipse."""
    base = random_boxes(seed, friction, **sizes)
    c = base.cones
    return replace(
        base, cones=replace(c, kind=np.where(c.kind == lv.CONTACT_BOX, lv.CONTACT_ELLIPSE, c.kind))
    )


#: Every way to give a problem, made of one given by rows.
FORMS = {"rows": lambda problem: problem, "matrix": as_matrix, "J and M": general}
#: And by a dense matrix with a guess.
GIVEN = FORMS | {
    "dense": lambda p: lv.Problem(p.b, p.cones, p.dense(), friction=p.friction, guess=np.zeros(p.m))
}
#: Every kind of contact that rows may have: (seed, friction, sizes) to a problem of rows.
CONTACTS = {
    "disks": partial(random_contact_problem, tangents=2, spin=False),
    "spin": random_contact_problem,
    "rolling": partial(random_contact_problem, spin=False, rolling=True),
    "rolling and spin": partial(random_contact_problem, rolling=True),
    "boxes": random_boxes,
    "ellipses": random_ellipses,
}


def random_lcp(seed, m=12, rank=None, boxed=True):
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(m, rank or m + 2))
    high = np.where(rng.random(m) < 0.5, rng.uniform(0.1, 1.0, m), np.inf) if boxed else np.inf
    # b in the range of A, plus a push into separation: solvable also where A is singular.
    a = g @ g.T
    return lv.Problem.lcp(
        a, a @ rng.normal(size=m) - rng.uniform(0.0, 1.0, m), upper=high, name=f"lcp {seed}"
    )


seeds = st.integers(0, 2**32 - 1)


def dragged(seed, contacts, mu=None, shape="disk", friction="coulomb"):
    """J and M of contacts alone, pressed on and dragged; two coefficients each are drawn where none are given."""
    rng = np.random.default_rng(seed)
    m, nv = 3 * contacts, 3 * contacts + 3
    mu = rng.uniform(0.1, 1.0, (contacts, 2)) if mu is None else mu
    target = rng.normal(size=m)
    target[::3] += 1.0
    cones = lv.Cones.contacts(mu, shape=shape, count=contacts if np.ndim(mu) == 0 else None)
    return lv.Problem.from_jacobian(
        rng.normal(size=(m, nv)),
        np.eye(nv),
        rng.normal(size=nv),
        target=target,
        cones=cones,
        friction=friction,
    )


def without_solution(seed, m):
    """A symmetric LCP, with y >= 0, A y = 0 and b.y > 0 put in by hand."""
    rng = np.random.default_rng(seed)
    y = np.maximum(rng.uniform(-0.5, 1.0, m), 0.0)
    y[0] = 1.0
    g = rng.normal(size=(m, m))
    g -= np.outer(y, y @ g) / (y @ y)
    a = g @ g.T
    b = rng.normal(size=m)
    return lv.Problem.lcp(0.5 * (a + a.T), b + y * (0.5 - b @ y) / (y @ y))


def good(solution, tol=1e-12):
    """Within tol, or twice what rounding lambda to float64 costs, and not contradicted."""
    return (
        solution.residual.relative <= max(tol, 2.0 * solution.residual.roundoff_floor)
        and solution.claim_check == "confirmed"
    )


def sweeps(problem, name, n, **options):
    """Impulse after n iterations."""
    return lv.solve(problem, name, tol=0.0, max_iter=n, **options).impulse


def warmed(problem, seed):
    """Targets that are a little different, from the answer; None where there is none."""
    solution, rng = lv.solve(problem, tol=1e-9), np.random.default_rng(seed)
    b = problem.b * (1.0 + rng.choice([1e-3, 1e-2, 0.1]) * rng.standard_normal(problem.m))
    return problem.updated(b=b, guess=solution.impulse) if solution.success else None


def spd(n, seed=0):
    a = np.random.default_rng(seed).normal(size=(n, n))
    return a @ a.T / n + np.eye(n), np.random.default_rng(seed + 1).normal(size=n)


def conditioned(rng, n, condition):
    """A symmetric matrix (n, n) with eigenvalues from 1 to `condition` along random directions."""
    basis, _ = np.linalg.qr(rng.standard_normal((n, n)))
    matrix = basis @ np.diag(np.geomspace(1.0, condition, n)) @ basis.T
    return 0.5 * (matrix + matrix.T)


def arrays_of(thing, name, seen, depth=0):
    """(name, array) of every array that can be reached from a thing's public attributes."""
    if isinstance(thing, np.ndarray):
        yield name, thing
    elif sp.issparse(thing):
        for part in ("data", "indices", "indptr"):
            yield f"{name}.{part}", getattr(thing, part)
    elif type(thing).__module__.startswith("lavender") and id(thing) not in seen and depth < 4:
        seen.add(id(thing))
        for attribute in dir(type(thing)):
            if attribute.startswith("__"):
                continue
            kind = getattr(type(thing), attribute)
            if callable(kind) and not isinstance(kind, type):
                continue
            try:
                value = getattr(thing, attribute)
            except lv.LavenderError:
                continue
            yield from arrays_of(value, f"{name}.{attribute}", seen, depth + 1)
        for attribute, value in getattr(thing, "__dict__", {}).items():
            yield from arrays_of(value, f"{name}.{attribute}", seen, depth + 1)


def nearly_singular(seed):
    """J and M of a few velocities, M of a condition number up to 1e17 and of any size."""
    rng = np.random.default_rng(seed)
    nv = int(rng.integers(1, 13))
    law = str(rng.choice(["linear", "lcp", "coulomb", "cone"]))
    q = np.linalg.qr(rng.normal(size=(nv, nv)))[0]
    mass = (q * 10.0 ** -rng.uniform(0.0, rng.uniform(6.0, 17.0), nv)) @ q.T
    mass = 0.5 * (mass + mass.T) * 10.0 ** rng.uniform(-6.0, 6.0)
    if law in ("coulomb", "cone"):
        cones = lv.Cones.contacts(rng.uniform(0.0, 1.2, int(rng.integers(1, 6))))
    else:
        m = int(rng.integers(1, nv + 3))
        cones = lv.Cones.bounded(
            np.where((law == "lcp") & (rng.random(m) < 0.5), 0.0, -np.inf), np.full(m, np.inf)
        )
    jac = rng.normal(size=(cones.n_rows, nv))
    if rng.random() < 0.3:
        jac[rng.random(jac.shape) < 0.5] = 0.0
    friction = "cone" if law == "cone" else "coulomb"
    return lv.Problem.from_jacobian(jac, mass, rng.normal(size=nv), cones=cones, friction=friction)


# -- generalised coordinates: forests, their mass matrices, rows on chains --------------------------------


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


def ancestors(parent, i):
    """A velocity of a tree and all between it and its root."""
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
        on = ancestors(parent, int(rng.integers(0, n))) + (
            ancestors(parent, int(rng.integers(0, n))) * (rng.random() < 0.5)
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
