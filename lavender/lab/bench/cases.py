"""From what a user names (files, folders, cases of the suite) to problems with a description."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lavender import io
from lavender.base.arrays import FloatArray, check_bool, check_int, check_sequence
from lavender.base.errors import InputError, SolverUnavailable
from lavender.io.stored import ENGINE, SUFFIXES, read_whole_file
from lavender.judge.residuals import DEFAULT_THRESHOLD, Residual, is_solved_by_zero, residual
from lavender.lab import suite
from lavender.lab.bench.record import CaseInfo, file_name, printable
from lavender.lab.diagnostics import diagnose
from lavender.lab.suite import Case
from lavender.lab.suite.case import FAMILIES, parse
from lavender.problem import Problem, check_problem
from lavender.problem.derived import cached_property

RANK_ROWS = 300  # rows up to which the rank of A is computed, a fraction of a second
SINGULAR = 1e-12  # of the largest singular value: far below any condition number met in practice
MANIFOLD = 8  # blocks between one pair of bodies, at most
LARGE_RATIO = 1e3  # mass ratio from which the velocity form changes everything
ASYMMETRY = 0.1  # of A, relative: recorded contact problems stay below a hundredth
MAX_SEEDS = 1_000_000  # of a family in one run: the name and place of each case take a kilobyte
SOLVED = 1e-6  # relative residual at which `lv.solve` ends by default


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
    stored: Callable[[], FloatArray | None] = lambda: None  # (m,) N s, the answer beside the problem
    # asked for by name, not met in a folder: that it does not load is the request's fault
    named: bool = False

    def __post_init__(self) -> None:
        self.name, self.sequence = printable(self.name), printable(self.sequence)

    @cached_property
    def problem(self) -> Problem:
        """The problem; loading errors come from here."""
        return self.load()

    def judged(self, precision: str | None = None, threshold: float = DEFAULT_THRESHOLD) -> Residual | None:
        """The answer stored beside the problem, judged; None where there is none, or one of another problem."""
        impulse = self.stored()
        if impulse is None or impulse.shape != (self.problem.m,):
            return None
        return residual(self.problem, impulse, precision, threshold)

    def forget(self) -> None:
        """Let go of the problem's memory."""
        self.__dict__.pop("problem", None)


def is_path(word: Source) -> bool:
    """A file or folder is meant, be it there or not; else a case of the suite."""
    if isinstance(word, Path):
        return True
    return isinstance(word, str) and (
        "/" in word or os.sep in word or Path(word).suffix.lower() in SUFFIXES or Path(word).exists()
    )


Source = str | Path | Problem | Case | Item


def resolve(words: Source | Iterable[Source], sequences: bool | None = None) -> list[Item]:
    """Cases behind files, folders (their files, those of folders in them), names or cases of the suite: all if none.

    Nothing is solved, and as a rule nothing loaded yet, but every word is checked to exist.

    Parameters
    ----------
    words : files, folders, names or cases of the suite, problems; or one of them
    sequences : bool, optional
        Folders hold the steps of a simulation. If None, those do whose files differ in a number alone and
        name their blocks (`Problem.key`), as recorded steps do.

    Raises
    ------
    InputError
        Neither a file nor a case of the suite; a folder without problem files.
    UnknownName
        A case that the suite does not have.
    """
    if sequences is not None:
        check_bool("sequences", sequences)
    items: list[Item] = []
    read: set[Path] = set()  # folders, which a link in one of them may lead back to
    words = (
        [words]
        if isinstance(words, Source)
        else check_sequence("cases", words, "files, folders, names or problems")
    )
    if not words:
        items = [_from_case(case, case.name) for case in suite.default()]
    for word in words:
        if isinstance(word, Problem):
            name = word.name or f"problem {len(items)}"
            items.append(Item(name, name, _constant(word), given=word))
        elif isinstance(word, Item):
            items.append(word)
        elif isinstance(word, Case):
            items.append(_from_case(word, word.name))
        elif not (isinstance(word, str) or hasattr(word, "__fspath__")):
            raise InputError(f"case {word!r:.60} is neither a file nor a name of the suite, nor a problem")
        elif sequences or (sequences is None and _holds_steps(Path(word))):
            steps = _another(steps_in(word), items)
            name, lost = steps[0].sequence, map(_from_file, _left_out(Path(word)))
            items += [*steps, *(replace(item, name=f"{name}, {item.name}", sequence=name) for item in lost)]
        elif Path(word).is_dir():
            paths = _problem_files(Path(word))
            read.add(Path(word).resolve())
            inner = [
                p
                for p in sorted(Path(word).iterdir())
                if p.is_dir() and p.resolve() not in read and os.access(p, os.R_OK) and _problem_files(p)
            ]
            words += inner
            if not paths and not inner:
                kept = Path(word) / "records.jsonl"
                shown = f": {kept} shows its report again" if kept.is_file() else ""
                raise InputError(f"{word} holds no problem file ({', '.join(SUFFIXES)}){shown}")
            items += [_from_file(path) for path in (*paths, *_left_out(Path(word)))]
        elif Path(word).exists() or Path(word) in _left_out(Path(word).parent):
            items.append(replace(_from_file(Path(word)), named=True))
        elif is_path(word):
            raise InputError(
                f"{word}: no such file; give problem files ({', '.join(SUFFIXES)}), folders or suite names"
            )
        else:
            chosen = [_from_name(name) for name in suite.names(str(word))]
            items += _as_steps(chosen) if str(word).removeprefix("@") == "sequences" else chosen
    return _unique_names(items)


