"""Resolve files, folders and names of suite cases to problems, and describe each problem."""

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
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from lavender import io, suite
from lavender.base.arrays import FloatArray, check_bool, check_sequence
from lavender.base.errors import InputError, SolverUnavailable
from lavender.diagnostics import diagnose
from lavender.io.stored import ENGINE, STATES_FOLDER, SUFFIXES, read_whole_file
from lavender.judge.residuals import DEFAULT_THRESHOLD, Residual, is_solved_by_zero, residual
from lavender.problem import Problem, check_problem
from lavender.problem.derived import cached_property
from lavender.report.records import CaseInfo, escape_unprintable, make_file_name
from lavender.report.structure import classify_structure_and_count_islands, compute_mass_ratio
from lavender.suite import Case

# Archives in the folder of an audit that do not hold problems.
AUDIT_RESULTS = ("records.npz", "states.npz")
DEFAULT_SOLVE_TOL = 1e-6  # Relative residual at which `lv.solve` ends by default.


@dataclass(eq=False)
class Item:
    """One case of a run; its problem is loaded at the first access."""

    name: str
    source: str  # Path, or name in the suite.
    load: Callable[[], Problem]
    reason: str = ""  # Property that the case tests.
    sequence: str = ""  # Name of the sequence that contains the case as a step; empty for a single case.
    step: int = -1  # Number of the step; -1 for a single case.
    in_memory: Problem | None = None  # The problem itself, if it was passed as an object.
    # Returns the answer stored with the problem (m,) [N s], or None.
    load_stored: Callable[[], FloatArray | None] = lambda: None
    # Whether the user named this case, and it was not found in a folder. It is an error if it does not load.
    named: bool = False

    def __post_init__(self) -> None:
        self.name, self.sequence = escape_unprintable(self.name), escape_unprintable(self.sequence)

    @cached_property
    def problem(self) -> Problem:
        """The problem; accessing it raises the errors of loading it."""
        return self.load()

    def judge_stored_answer(
        self, precision: str | None = None, threshold: float = DEFAULT_THRESHOLD
    ) -> Residual | None:
        """Judge the answer stored with the problem; return None without one, or if it does not have m entries."""
        impulse = self.load_stored()
        if impulse is None or impulse.shape != (self.problem.m,):
            return None
        return residual(self.problem, impulse, precision, threshold)

    def release_problem(self) -> None:
        """Release the memory of the problem."""
        self.__dict__.pop("problem", None)


def is_path(word: Source) -> bool:
    """Return whether `word` names a file or folder, which need not exist, and not a case of the suite."""
    if isinstance(word, Path):
        return True
    return isinstance(word, str) and (
        "/" in word or os.sep in word or Path(word).suffix.lower() in SUFFIXES or Path(word).exists()
    )


Source = str | Path | Problem | Case | Item


