"""Resolve files, folders and names of suite cases to problems, and describe each problem."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, count, groupby
from pathlib import Path
from typing import Any

import numpy as np

from lavender import io, suite
from lavender.base.arrays import FloatArray, check_bool, check_sequence
from lavender.base.errors import InputError, SolverUnavailable
from lavender.io.stored import ENGINE, STATES_FOLDER, SUFFIXES, read_bytes
from lavender.judge.residuals import DEFAULT_THRESHOLD, Residual, residual
from lavender.problem import Problem, check_problem
from lavender.problem.derived import cached_property
from lavender.report.case_kinds import make_case
from lavender.report.store import CASE_COLUMNS, Row
from lavender.report.text import escape_unprintable, make_file_name
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
    sequence: str = (
        ""  # Name of the sequence that contains the case as a step; empty for a single case.
    )
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
        """Judge the answer stored with the problem; return None without one of m entries, or of a program."""
        impulse = self.load_stored()
        if impulse is None or impulse.shape != (self.problem.m,) or self.problem.qp is not None:
            return None
        return residual(self.problem, impulse, precision, threshold)

    def release_problem(self) -> None:
        """Release the memory of the problem."""
        self.__dict__.pop("problem", None)


def is_path(word: Source) -> bool:
    """Return whether `word` names a file or folder, which need not exist, and not a case of the suite."""
    if not isinstance(word, str):
        return isinstance(word, Path)
    return (
        "/" in word
        or os.sep in word
        or Path(word).suffix.lower() in SUFFIXES
        or Path(word).exists()
    )


Source = str | Path | Problem | Case | Item


def resolve_sources(
    sources: Source | Iterable[Source], sequences: bool | None = None
) -> list[Item]:
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
    if isinstance(sources, Source):
        sources = [sources]
    sources = check_sequence("cases", sources, "files, folders, names or problems")
    items = (
        []
        if sources
        else [_make_item_of_problem(case.problem, case.name) for case in suite.default()]
    )
    visited: set[Path] = set()  # Folders that were searched: a link may lead back to one of them.
    for source in sources:  # Inner folders are added at the end.
        if isinstance(source, Problem):
            items.append(
                _make_item_of_problem(source, source.name or f"problem {len(items)}", source)
            )
        elif isinstance(source, Item):
            items.append(source)
        elif isinstance(source, Case):
            items.append(_make_item_of_problem(source.problem, source.name))
        elif not (isinstance(source, str) or hasattr(source, "__fspath__")):
            raise InputError(
                f"case {source!r:.60} is a {type(source).__name__}; the path of a file, a name of the suite "
                "or a Problem is needed"
            )
        elif not is_path(source) and not sequences:
            items += _list_items_of_set(str(source))
        elif sequences or (sequences is None and _holds_recorded_steps(Path(source))):
            items += _list_recorded_steps(Path(source), items)
        elif (path := Path(source)).is_dir():
            files = _list_problem_files(path)
            folders = sorted(p for p in path.iterdir() if p.is_dir())
            visited.add(path.resolve())
            folders = [p for p in folders if p.resolve() not in visited and os.access(p, os.R_OK)]
            inner = [p for p in folders if not _is_states_folder(p) and _list_problem_files(p)]
            sources += inner
            if not files and not inner:
                records = path / "records.jsonl"
                shown = f": {records} shows its report again" if records.is_file() else ""
                raise InputError(f"{source} holds no problem file ({', '.join(SUFFIXES)}){shown}")
            items += map(_make_item_of_file, (*files, *_read_unrecorded_steps(path)))
        elif path.exists() or path in _read_unrecorded_steps(path.parent):
            items.append(replace(_make_item_of_file(path), named=True))
        else:
            raise InputError(
                f"{source}: no such file; give problem files ({', '.join(SUFFIXES)}), folders or suite names"
            )
    return _make_names_differ(items)


def resolve_item(source: str | Problem, name: str) -> Item:
    """Create the item of a source in a worker process; an invalid source raises an error when it is loaded."""
    try:
        (item,) = resolve_sources([source])
    except Exception as error:  # The file was removed, or reading its folder raises an error.
        item = Item(name, str(source), _raise_when_loaded(error))
    return replace(item, name=name, sequence="", step=-1)


def make_sequence(problems: Iterable[Problem], name: str) -> list[Item]:
    """Return consecutive problems as the steps of one sequence."""
    if not isinstance(name, str):
        raise InputError(f"the name of a sequence is {name!r:.60}; a string is needed")
    items = []
    for i, problem in enumerate(check_sequence("problems", problems, "Problems")):
        check_problem(problem)
        item = _make_item_of_problem(problem, f"{name}[{i}]", problem)
        items.append(replace(item, source=name, sequence=name, step=i))
    return items


def list_steps_in_folder(folder: str | Path) -> list[Item]:
    """Return the problem files of a folder as the steps of a sequence, in the numeric order of their names.

    Steps that were recorded from different start states or in different worlds are different sequences; a single step
    of a state is a case.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"{folder} is not a folder; a folder of problem files is needed, one for each step"
        )
    paths = _list_problem_files(folder)
    name = folder.resolve().name
    if len(paths) < 2:
        n = f"{len(paths)} problem files ({', '.join(SUFFIXES)})"
        raise InputError(f"{folder} holds {n}; a sequence needs two")
    lines = {str(line.get("file")): line for line in read_engine_lines(folder)}
    has_worlds = any("world" in line for line in lines.values())
    # The files of a `Recorder` end with the number of the world, and its lines have the number of the step.
    numbered = [
        m.groups() for p in paths if (m := re.fullmatch(r"(.*?)(\d+)", p.stem)) and not has_worlds
    ]
    series = [prefix for prefix, n in Counter(prefix for prefix, _ in numbered).items() if n > 1]
    unlisted = [p.name for p in paths if lines and p.name not in lines]
    reason = ""
    if unlisted:
        reason = (
            f"{unlisted[0]} is not listed in its {ENGINE}, or the recording was killed before that"
        )
    if len(numbered) > len({(prefix, int(number)) for prefix, number in numbered}):
        reason = "two files have the same number"
    elif len(series) > 1:
        reason = f"files are named {series[0]}N and {series[1]}N"
    if reason:
        raise InputError(f"{folder} holds steps of more than one recording: {reason}")
    n_worlds = len({line.get("world", 0) for line in lines.values()})
    groups: dict[str, list[Item]] = {}
    for path in paths:
        line = lines.get(path.name, {})
        group = name if line.get("start") is None else f"{name}, state {line['start']}"
        group += f", world {line.get('world', 0)}" if n_worlds > 1 else ""
        groups.setdefault(group, []).append(_make_item_of_file(path))
    return [
        replace(item, name=f"{group}[{i}]", sequence=group, step=i)
        if len(items) > 1
        else replace(item, name=group)
        for group, items in groups.items()
        for i, item in enumerate(items)
    ]