def resolve_again(source: str | Problem, name: str, reason: str) -> Item:
    """Resolve the source of one item in another process. An error is raised when the problem is loaded."""
    try:
        (item,) = resolve([source])
    except Exception as error:  # the file is gone, or reading its folder raises
        item = Item(name, str(source), _raising(error))
    return replace(item, name=name, reason=reason, sequence="", step=-1)


def expand_seeds(words: Iterable[str], n: int, first: int = 0) -> list[str]:
    """Return each case with seed=first .. first + n - 1 if its family takes a seed; other names, sets and files once.

    Raises
    ------
    UnknownName, InputError
        A name that the suite does not have; more than `MAX_SEEDS` seeds.
    """
    n, first = check_int("n", n, high=None), check_int("first", first, high=None)
    if n > MAX_SEEDS:
        raise InputError(
            f"{n} seeds are asked for; at most {MAX_SEEDS} in one run: give A:B, part after part"
        )
    out = []
    for word in check_sequence("cases", words, "names"):
        if not isinstance(word, str):
            raise InputError(f"case {word!r:.60} is no name of the suite")
        if is_path(word) or word.startswith("@"):
            out.append(word)
            continue
        name, given = parse(word)
        if name in FAMILIES and "seed" in FAMILIES[name].signature.parameters and "seed" not in given:
            for seed in range(first, first + n):
                inside = ", ".join(f"{k}={v}" for k, v in {**given, "seed": seed}.items())
                out.append(f"{name}({inside})")
        else:
            out.append(word)
    return out


def sequence(problems: Iterable[Problem], name: str) -> list[Item]:
    """Consecutive problems as the steps of one sequence."""
    if not isinstance(name, str):
        raise InputError(f"name of a sequence is {name!r:.60}; a text is needed")
    items = []
    for i, problem in enumerate(check_sequence("problems", problems, "Problems")):
        check_problem(problem)
        items.append(Item(f"{name}[{i}]", name, _constant(problem), sequence=name, step=i, given=problem))
    return items


