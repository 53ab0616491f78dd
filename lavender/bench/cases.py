"""From what a user names (files, folders, cases of the suite) to problems with a description."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lavender.bench.record import CaseInfo
from lavender.cones import ROW
from lavender.errors import InputError
from lavender.problem import Problem
from lavender.suite import Case

__all__ = ["SUFFIXES", "Item", "describe", "resolve", "structure_of"]

SUFFIXES = (".npz", ".hdf5", ".h5")
RANK_ROWS = 300  # rows up to which the rank of A is computed, a fraction of a second
MANIFOLD = 8  # blocks between one pair of bodies, at most
LARGE_RATIO = 1e3  # mass ratio from which the velocity form changes everything


@dataclass(eq=False)
class Item:
    """One case to run: a problem that is loaded when it is first looked at."""

    name: str
    source: str  # path, or the name in the suite
    load: Callable[[], Problem]
    reason: str = ""
    sequence: str = ""
    step: int = -1
    given: Problem | None = None  # in memory, not behind a name

    @cached_property
    def problem(self) -> Problem:
        """The problem; loading errors come from here."""
        return self.load()

    def forget(self) -> None:
        """Let go of the problem's memory."""
        self.__dict__.pop("problem", None)


Source = str | Path | Problem | Case | Item


def resolve(words: Iterable[Source]) -> list[Item]:
    """Cases behind files, folders (their problem files), names or cases of the suite, problems; all of it if none.

    Nothing is loaded yet, but every word is checked to exist.

    Raises
    ------
    InputError
        Neither a file nor a case of the suite; a folder without problem files.
    UnknownName
        A case that the suite does not have.
    """
    items: list[Item] = []
    words = list(words)
    if not words:
        from lavender import suite

        items = [_from_case(case, case.name) for case in suite.default()]
    for word in words:
        if isinstance(word, Problem):
            name = word.name or f"problem {len(items)}"
            items.append(Item(name, name, _constant(word), given=word))
        elif isinstance(word, Item):
            items.append(word)
        elif isinstance(word, Case):
            items.append(_from_case(word, word.name))
        elif Path(word).is_dir():
            paths = sorted(p for p in Path(word).iterdir() if p.suffix.lower() in SUFFIXES)
            if not paths:
                raise InputError(f"{word} holds no problem file ({', '.join(SUFFIXES)})")
            items += [_from_file(path) for path in paths]
        elif Path(word).exists():
            items.append(_from_file(Path(word)))
        elif Path(word).suffix.lower() in SUFFIXES or "/" in str(word):
            raise InputError(
                f"{word}: no such file; give problem files ({', '.join(SUFFIXES)}), folders or suite names"
            )
        else:
            from lavender import suite

            items += [_from_case(case, case.name) for case in suite.cases(str(word))]
    return _unique_names(items)


def _constant(problem: Problem) -> Callable[[], Problem]:
    return lambda: problem


def _from_case(case: Case, source: str) -> Item:
    return Item(case.name, source, _constant(case.problem), case.reason)


def _from_file(path: Path) -> Item:
    def load() -> Problem:
        from lavender import io

        return io.load(path)

    return Item(path.stem, str(path), load)


def _unique_names(items: list[Item]) -> list[Item]:
    seen: dict[str, int] = {}
    for item in items:
        n = seen[item.name] = seen.get(item.name, 0) + 1
        if n > 1:
            item.name = f"{item.name} #{n}"
    return items


def describe(item: Item, run: str) -> CaseInfo:
    """What the report says of a case; loads its problem."""
    p = item.problem
    contacts = int(np.count_nonzero(p.cones.kind != ROW))
    return CaseInfo(
        run=run,
        case=item.name,
        source=item.source,
        sha=fingerprint(p),
        law=p.law,
        rows=p.m,
        blocks=p.n_blocks,
        contacts=contacts,
        bodies=p.rows.n_bodies if p.rows is not None else 0,
        nonzeros=int(p.jacobian.nnz if p.rows is not None else p.csr.nnz),
        mass_ratio=mass_ratio(p),
        structure=structure_of(p),
        symmetric=p.is_symmetric,
        reason=item.reason,
        sequence=item.sequence,
        step=item.step,
    )


