"""Classify the structure of contact problems in words, from their numbers."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from lavender.problem import Problem, check_problem

MAX_RANK_ROWS = 300  # The rank of A is computed up to this many rows, in a fraction of a second.
# Singular values up to this fraction of the largest count as zero.
ZERO_SINGULAR_VALUE_TOL = 1e-12
# Up to this many contacts with equal couplings count as contacts of one pair of bodies.
MAX_MANIFOLD_BLOCKS = 8
# Problems from this mass ratio on are "large mass ratio": J and M are more accurate than A.
LARGE_MASS_RATIO = 1e3
# A matrix with a larger relative asymmetry is not the A of bodies; recorded contact problems stay below 0.01.
MAX_MECHANICAL_ASYMMETRY = 0.1


def compute_mass_ratio(problem: Problem) -> float:
    """Return the largest body mass divided by the smallest.

    If bodies are not known, it is the ratio of the largest to the smallest d over bounded rows and contact normals.
    """
    if problem.rows is not None:
        x = problem.rows.inv_mass
    else:
        c = problem.cones
        rows = np.flatnonzero(~c.contact_rows)
        x = problem.d[np.concatenate([rows, c.normal_rows])]
    x = x[x > 0.0]
    return float(x.max() / x.min()) if len(x) else 1.0


def classify_structure(problem: Problem) -> tuple[str, ...]:
    """Return the words that describe a problem's structure, from its numbers; they decide which solver suits.

    - The largest connected component of the coupling graph. One moving body (in a matrix: a few blocks that are all
      coupled, as a body's contacts are): "separate". At most two neighbours on average: "chain" (most couplings are
      joints) or "stack" (contacts). More: "mesh" of joints or "pile". A matrix that couples more than half of all
      pairs: "dense".
    - "redundant": there are fewer independent rows than rows, if the rank is cheap to compute or the counts prove it.
    - "friction": the law. "ellipses": contacts with two coefficients. "large mass ratio": 1000 or more.
    - "asymmetric": A is not symmetric. A matrix that is not nearly symmetric comes from no scene of bodies, and gets
      no word for its graph or masses.
    """
    check_problem(problem)
    return classify_structure_and_count_islands(problem)[0]


def classify_structure_and_count_islands(problem: Problem) -> tuple[tuple[str, ...], int]:
    """Return the words of `classify_structure`, and the number of islands; 0 for a matrix that is not mechanical."""
    if problem.m == 0:
        return ("empty",), 0
    features = []
    islands = 0
    mechanical = problem.asymmetry <= MAX_MECHANICAL_ASYMMETRY
    if mechanical:
        word, islands = _classify_coupling_graph(problem)
        features.append(word)
    if _has_redundant_rows(problem):
        features.append("redundant")
    if problem.law in ("coulomb", "cone"):
        features.append("friction")
    if problem.cones.has_ellipse:
        features.append("ellipses")
    if mechanical and compute_mass_ratio(problem) >= LARGE_MASS_RATIO:
        features.append("large mass ratio")
    if not problem.is_symmetric:
        features.append("asymmetric")
    return tuple(features), islands


def _classify_coupling_graph(problem: Problem) -> tuple[str, int]:
    """Return the word for the largest connected component of the coupling graph, and the number of components."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n, i, j = (
        _build_body_graph(problem) if problem.rows is not None else _build_block_graph(problem)
    )
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(n, n))
    count, component = connected_components(graph, directed=False)
    count = int(count)
    largest = np.bincount(component).argmax()
    size = np.count_nonzero(component == largest)
    neighbours = 2.0 * np.count_nonzero(component[i] == largest) / size
    bilateral = _is_bilateral(problem)
    if size == 1:
        return "separate", count
    if neighbours <= 2.0:
        return "chain" if bilateral else "stack", count
    if problem.rows is None and size > MAX_MANIFOLD_BLOCKS and neighbours > 0.5 * (size - 1):
        return "dense", count
    return "mesh" if bilateral else "pile", count


