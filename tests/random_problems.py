"""Random problems for tests: joints and contacts of every kind in every form of A, and small matrices.

The same seed gives the same problem on every machine.
"""

import functools
import itertools
from dataclasses import replace
from functools import partial

import hypothesis.strategies as st
import numpy as np
import scipy.sparse as sp

import lavender as lv
from lavender import Cones, Problem, Rows
from lavender.problem.cones import CONTACT_BOX, CONTACT_ELLIPSE, ROW


def rotation(q):
    """Return the rotation (3, 3) from body to world of a unit quaternion w, x, y, z."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def unit(rng, n=3):
    """Draw a unit vector (n,) with a uniformly distributed direction."""
    x = rng.normal(size=n)
    return x / np.linalg.norm(x)


def random_bodies_and_contacts(rng, bodies=5, joints=3, contacts=8):
    """Draw bodies of different masses, joints of 1 to 3 rows (some angular), and contacts; some touch the ground."""
    mass = rng.uniform(0.5, 3.0, bodies)
    inertia = [
        r @ np.diag(rng.uniform(5.0, 12.0, 3)) @ r.T / m
        for m, r in zip(mass, (rotation(unit(rng, 4)) for _ in mass), strict=True)
    ]

    def draw_pair():
        a, b = rng.choice(bodies, 2, replace=False)
        return (-1, b) if rng.random() < 0.4 else (a, b)

    sizes = rng.integers(1, 4, joints)
    ptr = np.concatenate([[0], np.cumsum(sizes)])
    joint_body = np.array([draw_pair() for _ in range(joints)], np.int32).reshape(-1, 2)
    jac = rng.normal(size=(ptr[-1], 12))
    if joints:
        # Make the first row of every other joint angular, by removing its linear part.
        jac[ptr[:-1][::2], :3] = jac[ptr[:-1][::2], 6:9] = 0.0
    jac[np.repeat(joint_body[:, 0], sizes) < 0, :6] = 0.0
    normal = np.array([unit(rng) for _ in range(contacts)]).reshape(-1, 3)
    tangent = np.array([np.cross(n, unit(rng)) for n in normal]).reshape(-1, 3)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return Rows(
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
        contact_body=np.array([draw_pair() for _ in range(contacts)], np.int32).reshape(-1, 2),
    )


def touching(contact_body, **fields):
    """Build bodies at rest of 1 kg and 1 kg m^2 that touch at their centres along z.

    `fields` replaces fields of the resulting `Rows`.
    """
    body = np.reshape(contact_body, (-1, 2)).astype(np.int32)
    c = len(body)
    n = len(fields.get("inv_mass", range(body.max(initial=-1) + 1)))
    defaults = {
        "inv_mass": np.ones(n),
        "inv_inertia": np.tile(np.eye(3), (n, 1, 1)),
        "v_free": np.zeros((n, 6)),
        "normal": np.tile([0.0, 0.0, 1.0], (c, 1)),
        "tangent": np.tile([1.0, 0.0, 0.0], (c, 1)),
        "arm_a": np.zeros((c, 3)),
        "arm_b": np.zeros((c, 3)),
        "contact_body": body,
    }
    return Rows(**defaults | fields)


def random_contact_problem(
    seed, friction="coulomb", tangents=None, spin=True, rolling=False, **sizes
):
    """Draw a problem of bodies with free and bounded joint rows, and contacts.

    `tangents` is the number of tangents of each contact; None mixes 0, 1 and 2. `sizes` are the numbers of bodies,
    joints and contacts, as for `random_bodies_and_contacts`.
    """
    rng = np.random.default_rng(seed)
    rows = random_bodies_and_contacts(rng, **sizes)
    count = 2 if rolling else tangents
    c = rows.n_contacts
    mj = len(rows.jac)
    if count is None:
        count = rng.integers(0, 3, c)
    bounded = rng.random(mj) < 0.4
    high = np.where(bounded, rng.uniform(0.0, 0.5, mj), np.inf)
    m = mj + int(np.sum(np.broadcast_to(count, c))) + c * (1 + spin + 2 * rolling)
    return Problem.from_rows(
        rows,
        target=rng.normal(size=m) * 0.1,
        lower=-high,
        upper=high,
        mu=rng.uniform(0.0, 1.2, c) * (np.broadcast_to(count, c) > 0 if not spin else 1.0),
        tangents=count,
        patch_radius=rng.uniform(0.0, 0.4, c) if spin else None,
        rolling=rng.uniform(0.0, 0.3, c) * (rng.random(c) < 0.8) if rolling else None,
        friction=friction,
        compliance=rng.uniform(0.0, 0.2, m) * (rng.random(m) < 0.5),
        name=f"random {seed}",
    )


def as_matrix(problem):
    """Return the same problem with A as a sparse matrix."""
    return Problem(
        problem.b,
        problem.cones,
        problem.delassus(),
        friction=problem.friction,
        guess=problem.guess,
        name=problem.name,
    )


def general(problem):
    """Return the same problem of bodies as J and M."""
    assert problem.rows is not None
    minv = problem.rows.inverse_mass_matrix().toarray()
    free = problem.rows.v_free.ravel()
    return Problem.from_jacobian(
        problem.jacobian,
        np.linalg.inv(minv),
        free,
        target=problem.b + problem.jacobian @ free,
        cones=problem.cones,
        compliance=problem.compliance,
        friction=problem.friction,
    )


def random_box_friction_contacts(seed, friction="coulomb", **sizes):
    """Draw joints, and contacts that bound each tangent separately; most have two coefficients."""
    base = random_contact_problem(seed, friction, tangents=2, spin=False, **sizes)
    c = base.cones.shaped("box")
    rng = np.random.default_rng(seed + 7)
    radius = np.where(c.kind == CONTACT_BOX, rng.uniform(0.2, 3.0, c.n_blocks), 0.0)
    return replace(base, cones=replace(c, patch_radius=radius))


def random_ellipse_friction_contacts(seed, friction="coulomb", **sizes):
    """Draw the problem of `random_box_friction_contacts` with an ellipse instead of each box."""
    base = random_box_friction_contacts(seed, friction, **sizes)
    c = base.cones
    return replace(
        base, cones=replace(c, kind=np.where(c.kind == CONTACT_BOX, CONTACT_ELLIPSE, c.kind))
    )


#: Name of each form of A -> function that converts a problem of bodies to this form.
FORMS = {"rows": lambda problem: problem, "matrix": as_matrix, "J and M": general}
#: Kind of contact -> function (seed, friction, **sizes) that draws a problem of bodies with such contacts.
CONTACTS = {
    "disks": partial(random_contact_problem, tangents=2, spin=False),
    "spin": random_contact_problem,
    "rolling": partial(random_contact_problem, spin=False, rolling=True),
    "rolling and spin": partial(random_contact_problem, rolling=True),
    "boxes": random_box_friction_contacts,
    "ellipses": random_ellipse_friction_contacts,
}
#: Kind of contact -> function (mu (n,), arms [m] or second coefficients (n,)) that makes the cones of n such contacts.
CONES = {
    "normal": lambda mu, arm: Cones.contacts(0.0 * mu, 0),
    "one tangent": lambda mu, arm: Cones.contacts(mu, 1),
    "disk": lambda mu, arm: Cones.contacts(mu),
    "spin alone": lambda mu, arm: Cones.contacts(mu, 0, arm),
    "one tangent and spin": lambda mu, arm: Cones.contacts(mu, 1, arm),
    "spin": lambda mu, arm: Cones.contacts(mu, patch_radius=arm),
    "box": lambda mu, arm: Cones.contacts(np.stack([mu, 2.0 * arm], 1), shape="box"),
    "ellipse": lambda mu, arm: Cones.contacts(np.stack([mu + 0.1, 0.3 + 0.5 * arm], 1)),
    "rolling": lambda mu, arm: Cones.contacts(mu, rolling=arm),
    "rolling and spin": lambda mu, arm: Cones.contacts(
        mu, patch_radius=0.2 + 0.0 * mu, rolling=arm
    ),
    "round": lambda mu, arm: Cones.contacts(mu, 5),
}


def make_problem_with_other_numbers(problem):
    """Return a problem of the same structure with other numbers, bounds and coefficients."""
    cones = problem.cones
    fixed = (np.arange(problem.m) % 3 == 0) & (np.repeat(cones.kind, np.diff(cones.ptr)) == ROW)
    mu = np.where(np.arange(problem.n_blocks) % 3 == 0, 0.0, cones.mu)
    lower, upper = (np.where(fixed, 0.0, x) for x in (cones.lower, cones.upper))
    other = replace(problem, b=problem.b * 1.25 + 0.01)
    changed = replace(other, cones=replace(cones, lower=lower, upper=upper, mu=mu))
    return changed if changed.law == problem.law and not cones.has_ellipse else other


def random_lcp(seed, m=12, rank=None, boxed=True):
    """Draw a bounded problem of m rows that has a solution, also if `rank` makes A singular."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(m, rank or m + 2))
    high = np.where(rng.random(m) < 0.5, rng.uniform(0.1, 1.0, m), np.inf) if boxed else np.inf
    # Choose b as a vector in the range of A minus a non-negative vector: the problem then has a solution even if A is
    # singular.
    a = g @ g.T
    return Problem.lcp(
        a, a @ rng.normal(size=m) - rng.uniform(0.0, 1.0, m), upper=high, name=f"lcp {seed}"
    )


