"""Forces of contacts in newtons: the impulse divided by dt, its error, and whether the data determine it.

    forces = lavender.contact_forces(problem, impulse, dt=0.002)    # an engine's answer to a step of 2 ms
    forces.table                                                    # a row for each contact, in N

If A is singular, contact forces are not unique: of a table on four feet, only the sum is. With the null vectors y of
J^T (J^T y = 0; of A if only A is known), every solution is lambda + y. A sum of normal forces, of one contact or of all
contacts between two bodies, is *determined* if no y that is as large as the largest normal force of its island changes
it by more than 1 %. A friction force is determined if no such y changes it by more than 1 % of its normal force.

Compliance does not count: the softness of an engine divides a load among four feet, but no property of the bodies does.
These hold for symmetric A without Coulomb friction. Under Coulomb's law, other solutions with other sliding contacts
may exist, too; then a determined force is that of solutions with the reference's motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import InputError
from lavender.base.lazy_import import pandas as pd
from lavender.base.lazy_import import sparse as sp
from lavender.diagnostics.redundancy import MIN_NEW_PART, redundancy
from lavender.io import mujoco as adapter
from lavender.io.contact_friction import find_friction
from lavender.judge.residuals import Residual, residual
from lavender.judge.solution import raise_if_interrupted
from lavender.problem import Problem, check_problem
from lavender.problem.ordering import group_blocks_by_island
from lavender.solvers.islands import find_islands, get_rows_of_blocks
from lavender.solving.solve import solve

REFERENCE_TOL = 1e-10  # [-] Relative residual of the reference solve.
# Islands of up to this many rows are decomposed at once; larger ones if `redundancy` finds dependent rows.
MAX_DIRECT_ROWS = 200
MAX_NULL_ROWS = (
    2000  # Above this number of dependent rows in an island, no sum of a pair is tested.
)
NULL_ENTRY = 1e-8  # [-] A sum of a null vector of length 1 up to this counts as zero.
DETERMINED_TO = 0.01  # [-] A force is determined if it cannot change by more than this part of it.
CONTACT, PAIR, UNDETERMINED = "contact", "pair", "not determined"
HEADS = (
    "contact", "bodies", "normal force [N]", "friction force [N]", "exact normal force [N]", "error [N]",
    "share of the load [%]", "determined", "pair force [N]", "pair error [N]",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ContactForces:
    """Forces of the contacts of one step; `str()` is the table.

    Parameters
    ----------
    contacts : tuple of str
        Name of each of the c contacts.
    pairs : tuple of str
        Names of the two bodies of each contact.
    normal, tangential : (c,) N
        Normal force and norm of the friction force of the given impulse; the latter is nan if it is not determined, and
        for a pyramid whose coefficients are not known.
    exact : (c,) N
        Normal force of the reference.
    error : (c,) N
        Norm of the difference of both forces, over the normal row, and the tangents where friction is determined.
    share : (c,)
        Part of its pair's exact normal force that a contact bears [-]; nan if the contact's force is not determined.
    determined : tuple of str
        "contact" if the normal force of the contact is determined, "pair" if only the sum of the pair's normal forces
        is, else "not determined".
    dt : float, s
    reference_residual : Residual
    """

    contacts: tuple[str, ...]
    pairs: tuple[str, ...]
    normal: FloatArray
    tangential: FloatArray
    exact: FloatArray
    error: FloatArray
    share: FloatArray
    determined: tuple[str, ...]
    dt: float
    reference_residual: Residual

    @property
    def table(self) -> pd.DataFrame:
        """A row for each determined contact, and one for each other pair of bodies, with what is determined.

        The columns are `contact`, `bodies`, `normal force [N]`, `friction force [N]`, `exact normal force [N]`,
        `error [N]`, `share of the load [%]` and `determined`. The numbers of a pair are sums of normal forces; a pair
        whose sum is not determined has none.
        """
        rows: list[tuple[Any, ...]] = []
        done = set[str]()
        for i, (contact, pair, kind) in enumerate(
            zip(self.contacts, self.pairs, self.determined, strict=True)
        ):
            if kind == CONTACT:
                numbers = self.normal[i], self.tangential[i], self.exact[i], self.error[i]
                rows.append((contact, pair, *numbers, 100.0 * self.share[i], kind))
                continue
            if pair in done:
                continue
            done.add(pair)
            own = [
                k
                for k, (other, what) in enumerate(zip(self.pairs, self.determined, strict=True))
                if other == pair and what == kind
            ]
            name = f"{len(own)} contacts" if len(own) > 1 else contact
            if kind == PAIR:
                first, exact = self.normal[own].sum(), self.exact[own].sum()
                rows.append((name, pair, first, np.nan, exact, abs(first - exact), 100.0, kind))
            else:
                rows.append((name, pair, np.nan, np.nan, np.nan, np.nan, np.nan, kind))
        return pd.DataFrame(rows, columns=HEADS[:8])

    @property
    def by_contact(self) -> pd.DataFrame:
        """A row for each contact, also for those whose force is not determined alone.

        The columns are those of `table`, `pair force [N]`, the sum of the normal forces of the contact's two bodies,
        and `pair error [N]`; what is not determined is nan, but `normal force [N]`, which is the engine's.
        """
        return tabulate_contacts([self])

    def __str__(self) -> str:
        return self.table.to_string(index=False, float_format="{:.3g}".format, na_rep="–")


def tabulate_contacts(steps: Sequence[ContactForces]) -> pd.DataFrame:
    """Return the rows of `ContactForces.by_contact` of several steps."""
    parts: list[list[Any]] = [[] for _ in HEADS]
    for forces in steps:
        if not forces.contacts:
            continue
        pairs, place = np.unique(np.array(forces.pairs, object), return_inverse=True)
        kinds = np.array(forces.determined, object)
        is_alone = kinds == CONTACT
        sums = np.bincount(place, forces.normal, len(pairs))
        exact = np.bincount(place, forces.exact, len(pairs))
        sums[place[kinds == UNDETERMINED]] = np.nan
        columns = (
            forces.contacts, forces.pairs, forces.normal, forces.tangential,
            np.where(is_alone, forces.exact, np.nan), np.where(is_alone, forces.error, np.nan),
            100.0 * forces.share, kinds, sums[place], np.abs(sums - exact)[place],
        )  # fmt: skip
        for part, column in zip(parts, columns, strict=True):
            part.extend(column)
    return pd.DataFrame(dict(zip(HEADS, parts, strict=True)))


def contact_forces(
    problem: Problem,
    impulse: Any,
    *,
    dt: float,
    reference: Any = None,
    pairs: Sequence[str] | Callable[[str], str] | None = None,
    friction: Callable[[str], Any] | None = None,
) -> ContactForces:
    """Return the forces of all contacts in newtons, with their errors, and what of them the data determine.

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s
        The answer of an engine or a solver to the step.
    dt : float, s
        Duration of the step, or of the substep that the problem describes: force = impulse / dt.
    reference : (m,) N s or Solution, optional
        Solution with which forces are compared. Default: the result of `auto` from `impulse` to a relative residual of
        1e-10.
    pairs : names or callable, optional
        Name of the pair of bodies of each contact, in the order of the contacts, or a function that returns it for the
        name of a contact. Default: the bodies of a problem of bodies, or the text in parentheses of the contact's name.
    friction : callable, optional
        Function that returns the coefficients (2,) [-] of both tangents for the name of a contact, or None: the edges
        of a pyramid do not have them. Default: those of MuJoCo's model, if `from_mujoco` made the problem.

    Returns
    -------
    ContactForces

    Raises
    ------
    InputError
        `dt` is not positive, an impulse does not fit, `pairs` has another length, or no reference was found.
    """
    check_problem(problem)
    dt = check_float("dt", dt, above=0.0)
    own = problem.make_start(impulse)
    if reference is None:
        reference = raise_if_interrupted(solve(problem, impulse=own, tol=REFERENCE_TOL)).impulse
    exact = problem.make_start(reference, "reference")
    judged = residual(problem, exact)
    if not is_reference(judged):
        raise InputError(
            f"reference has a relative residual of {judged.relative:.1e}; {1e3 * REFERENCE_TOL:.0e}, or its floor, is "
            "needed: forces of a step without a solution have no error"
        )
    model = adapter.find_source(problem)[0]
    if friction is None and model is not None:
        friction = partial(find_friction, model)
    return measure_forces(problem, own, exact, dt, pairs, judged, friction)


def is_reference(judged: Residual) -> bool:
    """Return whether a solution is exact enough for forces to be compared with it."""
    return bool(judged.relative <= 1e3 * REFERENCE_TOL or judged.at_floor)


def measure_forces(
    problem: Problem,
    own: FloatArray,
    exact: FloatArray,
    dt: float,
    pairs: Sequence[str] | Callable[[str], str] | None,
    judged: Residual,
    friction_of: Callable[[str], Any] | None = None,
) -> ContactForces:
    """Return the forces of an impulse [N s] beside those of a solution, whose residual is `judged`.

    `friction_of` returns the coefficients (2,) of both tangents for the name of a contact, or None.
    """
    found = _list_contacts(problem, friction_of)
    if callable(pairs):
        pairs = [pairs(contact.name) for contact in found]
    names = [contact.pair for contact in found] if pairs is None else list(map(str, pairs))
    if len(names) != len(found):
        raise InputError(
            f"pairs has {len(names)} names; one for each of {len(found)} contacts is needed"
        )

    def measure(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the normal force (c,) and the friction force (c, 2) [N] of an impulse."""
        friction = np.zeros((len(found), 2))
        for k, contact in enumerate(found):
            friction[k] = contact.weights @ x[contact.tangents]
        return np.array([x[contact.normals].sum() for contact in found]) / dt, friction / dt

    (normal, friction), (correct, wanted) = measure(own), measure(exact)
    determined, has_friction = _find_determined(problem, found, names, exact)
    with np.errstate(over="ignore"):  # Of impulses beyond 1e154 N s.
        gap = np.where(has_friction, np.linalg.norm(friction - wanted, axis=1), 0.0)
        error = np.hypot(normal - correct, gap)
        size = np.where(has_friction, np.linalg.norm(friction, axis=1), np.nan)
    loads: dict[str, float] = {}
    for name, force in zip(names, correct, strict=True):
        loads[name] = loads.get(name, 0.0) + float(force)
    share = np.array(
        [
            force / loads[name] if kind == CONTACT and loads[name] > 0.0 else np.nan
            for name, force, kind in zip(names, correct, determined, strict=True)
        ]
    )
    contacts = tuple(contact.name for contact in found)
    return ContactForces(
        contacts, tuple(names), normal, size, correct, error, share, determined, dt, judged
    )  # fmt: skip


