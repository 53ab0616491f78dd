"""Read and write problems in NumPy archives (.npz).

Our own format, quadratic programs and the plain box format are read. `docs/formats.md` describes each entry.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array
from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.io.engine_motion import MOVERS, EngineMotion
from lavender.io.stored import Arrays, read_arrays, write_arrays
from lavender.problem import Problem, check_problem
from lavender.problem.cones import Cones, get_block_kinds
from lavender.problem.engine_record import EngineRecord
from lavender.problem.generalized import Generalized
from lavender.problem.rows import Rows

FORMAT_VERSION = 1
CONES = tuple(f"cones_{f.name}" for f in fields(Cones) if f.name != "rolling")
ROWS = tuple(f"rows_{f.name}" for f in fields(Rows) if f.name != "copy")
COMPRESSED = ("data", "indices", "indptr")
FORMS = ("dense", "csr", "rows", "generalized", "program")
PROGRAM = ("P", "q", "G", "h", "A", "b", "lb", "ub")
MOTION = ("engine_change", "engine_compliance", "engine_momentum")
ENGINE_ENTRIES = ("engine_impulse", *MOTION)
USER = "user/"  # Entries below this name, and the key "user" of `meta`, belong to the user and are not read.
META_KEYS = {"operator", "friction", "name", "names", "precision", "user"}


def _list_matrix_entries(name: str, *more: str) -> set[str]:
    """Return the names of the entries of a compressed matrix."""
    return {f"{name}_{part}" for part in (*COMPRESSED, *more)}


PROGRAM_ENTRIES = {*PROGRAM}.union(*(_list_matrix_entries(name, "shape") for name in "PGA"))
#: Entries of every operator, and those of each.
ENTRIES = {"lavender_format", "meta", "guess", "key", "angular", "impulse", "gap"}
CONSTRAINTS = {"b", *CONES, "cones_rolling"}
ENTRIES_OF: dict[str, set[str]] = {
    "dense": {"A", *CONSTRAINTS},
    "csr": _list_matrix_entries("A", "shape") | CONSTRAINTS,
    "rows": {*ROWS, "compliance", *CONSTRAINTS},
    "generalized": _list_matrix_entries("general_jac")
    | _list_matrix_entries("general_mass")
    | {"general_v_free", "compliance", *ENGINE_ENTRIES, *CONSTRAINTS},
    "program": {*PROGRAM_ENTRIES, "compliance"},
}


@dataclass(frozen=True, eq=False)
class Stored:
    """A problem from a file, with the stored solution and guesses.

    Parameters
    ----------
    problem : Problem
    format : str
        "lavender", "program", "box", "fclib_local" or "fclib_global", the last two also with the suffix "_rolling".
    impulse : (m,) N s, optional
        Stored solution.
    slack : (m,) m/s, optional
        Stored slack of that solution.
    compare : str
        Unique quantities of the solution, if the file names them: "l,w", "r,u", "w", "u", "error", "no solution".
    guesses : tuple of (m,) N s
    gap : (k,) m, optional
        Distance of the surfaces of each contact, negative in penetration; nan of other blocks.
    info : mapping of str to str
        Texts of the file: title, description, ...
    """

    problem: Problem
    format: str
    impulse: FloatArray | None = None
    slack: FloatArray | None = None
    compare: str = ""
    guesses: tuple[FloatArray, ...] = ()
    gap: FloatArray | None = None
    info: Mapping[str, str] = field(default_factory=dict)


def read_npz(path: str | os.PathLike[str]) -> Stored:
    """Read a problem from an .npz archive of any layout that `docs/formats.md` lists."""
    archive = read_arrays(path)
    try:
        if "lavender_format" in archive:
            return _read_own_format(archive)
        if {"b", "lo", "hi"} <= set(archive):  # w = A l - b, lo <= l <= hi complementary to w.
            b = as_array("entry 'b'", archive["b"], (None,))
            cones = _build_box_cones(archive, len(b))
            problem = Problem(b, cones, _read_matrix(archive), name=Path(path).stem)
            compare = archive["compare"].ravel().tolist() if "compare" in archive else [""]
            if len(compare) != 1:
                raise InputError(f"entry 'compare' is {compare!r:.60}; one text is needed")
            impulse, slack = (_read_vector(archive, name, problem) for name in ("l_ref", "w_ref"))
            return Stored(problem, "box", impulse, slack, str(compare[0]))
        if "q" in archive:
            _check_known("entry", archive, PROGRAM_ENTRIES)
            return Stored(_read_program(archive, name=Path(path).stem), "program")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    has = ", ".join(archive) or "nothing"
    raise InputError(
        f"{path} holds the entries {has}; a problem has lavender_format (written by lavender.io.save), or "
        "b, lo, hi and A, or q and P of a quadratic program"
    )


# -- our own format -------------------------------------------------------------------------------


def write_npz(
    problem: Problem, path: str | os.PathLike[str], *, impulse: Any = None, gap: Any = None
) -> None:
    """Write a problem in our own format, optionally with an impulse (m,) [N s] and the gaps (k,) [m] of its blocks.

    `read_npz(path).problem == problem`, bit for bit. If the impulse is an engine's answer, the motion of the engine is
    written, too, so that `residual` judges what moved the bodies.
    """
    check_problem(problem)
    arrays: dict[str, Any] = {"lavender_format": np.int64(FORMAT_VERSION)}
    rows, general, qp, cones = problem.rows, problem.generalized, problem.qp, problem.cones
    if qp is None:
        arrays["b"] = problem.b
        arrays |= {name: getattr(cones, name.removeprefix("cones_")) for name in CONES}
        arrays |= {"cones_rolling": cones.rolling} if cones.has_rolling else {}
    if qp is not None:
        operator = "program"
        for name, x in qp.arrays.items():
            arrays |= _split_matrix(name, sp.csc_array(x)) if issparse(x) else {name: x}
    elif rows is not None:
        operator = "rows"
        arrays |= {name: getattr(rows, name.removeprefix("rows_")) for name in ROWS}
    elif general is not None:
        operator = "generalized"
        for name in ("jac", "mass"):
            arrays |= _split_matrix(f"general_{name}", getattr(general, name), has_shape=False)
        arrays["general_v_free"] = general.v_free
    elif issparse(problem.matrix):
        operator = "csr"
        arrays |= _split_matrix("A", problem.matrix)
    else:
        operator = "dense"
        arrays["A"] = problem.matrix
    stored = {
        "compliance": problem.compliance,
        "guess": problem.guess,
        "key": problem.key,
        "angular": None if problem.angular is None else problem.angular.astype(np.int8),
        "impulse": None if impulse is None else problem.make_start(impulse),
        "gap": None if gap is None else _check_gap("gap", gap, problem),
    }
    arrays |= {name: x for name, x in stored.items() if x is not None}
    names = None if problem.names is None else list(problem.names)
    meta: dict[str, Any] = {"operator": operator, "friction": problem.friction}
    meta |= {"name": problem.name, "names": names}
    if problem.precision != "float64":
        meta["precision"] = problem.precision
    if general is not None and qp is None:
        meta["dof_names"] = general.names
    motion = problem.engine_motion
    if motion is not None:
        if impulse is None or not np.array_equal(arrays["impulse"], motion.impulse):
            arrays["engine_impulse"] = motion.impulse
        meta["moved_by"] = motion.moved_by
        parts = (motion.change, motion.compliance, motion.momentum)
        arrays |= {name: x for name, x in zip(MOTION, parts, strict=True) if x is not None}
    arrays["meta"] = np.frombuffer(json.dumps(meta).encode("ascii"), np.uint8)
    write_arrays(path, arrays)


def _split_matrix(name: str, matrix: Any, has_shape: bool = True) -> dict[str, Any]:
    """Return the entries of a matrix in compressed rows or columns, by default with its shape."""
    shape = {f"{name}_shape": np.array(matrix.shape, np.int64)} if has_shape else {}
    return {f"{name}_{part}": getattr(matrix, part) for part in COMPRESSED} | shape


def _read_own_format(archive: Arrays) -> Stored:
    """Read a problem in our own format."""
    version = archive["lavender_format"].ravel().tolist()
    if version != [FORMAT_VERSION] or isinstance(version[0], bool):
        raise InputError(
            f"lavender_format is {version!r:.60}; this lavender reads {FORMAT_VERSION}: update it"
        )
    meta = _read_meta(archive)
    operator = meta["operator"]
    _check_known("entry", archive, ENTRIES_OF[operator] | ENTRIES)
    more = {"dof_names", "moved_by"} if operator == "generalized" else set()
    _check_known("key of the entry 'meta':", meta, META_KEYS | more)
    if "moved_by" not in meta and (engine := [x for x in ENGINE_ENTRIES if x in archive]):
        raise InputError(f"entry {engine[0]!r} needs the key 'moved_by' in the entry 'meta'")
    for name in archive:
        if name.startswith(USER):
            continue
        if archive[name].dtype.kind not in "iuf":
            raise InputError(f"entry {name!r} has dtype {archive[name].dtype}; numbers are needed")
    parts: dict[str, Any] = {
        name: archive[name] for name in ("guess", "key", "angular") if name in archive
    }
    parts |= {
        name: meta[name] for name in ("friction", "names", "name", "precision") if name in meta
    }
    if meta["operator"] in ("rows", "generalized") or (
        meta["operator"] == "program" and "compliance" in archive
    ):
        parts["compliance"] = archive["compliance"]
    if meta["operator"] == "program":
        problem = _read_program(archive, **parts)
        return Stored(problem, "lavender", impulse=_read_vector(archive, "impulse", problem))
    b, ptr = archive["b"], archive["cones_ptr"]
    # Check the number of rows before bounds of that length are allocated.
    if b.ndim != 1 or ptr.ndim != 1 or len(ptr) == 0 or ptr[-1] != len(b):
        raise InputError(f"b has shape {b.shape}; cones.ptr must end with the number of its rows")
    if meta["operator"] == "rows":
        fields_of_rows: dict[str, Any] = {
            name.removeprefix("rows_"): archive[name] for name in ROWS
        }
        parts["rows"] = Rows(**fields_of_rows)
    elif meta["operator"] == "generalized":
        v_free = archive["general_v_free"]
        sizes = (("general_jac", b.size), ("general_mass", v_free.size))
        jac, mass = (_read_compressed(archive, name, rows, v_free.size) for name, rows in sizes)
        parts["generalized"] = Generalized(jac, mass, v_free, meta.get("dof_names"))
    else:
        parts["matrix"] = _read_matrix(archive)
    entries = [*CONES, *(["cones_rolling"] if "cones_rolling" in archive else [])]
    cones = Cones(**{name.removeprefix("cones_"): archive[name] for name in entries})
    problem = Problem(b, cones, **parts)
    impulse = _read_vector(archive, "impulse", problem)
    if "moved_by" in meta:
        moved = _read_vector(archive, "engine_impulse", problem)
        moved = impulse if moved is None else moved
        moved_by = meta["moved_by"]
        general = problem.generalized
        if general is None or moved is None or moved_by not in MOVERS:
            raise InputError(
                f"entry 'meta': moved_by is {moved_by!r:.60}; {' or '.join(MOVERS)} is needed, in generalised "
                "coordinates and with the entry impulse"
            )
        change, compliance, *momentum = (
            as_array(f"entry {name!r}", archive[name], (n,), finite=False)
            for name, n in zip(MOTION, (general.nv, problem.m, general.nv), strict=True)
            if name in archive or name in MOTION[:2]
        )
        answer = EngineMotion(moved, change, compliance, moved_by, *momentum)
        problem._set_record(EngineRecord(answer))
    gap = _check_gap("entry 'gap'", archive["gap"], problem) if "gap" in archive else None
    return Stored(problem, "lavender", impulse=impulse, gap=gap)


def _check_gap(name: str, gap: Any, problem: Problem) -> FloatArray:
    return as_array(name, gap, (problem.n_blocks,), finite=False, unit="m")


def _check_known(kind: str, given: Iterable[str], known: set[str]) -> None:
    """Raise InputError for a name that is not known and not the user's own."""
    for name in given:
        if name in known or name.startswith(USER):
            continue
        import difflib  # Imported here, as it is needed only for this message.

        near = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(sorted(known))}."
        raise InputError(
            f"the {kind} {name!r} is unknown: {hint} Your own data go into entries below {USER!r}, or into the key "
            "'user' of the entry 'meta'"
        )


