"""A problem set that others can cite: the sets of the suite, and what is known of each problem's solution.

    enclosed    an exact solution is proved to lie within `radius` m/s of an answer (`lavender.prove`)
    infeasible  a certificate that there is none, checked by the judge
    open        neither: `reason` says what is in the way

`manifest.json` beside this file has a line for each problem; its `sha` is of all numbers, so that anybody can make the
problem from its name and see that it is the same.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.errors import CapabilityError, InputError
from lavender.io.stored import read_whole_file, write_text
from lavender.judge.solution import CONFIRMED, Status
from lavender.lab import suite
from lavender.lab.bench.cases import condition, fingerprint, is_path, resolve
from lavender.lab.motion import find_solutions
from lavender.lab.proof import prove
from lavender.problem import Problem
from lavender.solving.solve import solve

MANIFEST = Path(__file__).with_name("manifest.json")
RECORDED = MANIFEST.with_name("recorded.json")  # of files of other projects, which are not part of this one
SEARCHED = 60  # rows under Coulomb's law up to which other motions are looked for
NEAR = 1e-9  # m/s
SWEEPS = 10_000  # of PGS, at most
SECONDS = 30.0  # of `auto`, to the answer that a proof begins from


@dataclass(frozen=True)
class Entry:
    """One problem of the set and what is known of it."""

    name: str
    group: str
    sha: str  # of its numbers
    rows: int
    law: str
    form: str  # rows (bodies), matrix, generalized (J and M)
    licence: str = ""  # of a model that another package installs
    made: str = ""  # versions that give these numbers, where they hang on other packages
    # of PGS to 1e-3 of doing nothing; None: not within 10,000, or it does not take the problem
    sweeps: int | None = None
    # of A, scaled to a diagonal of 1, over its range; None above CONDITION rows
    condition: float | None = None
    degenerate: float = (
        0.0  # share of blocks at a boundary, among those whose error has a bound (0 if none has one)
    )
    known: str = "open"  # enclosed, infeasible or open
    radius: float | None = None  # m/s, of every row of the enclosed solution
    unique: bool = False  # proved to be the only motion
    motions: int = 0  # found, at least; 0: not looked for
    apart: float | None = None  # m/s between two of them
    reason: str = ""


def certified(problem: Problem, name: str, group: str) -> Entry:
    """The entry of a problem, with a proof or a certificate where there is one. Needs the extra `proof`."""
    package = suite.package_of(name)
    answer = solve(problem, "auto", tol=1e-12, time_limit=SECONDS)
    entry = Entry(
        name=name,
        group=group,
        sha=fingerprint(problem),
        rows=problem.m,
        law=problem.law,
        form=problem.operator,
        licence=suite.LICENCES.get(package, ""),
        made=suite.versions(package),
        sweeps=difficulty(problem),
        condition=condition(problem),
        degenerate=round(answer.states.boundary_fraction or 0.0, 3),
    )
    base = asdict(entry)
    if answer.status is Status.INFEASIBLE and answer.claim_check == CONFIRMED:
        return Entry(**base | {"known": "infeasible", "reason": answer.message.rpartition("; ")[2]})
    try:
        found = prove(problem, answer)
    except CapabilityError as error:
        return Entry(**base | {"reason": str(error)})
    base |= {"reason": found.reason, "unique": found.unique}
    if found.infeasible:
        return Entry(**base | {"known": "infeasible"})
    if found.proven:
        base |= {"known": "enclosed", "radius": found.velocity_radius}
    if problem.law == "coulomb" and not found.unique and problem.m <= SEARCHED:
        several = find_solutions(problem.disk)
        base |= {"motions": len(several), "apart": several.spread, "unique": bool(several.unique)}
    return Entry(**base)


def difficulty(problem: Problem) -> int | None:
    """Sweeps that `pgs` takes to a thousandth of the error of doing nothing, `Entry.sweeps`."""
    try:
        found = solve(problem, "pgs", impulse=problem.start(), tol=1e-3, max_iter=SWEEPS)
    except CapabilityError:
        return None
    return found.iterations if found.success else None


def entries(groups: Iterable[str]) -> Iterator[Entry]:
    """The certified entry of every problem of these sets, files and folders; of all sets if none is named."""
    for group in [g.removeprefix("@") for g in groups] or suite.SETS:
        if is_path(group):
            for item in resolve(group):
                yield certified(item.problem, item.name, "recorded")
                item.forget()
            continue
        for case in suite.cases(f"@{group}"):
            yield certified(case.problem, case.name, group)


def save(found: Iterable[Entry], path: Path | str) -> None:
    """Write a manifest."""
    usual = {f.name: f.default for f in fields(Entry)}
    lines = [{k: v for k, v in asdict(e).items() if v != usual[k]} for e in found]
    text = ",\n ".join(json.dumps(line, ensure_ascii=False) for line in lines)
    write_text(path, f"[{text}]\n")


def load(path: Path | str = MANIFEST) -> list[Entry]:
    """Read a manifest.

    Raises
    ------
    InputError
        Not a manifest, with what is wrong.
    """
    known = {f.name for f in fields(Entry)}
    try:
        lines: list[dict[str, Any]] = json.loads(read_whole_file(path, "the manifest"))
        return [Entry(**{k: v for k, v in line.items() if k in known}) for line in lines]
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is no manifest of problems: {error}") from None


def makeable(found: Iterable[Entry]) -> tuple[list[Entry], list[str]]:
    """Those of the entries whose models are installed, and a line for each package that is not."""
    found = list(found)
    missing = {e.name: suite.missing(package) for e in found if (package := suite.package_of(e.name))}
    kept = [e for e in found if not missing.get(e.name)]
    return kept, sorted({told for told in missing.values() if told})


def changed(found: Iterable[Entry]) -> Iterator[str]:
    """Make every problem again by its name; a line for each that has other numbers."""
    for entry in found:
        problem = suite.case(entry.name).problem
        if (now := fingerprint(problem)) != entry.sha:
            here = suite.versions(suite.package_of(entry.name))
            why = f"; made with {entry.made}, here {here}" if here != entry.made else ""
            yield f"{entry.name}: {now} here, {entry.sha} in the manifest{why}"


def told(entry: Entry) -> str:
    """What is known of a problem, in a few words."""
    words = f"enclosed within {entry.radius:.1e} m/s" if entry.radius is not None else entry.known
    more = ", one motion" if entry.unique else ""
    return words + more + (f", at least {entry.motions} motions" if entry.motions > 1 else "")


def page(found: list[Entry], recorded: Sequence[Entry] = ()) -> str:
    """The catalogue: what is known of how many, and the problems that have no solution, several, or none known.

    `recorded` are files of other projects.
    """
    found = [*found, *recorded]
    count = Counter(e.known for e in found)
    near = sum(e.radius is not None and e.radius <= NEAR for e in found)
    unique = sum(e.unique for e in found)
    first = (
        f"Of these {len(found)} contact problems {count['enclosed']} have an exact solution that is proved to lie "
        f"near a known answer, {near} within {NEAR:.0e} m/s of it; for {unique} no other motion exists; "
        f"{count['infeasible']} have no solution, with a certificate."
    )
    how = (
        "`lavender problems` makes them from their names, `lavender problems --check` compares every number with "
        "`lavender/lab/manifest.json`, from which `lavender problems --page docs/catalogue.md` writes this page. "
        "Robots need the extra `robots`: models of gymnasium (MIT) and dm_control (Apache-2.0). Recorded are files of "
        "other projects that are not part of this one: test data of FCLIB and Siconos (Apache-2.0), and two of "
        "ContactBench (BSD-2-Clause); `lavender problems FOLDER --certify FILE` says the same of yours."
    )
    columns = (
        "Rows from the least to the most; sweeps of PGS to a thousandth of the error of doing nothing, in the median "
        f"({SWEEPS:,} where it does not get there or does not take the problem), the same of the condition of A, "
        "problems with blocks at a boundary; problems by law; and what is known. "
        "Open are problems on the boundary of two states, where no proof by signs exists."
    )
    claims = (
        "None of the files says which solver claimed what, so no published claim stands here to be contradicted; "
        "`lavender report @hard --prove` holds what solvers claim of a run of yours against what is proved."
    )
    laws = sorted({e.law for e in found})
    out = [
        "# Catalogue",
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
        cells.append(f"{np.median([SWEEPS if e.sweeps is None else e.sweeps for e in own]):.0f}")
        conditions = [e.condition for e in own if e.condition is not None]
        cells += [f"{np.median(conditions):.0e}" if conditions else "", sum(e.degenerate > 0.0 for e in own)]
        cells += [sum(e.law == law for e in own) for law in laws]
        cells += [sum(e.known == "enclosed" for e in own), sum(e.unique for e in own)]
        cells += [sum(e.known == known for e in own) for known in ("infeasible", "open")]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    if recorded:
        out += ["## Recorded files", "| file | sha | rows | law | known |\n|---|---|---|---|---|"]
        out += [f"| `{e.name}` | `{e.sha}` | {e.rows} | {e.law} | {told(e)} |" for e in recorded]
    several = [e for e in found if e.motions > 1]
    for title, chosen, tell in (
        ("No solution", [e for e in found if e.known == "infeasible"], lambda e: e.reason),
        ("Several motions", several, lambda e: f"at least {e.motions}, up to {e.apart:.1e} m/s apart"),
        ("Open", [e for e in found if e.known == "open"], lambda e: e.reason),
    ):
        out += [
            f"## {title}",
            f"{len(chosen)} problems." if not chosen else "| problem | rows | |\n|---|---|---|",
        ]
        out += [f"| `{e.name}` | {e.rows} | {tell(e)} |" for e in chosen]
    text = "\n\n".join(out)
    return text.replace(" |\n\n|", " |\n|").replace("|\n\n| `", "|\n| `") + "\n"