def steps_in(folder: str | Path) -> list[Item]:
    """Problem files of a folder as the steps of one sequence, numbers in their names in numeric order.

    Raises
    ------
    InputError
        Not a folder, or fewer than two problem files in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"{folder} is not a folder; a sequence is a folder of problem files, one for each step"
        )
    paths = _problem_files(folder)
    if len(paths) < 2:
        raise InputError(
            f"{folder} holds {len(paths)} problem files ({', '.join(SUFFIXES)}); a sequence needs two"
        )
    _check_one_recording(folder, paths)
    name = folder.resolve().name
    return [
        replace(_from_file(path), name=f"{name}[{i}]", sequence=name, step=i) for i, path in enumerate(paths)
    ]


def _check_one_recording(folder: Path, paths: list[Path]) -> None:
    # Two files of one number, two rows of numbers, or files that the engine's own list does not name.
    numbered = [(m[1], int(m[2])) for p in paths if (m := re.fullmatch(r"(.*?)(\d+)", p.stem))]
    series = [prefix for prefix, n in Counter(prefix for prefix, _ in numbered).items() if n > 1]
    twice = len(numbered) > len(set(numbered))
    listed = {str(line["file"]) for line in _told(folder)}
    strange = [p.name for p in paths if listed and p.name not in listed]
    if twice or len(series) > 1 or strange:
        why = (
            f"{strange[0]} is not in its {ENGINE}"
            if strange
            else "two files have one number"
            if twice
            else f"files are named {series[0]}N and {series[1]}N"
        )
        raise InputError(
            f"{folder} holds steps of more than one recording ({why}): move each into a folder of its own"
        )


def _told(folder: Path) -> list[dict[str, Any]]:
    """What an engine said of the steps in a folder, each with its "file"; nothing if a line of it cannot be read."""
    try:
        text = read_whole_file(folder / ENGINE, "the engine's answers").decode(errors="replace")
        lines = [dict(json.loads(line)) for line in text.splitlines()]
        return lines if all("file" in line for line in lines) else []
    except (ValueError, TypeError, RecursionError):
        return []


def _left_out(folder: Path) -> dict[Path, str]:
    """Files that a recording should have made and could not, with the reason of each."""
    found = {folder / Path(str(t["file"])).name: str(t["left_out"]) for t in _told(folder) if "left_out" in t}
    return {path: why for path, why in found.items() if not path.exists()}


def _problem_files(folder: Path) -> list[Path]:
    try:
        return sorted((p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES), key=_natural)
    except OSError as error:
        raise InputError(f"cannot read the folder {folder} ({error.strerror or error})") from None


def _natural(path: Path) -> list[tuple[int, int | str]]:
    # Numbers by size; what merely looks like one, such as a superscript, is a letter.
    parts = re.split(r"([0-9]{1,18})", path.name)
    return [(0, int(t)) if i % 2 else (1, t) for i, t in enumerate(parts) if t]


def _holds_steps(folder: Path) -> bool:
    paths = _problem_files(folder) if folder.is_dir() else []
    if len(paths) < 2 or len({re.sub(r"\d+$", "", p.stem) for p in paths}) > 1:
        return False
    try:
        return _from_file(paths[0]).problem.key is not None
    except Exception:  # whatever it raises, it is told where the case is run
        return False


def _another(steps: list[Item], items: list[Item]) -> list[Item]:
    # Two folders of one name are two sequences, told apart by the folder around them where that is another. Figures
    # are named after them: names are other ones as names of files, too.
    names = {file_name(item.sequence).lower() for item in items if item.sequence}
    name, n = steps[0].sequence, 1
    if file_name(name).lower() in names:
        around = f"{Path(steps[0].source).resolve().parent.parent.name}/{name}"
        name = name if file_name(around).lower() in names else around
    while file_name(unique := f"{name} #{n}" if n > 1 else name).lower() in names:
        n += 1
    return [replace(item, name=f"{unique}[{item.step}]", sequence=unique) for item in steps]


def _constant(problem: Problem) -> Callable[[], Problem]:
    return lambda: problem


def _from_case(case: Case, source: str) -> Item:
    return Item(case.name, source, _constant(case.problem), case.reason)


def _from_name(name: str) -> Item:
    """A case of the suite; where it needs a package that is not there, one that does not load."""
    try:
        return _from_case(suite.case(name), name)
    except SolverUnavailable as error:
        return Item(name, name, _raising(error))


def _as_steps(items: list[Item]) -> list[Item]:
    """Cases that differ in `at` alone, one after the other: the steps of sequences."""
    out, count = [], Counter[str]()
    for item in items:
        name = item.name.rpartition(", at=")[0] + ")"
        out.append(replace(item, name=f"{name}[{count[name]}]", sequence=name, step=count[name]))
        count[name] += 1
    return out


def _raising(error: Exception) -> Callable[[], Problem]:
    def load() -> Problem:
        raise error

    return load


def _from_file(path: Path) -> Item:
    def load() -> Problem:
        if path.exists() and not path.is_file():
            # a pipe never ends
            raise InputError(f"{path} is no file; a problem ({', '.join(SUFFIXES)}) is needed")
        if not path.exists() and (why := _left_out(path.parent).get(path)):
            raise InputError(f"{path}: left out of its recording: {why}")
        return io.load(path)

    return Item(path.stem, str(path), load, stored=partial(io.load_solution, path))


def _unique_names(items: list[Item]) -> list[Item]:
    # As files on a system that does not tell capitals, too: figures are named after cases.
    taken: set[str] = set()
    for item in items:
        name, n = item.name, 1
        while file_name(item.name).lower() in taken:
            n += 1
            item.name = f"{name} #{n}"
        taken.add(file_name(item.name).lower())
    return items


def describe(item: Item, run: str) -> CaseInfo:
    """What the report says of a case; loads its problem."""
    p = item.problem
    contacts = int(np.count_nonzero(p.cones.is_contact))
    answer = item.judged()
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
        stored=math.nan if answer is None else answer.relative,
        stored_verdict=answer.verdict_in_words if answer and answer.rounding else "",
        nothing_to_do=is_solved_by_zero(p),
        diagnostics=tuple(map(str, diagnose(p))),
        guess=_guess_of(item),
        condition=condition(p),
    )


def _guess_of(item: Item) -> str:
    """As `CaseInfo.guess`. An answer is the one stored beside the problem, or any at which a solve would end."""
    guess = item.problem.guess
    if guess is None:
        return ""
    stored = item.stored()
    is_stored = stored is not None and np.array_equal(guess, stored)
    return "answer" if is_stored or residual(item.problem, guess).relative <= SOLVED else "start"


def fingerprint(problem: Problem) -> str:
    """Hash of the numbers of a problem and the keys of its blocks; what bodies' v* is to it stands in b."""
    digest = hashlib.sha256(problem.friction.encode())
    c, r, g = problem.cones, problem.rows, problem.generalized
    arrays: list[Any] = [problem.b, problem.guess, c.ptr, c.kind, c.lower, c.upper, c.mu, c.patch_radius]
    arrays += [c.rolling] if c.has_rolling else []
    if r is None:
        for a in (problem.csr,) if g is None else (g.jac, g.mass):
            arrays += [a.indptr, a.indices, a.data]
        arrays += [] if g is None else [g.v_free, problem.compliance]
    else:
        arrays += [r.jac, r.joint_body, r.normal, r.tangent, r.arm_a, r.arm_b, r.contact_body, r.inv_mass]
        arrays += [r.inv_inertia, problem.compliance]
    for x in arrays:
        digest.update(b"-" if x is None else np.ascontiguousarray(x).tobytes() + b"|")
    if problem.precision != "float64":
        digest.update(problem.precision.encode())
    if problem.key is not None:
        digest.update(b"key" + problem.key.tobytes())
    return digest.hexdigest()[:16]


