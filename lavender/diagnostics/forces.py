"""Forces of contacts in newtons: the impulse divided by dt, its error, and whether the data determine it.

    forces = lavender.contact_forces(problem, impulse, dt=0.002)    # an engine's answer to a step of 2 ms
    forces.table                                                    # a row for each contact, in N

If A is singular, contact forces are not unique: of a table on four feet, only the sum is. With the null vectors y of
J^T (J^T y = 0; of A if only A is known), every solution is lambda + y, so that

    a contact's force is determined if y is zero on its rows                          (`lavender.redundancy`)
    a pair's normal force, sum lambda_n / dt over its contacts, if sum y_n = 0 for all y

Compliance does not count: the softness of an engine divides a load among four feet, but no property of the bodies does.
These hold for symmetric A without Coulomb friction. Under Coulomb's law, other solutions with other sliding contacts
may exist, too; then a determined force is that of solutions with the reference's motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import InputError
from lavender.base.lazy_import import pandas as pd
from lavender.base.lazy_import import sparse as sp
from lavender.diagnostics.redundancy import redundancy
from lavender.judge.residuals import Residual, residual
from lavender.judge.solution import raise_if_interrupted
from lavender.problem import Problem, check_problem
from lavender.problem.ordering import group_blocks_by_island
from lavender.solvers.islands import find_islands, get_rows_of_blocks
from lavender.solving.solve import solve

REFERENCE_TOL = 1e-10  # [-] Relative residual of the reference solve.
MAX_NULL_ROWS = (
    2000  # Above this number of dependent rows in an island, no sum of a pair is tested.
)
NULL_ENTRY = 1e-8  # [-] A sum of a null vector of length 1 up to this counts as zero.
CONTACT, PAIR, UNDETERMINED = "contact", "pair", "not determined"


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
        Normal force and norm of the friction force of the given impulse.
    exact : (c,) N
        Normal force of the reference.
    error : (c,) N
        Norm of the difference of both forces, over the rows of normal and tangents.
    share : (c,)
        Part of its pair's exact normal force that a contact bears [-]; nan if the contact's force is not determined.
    determined : tuple of str
        "contact" if the force of the contact is determined, "pair" if only the sum of the pair's normal forces is, else
        "not determined".
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
        heads = ["contact", "bodies", "normal force [N]", "friction force [N]"]
        heads += ["exact normal force [N]", "error [N]", "share of the load [%]", "determined"]
        return pd.DataFrame(rows, columns=heads)

    def __str__(self) -> str:
        return self.table.to_string(index=False, float_format="{:.3g}".format, na_rep="–")


def contact_forces(
    problem: Problem,
    impulse: Any,
    *,
    dt: float,
    reference: Any = None,
    pairs: Sequence[str] | Callable[[str], str] | None = None,
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
    if not (judged.relative <= 1e3 * REFERENCE_TOL or judged.at_floor):
        raise InputError(
            f"reference has a relative residual of {judged.relative:.1e}; {1e3 * REFERENCE_TOL:.0e}, or its floor, is "
            "needed: forces of a step without a solution have no error"
        )
    found = _list_contacts(problem)
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
            friction[k, : len(contact.tangents)] = x[contact.tangents]
        return np.array([x[contact.normals].sum() for contact in found]) / dt, friction / dt

    (normal, friction), (correct, wanted) = measure(own), measure(exact)
    with np.errstate(over="ignore"):  # Of impulses beyond 1e154 N s.
        error = np.hypot(normal - correct, np.linalg.norm(friction - wanted, axis=1))
        size = np.linalg.norm(friction, axis=1)
    tangential = np.array(
        [np.nan if len(contact.normals) > 1 else x for contact, x in zip(found, size, strict=True)]
    )
    determined = _find_determined(problem, found, names)
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
        contacts, tuple(names), normal, tangential, correct, error, share, determined, dt, judged
    )  # fmt: skip


class _Contact(NamedTuple):
    """A contact with the names of its bodies: its normal row, or the edges of its pyramid, and its tangents."""

    name: str
    pair: str
    normals: list[int]
    tangents: list[int]


def _list_contacts(problem: Problem) -> list[_Contact]:
    """Return the contacts of a problem; rows "NAME, edge K" are one contact NAME with a pyramid."""
    cones, rows = problem.cones, problem.rows
    contacts: list[_Contact] = []
    pyramids: dict[str, _Contact] = {}
    bodies: Iterator[list[int]] = iter([] if rows is None else rows.contact_body.tolist())
    for k in range(problem.n_blocks):
        name, first = problem.block_name(k), int(cones.ptr[k])
        if not cones.is_contact[k]:
            name, edge, _ = name.partition(", edge ")
            if not edge:
                continue
            if name not in pyramids:
                pyramids[name] = _Contact(name, _name_pair(name), [], [])
                contacts.append(pyramids[name])
            pyramids[name].normals.extend(range(first, int(cones.ptr[k + 1])))
            continue
        pair = _name_pair(name)
        if rows is not None:
            pair = " and ".join("ground" if b < 0 else f"body {b}" for b in next(bodies))
        count = min(2, int(cones.n_tangents[k]))
        contacts.append(_Contact(name, pair, [first], list(range(first + 1, first + 1 + count))))
    return contacts


def _name_pair(contact: str) -> str:
    """Return the names in parentheses of a contact's name, or the name itself."""
    return contact.partition(" (")[2].rstrip(")").replace(", ", " and ") or contact