def _read_meta(archive: Arrays) -> dict[str, Any]:
    """Read and check the entry 'meta', a JSON object."""
    try:
        meta = json.loads(archive["meta"].astype(np.uint8, casting="safe").tobytes())
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"entry 'meta' cannot be read as JSON ({error}); JSON text in bytes is needed, as "
            "lavender.io.save writes it: save the problem again"
        ) from None
    needed = ("operator", "friction", "name", "names")
    if missing := [name for name in needed if not isinstance(meta, dict) or name not in meta]:
        raise InputError(
            f"entry 'meta' has no {', '.join(missing)}; a JSON object with them is needed"
        )
    if meta["operator"] not in FORMS:
        raise InputError(
            f"entry 'meta' has operator {meta['operator']!r}; {', '.join(FORMS)} are known"
        )
    return meta


# -- quadratic programs ------------------------------------------------------------------------


def _read_program(archive: Arrays, **more: Any) -> Problem:
    """Build a quadratic program from P, q, G, h, A, b, lb and ub; matrices are dense or in compressed columns."""
    arrays: dict[str, Any] = {name: archive[name] for name in PROGRAM if name in archive}
    n = archive["q"].size
    for name, side in (("P", "q"), ("G", "h"), ("A", "b")):
        if f"{name}_shape" in archive:
            m = archive[side].size
            shape = tuple(archive[f"{name}_shape"].ravel().tolist())
            if shape != (m, n):
                raise InputError(
                    f"{name}_shape is {shape}; ({m}, {n}) is needed, as {side} has {m} entries"
                )
            arrays[name] = _read_compressed(archive, name, n, m).T
    arrays.setdefault("P", sp.csr_array((n, n)))
    return Problem.from_qp(**arrays, **more)