class _Contact(NamedTuple):
    """A contact with the names of its bodies and its rows.

    `normals` are its normal row, or the edges of its pyramid. `weights` (2, rows) times the impulses of the rows
    `tangents` are its friction impulses along both tangents [N s]; nan if the coefficients of a pyramid are not known.
    """

    name: str
    pair: str
    normals: list[int]
    tangents: list[int]
    weights: FloatArray


def _list_contacts(
    problem: Problem, friction_of: Callable[[str], Any] | None = None
) -> list[_Contact]:
    """Return the contacts of a problem; rows "NAME, edge K" from edge 0 on are one contact NAME with a pyramid.

    The edges 2 j and 2 j + 1 of a pyramid are the normal plus and minus the coefficient times tangent j. The tangents
    of MuJoCo's elliptic contacts are scaled by their coefficient divided by the first one.
    """
    cones, rows = problem.cones, problem.rows
    contacts: list[_Contact] = []
    pyramids: dict[str, int] = {}
    bodies: Iterator[list[int]] = iter([] if rows is None else rows.contact_body.tolist())
    for k in range(problem.n_blocks):
        name, first = problem.block_name(k), int(cones.ptr[k])
        if not cones.is_contact[k]:
            name, edge, number = name.partition(", edge ")
            if not edge:
                continue
            if name not in pyramids or number == "0":
                pyramids[name] = len(contacts)
                pair = name_pair(name) or name
                contacts.append(_Contact(name, pair, [], [], np.zeros((2, 0))))
            own = range(first, int(cones.ptr[k + 1]))
            contacts[pyramids[name]].normals.extend(own)
            continue
        own_pair = " and ".join("ground" if b < 0 else f"body {b}" for b in next(bodies, ()))
        pair = name_pair(name) or own_pair or name
        count = min(2, int(cones.n_tangents[k]))
        tangents = list(range(first + 1, first + 1 + count))
        contacts.append(_Contact(name, pair, [first], tangents, np.eye(2)[:, :count]))
    for k, contact in enumerate(contacts):
        found = None if friction_of is None else friction_of(contact.name)
        is_pyramid = len(contact.normals) > 1
        if not is_pyramid and (found is None or len(contact.tangents) < 2):
            continue
        mu = np.full(2, np.nan) if found is None else np.asarray(found, float)
        if is_pyramid:
            signs = np.array([[mu[0], -mu[0], 0.0, 0.0], [0.0, 0.0, mu[1], -mu[1]]])
            edges = contact.normals[:4]
            contacts[k] = contact._replace(tangents=edges, weights=signs[:, : len(edges)])
        else:
            contacts[k] = contact._replace(weights=np.diag([1.0, mu[1] / mu[0]]))
    return contacts


