"""The citable problem set: the cases of the suite's sets, and the proved properties of each problem's solution.

    enclosed    an exact solution is proved to lie within `radius` m/s of an answer (`lavender.prove`)
    infeasible  a certificate, checked by the judge, proves that no solution exists
    open        neither is proved: `reason` says why

`manifest.json` in this folder has a line for each problem. Its `sha` is a hash of all numbers, so that anybody can
build the problem from its name and check that it is the same.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.errors import CapabilityError, InputError
from lavender.io.stored import read_whole_file, write_text
from lavender.judge.solution import CONFIRMED, Status
from lavender.lab import suite
from lavender.lab.bench.cases import compute_condition_number, hash_problem, is_path, resolve_sources
from lavender.lab.motion import find_solutions
from lavender.lab.proof import prove
from lavender.problem import Problem
from lavender.solving.solve import solve

MANIFEST = Path(__file__).with_name("manifest.json")
# Manifest of problems that are files of other projects and are not part of this repository.
RECORDED = MANIFEST.with_name("recorded.json")
# Several motions are searched for if a problem under Coulomb's law has at most this many rows.
MAX_SEARCH_ROWS = 60
NEAR_SOLUTION_SPEED = 1e-9  # [m/s] The catalogue counts answers within this distance of an exact solution.
MAX_SWEEPS = 10_000  # Largest number of PGS sweeps with which the difficulty of a problem is measured.
ANSWER_TIME_LIMIT = 30.0  # [s] Time limit of `auto` for the answer from which a proof starts.


@dataclass(frozen=True)
class Entry:
    """One problem of the set and its proved properties.

    Parameters
    ----------
    name, group : str
        Name of the case, and set that contains it.
    sha : str
        Hash of its numbers.
    rows : int
    law : str
    form : {"rows", "matrix", "generalized"}
        Bodies, A, or J and M.
    licence : str
        Licence of a model that another package installs.
    made : str
        Versions of other packages on which the problem's numbers depend.
    sweeps : int or None
        Sweeps of PGS to a residual of 1e-3; None if 10,000 do not suffice, or PGS does not accept the problem.
    condition : float or None
        Condition number of A on its range, scaled to a diagonal of 1; None above CONDITION rows.
    degenerate : float
        Fraction of the blocks with a bounded error that are at a boundary between two states; 0 without such blocks.
    known : {"enclosed", "infeasible", "open"}
    radius : float or None, m/s
        Radius of the enclosed solution, for every row.
    unique : bool
        Whether the motion of the enclosed solution is proved to be the only one.
    motions : int
        Number of motions that were found, a lower bound; 0 if they were not searched.
    apart : float or None, m/s
        Largest distance of two motions.
    reason : str
    """

    name: str
    group: str
    sha: str
    rows: int
    law: str
    form: str
    licence: str = ""
    made: str = ""
    sweeps: int | None = None
    condition: float | None = None
    degenerate: float = 0.0
    known: str = "open"
    radius: float | None = None
    unique: bool = False
    motions: int = 0
    apart: float | None = None
    reason: str = ""


def certify_problem(problem: Problem, name: str, group: str) -> Entry:
    """Build the entry of a problem, with a proof or a certificate if there is one; needs the extra `proof`."""
    package = suite.get_package_name_of_case(name)
    answer = solve(problem, "auto", tol=1e-12, time_limit=ANSWER_TIME_LIMIT)
    entry = Entry(
        name=name,
        group=group,
        sha=hash_problem(problem),
        rows=problem.m,
        law=problem.law,
        form=problem.operator,
        licence=suite.LICENCES.get(package, ""),
        made=suite.get_package_versions(package),
        sweeps=count_sweeps_to_thousandth(problem),
        condition=compute_condition_number(problem),
        degenerate=round(answer.states.boundary_fraction or 0.0, 3),
    )
    if answer.status is Status.INFEASIBLE and answer.claim_check == CONFIRMED:
        return replace(entry, known="infeasible", reason=answer.message.rpartition("; ")[2])
    try:
        found = prove(problem, answer)
    except CapabilityError as error:
        return replace(entry, reason=str(error))
    entry = replace(entry, reason=found.reason, unique=found.unique)
    if found.infeasible:
        return replace(entry, known="infeasible")
    if found.proven:
        entry = replace(entry, known="enclosed", radius=found.velocity_radius)
    if problem.law == "coulomb" and not found.unique and problem.m <= MAX_SEARCH_ROWS:
        solutions = find_solutions(problem.disk)
        entry = replace(entry, motions=len(solutions), apart=solutions.spread, unique=bool(solutions.unique))
    return entry


def count_sweeps_to_thousandth(problem: Problem) -> int | None:
    """Count the sweeps that `pgs` needs to a relative residual of 1e-3; None if MAX_SWEEPS do not suffice."""
    try:
        found = solve(problem, "pgs", impulse=problem.start(), tol=1e-3, max_iter=MAX_SWEEPS)
    except CapabilityError:
        return None
    return found.iterations if found.success else None


def certify_groups(groups: Iterable[str]) -> Iterator[Entry]:
    """Certify every problem of the named sets, files and folders, or of all sets if `groups` is empty."""
    for group in [g.removeprefix("@") for g in groups] or suite.SETS:
        if is_path(group):
            for item in resolve_sources(group):
                yield certify_problem(item.problem, item.name, "recorded")
                item.release_problem()
            continue
        for case in suite.cases(f"@{group}"):
            yield certify_problem(case.problem, case.name, group)


def save_manifest(entries_to_save: Iterable[Entry], path: Path | str) -> None:
    """Write a manifest."""
    defaults = {f.name: f.default for f in fields(Entry)}
    lines = [{k: v for k, v in asdict(e).items() if v != defaults[k]} for e in entries_to_save]
    text = ",\n ".join(json.dumps(line, ensure_ascii=False) for line in lines)
    write_text(path, f"[{text}]\n")


def load_manifest(path: Path | str = MANIFEST) -> list[Entry]:
    """Read a manifest.

    Raises
    ------
    InputError
        The file is not a manifest; the message says why.
    """
    known = {f.name for f in fields(Entry)}
    try:
        lines: list[dict[str, Any]] = json.loads(read_whole_file(path, "the manifest"))
        return [Entry(**{k: v for k, v in line.items() if k in known}) for line in lines]
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is not a manifest of problems: {error}") from None


def select_buildable(entries: Iterable[Entry]) -> tuple[list[Entry], list[str]]:
    """Select the entries with installed models; return them and a line for each missing package."""
    entries = list(entries)
    missing = {
        e.name: suite.explain_missing_packages(package)
        for e in entries
        if (package := suite.get_package_name_of_case(e.name))
    }
    buildable = [e for e in entries if not missing.get(e.name)]
    return buildable, sorted({message for message in missing.values() if message})


def find_changed_problems(entries: Iterable[Entry]) -> Iterator[str]:
    """Build every problem again from its name; yield a line for each that does not have the hash of its entry."""
    for entry in entries:
        problem = suite.case(entry.name).problem
        if (now := hash_problem(problem)) != entry.sha:
            here = suite.get_package_versions(suite.get_package_name_of_case(entry.name))
            why = f"; made with {entry.made}, here {here}" if here != entry.made else ""
            yield f"{entry.name}: {now} here, {entry.sha} in the manifest{why}"


def describe_properties(entry: Entry) -> str:
    """Describe the proved properties of a problem in a few words."""
    text = f"enclosed within {entry.radius:.1e} m/s" if entry.radius is not None else entry.known
    more = ", one motion" if entry.unique else ""
    return text + more + (f", at least {entry.motions} motions" if entry.motions > 1 else "")


def format_catalogue(entries: list[Entry], recorded: Sequence[Entry] = ()) -> str:
    """Write the catalogue: counts of proved properties, and problems without a solution, with several, or open.

    `recorded` holds the entries of files of other projects.
    """
    found = [*entries, *recorded]
    count = Counter(e.known for e in found)
    near = sum(e.radius is not None and e.radius <= NEAR_SOLUTION_SPEED for e in found)
    unique = sum(e.unique for e in found)
    first = (
        f"This page lists a fixed set of {len(found)} contact problems with proved properties. An *enclosed* problem "
        f"has an exact solution that is [proved](proof.md) to lie near a known answer. {count['enclosed']} problems "
        f"are enclosed, {near} of them within {NEAR_SOLUTION_SPEED:.0e} m/s of the answer. For {unique} problems it is "
        f"proved that all solutions have one motion. {count['infeasible']} problems have no solution, which a "
        "[certificate](residual.md#certificates-of-infeasibility) proves. Rows, laws and the matrix A are defined in "
        "[the contact problem](concepts.md)."
    )
    how = (
        "`lavender problems` builds the problems from their names. `lavender problems --check` also compares "
        "every number with `lavender/lab/manifest.json`. `lavender problems --page docs/catalogue.md` writes this page "
        "from the manifest. The robots are models of gymnasium (MIT) and dm_control (Apache-2.0) and need the extra "
        "`robots`. The recorded problems are files of other projects and are not distributed with lavender: test data "
        "of FCLIB and Siconos (Apache-2.0), and two files of ContactBench (BSD-2-Clause). `lavender problems FOLDER "
        "--certify FILE` proves the properties of your own files."
    )
    columns = (
        "The first table has a line for each set of problems, with these columns:\n\n"
        "- *rows*: the smallest and the largest number of rows\n"
        "- *sweeps*: the median number of [sweeps](sweep.md) of PGS until the relative residual is 1e-3. "
        f"{MAX_SWEEPS:,} is counted if these sweeps do not suffice or PGS does not accept the problem\n"
        "- *condition*: the median condition number of A\n"
        "- *at a boundary*: the number of problems with blocks at the boundary of two "
        "[states](concepts.md#states-of-blocks)\n"
        f"- {', '.join(f'*{law}*' for law in sorted({e.law for e in found}))}: the number of problems under this law\n"
        "- *enclosed*, *one motion*, *infeasible*: the number of problems with this proved property\n"
        "- *open*: the number of problems for which neither a solution nor infeasibility is proved. Usually a block is "
        "then at the boundary of two states"
    )
    claims = "`lavender report @hard --prove` compares the claims of solvers with the proofs."
    laws = sorted({e.law for e in found})
    out = [
        "# Catalogue of problems with proved properties",
        first,
        how,
        columns,
        claims,
        "| set | problems | rows | sweeps | condition | at a boundary | "
        + " | ".join(laws)
        + " | enclosed | one motion | infeasible | open |",
        "|---|---|---|---|---|---|" + "---|" * (len(laws) + 4),
    ]
    for group in dict.fromkeys(e.group for e in found):
        own = [e for e in found if e.group == group]
        cells = [
            f"`@{group}`" if group in suite.SETS else group,
            len(own),
            f"{min(e.rows for e in own)} to {max(e.rows for e in own)}",
        ]
        cells.append(f"{np.median([MAX_SWEEPS if e.sweeps is None else e.sweeps for e in own]):.0f}")
        conditions = [e.condition for e in own if e.condition is not None]
        cells += [f"{np.median(conditions):.0e}" if conditions else "", sum(e.degenerate > 0.0 for e in own)]
        cells += [sum(e.law == law for e in own) for law in laws]
        cells += [sum(e.known == "enclosed" for e in own), sum(e.unique for e in own)]
        cells += [sum(e.known == known for e in own) for known in ("infeasible", "open")]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    if recorded:
        out += [
            "## Recorded files",
            "*sha* is a hash of the data. A distance in m/s is the distance of the exact solution from the answer.",
            "| file | sha | rows | law | proved properties |\n|---|---|---|---|---|",
        ]
        out += [
            f"| `{e.name}` | `{e.sha}` | {e.rows} | {e.law} | {describe_properties(e)} |" for e in recorded
        ]
    solutions = [e for e in found if e.motions > 1]
    for title, head, selected, cell in (
        ("No solution", "reason", [e for e in found if e.known == "infeasible"], lambda e: e.reason),
        (
            "Several motions",
            "solutions found",
            solutions,
            lambda e: f"at least {e.motions}, which differ by up to {e.apart:.1e} m/s",
        ),
        ("Open", "reason", [e for e in found if e.known == "open"], lambda e: e.reason),
    ):
        out += [
            f"## {title}",
            f"{len(selected)} problems." if not selected else f"| problem | rows | {head} |\n|---|---|---|",
        ]
        out += [f"| `{e.name}` | {e.rows} | {cell(e)} |" for e in selected]
    text = "\n\n".join(out)
    return text.replace(" |\n\n|", " |\n|").replace("|\n\n| `", "|\n| `") + "\n"