def resolve_sources(sources: Source | Iterable[Source], sequences: bool | None = None) -> list[Item]:
    """Resolve files, folders (and folders in them), names and cases of the suite to items; the default suite if none.

    No problem is solved and usually none is loaded, but every source is checked to exist.

    Parameters
    ----------
    sources : files, folders, names or cases of the suite, problems; or one of them
    sequences : bool, optional
        Folders hold the steps of a simulation. If None, this is assumed for folders with files that differ only in a
        number and name their blocks (`Problem.key`), as recorded steps do.

    Raises
    ------
    InputError
        An entry of `sources` is neither a file nor a case of the suite, or a folder holds no problem files.
    UnknownName
        The suite does not have the case.
    """
    if sequences is not None:
        check_bool("sequences", sequences)
    items: list[Item] = []
    visited: set[Path] = set()  # Folders that were searched: a link may lead back to one of them.
    sources = (
        [sources]
        if isinstance(sources, Source)
        else check_sequence("cases", sources, "files, folders, names or problems")
    )
    if not sources:
        items = [_make_item_of_case(case, case.name) for case in suite.default()]
    for source in sources:
        if isinstance(source, Problem):
            name = source.name or f"problem {len(items)}"
            items.append(Item(name, name, _make_loader(source), in_memory=source))
        elif isinstance(source, Item):
            items.append(source)
        elif isinstance(source, Case):
            items.append(_make_item_of_case(source, source.name))
        elif not (isinstance(source, str) or hasattr(source, "__fspath__")):
            raise InputError(
                f"case {source!r:.60} is a {type(source).__name__}; the path of a file, a name of the suite "
                "or a Problem is needed"
            )
        elif sequences or (sequences is None and _holds_recorded_steps(Path(source))):
            for _, group in groupby(list_steps_in_folder(source), key=lambda item: item.sequence):
                steps = list(group)
                items += _rename_duplicate_sequence(steps, items) if steps[0].sequence else steps
            name, folder_name = items[-1].sequence, Path(source).resolve().name
            missing = map(_make_item_of_file, _read_unrecorded_steps(Path(source)))
            items += [
                replace(item, name=f"{name or folder_name}, {item.name}", sequence=name) for item in missing
            ]
        elif Path(source).is_dir():
            paths = _list_problem_files(Path(source))
            visited.add(Path(source).resolve())
            inner = [
                p
                for p in sorted(Path(source).iterdir())
                if p.is_dir()
                and p.resolve() not in visited
                and os.access(p, os.R_OK)
                and not _is_states_folder(p)
                and _list_problem_files(p)
            ]
            sources += inner
            if not paths and not inner:
                records = Path(source) / "records.jsonl"
                shown = f": {records} shows its report again" if records.is_file() else ""
                raise InputError(f"{source} holds no problem file ({', '.join(SUFFIXES)}){shown}")
            items += [_make_item_of_file(path) for path in (*paths, *_read_unrecorded_steps(Path(source)))]
        elif Path(source).exists() or Path(source) in _read_unrecorded_steps(Path(source).parent):
            items.append(replace(_make_item_of_file(Path(source)), named=True))
        elif is_path(source):
            raise InputError(
                f"{source}: no such file; give problem files ({', '.join(SUFFIXES)}), folders or suite names"
            )
        else:
            selected = [_make_item_of_name(name) for name in suite.get_case_names_of_set(str(source))]
            items += (
                _convert_to_sequence_steps(selected)
                if str(source).removeprefix("@") == "sequences"
                else selected
            )
    return _make_names_differ(items)


def resolve_item(source: str | Problem, name: str, reason: str) -> Item:
    """Create the item of a source in a worker process; an invalid source raises an error when it is loaded."""
    try:
        (item,) = resolve_sources([source])
    except Exception as error:  # The file was removed, or reading its folder raises an error.
        item = Item(name, str(source), _raise_when_loaded(error))
    return replace(item, name=name, reason=reason, sequence="", step=-1)


def make_sequence(problems: Iterable[Problem], name: str) -> list[Item]:
    """Return consecutive problems as the steps of one sequence."""
    if not isinstance(name, str):
        raise InputError(f"the name of a sequence is {name!r:.60}; a string is needed")
    items = []
    for i, problem in enumerate(check_sequence("problems", problems, "Problems")):
        check_problem(problem)
        items.append(
            Item(f"{name}[{i}]", name, _make_loader(problem), sequence=name, step=i, in_memory=problem)
        )
    return items


def list_steps_in_folder(folder: str | Path) -> list[Item]:
    """Return the problem files of a folder as the steps of a sequence, in the numeric order of their names.

    Steps that were recorded from different start states are different sequences; a single step of a state is a case.

    Raises
    ------
    InputError
        `folder` is not a folder, or it holds fewer than two problem files.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"{folder} is not a folder; a sequence is a folder of problem files, one for each step"
        )
    paths = _list_problem_files(folder)
    if len(paths) < 2:
        raise InputError(
            f"{folder} holds {len(paths)} problem files ({', '.join(SUFFIXES)}); a sequence needs two"
        )
    _check_one_recording(folder, paths)
    name = folder.resolve().name
    starts = {str(line["file"]): line.get("start") for line in _read_engine_records(folder)}
    groups: dict[str, list[Path]] = {}
    for path in paths:
        start = starts.get(path.name)
        groups.setdefault(name if start is None else f"{name}, state {start}", []).append(path)
    return [
        replace(_make_item_of_file(path), name=f"{group}[{i}]", sequence=group, step=i)
        if len(members) > 1
        else replace(_make_item_of_file(path), name=group)
        for group, members in groups.items()
        for i, path in enumerate(members)
    ]


def _check_one_recording(folder: Path, paths: list[Path]) -> None:
    """Raise InputError if a folder holds steps of several recordings.

    It does if two files have the same number, if file names have different prefixes, or if the list of steps that the
    engine wrote to the folder does not contain a file.
    """
    numbered = [(m[1], int(m[2])) for p in paths if (m := re.fullmatch(r"(.*?)(\d+)", p.stem))]
    series = [prefix for prefix, n in Counter(prefix for prefix, _ in numbered).items() if n > 1]
    twice = len(numbered) > len(set(numbered))
    listed = {str(line["file"]) for line in _read_engine_records(folder)}
    unlisted = [p.name for p in paths if listed and p.name not in listed]
    if twice or len(series) > 1 or unlisted:
        reason = (
            f"{unlisted[0]} is not listed in its {ENGINE}, or the recording was killed before that"
            if unlisted
            else "two files have the same number"
            if twice
            else f"files are named {series[0]}N and {series[1]}N"
        )
        raise InputError(
            f"{folder} holds steps of more than one recording ({reason}): move each recording into a separate folder"
        )


def _read_engine_records(folder: Path) -> list[dict[str, Any]]:
    """Read the engine's data of the steps in a folder, each with its "file"; empty if a line cannot be read."""
    try:
        text = read_whole_file(folder / ENGINE, "the engine's answers").decode(errors="replace")
        lines = [dict(json.loads(line)) for line in text.splitlines()]
        return lines if all("file" in line for line in lines) else []
    except (ValueError, TypeError, RecursionError):
        return []