# -- generalized coordinates: kinematic trees, their mass matrices, rows on chains ------------------------


def random_tree_parents(rng, n):
    """Draw the parents of n velocities that form about three trees; a root has -1, a parent precedes its children."""
    return [-1 if i == 0 or rng.random() < 3.0 / n else int(rng.integers(0, i)) for i in range(n)]


def tree_mass(rng, parent):
    """Draw a mass matrix (n, n) with a condition number near 1e2 that couples each velocity only to its ancestors."""
    n = len(parent)
    lower = np.eye(n)
    for i in range(n):
        a = parent[i]
        while a >= 0:
            lower[i, a] = rng.normal() * 0.4
            a = parent[a]
    return lower.T @ np.diag(rng.uniform(0.2, 3.0, n)) @ lower


def ancestors(parent, i):
    """Return the indices of velocity i and of all its ancestors, from i to the root."""
    chain = []
    while i >= 0:
        chain.append(i)
        i = parent[i]
    return chain


def random_generalized_problem(
    seed, friction="cone", n=14, compliance=True, contacts=5, tangents=2, spin=False
):
    """Draw J and M of a random forest with free and bounded rows and contacts, each row on one or two chains."""
    rng = np.random.default_rng(seed)
    parent = random_tree_parents(rng, n)
    cones = Cones.free(2) + Cones.bounded(np.array([0.0, -0.3]), np.array([np.inf, 0.3]))
    radius = {"patch_radius": rng.uniform(0.0, 0.4, contacts)} if spin else {}
    if contacts:
        cones = cones + Cones.contacts(rng.uniform(0.0, 1.2, contacts), tangents, **radius)
    jac = np.zeros((cones.n_rows, n))
    for first, last in zip(cones.ptr[:-1], cones.ptr[1:], strict=True):
        on = ancestors(parent, int(rng.integers(0, n))) + (
            ancestors(parent, int(rng.integers(0, n))) * (rng.random() < 0.5)
        )
        jac[first:last, sorted(set(on))] = rng.normal(size=(last - first, len(set(on))))
    m = cones.n_rows
    soft = rng.uniform(0.01, 0.3, m) if compliance else np.zeros(m)
    # Choose targets that some velocity exceeds by a margin, so that the problem without compliance has a solution.
    margin = np.zeros(m)
    margin[2:][cones.lower[2:] == 0.0] = 0.5
    return Problem.from_jacobian(
        jac,
        tree_mass(rng, parent),
        rng.normal(size=n),
        target=jac @ rng.normal(size=n) - margin,
        cones=cones,
        compliance=soft,
        friction=friction,
        name=f"general {seed}",
    )