def _find_determined(
    problem: Problem, contacts: Sequence[_Contact], names: Sequence[str]
) -> tuple[str, ...]:
    """Return what the rigid rows determine of each contact: its force, the sum of its pair, or nothing."""
    if problem.compliance is not None and problem.compliance.any():
        problem = replace(problem, compliance=np.zeros(problem.m))
    found = redundancy(problem)
    unique = found.impulse_is_unique
    sums = {name: np.zeros(problem.m) for name in names}
    for name, contact in zip(names, contacts, strict=True):
        sums[name][contact.normals] = 1.0
    is_known = dict.fromkeys(names, True)
    whole = [bool(unique[[*c.normals, *c.tangents]].all()) for c in contacts]
    pyramids = {k: True for k, c in enumerate(contacts) if len(c.normals) > 1 and not whole[k]}
    for island in [] if unique.all() else group_blocks_by_island(*find_islands(problem)):
        rows = get_rows_of_blocks(problem, island)
        if unique[rows].all():
            continue
        vectors = _compute_null_vectors(problem, rows, found.tol)
        place = {int(row): i for i, row in enumerate(rows)}
        for name, total in sums.items():
            if total[rows].any() and not _is_zero_for_all(vectors, total[rows]):
                is_known[name] = False
        for k in pyramids:
            if contacts[k].normals[0] in place:
                part = np.isin(rows, contacts[k].normals).astype(float)
                pyramids[k] = _is_zero_for_all(vectors, part)
    return tuple(
        CONTACT if whole[k] or pyramids.get(k, False) else PAIR if is_known[name] else UNDETERMINED
        for k, name in enumerate(names)
    )


def _is_zero_for_all(vectors: FloatArray | None, part: FloatArray) -> bool:
    """Return whether a sum of entries is zero for all null vectors; False if these are not known."""
    return vectors is not None and bool(np.abs(vectors @ part).max(initial=0.0) <= NULL_ENTRY)


def _compute_null_vectors(problem: Problem, rows: Any, tol: float) -> FloatArray | None:
    """Return the vectors y (any, rows) of length 1 that move nothing in an island; None if it is too large."""
    if len(rows) > MAX_NULL_ROWS:
        return None
    if problem.matrix is None:
        # The columns of bodies that cannot move have to be zero.
        whole = problem.jacobian if problem.rows is None else problem.velocity_form().jacobian
        part = sp.csr_array(whole)[rows]
        part = part[:, np.unique(part.indices)].toarray()
    else:
        part = problem.csr[rows][:, rows].toarray()
    scale = np.linalg.norm(part, axis=1)
    scale = np.where(scale > 0.0, scale, 1.0)
    left, size, _ = np.linalg.svd(part / scale[:, None])
    kept = np.concatenate([size, np.zeros(len(rows) - len(size))])
    limit = max(tol, len(rows) * 2.0**-50) * kept.max(initial=1.0)
    vectors = left[:, kept <= limit].T / scale
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