def _read_unrecorded_steps(folder: Path) -> dict[Path, str]:
    """Return {file: reason} for steps that could not be recorded."""
    steps = {
        folder / Path(str(t["file"])).name: str(t["left_out"])
        for t in _read_engine_records(folder)
        if "left_out" in t
    }
    return {path: reason for path, reason in steps.items() if not path.exists()}


def _list_problem_files(folder: Path) -> list[Path]:
    """List the problem files of a folder, in the numeric order of their names, without the results of an audit."""
    try:
        results = AUDIT_RESULTS if (folder / "numbers.json").is_file() else ()
        files = (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.name not in results)
        return sorted(files, key=_natural_sort_key)
    except OSError as error:
        raise InputError(f"cannot read the folder {folder} ({error.strerror or error})") from None


def _is_states_folder(folder: Path) -> bool:
    """Whether a folder holds the states before recorded steps; the problems are in its parent."""
    parent = folder.parent
    if folder.name != STATES_FOLDER:
        return False
    return (parent / ENGINE).is_file() or any((parent / p.name).is_file() for p in folder.glob("*.npz"))


def _natural_sort_key(path: Path) -> list[tuple[int, int | str]]:
    """Return a sort key in which numbers are ordered by value; digits such as superscripts count as letters."""
    parts = re.split(r"([0-9]{1,18})", path.name)
    return [(0, int(t)) if i % 2 else (1, t) for i, t in enumerate(parts) if t]


def _holds_recorded_steps(folder: Path) -> bool:
    """Whether a folder holds the recorded steps of one simulation."""
    paths = _list_problem_files(folder) if folder.is_dir() else []
    if len(paths) < 2 or len({re.sub(r"\d+$", "", p.stem) for p in paths}) > 1:
        return False
    try:
        return _make_item_of_file(paths[0]).problem.key is not None
    except Exception:  # The error is reported when the case is run.
        return False


def _rename_duplicate_sequence(steps: list[Item], items: list[Item]) -> list[Item]:
    """Rename a sequence if an earlier one has its name: prefix the parent folder's name, or append a number.

    Figures are files named after sequences, so names must differ as file names, too.
    """
    names = {make_file_name(item.sequence).lower() for item in items if item.sequence}
    name, n = steps[0].sequence, 1
    if make_file_name(name).lower() in names:
        with_parent = f"{Path(steps[0].source).resolve().parent.parent.name}/{name}"
        name = name if make_file_name(with_parent).lower() in names else with_parent
    while make_file_name(unique := f"{name} #{n}" if n > 1 else name).lower() in names:
        n += 1
    return [replace(item, name=f"{unique}[{item.step}]", sequence=unique) for item in steps]


def _make_loader(problem: Problem) -> Callable[[], Problem]:
    """Return a function that returns the problem."""
    return lambda: problem


def _make_item_of_case(case: Case, source: str) -> Item:
    """Create the item of a case."""
    return Item(case.name, source, _make_loader(case.problem), case.reason)