def read_engine_lines(folder: Path) -> list[dict[str, Any]]:
    """Return the last line for each file of a folder's `engine.jsonl`, without those that are not JSON.

    A C engine that runs again into the same folder replaces the files and appends further lines.
    """
    lines: list[Any] = []
    if (folder / ENGINE).is_file():
        text = read_bytes(folder / ENGINE, "the engine's answers").decode(errors="replace")
        for line in text.splitlines():
            with contextlib.suppress(ValueError, RecursionError):
                lines.append(json.loads(line))
    lines = [line for line in lines if isinstance(line, dict)]
    return list({str(line.get("file", i)): line for i, line in enumerate(lines)}.values())


def _read_unrecorded_steps(folder: Path) -> dict[Path, str]:
    """Return {file: reason} for steps that could not be recorded."""
    lost = [line for line in read_engine_lines(folder) if "left_out" in line and "file" in line]
    steps = {folder / Path(str(line["file"])).name: str(line["left_out"]) for line in lost}
    return {path: reason for path, reason in steps.items() if not path.exists()}


def _list_problem_files(folder: Path) -> list[Path]:
    """List the problem files of a folder, in the numeric order of their names, without the results of an audit."""
    try:
        results = AUDIT_RESULTS if (folder / "numbers.json").is_file() else ()
        files = (
            p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.name not in results
        )
        return sorted(files, key=_natural_sort_key)
    except OSError as error:
        raise InputError(f"cannot read the folder {folder} ({error.strerror or error})") from None


def _is_states_folder(folder: Path) -> bool:
    """Whether a folder holds the states before recorded steps; the problems are in its parent."""
    parent = folder.parent
    if folder.name != STATES_FOLDER:
        return False
    return (parent / ENGINE).is_file() or any(
        (parent / p.name).is_file() for p in folder.glob("*.npz")
    )


def _natural_sort_key(path: Path) -> list[tuple[int, int | str]]:
    """Return a sort key in which numbers are ordered by value; digits such as superscripts count as letters."""
    parts = re.split(r"([0-9]{1,18})", path.name)
    return [(0, int(t)) if i % 2 else (1, t) for i, t in enumerate(parts) if t]