# -- problems of every law and kind of block --------------------------------------------------------


def add_compliance(problem, compliance):
    """Return the problem with more compliance [1/kg], which adds to the smallest eigenvalue of A."""
    present = np.zeros(problem.m) if problem.compliance is None else problem.compliance
    return replace(problem, compliance=present + compliance)


@functools.cache
def make_well_posed_problem(law, rows):
    """Return a problem of a law, given by rows or as a matrix; the smallest eigenvalue of A is far from zero."""
    if law == "linear":
        base = random_contact_problem(21, contacts=0, joints=12, bodies=6)
        free = replace(base.cones, lower=np.full(base.m, -np.inf), upper=np.full(base.m, np.inf))
        problem = add_compliance(replace(base, cones=free), 0.5)
    elif law == "lcp":
        problem = add_compliance(random_contact_problem(22, tangents=0, spin=False), 0.3)
    else:
        problem = add_compliance(
            random_contact_problem(23, friction=law, tangents=2, spin=False), 0.3
        )
    return problem if rows else as_matrix(problem)


def make_well_posed_problems(spec):
    """Yield the well-posed problems of every law and form that a solver accepts."""
    for law, rows in itertools.product(("linear", "lcp", "coulomb", "cone"), (True, False)):
        problem = make_well_posed_problem(law, rows)
        if spec.refuses(problem) is None:
            yield problem