def fingerprint(problem: Problem) -> str:
    """Hash of the numbers of a problem."""
    digest = hashlib.sha256(problem.friction.encode())
    c, r = problem.cones, problem.rows
    arrays: list[Any] = [problem.b, problem.guess, c.ptr, c.kind, c.lower, c.upper, c.mu, c.patch_radius]
    if r is None:
        arrays += [problem.csr.indptr, problem.csr.indices, problem.csr.data]
    else:
        arrays += [r.jac, r.joint_body, r.normal, r.tangent, r.arm_a, r.arm_b, r.contact_body, r.inv_mass]
        arrays += [r.inv_inertia, problem.compliance]
    for x in arrays:
        digest.update(b"-" if x is None else np.ascontiguousarray(x).tobytes() + b"|")
    return digest.hexdigest()[:16]


def mass_ratio(problem: Problem) -> float:
    """Heaviest over lightest: moving bodies where there are rows, else the diagonal of A on rows and normals."""
    if problem.rows is not None:
        x = problem.rows.inv_mass
    else:
        c = problem.cones
        rows = np.flatnonzero(np.repeat(c.kind == ROW, np.diff(c.ptr)))
        x = problem.d[np.concatenate([rows, c.ptr[:-1][c.kind != ROW]])]
    x = x[x > 0.0]
    return float(x.max() / x.min()) if len(x) else 1.0


def structure_of(problem: Problem) -> tuple[str, ...]:
    """Words that decide which solver suits: chain, stack, pile, redundant, friction, large mass ratio, asymmetric.

    From the graph of blocks (an entry of A couples them), those of one pair of bodies taken together
    (they couple to the same blocks): at most two neighbours on average is a chain (bilateral) or a stack
    (contacts), more is a mesh of joints or a pile. Redundant: fewer independent rows than rows, where the
    rank is cheap to know or the counts alone prove it.
    """
    if problem.m == 0:
        return ("empty",)
    found = []
    line = _neighbours(problem) <= 2.0
    if problem.law == "linear":
        found.append("chain" if line else "mesh")
    else:
        found.append("stack" if line else "pile")
    if _redundant(problem):
        found.append("redundant")
    if problem.law in ("coulomb", "cone"):
        found.append("friction")
    if mass_ratio(problem) >= LARGE_RATIO:
        found.append("large mass ratio")
    if not problem.is_symmetric:
        found.append("asymmetric")
    return tuple(found)


def _neighbours(problem: Problem) -> float:
    # Mean number of neighbours of a group of blocks.
    import scipy.sparse as sp

    c = problem.cones
    block = np.repeat(np.arange(c.n_blocks), np.diff(c.ptr))
    if problem.rows is not None:
        r = problem.rows
        body = np.concatenate([r.joint_body, r.contact_body])
        body = np.sort(body[(body >= 0).any(axis=1)], axis=1)
        pairs = np.unique(body, axis=0)
        inner = pairs[pairs[:, 0] >= 0]
        bodies = np.unique(pairs[pairs >= 0])
        return 2.0 * len(inner) / max(1, len(bodies))
    a = problem.csr.tocoo()
    i, j = block[a.coords[0]], block[a.coords[1]]
    graph = sp.csr_array((np.ones(len(i)), (i, j)), shape=(c.n_blocks, c.n_blocks))
    graph = sp.csr_array(graph + graph.T + sp.eye_array(c.n_blocks))
    graph.sort_indices()
    patterns = [graph.indices[graph.indptr[k] : graph.indptr[k + 1]].tobytes() for k in range(c.n_blocks)]
    count = Counter(patterns)
    groups: dict[bytes | int, int] = {}
    # More twins than points between two bodies: a dense matrix, not a manifold.
    keys = [p if count[p] <= MANIFOLD else k for k, p in enumerate(patterns)]
    label = np.array([groups.setdefault(key, len(groups)) for key in keys])
    g = graph.tocoo()
    edges = np.unique(np.stack([label[g.coords[0]], label[g.coords[1]]]), axis=1)
    return float(np.count_nonzero(edges[0] != edges[1])) / max(1, len(groups))


def _redundant(problem: Problem) -> bool:
    if problem.rows is not None and problem.m > 6 * problem.rows.n_bodies:
        return True
    if problem.m > RANK_ROWS:
        return False
    scale = 1.0 / np.sqrt(problem.d)
    a = problem.dense() * scale[:, None] * scale[None, :]
    values = np.linalg.svd(a, compute_uv=False)
    return bool(
        values[-1] <= 1e-12 * max(values[0], 1e-300)
    )  # far below any condition number met in practice