def mass_ratio(problem: Problem) -> float:
    """Heaviest over lightest: moving bodies where there are rows, else the diagonal of A on rows and normals."""
    if problem.rows is not None:
        x = problem.rows.inv_mass
    else:
        c = problem.cones
        rows = np.flatnonzero(~c.contact_rows)
        x = problem.d[np.concatenate([rows, c.normal_rows])]
    x = x[x > 0.0]
    return float(x.max() / x.min()) if len(x) else 1.0


def structure_of(problem: Problem) -> tuple[str, ...]:
    """Words that decide which solver suits, read off the numbers; a problem may have several.

    - The largest part of the graph that hangs together. One moving body (in a matrix: a few blocks that all
      couple with each other, as its contacts do): "separate". At most two neighbours on average: "chain"
      (most couplings are joints) or "stack" (contacts). More: "mesh" of joints or "pile". A matrix that couples
      more than half of all pairs: "dense".
    - "redundant": fewer independent rows than rows, where the rank is cheap to know or the counts alone
      prove it.
    - "friction": the law. "ellipses": contacts of two coefficients. "large mass ratio": from 1000 on.
    - "asymmetric": A is not symmetric. A matrix that is not even nearly so comes from no scene of
      bodies, and gets no word for its shape or masses.
    """
    check_problem(problem)
    if problem.m == 0:
        return ("empty",)
    found = []
    mechanical = problem.asymmetry <= ASYMMETRY
    if mechanical:
        found.append(_shape(problem))
    if _redundant(problem):
        found.append("redundant")
    if problem.law in ("coulomb", "cone"):
        found.append("friction")
    if problem.cones.has_ellipse:
        found.append("ellipses")
    if mechanical and mass_ratio(problem) >= LARGE_RATIO:
        found.append("large mass ratio")
    if not problem.is_symmetric:
        found.append("asymmetric")
    return tuple(found)