def _is_bilateral(problem: Problem) -> bool:
    """Return whether more pairs of bodies share a joint than a contact; for a matrix, whether most blocks are free.

    A joint has a free row. Limits, motors, and contacts written as bounded rows (`Problem.boxed`) have none: they count
    as contacts, unless a joint connects the same bodies.
    """
    if problem.law == "linear":
        return True
    r, c = problem.rows, problem.cones
    if r is not None:
        n = c.ptr[r.n_joints]
        free_rows = np.append(0, np.cumsum(np.isinf(c.lower[:n]) & np.isinf(c.upper[:n])))
        has_free_row = np.diff(free_rows[c.ptr[: r.n_joints + 1]]) > 0
        low, high = np.sort(r.block_bodies, axis=1).astype(np.int64).T
        pairs = (low + 1) * (r.n_bodies + 1) + high
        joints = pairs[: r.n_joints][has_free_row]
        bounded = pairs[: r.n_joints][~has_free_row]
        contacts = np.append(pairs[r.n_joints :], np.setdiff1d(bounded, joints))
        return len(np.unique(joints)) > len(np.unique(contacts))
    first = c.ptr[:-1][~c.is_contact]
    free = np.count_nonzero(np.isinf(c.lower[first]) & np.isinf(c.upper[first]))
    return bool(2 * free > c.n_blocks)


Edges = tuple[
    int, NDArray[np.int64], NDArray[np.int64]
]  # Number of nodes, and both ends of each edge.


def _build_body_graph(problem: Problem) -> Edges:
    """Return the graph of moving bodies that a joint or a contact connects."""
    r = problem.rows
    assert r is not None
    ends = r.moving_block_bodies
    pairs = np.unique(np.sort(ends[(ends >= 0).any(axis=1)], axis=1), axis=0)
    bodies, indices = np.unique(pairs, return_inverse=True)
    indices = indices.reshape(pairs.shape)[pairs[:, 0] >= 0]
    # `bodies` is sorted, so the number of static bodies, -1, comes first if it occurs. Moving bodies are numbered from
    # 0.
    ground = int(len(bodies) > 0 and bodies[0] < 0)
    return max(1, len(bodies) - ground), indices[:, 0] - ground, indices[:, 1] - ground


def _build_block_graph(problem: Problem) -> Edges:
    """Return the graph of blocks that A couples; blocks with equal couplings, as of one body pair, are one node."""
    import scipy.sparse as sp

    c = problem.cones
    block = np.repeat(np.arange(c.n_blocks), np.diff(c.ptr))
    a = problem.csr.tocoo()
    i, j = block[a.coords[0]], block[a.coords[1]]
    graph = sp.csr_array((np.ones(len(i)), (i, j)), shape=(c.n_blocks, c.n_blocks))
    graph = sp.csr_array(graph + graph.T + sp.eye_array(c.n_blocks))
    graph.sort_indices()
    patterns = [
        graph.indices[graph.indptr[k] : graph.indptr[k + 1]].tobytes() for k in range(c.n_blocks)
    ]
    count = Counter(patterns)
    groups: dict[bytes | int, int] = {}
    # More blocks with equal couplings than a pair of bodies has contacts mean a dense matrix: keep them separate.
    keys = [p if count[p] <= MAX_MANIFOLD_BLOCKS else k for k, p in enumerate(patterns)]
    label = np.array([groups.setdefault(key, len(groups)) for key in keys])
    g = graph.tocoo()
    i, j = label[g.coords[0]], label[g.coords[1]]
    edges = np.unique(np.stack([i[i < j], j[i < j]]), axis=1)
    return len(groups), edges[0], edges[1]


def _has_redundant_rows(problem: Problem) -> bool:
    """Whether some rows depend on others: by counts of rows and velocities, or by singular values."""
    if problem.rows is not None and problem.m > 6 * problem.rows.n_bodies:
        return True
    if problem.m > MAX_RANK_ROWS:
        return False
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(problem.d)
        a = problem.dense() * scale[:, None] * scale[None, :]
    values = np.linalg.svd(a, compute_uv=False) if np.isfinite(a).all() else np.zeros(0)
    return len(values) > 0 and bool(values[-1] <= ZERO_SINGULAR_VALUE_TOL * values[0])