def _make_item_of_name(name: str) -> Item:
    """Create the item of a name in the suite; if a package is missing, loading the item raises the error."""
    try:
        return _make_item_of_case(suite.case(name), name)
    except SolverUnavailable as error:
        return Item(name, name, _raise_when_loaded(error))


def _convert_to_sequence_steps(items: list[Item]) -> list[Item]:
    """Convert consecutive cases that differ only in `at` to the steps of sequences."""
    out, count = [], Counter[str]()
    for item in items:
        name = item.name.rpartition(", at=")[0] + ")"
        out.append(replace(item, name=f"{name}[{count[name]}]", sequence=name, step=count[name]))
        count[name] += 1
    return out


def _raise_when_loaded(error: Exception) -> Callable[[], Problem]:
    """Return a function that raises the error when the problem is loaded."""

    def load() -> Problem:
        raise error

    return load


def _make_item_of_file(path: Path) -> Item:
    """Create the item of a problem file."""

    def load() -> Problem:
        if _is_states_folder(path.parent):
            raise InputError(
                f"{path} holds the state before a recorded step; its problem is {path.parent.parent / path.name}"
            )
        if path.exists() and not path.is_file():
            # A pipe may never end.
            raise InputError(f"{path} is not a file; a problem ({', '.join(SUFFIXES)}) is needed")
        if not path.exists() and (reason := _read_unrecorded_steps(path.parent).get(path)):
            raise InputError(
                f"{path} was not written, because this step could not be recorded ({reason}): choose "
                "another step"
            )
        return io.load(path)

    return Item(path.stem, str(path), load, load_stored=partial(io.load_solution, path))


def _make_names_differ(items: list[Item]) -> list[Item]:
    """Prefix equal names of files with the folders that differ, and append numbers to names that are still equal.

    Figures are files named after cases, so case-insensitive names must differ.
    """
    files: dict[str, list[Item]] = {}
    for item in items:
        if item.in_memory is None and not item.sequence and is_path(item.source):
            files.setdefault(make_file_name(item.name).lower(), []).append(item)
    for same in files.values():
        folders = [Path(item.source).parent.resolve().parts for item in same]
        first, last = min(folders), max(folders)
        n = next((i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))
        for item, parts in zip(same, folders, strict=True):
            item.name = escape_unprintable("/".join([*parts[n:], item.name]))
    used_names: set[str] = set()
    for item in items:
        name, n = item.name, 1
        while make_file_name(item.name).lower() in used_names:
            n += 1
            item.name = f"{name} #{n}"
        used_names.add(make_file_name(item.name).lower())
    return items


def describe_case(item: Item, run: str) -> CaseInfo:
    """Load the problem of an item and describe it for the report."""
    p = item.problem
    contacts = int(np.count_nonzero(p.cones.is_contact))
    answer = item.judge_stored_answer()
    structure, islands = classify_structure_and_count_islands(p)
    return CaseInfo(
        run=run, case=item.name, source=item.source, sha=hash_problem(p), law=p.law, rows=p.m, blocks=p.n_blocks,
        contacts=contacts, bodies=p.rows.n_bodies if p.rows is not None else 0,
        nonzeros=int(p.jacobian.nnz if p.rows is not None else p.csr.nnz), mass_ratio=compute_mass_ratio(p),
        structure=structure, islands=islands, symmetric=p.is_symmetric, reason=item.reason, sequence=item.sequence,
        step=item.step, stored=math.nan if answer is None else answer.relative,
        stored_verdict=answer.verdict_in_words if answer and answer.rounding else "",
        nothing_to_do=is_solved_by_zero(p), diagnostics=tuple(map(str, diagnose(p))), guess=_classify_guess(item),
    )  # fmt: skip


def _classify_guess(item: Item) -> str:
    """Return the kind of the problem's guess for `CaseInfo.guess`: "", "start" or "answer".

    A guess is an answer if it is the stored answer, or if its residual is at most `DEFAULT_SOLVE_TOL`.
    """
    guess = item.problem.guess
    if guess is None:
        return ""
    stored = item.load_stored()
    is_stored = stored is not None and np.array_equal(guess, stored)
    return "answer" if is_stored or residual(item.problem, guess).relative <= DEFAULT_SOLVE_TOL else "start"


def hash_problem(problem: Problem) -> str:
    """Hash the numbers of a problem and the keys of its blocks; the v* of bodies is hashed as part of b."""
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