def name_pair(block: str) -> str:
    """Return the two names in parentheses of a block's name, as "a and b"; empty without them."""
    return block.partition(" (")[2].partition(")")[0].replace(", ", " and ")


def _find_determined(
    problem: Problem, contacts: Sequence[_Contact], names: Sequence[str], exact: FloatArray
) -> tuple[tuple[str, ...], Any]:
    """Return what the rigid rows determine of each contact with these forces [N s], and whether its friction, too."""
    if problem.compliance is not None and problem.compliance.any():
        problem = replace(problem, compliance=np.zeros(problem.m))
    labels = {name: i for i, name in enumerate(dict.fromkeys(names))}
    # The contact and the pair of bodies of each normal row, -1 for other rows.
    contact_of, pair_of = np.full((2, problem.m), -1)
    is_contact = np.zeros(problem.m, bool)
    for k, contact in enumerate(contacts):
        contact_of[contact.normals], pair_of[contact.normals] = k, labels[names[k]]
        is_contact[[*contact.normals, *contact.tangents]] = True
    is_alone, has_sum = np.ones(len(contacts), bool), np.ones(len(labels), bool)
    has_friction = np.array([np.isfinite(contact.weights).all() for contact in contacts], bool)
    loads = np.array([exact[contact.normals].sum() for contact in contacts])
    islands = [
        get_rows_of_blocks(problem, x) for x in group_blocks_by_island(*find_islands(problem))
    ]
    unique = np.zeros(problem.m, bool)
    if max(map(len, islands), default=0) > MAX_DIRECT_ROWS:
        unique = redundancy(problem).impulse_is_unique
    for rows in islands:
        if unique[rows].all() or not is_contact[rows].any():
            continue
        vectors = _compute_null_vectors(problem, rows, is_contact[rows])
        if vectors is None:
            vectors = np.where(unique[rows] | ~is_contact[rows], 0.0, 1.0)[None]
        inside = np.unique(contact_of[rows][contact_of[rows] >= 0])
        scale = float(loads[inside].max(initial=0.0)) or 1.0
        for is_known, group in ((is_alone, contact_of[rows]), (has_sum, pair_of[rows])):
            entries, place = np.unique(group, return_inverse=True)
            sums = np.linalg.norm(vectors @ np.eye(len(entries))[place], axis=0)
            total = np.bincount(place, np.maximum(exact[rows], 0.0), len(entries))
            is_lost = scale * sums > np.maximum(NULL_ENTRY * scale, DETERMINED_TO * total)
            is_known[entries[is_lost & (entries >= 0)]] = False
        at = {int(row): i for i, row in enumerate(rows)}
        for k in inside.tolist():
            own = [at[row] for row in contacts[k].tangents]
            change = scale * float(np.linalg.norm(vectors[:, own] @ contacts[k].weights.T))
            if change > max(NULL_ENTRY * scale, DETERMINED_TO * loads[k]):
                has_friction[k] = False
    kinds = [
        CONTACT if is_alone[k] else PAIR if has_sum[labels[names[k]]] else UNDETERMINED
        for k in range(len(contacts))
    ]
    return tuple(kinds), has_friction & is_alone


