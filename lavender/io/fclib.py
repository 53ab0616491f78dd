"""Read FCLIB files (HDF5) with local and global friction problems in 2D and 3D, and write their local form.

    local     u = W r + q                                         A = W, b = -q, lambda = r, w = u
    global    M v = H r + f,  u = H^T v + w                       A = H^T M^-1 H,  b = -(w + H^T M^-1 f)
    equations (V, R, s or G, b) become free rows after the contacts, on which w = 0
    rolling   five rows per contact, |r_T| <= mu r_N, and |r_R| <= mu_r r_N on the last two

FCLIB's vector `w` is an offset of the velocity, not our slack. Format: Acary, Bremond, Huber et al.,
"FCLIB: a collection of discrete 3D frictional contact problems", Inria RT-444, 2014.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.io.hdf5 import HDF5Reader, import_h5py, write_array, write_matrix
from lavender.io.npz import Stored
from lavender.io.stored import write_bytes
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.problem.generalized import Generalized

LOCAL, GLOBAL = "fclib_local", "fclib_global"
ROLLING = "_rolling"  # Suffix of both group names.
ROLLING_ROWS = 5  # Normal, two tangents, two rolling rows.
# Dimensions of the arrays of each form, one letter each: m rows of c contacts, p equations, n velocities.
PARTS = {
    LOCAL: {"W": "mm", "V": "mp", "R": "pp", "q": "m", "s": "p", "mu": "c", "mu_r": "c"},
    GLOBAL: {"H": "nm", "M": "nn", "G": "np", "f": "n", "w": "m", "b": "p", "mu": "c", "mu_r": "c"},
}
DENSE_CHUNK_NUMBERS = (
    2**23
)  # At most this many entries of M^-1 J^T or A are held densely at a time (64 MiB).
# Factors of M with more entries than this (in dense storage) are not computed: 2 GiB of values and indices.
MAX_MASS_FACTOR_ENTRIES = 2**27


class Contents(NamedTuple):
    """Contents of an FCLIB file: nothing is condensed, rescaled or symmetrised."""

    group: str  # Name of the problem's group in the file.
    spacedim: int  # Rows of each contact, normal first: 2, 3, or 5 with rolling friction.
    # Matrices (CSR) and vectors by the names of `PARTS` of the form; absent ones are not in it.
    parts: Mapping[str, Any]
    # The stored solution and guesses: "r" and "u" (m,), "v" (n,), "l" (p,).
    solution: Mapping[str, FloatArray] = MappingProxyType({})
    guesses: Sequence[Mapping[str, FloatArray]] = ()
    info: Mapping[str, str] = MappingProxyType({})  # dict of str to str
    compare: str = (
        ""  # Not part of FCLIB: "r,u", "u" or "error" if the file has a group `reference`.
    )

    def build_problem(self, name: str = "") -> Problem:
        """Return the problem.

        A global problem is returned in generalised coordinates (J = H^T), or as A and b if M is not a mass matrix.
        """
        x = self.parts
        a = None
        general = None
        if self.group.startswith(LOCAL):
            a = x["W"]
            b = -x["q"]
            if "s" in x:
                a = sp.csr_array(sp.block_array([[a, x["V"]], [x["V"].T, x["R"]]]))
                b = np.append(b, -x["s"])
        else:
            # The rows of J = [H G]^T are the contact rows and the equations.
            jt = sp.csr_array(sp.hstack([x["H"], x["G"]])) if "G" in x else x["H"]
            offset = np.append(x["w"], x["b"]) if "b" in x else x["w"]
            general = _build_generalised_form(x["M"], jt, x["f"])
            if general is not None:
                b = general.bias(-offset)
            elif x["M"].shape[0] == 0:
                a = sp.csr_array((len(offset), len(offset)))
                b = -offset
            else:
                a, free_velocity = form_dense_a(x["M"], jt, x["f"])
                b = -(offset + free_velocity)
        mu = x["mu"]
        mu_r = x.get("mu_r")
        d = self.spacedim
        cones = Cones.contacts(mu, d - 1 if mu_r is None else 2, rolling=mu_r) + Cones.free(
            len(b) - len(mu) * d
        )
        guess = _join_impulse(self.guesses[0]) if self.guesses else None
        return Problem(
            b, cones, a, guess=guess, name=self.info.get("title", "") or name, generalized=general
        )


def _join_impulse(point: Mapping[str, FloatArray]) -> FloatArray:
    return np.concatenate([point["r"], point["l"]]) if "l" in point else point["r"]


def _build_generalised_form(
    mass: sp.csr_array, jt: sp.csr_array, f: FloatArray
) -> Generalized | None:
    """Return the generalised form, or None if M (n, n) is not a mass matrix of bodies.

    M does not count as a mass matrix if it is asymmetric or not positive definite, or if a connected component of it is
    too large to factor.
    """
    if mass.shape[0] == 0:
        return None
    if 4 * _bound_factor_entries(mass) > MAX_MASS_FACTOR_ENTRIES:
        return None
    try:
        general = Generalized(jt.T.tocsr(), mass, np.zeros(mass.shape[0]))
        return general.with_jacobian(v_free=general.solve(f))
    except InputError:
        return None


def _bound_factor_entries(mass: sp.csr_array) -> float:
    """Return the number of entries of the factors of M: up to n^2 of a connected component of n unknowns."""
    size = np.bincount(sp.csgraph.connected_components(mass, directed=False)[1]).astype(float)
    return float(size @ size)


def form_dense_a(
    mass: sp.csr_array, jt: sp.csr_array, f: FloatArray
) -> tuple[sp.csr_array, FloatArray]:
    """Return A = J M^-1 J^T (m, m) and J M^-1 f (m,) for M (n, n), J^T (n, m) and f (n,)."""
    entries = _bound_factor_entries(mass)
    if entries > MAX_MASS_FACTOR_ENTRIES:
        raise InputError(
            f"the factors of M may have {entries:.3g} entries, above {MAX_MASS_FACTOR_ENTRIES}"
        )
    try:
        solve = factor_sparse_lu(mass).solve
    except RuntimeError as error:
        raise InputError(f"M cannot be factorised ({error}); an invertible M is needed") from None
    m = jt.shape[1]
    step = max(1, DENSE_CHUNK_NUMBERS // max(1, *jt.shape))
    columns = sp.csc_array(jt)
    j = sp.csr_array(jt.T)
    parts = [
        sp.csr_array(j @ solve(columns[:, k : min(k + step, m)].toarray()))
        for k in range(0, m, step)
    ]
    a = sp.csr_array(sp.hstack(parts)) if parts else sp.csr_array((0, 0))
    gap = mass - mass.T
    if gap.nnz == 0 or not np.any(gap.data):
        a = sp.csr_array(0.5 * (a + a.T))  # With a symmetric M, A is asymmetric only by rounding.
    return a, j @ solve(f)


# -- reading --------------------------------------------------------------------------------------


def read(path: str | os.PathLike[str]) -> Stored:
    """Read the problem, the solution and the guesses of an FCLIB file.

    A file with both forms is read in its local form. The first guess becomes `problem.guess`.
    """
    h5py = import_h5py()
    try:
        with h5py.File(path, "r") as stream:
            file = _read_file(HDF5Reader(h5py, stream))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (
        OSError,
        KeyError,
        RuntimeError,
        ValueError,
        TypeError,
        OverflowError,
        MemoryError,
    ) as error:
        raise InputError(
            f"{path} cannot be read as HDF5 ({error}); the file is damaged or not an HDF5 file: write it again"
        ) from None
    try:
        problem = file.build_problem(Path(path).stem)
        guesses = tuple(problem.make_start(_join_impulse(g), "guess") for g in file.guesses)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    point = file.solution
    return Stored(
        problem,
        file.group,
        impulse=_join_impulse(point) if "r" in point else None,
        slack=np.append(point["u"], np.zeros(len(point.get("l", ())))) if "u" in point else None,
        compare=file.compare,
        guesses=guesses,
        info=file.info,
    )


def _read_file(r: HDF5Reader) -> Contents:
    """Read an open file; check all lengths before reading numbers."""
    present = [
        name for name in (LOCAL, GLOBAL, LOCAL + ROLLING, GLOBAL + ROLLING) if r.has_path(name)
    ]
    if not present:
        found = ", ".join(list(r.file)[:8]) or "nothing"
        raise InputError(
            f"holds {found}; an FCLIB file has a group {LOCAL} or {GLOBAL}, with the suffix {ROLLING} if contacts have "
            "rolling friction"
        )
    group = present[0]
    rolling = present[0].endswith(ROLLING)
    if present[-1].endswith(ROLLING) != rolling:
        raise InputError(
            f"the file holds the groups {' and '.join(present)}; only one of the two is needed"
        )
    spacedim = r.read_integer(f"{group}/spacedim")
    if spacedim not in ((ROLLING_ROWS,) if rolling else (2, 3)):
        needed = f"{ROLLING_ROWS}, as rolling friction has," if rolling else "2 or 3"
        raise InputError(f"{group}/spacedim is {spacedim}; {needed} is needed")
    vectors = f"{group}/vectors"
    local = group.startswith(LOCAL)
    first_shape = r.read_matrix_shape(f"{group}/{'W' if local else 'H'}")
    more = f"{group}/{'V' if local else 'G'}"
    has_equations = r.has_path(more) or (local and r.has_path(f"{group}/R"))
    n = 0 if local else first_shape[0]
    m = first_shape[1]
    p = r.read_matrix_shape(more)[1] if has_equations else 0
    if local and first_shape != (m, m):
        raise InputError(f"{group}/W is {first_shape[0]} x {m}; a square matrix is needed")
    if m % spacedim:
        raise InputError(f"{group} has {m} rows; a multiple of spacedim = {spacedim} is needed")
    size = {"m": m, "n": n, "p": p, "c": m // spacedim}
    absent = [
        *("" if has_equations else "VRG"),
        *("" if p else "sb"),
        *([] if rolling else ["mu_r"]),
    ]
    parts = {
        name: shape
        for name, shape in PARTS[LOCAL if local else GLOBAL].items()
        if name not in absent
    }
    shapes: dict[str, Any] = {name: tuple(size[x] for x in shape) for name, shape in parts.items()}
    matrices, names = ([name for name in shapes if len(shapes[name]) == k] for k in (2, 1))
    for name in names:
        r.find_dataset(f"{vectors}/{name}", "iuf", shapes[name][0])
    count = r.read_integer("guesses/number_of_guesses") if r.has_path("guesses") else 0
    if count < 0 or (count > 0 and count > len(r.find_node("guesses"))):
        raise InputError(
            f"guesses/number_of_guesses is {count}; it has {len(r.find_node('guesses')) - 1}"
        )
    values: dict[str, Any] = {
        name: r.read_matrix(f"{group}/{name}", shapes[name]) for name in matrices
    }
    values |= {name: r.read_vector(f"{vectors}/{name}", shapes[name][0]) for name in names}
    return Contents(
        group,
        spacedim,
        values,
        solution=_read_point(r, "solution", n, m, p) if r.has_path("solution") else {},
        guesses=tuple(_read_point(r, f"guesses/{i + 1}", n, m, p) for i in range(count)),
        info={
            name: r.read_text(f"{group}/info/{name}")
            for name in ("title", "description", "math_info")
        },
        compare=r.read_text("reference/compare"),
    )


def _read_point(r: HDF5Reader, group: str, n: int, m: int, p: int) -> dict[str, FloatArray]:
    """Read a solution or guess: r, and u, v and l if they are present; l is required if the problem has equations."""
    point = {"r": r.read_vector(f"{group}/r", m)}
    for name, size in (("u", m), ("v", n), ("l", p)):
        if size and r.has_path(f"{group}/{name}"):
            point[name] = r.read_vector(f"{group}/{name}", size)
    if p and "l" not in point:
        raise InputError(
            f"{group} has no dataset l; the multipliers of the {p} equations are needed in it"
        )
    return point


# -- writing --------------------------------------------------------------------------------------


def write(
    problem: Problem,
    path: str | os.PathLike[str],
    *,
    impulse: Any = None,
    drop: Collection[str] = (),
) -> None:
    """Save a friction contact problem in the local form, W = A and q = -b; see `lavender.io.save`."""
    if not isinstance(problem, Problem):
        raise InputError(f"problem is a {type(problem).__name__}; a lavender.Problem is needed")
    unknown = sorted(set(drop) - {"names", "key", "precision"})
    if unknown:
        raise InputError(
            f"drop names {', '.join(unknown)}; only 'names', 'key' and 'precision' may be"
        )
    obstacles = _list_unsupported_data(problem, drop)
    if obstacles:
        raise CapabilityError(f"FCLIB cannot hold {'; '.join(obstacles)}. An .npz holds everything")
    h5py = import_h5py()
    # The file is built in memory first, because HDF5 ends the process by a signal if the disk is full.
    with h5py.File("in memory", "w", driver="core", backing_store=False) as out:
        _write_file(out, problem, impulse)
        out.flush()
        image = out.id.get_file_image()
    write_bytes(path, image)


def _write_file(out: Any, problem: Problem, impulse: Any) -> None:
    """Write all groups of the file, with the matrix in compressed rows."""
    c = problem.cones
    group = out.create_group(LOCAL + ROLLING if c.has_rolling else LOCAL)
    write_array(group, "spacedim", c.ptr[1:2])
    write_matrix(group.create_group("W"), problem.csr)
    vectors = {"q": -problem.b, "mu": c.mu} | ({"mu_r": c.rolling} if c.has_rolling else {})
    _write_arrays(group.create_group("vectors"), vectors)
    if problem.name:
        # FCLIB expects strings that end in a NUL character.
        texts = {"title": problem.name.encode(), "description": b"", "math_info": b""}
        info = {name: np.array(text, f"S{len(text) + 1}") for name, text in texts.items()}
        _write_arrays(group.create_group("info"), info)
    if impulse is not None:
        _write_point(out, "solution", problem, impulse)
    if problem.guess is not None:
        write_array(out.create_group("guesses"), "number_of_guesses", np.array([1], np.int32))
        _write_point(out, "guesses/1", problem, problem.guess)


def _write_point(out: Any, name: str, problem: Problem, impulse: Any) -> None:
    """Write a group with an impulse and its slack."""
    lam = problem.make_start(impulse)
    _write_arrays(out.create_group(name), {"r": lam, "u": problem.slack(lam)})


def _write_arrays(group: Any, arrays: Mapping[str, Any]) -> None:
    for name, value in arrays.items():
        write_array(group, name, value)


def _list_unsupported_data(problem: Problem, drop: Collection[str]) -> list[str]:
    """Return everything of the problem that FCLIB cannot hold, each as a phrase for the error message."""
    c, general = problem.cones, problem.generalized
    rows = ~c.contact_rows
    is_free = np.isneginf(c.lower) & np.isposinf(c.upper)
    kind = "free rows" if np.all(is_free[rows]) else "bounded rows"
    tangents = c.n_tangents[c.is_contact]
    rolls = np.count_nonzero(c.rolling_rows >= 0)
    sizes = np.unique(tangents) + 1
    has_surrogate = any("\ud800" <= letter <= "\udfff" for letter in problem.name)
    names, key, precision = (name not in drop for name in ("names", "key", "precision"))
    table: tuple[tuple[Any, str], ...] = (
        (rows.any(), f"blocks of bounded rows ({int(rows.sum())} {kind}; contacts only)"),
        (c.has_ellipse, "ellipses (give problem.disk; problem.on_disk converts impulses)"),
        (
            c.has_box,
            "boxes (FCLIB's friction is a disk: give cones.shaped('disk'), which is another law)",
        ),
        (np.any(c.spin_rows >= 0) or c.has_round, "torsional friction"),
        (
            0 < rolls < len(tangents),
            f"contacts with and without rolling rows ({rolls} of {len(tangents)}; all, or none)",
        ),
        (problem.n_blocks == 0, "a problem without contacts"),
        (
            len(sizes) > 1 or 1 in sizes,
            f"contacts of {', '.join(map(str, sizes))} rows (all 2, or all 3)",
        ),
        (
            problem.friction != "coulomb",
            "the 'cone' law (FCLIB means Coulomb friction: give problem.relaxed('coulomb'))",
        ),
        (names and problem.names is not None, "names of blocks (drop=('names',) leaves them out)"),
        (key and problem.key is not None, "keys of blocks (drop=('key',) leaves them out)"),
        (
            names and general is not None and general.names is not None,
            "names of velocities (drop=('names',) leaves them out)",
        ),
        (
            precision and problem.precision != "float64",
            f"the precision {problem.precision!r} (drop=('precision',) leaves it out)",
        ),
        (has_surrogate, "half a surrogate pair in its name (give another name)"),
        (
            "\0" in problem.name,
            "a NUL character in its name, which ends texts in FCLIB (give another name)",
        ),
    )
    return [text for is_present, text in table if is_present]