def _shape(problem: Problem) -> str:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n, i, j = _coupled_bodies(problem) if problem.rows is not None else _coupled_blocks(problem)
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(n, n))
    part = connected_components(graph, directed=False)[1]
    largest = np.bincount(part).argmax()
    size = np.count_nonzero(part == largest)
    neighbours = 2.0 * np.count_nonzero(part[i] == largest) / size
    bilateral = _is_bilateral(problem)
    if size == 1:
        return "separate"
    if neighbours <= 2.0:
        return "chain" if bilateral else "stack"
    if problem.rows is None and size > MANIFOLD and neighbours > 0.5 * (size - 1):
        return "dense"
    return "mesh" if bilateral else "pile"


def _is_bilateral(problem: Problem) -> bool:
    # Joints couple most of what is coupled; of a matrix, rows without bounds.
    if problem.law == "linear":
        return True
    r, c = problem.rows, problem.cones
    if r is not None:
        joints, contacts = (
            len(np.unique(np.sort(x, axis=1), axis=0)) for x in (r.joint_body, r.contact_body)
        )
        return joints > contacts
    first = c.ptr[:-1][~c.is_contact]
    free = np.count_nonzero(np.isinf(c.lower[first]) & np.isinf(c.upper[first]))
    return bool(2 * free > c.n_blocks)


Edges = tuple[int, NDArray[np.int64], NDArray[np.int64]]  # nodes, and the ends of each edge, once


def _coupled_bodies(problem: Problem) -> Edges:
    # Moving bodies that a joint or a contact connects.
    r = problem.rows
    assert r is not None
    ends = np.concatenate([r.joint_body, r.contact_body])
    pairs = np.unique(np.sort(ends[(ends >= 0).any(axis=1)], axis=1), axis=0)
    bodies, place = np.unique(pairs, return_inverse=True)
    place = place.reshape(pairs.shape)[pairs[:, 0] >= 0]
    # The ground, -1, stands first where there is one; bodies count from it.
    ground = int(len(bodies) > 0 and bodies[0] < 0)
    return max(1, len(bodies) - ground), place[:, 0] - ground, place[:, 1] - ground


def _coupled_blocks(problem: Problem) -> Edges:
    # Blocks that an entry of A couples; those that couple to the same blocks are the points of one manifold.
    import scipy.sparse as sp

    c = problem.cones
    block = np.repeat(np.arange(c.n_blocks), np.diff(c.ptr))
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
    i, j = label[g.coords[0]], label[g.coords[1]]
    edges = np.unique(np.stack([i[i < j], j[i < j]]), axis=1)
    return len(groups), edges[0], edges[1]


def _redundant(problem: Problem) -> bool:
    if problem.rows is not None and problem.m > 6 * problem.rows.n_bodies:
        return True
    values = _singular_values(problem)
    return len(values) > 0 and bool(values[-1] <= SINGULAR * values[0])


def condition(problem: Problem) -> float | None:
    """Of A, scaled to a diagonal of 1, over its range, to two digits; None above RANK_ROWS rows, and of A = 0."""
    values = _singular_values(problem)
    live = values[values > SINGULAR * values.max(initial=0.0)]
    return float(f"{live[0] / live[-1]:.1e}") if len(live) else None


def _singular_values(problem: Problem) -> NDArray[Any]:
    if problem.m > RANK_ROWS:
        return np.zeros(0)
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(problem.d)
        a = problem.dense() * scale[:, None] * scale[None, :]
    return np.linalg.svd(a, compute_uv=False) if np.isfinite(a).all() else np.zeros(0)
