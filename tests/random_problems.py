"""Small random problems for property tests: the generators of `lavender.contract`, and others that only tests use."""

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import scipy.sparse as sp

import lavender as lv
from lavender.contract.problems import (  # noqa: F401 - tests import them from here
    CONTACTS,
    FORMS,
    as_matrix,
    random_bodies_and_contacts,
    random_box_friction_contacts,
    random_contact_problem,
    random_ellipse_friction_contacts,
    random_generalized_problem,
    random_lcp,
    random_tree_parents,
)
from lavender.contract.problems import as_generalized as general  # noqa: F401
from lavender.contract.problems import list_ancestors as ancestors  # noqa: F401
from lavender.contract.problems import make_touching_bodies as touching  # noqa: F401
from lavender.contract.problems import random_tree_mass as tree_mass  # noqa: F401
from lavender.contract.problems import random_unit_vector as unit  # noqa: F401
from lavender.contract.problems import rotation_matrix as rotation  # noqa: F401


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


def with_ground_as_body(problem):
    """Return the problem of bodies with its static body, -1, given as one more body of inverse mass and inertia 0."""
    rows, n = problem.rows, problem.rows.n_bodies
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
        problem.b, problem.cones, rows=bodies, compliance=problem.compliance, friction=problem.friction
    )


#: And by a dense matrix with a guess.
GIVEN = FORMS | {
    "dense": lambda p: lv.Problem(p.b, p.cones, p.dense(), friction=p.friction, guess=np.zeros(p.m))
}
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