def _compute_null_vectors(problem: Problem, rows: Any, kept: Any) -> FloatArray | None:
    """Return vectors y (any, rows) that move nothing in an island, orthonormal on the rows `kept` and 0 elsewhere.

    None if it is too large, or if A is not symmetric and singular.
    """
    if len(rows) > MAX_NULL_ROWS:
        return None
    tol = MIN_NEW_PART if problem.matrix is not None or problem.precision == "float32" else 1e-12
    if problem.matrix is None:
        # The columns of bodies that cannot move have to be zero.
        whole = problem.jacobian if problem.rows is None else problem.velocity_form().jacobian
        part = sp.csr_array(whole)[rows].toarray()
        part = part[:, part.any(axis=0)]
    else:
        part = problem.csr[rows][:, rows].toarray()
    scale = np.linalg.norm(part, axis=1)
    scale = np.where(scale > 0.0, scale, 1.0)
    left, size, _ = np.linalg.svd(part / scale[:, None])
    sizes = np.concatenate([size, np.zeros(len(rows) - len(size))])
    limit = max(tol, len(rows) * 2.0**-50) * sizes.max(initial=1.0)
    vectors = left[:, sizes <= limit].T / scale
    if len(vectors) and not problem.is_symmetric:
        return None
    _, size, right = np.linalg.svd(vectors * kept, full_matrices=False)
    return np.asarray(right[size > NULL_ENTRY * size.max(initial=1.0)])