@functools.cache
def make_problems_of_every_kind():
    """Return {(law, kind of block): (a well-posed problem in each form of A, its slack (m,) [m/s])}."""
    problems = {}
    for law in ("linear", "lcp"):
        problems[law, "rows"] = [
            convert(make_well_posed_problem(law, True)) for convert in FORMS.values()
        ]
    for law, (kind, draw) in itertools.product(("coulomb", "cone"), CONTACTS.items()):
        soft = add_compliance(draw(23, law), 0.3)
        problems[law, kind] = [convert(soft) for convert in FORMS.values()]
    for tangents in (3, 4, 5):
        base = random_generalized_problem(tangents, "cone", n=12, contacts=4, tangents=tangents)
        problems["cone", f"round, {tangents} tangents"] = [base, as_matrix(base)]
    result = {}
    for key, forms in problems.items():
        best = min((lv.solve(p, tol=1e-12) for p in forms), key=lambda s: s.residual.relative)
        assert best.residual.relative <= 1e-11, best
        result[key] = forms, best.slack
    return result


# -- problems of tests ------------------------------------------------------------------------------


def side_by_side(parts):
    """Problems given by their matrices as one, of which each is an island."""
    cones = parts[0].cones
    for part in parts[1:]:
        cones = cones + part.cones
    b = np.concatenate([part.b for part in parts])
    a = sp.block_diag([part.csr for part in parts], format="csr")
    return lv.Problem(b, cones, a, friction=parts[0].friction)


def with_ground_as_body(problem):
    """Return the problem of bodies with its static body, -1, given as one more body of inverse mass and inertia 0."""
    rows = problem.rows
    n = problem.rows.n_bodies
    ground = {
        "inv_mass": np.append(rows.inv_mass, 0.0),
        "inv_inertia": np.concatenate([rows.inv_inertia, np.zeros((1, 3, 3))]),
        "v_free": np.concatenate([rows.v_free, np.zeros((1, 6))]),
    }
    pairs = {
        name: np.where(getattr(rows, name) < 0, np.int32(n), getattr(rows, name))
        for name in ("joint_body", "contact_body")
    }
    bodies = replace(rows, **ground, **pairs)
    return lv.Problem(
        problem.b,
        problem.cones,
        rows=bodies,
        compliance=problem.compliance,
        friction=problem.friction,
    )