def _holds_recorded_steps(folder: Path) -> bool:
    """Whether a folder holds the recorded steps of one simulation.

    `Recorder(every=...)` marks its steps. Other recordings have files that differ in one number, and steps that
    assign impulses to the same blocks; states that have nothing in common are single cases.
    """
    paths = _list_problem_files(folder) if folder.is_dir() else []
    lines = [line for line in read_engine_lines(folder) if "left_out" not in line]
    if any("world" in line for line in lines):
        return len(paths) > 1 and all("every" in line for line in lines)
    if len(paths) < 2 or len({re.sub(r"\d+$", "", p.stem) for p in paths}) > 1:
        return False
    try:
        first, second = (_make_item_of_file(path).problem.key for path in paths[:2])
    except Exception:  # The error is reported when the case is run.
        return False
    has_keys = first is not None and second is not None
    return has_keys and bool(np.isin(second, first).any() or not second.size)


def _list_recorded_steps(folder: Path, items: list[Item]) -> list[Item]:
    """List the steps of a folder, in sequences with names that differ from the earlier `items`.

    A name that is taken gets the parent folder's name as prefix, or a number. Figures are files named after sequences,
    so names must differ as file names, too.
    """
    found: list[Item] = []
    used = {make_file_name(item.sequence).lower() for item in items if item.sequence}
    for name, group in groupby(list_steps_in_folder(folder), key=lambda item: item.sequence):
        name = name and _take_free_name([name, f"{folder.resolve().parent.name}/{name}"], used)
        found += [replace(s, name=f"{name}[{s.step}]", sequence=name) if name else s for s in group]
    missing = map(_make_item_of_file, _read_unrecorded_steps(folder))
    name = found[-1].sequence
    named = name or folder.resolve().name
    return [
        *found,
        *(replace(item, name=f"{named}, {item.name}", sequence=name) for item in missing),
    ]


def _make_item_of_problem(problem: Problem, name: str, in_memory: Problem | None = None) -> Item:
    """Create the item of a problem."""
    return Item(name, name, lambda: problem, in_memory=in_memory)


def _list_items_of_set(name: str) -> list[Item]:
    """List the items of a case or set of the suite; if a package is missing, loading an item raises the error.

    Consecutive cases of @sequences that differ only in `at` are the steps of sequences.
    """
    items: list[Item] = []
    for case in suite.get_case_names_of_set(name):
        try:
            items.append(_make_item_of_problem(suite.case(case).problem, suite.case(case).name))
            items[-1].source = case
        except SolverUnavailable as error:
            items.append(Item(case, case, _raise_when_loaded(error)))
    if name.removeprefix("@") != "sequences":
        return items
    steps = Counter[str]()
    for item in items:
        item.sequence = item.name.rpartition(", at=")[0] + ")"
        item.step = steps[item.sequence]
        steps[item.sequence] = steps[item.sequence] + 1
        item.name = f"{item.sequence}[{item.step}]"
    return items


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
        if not path.exists() and (reason := _read_unrecorded_steps(path.parent).get(path)):
            raise InputError(f"{path} was not written, as its step was not recorded ({reason})")
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
        n = next(
            (i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first)
        )
        for item, parts in zip(same, folders, strict=True):
            item.name = escape_unprintable("/".join([*parts[n:], item.name]))
    used = set[str]()
    for item in items:
        item.name = _take_free_name([item.name], used)
    return items


def _take_free_name(names: list[str], used: set[str]) -> str:
    """Return one of `names`, or the first with a number, that is not `used` as a file name; add it to them."""
    numbered = (f"{names[0]} #{n}" for n in count(2))
    name = next(x for x in chain(names, numbered) if make_file_name(x).lower() not in used)
    used.add(make_file_name(name).lower())
    return name


def describe_case(item: Item, run: str) -> Row:
    """Load the problem of an item and return the row that describes it."""
    p = item.problem
    answer = item.load_stored()
    case = make_case(p)
    guess = ""
    if p.guess is not None and p.qp is None:
        is_stored = answer is not None and np.array_equal(p.guess, answer)
        is_answer = is_stored or residual(p, p.guess).relative <= DEFAULT_SOLVE_TOL
        guess = "answer" if is_answer else "start"
    stored = math.nan if answer is None or answer.shape != (p.m,) else case.judge_impulse(answer)
    return {
        **CASE_COLUMNS,
        **case.describe(),
        "kind": "case",
        "run": run,
        "case": item.name,
        "source": item.source,
        "sha": hash_problem(p),
        "sequence": item.sequence,
        "step": item.step,
        "identity": "",
        "stored": stored,
        "guess": guess,
        "diagnostics": case.list_diagnostics(),
    }


def hash_problem(problem: Problem) -> str:
    """Hash the numbers of a problem and the keys of its blocks."""
    digest = hashlib.sha256(problem.friction.encode())
    for x in make_case(problem).list_arrays():
        digest.update(b"-" if x is None else np.ascontiguousarray(x).tobytes() + b"|")
    if problem.precision != "float64":
        digest.update(problem.precision.encode())
    if problem.key is not None:
        digest.update(b"key" + problem.key.tobytes())
    return digest.hexdigest()[:16]