# -- plain box format --------------------------------------------------------------------------


def _build_box_cones(archive: Arrays, m: int) -> Cones:
    """Build the cones of the box format from bounds and, if given, contacts of 1 to 3 rows."""
    lower, upper = (
        as_array(f"entry {name!r}", archive[name], (m,), finite=False) for name in ("lo", "hi")
    )
    if "cone_start" not in archive or archive["cone_start"].size == 0:
        return Cones.bounded(lower, upper)
    count = archive["cone_start"].size
    start, size, mu = (
        as_array(f"entry {name!r}", archive[name], (count,), dtype=dtype)
        for name, dtype in (
            ("cone_start", np.int32),
            ("cone_dim", np.int32),
            ("cone_mu", np.float64),
        )
    )
    order = np.argsort(start)
    start, size, mu = start[order], size[order], mu[order]
    end = start.astype(np.int64) + size
    if (
        size.min() < 1
        or size.max() > 3
        or start.min() < 0
        or end.max() > m
        or np.any(end[:-1] > start[1:])
    ):
        raise InputError(
            f"cones have sizes {size.min()} to {size.max()}, from row {start.min()} to {end.max() - 1}; cone_start "
            f"and cone_dim of cones of 1 to 3 rows that do not overlap, within rows 0 to {m - 1}, are needed"
        )
    # All rows but the later ones of cones are the first of a block.
    later = [np.arange(s + 1, e) for s, e in zip(start, end, strict=True)]
    first = np.setdiff1d(np.arange(m), np.concatenate(later))
    contact = np.zeros(len(first), bool)
    friction = np.zeros(len(first))
    at = np.searchsorted(first, start)
    contact[at] = True
    friction[at] = mu
    return Cones(
        ptr=np.append(first, m),
        kind=get_block_kinds(contact),
        lower=lower,
        upper=upper,
        mu=friction,
        patch_radius=np.zeros(len(first)),
    )