#: And by a dense matrix with a guess.
GIVEN = FORMS | {
    "dense": lambda p: lv.Problem(p.b, p.cones, p.dense(), friction=p.friction, guess=np.zeros(p.m))
}
seeds = st.integers(0, 2**32 - 1)


def dragged(seed, contacts, mu=None, shape="disk", friction="coulomb"):
    """J and M of contacts alone, pressed on and dragged; two coefficients each are drawn where none are given."""
    rng = np.random.default_rng(seed)
    m = 3 * contacts
    nv = 3 * contacts + 3
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
    solution = lv.solve(problem, tol=1e-9)
    rng = np.random.default_rng(seed)
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


# -- few rows ---------------------------------------------------------------------------------------


def draw_few_rows(kind, seed):
    """Draw a problem that a compiled call may solve at once, of one of the kinds `FEW_ROWS`."""
    rng = np.random.default_rng(seed)
    if kind == "lcp":
        return random_lcp(seed, m=int(rng.integers(1, 64)), rank=None if rng.random() < 0.7 else 3)
    if kind == "linear":
        g = rng.normal(size=(9, 9))
        a = g @ g.T if rng.random() < 0.6 else g
        return lv.Problem.linear(a, rng.normal(size=9))
    if kind == "singular":
        g = rng.normal(size=(9, 9 - seed % 4)) * 10.0 ** rng.uniform(0.0, seed % 3, (9, 1))
        a = g @ g.T
        return lv.Problem.linear(
            0.5 * (a + a.T), a @ rng.normal(size=9) if seed % 5 else rng.normal(size=9)
        )
    if kind == "one-sided":  # unsymmetric
        return lv.Problem.lcp(
            rng.normal(size=(6, 6)) + 6.0 * np.eye(6),
            rng.normal(size=6),
            friction=["coulomb", "cone"][seed % 2],
        )
    if kind.startswith("rows"):
        return random_contact_problem(
            seed,
            kind.split()[1],
            bodies=3,
            joints=int(rng.integers(0, 3)),
            contacts=int(rng.integers(0, 5)),
        )
    if kind.startswith("matrix"):
        return as_matrix(draw_few_rows("rows " + kind.split()[1], seed))
    law = kind.split()[1]
    if kind.startswith("hollow"):
        return hollow(random_generalized_problem(seed, law, n=8, compliance=seed % 3 > 0), rng)
    tangents = int(rng.integers(1, 6)) if law == "cone" else int(rng.integers(0, 3))
    return random_generalized_problem(
        seed,
        law,
        n=int(rng.integers(2, 12)),
        compliance=seed % 3 > 0,
        contacts=4,
        tangents=tangents,
    )


def hollow(problem, rng):
    """Return the problem with some rows of J, and the compliance of these, all zero: no impulse moves them."""
    general = problem.generalized
    soft = problem.compliance.copy()
    jac = general.jac.toarray()
    rows = rng.random(problem.m) < 0.3
    jac[rows] = soft[rows] = 0.0
    target = np.where(rows, rng.choice([-1.0, -1e-3, 0.0, 0.2], problem.m), problem.b)
    return lv.Problem.from_jacobian(
        jac,
        general.mass,
        general.v_free,
        target=target + jac @ general.v_free,
        cones=problem.cones,
        compliance=soft,
        friction=problem.friction,
    )


#: Kinds of `draw_few_rows`.
FEW_ROWS = (
    "lcp",
    "linear",
    "singular",
    "one-sided",
    "rows coulomb",
    "rows cone",
    "matrix coulomb",
    "matrix cone",
    "general coulomb",
    "general cone",
    "hollow coulomb",
    "hollow cone",
)