def _read_vector(archive: Arrays, name: str, problem: Problem) -> FloatArray | None:
    return problem.make_start(archive[name], f"entry {name!r}") if name in archive else None


def _read_matrix(archive: Arrays) -> Any:
    """Return the matrix A of an archive: the dense entry `A`, or a CSR matrix from entries with checked indices."""
    if "A" in archive:
        return archive["A"]
    m = archive["b"].size
    shape = tuple(archive["A_shape"].ravel().tolist())
    if shape != (m, m):
        raise InputError(f"A_shape is {shape}; ({m}, {m}) is needed, as b has {m} rows")
    return _read_compressed(archive, "A", m, m)


def _read_compressed(archive: Arrays, name: str, m: int, n: int) -> sp.csr_array:
    """Build a matrix (m, n) from the entries of its compressed rows, with checked indices."""
    data, indices, indptr = (archive[f"{name}_{part}"] for part in COMPRESSED)
    return build_checked_csr(indptr, indices, data, m, n)


def build_checked_csr(
    indptr: np.ndarray, indices: np.ndarray, data: np.ndarray, m: int, n: int
) -> sp.csr_array:
    """Build a CSR matrix (m, n) from arrays of a file, with checked indices; arrays may be longer than needed."""
    for name, x, kinds in (
        ("pointers", indptr, "iu"),
        ("indices", indices, "iu"),
        ("values", data, "buif"),
    ):
        if x.ndim != 1 or x.dtype.kind not in kinds:
            raise InputError(
                f"the {name} of a compressed matrix have dtype {x.dtype} and shape {x.shape}; "
                f"one dimension of {'whole ' if kinds == 'iu' else ''}numbers is needed"
            )
    used = int(indptr[-1]) if len(indptr) else 0
    try:
        if np.any(
            indptr[1:] < indptr[:-1]
        ):  # SciPy does not test this if the matrix has no entries.
            raise ValueError("pointers decrease")
        matrix = sp.csr_array((data[:used].astype(float), indices[:used], indptr), shape=(m, n))
        matrix.check_format(full_check=True)
    except ValueError as error:
        raise InputError(
            f"pointers, indices, values of a compressed ({m}, {n}) do not fit: {error}"
        ) from None
    return matrix
