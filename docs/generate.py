"""Pages made from what the package says of itself: SPECs, docstrings, examples, scenes, cases, and a small benchmark.

    python docs/generate.py            write docs/generated/, as the Sphinx build does
    python docs/generate.py --pages    rewrite solvers.md and the tables of engine.md and quadratic-programs.md
    python docs/generate.py --tables   measure; rewrite the tables of docs/choose.md, and the
                                       figures in docs/static/examples/

docs/generated/ is not checked in, and no page links to it: links work in a checkout and on a forge. The benchmark keeps
its records beside the build and measures again only what is missing: another version, machine or plan.
"""

import argparse
import contextlib
import hashlib
import importlib
import importlib.util
import inspect
import io
import itertools
import json
import os
import re
import statistics
import sys
import tempfile
import warnings
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

sys.path.append(
    str(Path(__file__).resolve().parent.parent / "examples")
)  # where examples find `panels`

import docstrings
from panels import save

import lavender as lv
import lavender_ext
from benchmarks import stability
from benchmarks.output import markdown as table
from lavender import registry, suite
from lavender.base.deadline import format_seconds
from lavender.problem import LAWS
from lavender.report import Plan, Report, run, tables
from lavender.report.figures import draw_profile
from lavender.report.text import format_residual, format_tolerance
from lavender.sim.scene.gallery import SCENES

ROOT = Path(__file__).resolve().parent.parent
# Examples whose figures pages show.
FIGURES = (
    "planned_push",
    "residual_or_motion",
    "motion_over_a_run",
    "inverse_kinematics",
)
TOLERANCES = (1e-3, 1e-6, 1e-9)
CASES = (
    "random_spd(n=100, condition=1e4)",
    "chain(n=33, tip_mass=1e4)",
    "hang(n=33)",
    "stack(n=64)",
    "box_stack(n=10)",
    "box_stack(n=10, mass_ratio=1e6)",
    "pyramid(k=10)",
    "granular(n=4)",
    "granular(n=9)",
    "box_stackF(n=10)",
    "pyramidF(k=6, sliding=0.5)",
    "granularF(n=3, sliding=0.5)",
    "pyramid(k=6, friction=cone)",
    "granular(n=4, friction=cone)",
)
PLAN = Plan(TOLERANCES, budgets=(4, 16, 64), repeats=2, time_limit=0.1, warm=False)
# Beside the solvers of lavender: one backend of each kind (splitting, interior point, cones).
BACKENDS = ("osqp", "scs", "piqp", "clarabel", "clarabel_cone")
NEAR = 1.25  # times the fastest: differences below say nothing on a machine that does other work
ADVICE = (
    "For each structure of the built-in suite and each relative residual: the solver that solves the largest number "
    "of problems, then the\nfastest, with the shifted geometric mean of its times. Solvers after ≈ are equally good "
    "within the noise."
)
# Paragraphs of docs/solvers.md.
INTRODUCTION = """\
`lavender.solve` accepts these names. [How to choose a solver](choose.md) recommends one, and `lv.available(problem)`
lists the solvers that accept a problem. *Laws* are the [friction models](concepts.md#laws) that the solver accepts;
it *reads* body velocities (*rows*), J and M (*generalized*), or A (*matrix*, computed from the other forms)."""
KINDS = """\
{exact} end after finitely many steps with the exact solution, up to rounding. All but {others} have the same bits after
n₁ and then n₂ iterations as after n₁ + n₂."""
BACKENDS_LISTED = """\
A *backend* is a solver of another package. Backends accept the laws linear and lcp (`clarabel_cone` also cone), and
read matrices and rows; [which one for your program](quadratic-programs.md#which-solver). The table shows results on
small programs with known solutions, for each backend alone, at its default settings: the same row twice (*repeated*),
*dependent* equalities, *contradictory* equalities, an *unbounded* objective, a *singular* P, an indefinite P that is
*convex on rows*, and an indefinite P with a *saddle*. *Wrong* names programs that are reported as solved although the
answer is wrong, *fails* solvable programs without an answer."""
BACKENDS_CALLED = """\
lavender judges every answer, so a wrong one is marked as a contradicted claim. It scales programs to numbers near 1,
removes the error of the backend's tolerance by a Newton step, passes both triangles of P, and counts a claim of
infeasibility only with a certificate. A start is passed to osqp, proxqp and daqp. `lavender solvers NAME` prints all
observations of a backend and the measures against them. ECOS, OSQP and SCS replace the handler of Ctrl-C, so they run
one solve at a time, also on several threads. Options:"""
ORDERS = """\
Options are keywords of `lavender.solve`; `lavender solvers NAME` prints their meanings. Sweep solvers
also take `order=`, the [sweep order](sweep.md#sweep-orders), `seed=` of random orders, and `ground=`, the blocks that
touch the ground, from which `bottom_up` and `top_down` count their levels if a problem is given as a matrix."""
LAW_NAMES = {
    "linear": "linear systems",
    "lcp": "bounded rows and contacts without friction",
    "coulomb": "Coulomb friction",
    "cone": "relaxed (convex) friction",
}


class Site:
    """Where pages go; a page that has not changed is not touched, so that Sphinx need not read it again."""

    def __init__(self, folder):
        self.folder = folder
        self.kept = set()

    def path(self, name):
        """Path of a file below `generated/`, with its folder made."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self.kept.add(path)
        return path

    def write(self, name, text):
        """Write a text if it differs from what is there."""
        path = self.path(name)
        text = text.rstrip() + "\n"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")

    def forget_others(self):
        """Remove what an earlier build left and this one did not write."""
        for path in self.folder.rglob("*"):
            if path.is_file() and path not in self.kept:
                path.unlink()


def join_laws(spec):
    """Laws of a spec in the order of the classes."""
    return ", ".join(law for law in LAWS if law in spec.laws)


def built_in():
    """Specs by name, without plug-ins that happen to be installed."""
    return {
        name: spec
        for name, spec in registry.specs().items()
        if _module_of(spec).startswith("lavender.")
    }


def measure(cache):
    """Measure every solver of lavender and some backends on CASES and return the records."""
    ours = [name for name, spec in built_in().items() if not spec.external]
    cache.mkdir(parents=True, exist_ok=True)
    solvers = ours + [name for name in BACKENDS if registry.specs()[name].missing() is None]
    return run(CASES, solvers, PLAN, cache / f"records-{fingerprint()}.jsonl")


def fingerprint():
    """Of the sources and the compiled kernels: records of other code are not shown as this code's."""
    digest = hashlib.sha256()
    package, kernels = Path(lv.__file__).parent, Path(lavender_ext.__file__).parent
    for path in sorted(
        [*package.rglob("*.py"), *kernels.rglob("*.px[id]"), *kernels.rglob("*.so")]
    ):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


# -- figures ----------------------------------------------------------------------------------------


def law_figures(report):
    """Law -> SVG text: performance profile over the cases of a law, lines with the solver's name as id."""
    out = {}
    times = report.get_times(report.tolerance)
    for law in LAWS:
        cases = [case for case in times if report.cases.at[case, "law"] == law]
        own = times.loc[report.accepted[cases].any(axis=1), cases] if cases else times.iloc[:0]
        if len(own):
            with tempfile.TemporaryDirectory() as folder:
                names = list(tables.rank_solvers(report, report.tolerance, cases).index)
                draw_profile(own, names, Path(folder), f"law-{law}")
                out[law] = (Path(folder) / f"law-{law}.svg").read_text(encoding="utf-8")
    return out


def highlighted(svg, solver):
    """Draw the figure with the curve of one solver in colour and the others in grey."""
    style = (
        '<style type="text/css">'
        '[id*="--"] path {stroke: #d0d0d0 !important}'
        f'[id^="{solver}--"] path {{stroke: #5b2a9d !important; stroke-width: 2 !important; '
        "stroke-dasharray: none !important}</style>"
    )
    return svg.replace("</metadata>", "</metadata>" + style, 1)


def image(path, text):
    """Return the markdown of an image of this site."""
    return f"```{{image}} {path}\n:class: figure\n:alt: {text}\n```"


# -- solvers ----------------------------------------------------------------------------------------


def abilities(spec):
    """Describe the capabilities of a spec."""
    reads = {
        "rows": "body velocities (`Problem.from_rows`)",
        "matrix": "the matrix A (formed once where it is not given)",
        "generalized": "generalised velocities (`Problem.from_jacobian`)",
    }
    yes = {
        "impulse": "starts from `impulse=`",
        "order": "`order=`, `ground=`",
        "seed": "`seed=`",
        "callback": "`callback=`",
        "history": "`history=True`",
    }
    boxes = (
        f"; boxes under {' and '.join(sorted(spec.box_friction_laws))}"
        if spec.box_friction_laws
        else ""
    )
    rows = [
        (
            "laws",
            join_laws(spec) + boxes,
        ),
        ("reads", "; ".join(text for name, text in reads.items() if name in spec.operators)),
        (
            "ends",
            "after finitely many steps or at rounding accuracy, independently of `tol`"
            if spec.exact
            else "when its convergence test at `tol` is met",
        ),
        (
            "runs",
            "in steps that can be interrupted and continued" if spec.resumable else "in one call",
        ),
        (
            "takes",
            "; ".join(text for name, text in yes.items() if getattr(spec, name))
            or "neither a start nor an order",
        ),
        ("budget", f"{spec.max_iter:,} iterations unless `max_iter=` says otherwise"),
    ]
    if spec.delegates:
        rows.append(("calls", "other solvers; its message and `work` name them"))
    if spec.requires:
        rows.append(("needs", f"`pip install {spec.install or ' '.join(spec.requires)}`"))
    if spec.reference:
        rows.append(("source", spec.reference))
    return table(("", ""), rows)


def _times(ratio):
    return f"{ratio:.2g}" if ratio < 100.0 else f"{ratio:.0f}"


def standing(report, solver):
    """Where a solver is the fastest, and where it does not arrive, in this build's measurements."""
    times = {tolerance: report.get_times(tolerance) for tolerance in TOLERANCES}
    best_residuals = tables.tabulate_runs(report).set_index(["solver", "case"])[
        "smallest residual [-]"
    ]
    rows = []
    best = {tolerance: [] for tolerance in TOLERANCES}
    for case in times[TOLERANCES[0]]:
        if (solver, case) not in best_residuals.index:
            continue
        cells = [f"`{case}`"]
        for tolerance in TOLERANCES:
            own = times[tolerance][case]
            fastest = own.drop([solver, "auto"], errors="ignore").min()
            t = own[solver]
            if t != t:
                cells.append("–")
                continue
            if not t > NEAR * fastest:
                best[tolerance].append(case)
            ratio = "" if fastest != fastest else f" ({_times(t / fastest)} ×)"
            cells.append(f"{format_seconds(t)}{ratio}")
        rows.append([*cells, format_residual(best_residuals[solver, case])])
    if not rows:
        return "Not measured here: it is not installed, or accepts none of the cases."
    lines = []
    for tolerance, cases in best.items():
        if cases:
            shown = ", ".join(f"`{c}`" for c in cases)
            lines.append(
                f"- to {format_tolerance(tolerance)} it is the fastest, or within a quarter of it, on {shown};"
            )
    if lines:
        lines[-1] = lines[-1].rstrip(";") + "."
        said = "In the measurements of this build:\n\n" + "\n".join(lines)
    else:
        said = "In the measurements of this build another solver was faster on every case, to every tolerance."
    head = ("case", *(f"to {format_tolerance(x)}" for x in TOLERANCES), "best residual")
    note = (
        "Times are of the whole call of `lv.solve`; brackets: relative to the fastest *other* solver (`auto` "
        "excluded); –: not reached."
    )
    return f"{said}\n\n{table(head, rows)}\n\n{note}"


def solver_page(site, spec, report, figures):
    """One page: formula and remarks from the module, abilities and options from the SPEC, curves from the records."""
    module = importlib.import_module(_module_of(spec))
    title = f"# {spec.name}\n\n{spec.summary[:1].upper() + spec.summary[1:]}."
    parts = [
        title,
        docstrings.markdown(module.__doc__ or ""),
        "## Problems and arguments",
        abilities(spec),
    ]
    if spec.options:
        rows = [(f"`{name}`", text) for name, text in spec.options.items()]
        parts += ["## Options", table(("option", "meaning"), rows)]
    parts += [
        "## When to use it",
        standing(report, spec.name),
        "## Performance profile",
        "The share of the cases solved within a factor of the fastest solver: its line in colour, all others in grey.",
    ]
    for name in LAWS:
        if name in spec.laws and name in figures and f'id="{spec.name}--' in figures[name]:
            file = f"figures/{spec.name}-{name}.svg"
            site.write(file, highlighted(figures[name], spec.name))
            parts += [
                f"**{LAW_NAMES[name].capitalize()}**",
                image("../" + file, f"performance profile of {spec.name} on {LAW_NAMES[name]}"),
            ]
    site.write(f"solvers/{spec.name}.md", "\n\n".join(p for p in parts if p))


def _module_of(spec):
    if isinstance(spec.factory, str):
        return spec.factory.partition(":")[0]
    function = getattr(spec.factory, "func", spec.factory)  # backends are partials of one class
    return function.__module__


def join_names(specs):
    """Return the names of solvers as text."""
    *first, last = (f"`{spec.name}`" for spec in specs)
    return f"{', '.join(first)} and {last}"


def solver_overview():
    """Return the text of docs/solvers.md: a table of all solvers, and their options."""
    specs = built_in().values()
    rows = [
        (
            f"`{s.name}`",
            "all" if set(s.laws) == set(LAWS) else join_laws(s),
            "all" if len(s.operators) == 3 else ", ".join(sorted(s.operators)),
            s.summary,
        )
        for s in specs
        if not s.external
    ]
    own = [
        (f"`{s.name}`", ", ".join(f"`{n}`" for n in s.options))
        for s in specs
        if not s.external and s.options
    ]
    others = next(s for s in specs if s.external and s.options).options
    return "\n\n".join(
        (
            "# Solvers",
            "<!-- Written by `python docs/generate.py --pages`. -->",
            INTRODUCTION,
            table(("name", "laws", "reads", "method"), rows),
            KINDS.format(
                exact=join_names(s for s in specs if not s.external and s.exact),
                others=join_names(s for s in specs if not s.external and not s.resumable),
            ),
            "## Options",
            ORDERS,
            "\n".join(f"- {name}: {options}" for name, options in own),
            "## Backends",
            BACKENDS_LISTED,
            tabulate_backends(s for s in specs if s.external),
            BACKENDS_CALLED,
            table(("option", "meaning"), [(f"`{n}`", text) for n, text in others.items()]),
        )
    )


def tabulate_backends(specs):
    """Return the table of backends, the programs that each does not solve, and the names without observations."""
    from lavender.programs import backends as b

    programs = (
        "repeated",
        "dependent",
        "contradictory",
        "unbounded",
        "singular",
        "convex_on_rows",
        "saddle",
    )
    solvable = "repeated", "dependent", "singular", "convex_on_rows"
    behaviours = {x.name: x.behaviour for x in b.BACKENDS}
    rows = []
    unseen = []
    for spec in specs:
        method = spec.summary.removesuffix(" (QP backend)")
        seen = behaviours.get(spec.name)
        if seen is None:
            unseen.append(spec)
            continue
        wrong = [n.replace("_", " ") for n in programs if getattr(seen, n) == "wrong"]
        fails = [
            n.replace("_", " ") for n in solvable if getattr(seen, n) in ("not found", "raises")
        ]
        rows.append(
            (
                f"`{spec.name}` {seen.version}",
                method,
                ", ".join(wrong),
                ", ".join(fails),
            )
        )
    seen = table(("backend", "method", "wrong", "fails"), rows)
    return f"{seen}\n\nNot observed: {join_names(unseen)}."


def tabulate_programs(lines):
    """Return the table of QP solvers by size and structure, and the errors of backends alone."""
    times = {}
    missed = {}
    alone = {}
    for line in lines:
        program = (line["structure"], line["n"])
        of = times.setdefault(program, {})
        if line["found"]:
            of.setdefault(line["solver"], []).append(line["time"])
        elif line["accepted"]:
            missed.setdefault(program, set()).add(line["solver"])
        if line["alone"] is not None:
            alone.setdefault(line["solver"], []).append(line["alone"])
    rows = []
    slow = []
    for program, of in times.items():
        medians = {name: statistics.median(t) for name, t in of.items()}
        best = min(medians.values())
        groups = ([], [], [])  # Up to 2, 10 and more times the fastest.
        for name in sorted(medians, key=medians.__getitem__):
            ratio = medians[name] / best
            groups[0 if ratio <= 2.0 else 1 if ratio <= 10.0 else 2].append(name)
        groups[2].extend(sorted(missed.get(program, set()) - set(medians)))
        name, *others = groups[0]
        structure, n = program
        if medians["auto"] > 2.0 * best:
            slow.append(f"{structure} {n} ({medians['auto'] / best:.0f} times)")
        cells = (f"**{name}** {format_seconds(best)}", *map(", ".join, (others, *groups[1:])))
        rows.append((structure, n, *cells))
    head = (
        "program",
        "variables",
        "fastest",
        "up to 2 times",
        "up to 10 times",
        "more, or not found",
    )
    errors = sorted(alone.items(), key=lambda item: max(item[1]))
    text = ", ".join(f"{name} {max(e):.0e}".replace("e-0", "e-") for name, e in errors)
    text = (
        f"Alone, at default settings, x differs by up to (relative to its largest entry): {text}."
    )
    late = f"`auto` takes more than twice the time of the fastest on: {', '.join(slow)}."
    return f"{table(head, rows)}\n\n{late}\n\n{text}"


# Paragraphs of the page of backends in the built documentation.
BACKENDS_VERDICTS = """\
*Triangle* is the part of P that is used if P is not symmetric: *all* gives a wrong answer, *none* rejects P. *Start*
has the arrays of a start that the backend uses. The program *contradictory* has no solution, *unbounded* has no
minimum, and *saddle* is not convex: *wrong* means that a saddle point is reported as solved."""
BACKENDS_NUMBERS = """\
*Linear term* is x2, and 1 is right. *Small part* is x3, and 0.5 is right. *Smallest* is the largest e of 0.1, 0.01,
..., 1e-10 that is not returned within 1 %, or 0. *Far bound* is the smallest B of 1e3, 1e4, ..., 1e19 that prevents a
solution. *Fixed multiplier* is the multiplier of x1, and -1 is right. *Infeasible x* is the first entry of x after the
program. *Conflict* is the largest d of 1, 0.1, ..., 1e-10 with which the program is reported as solved, or 0. *Offset*
is x1 - 1e8, and 0.3 is right. *Second solve* is "other" if a second solve of one object, without a start, gives other
bits: the object keeps its step size or its last answer. *Time limit* is the time that the backend's own limit counts.
Both were observed if the backend has an object with a set-up before the solve. In the other columns, *none* means that
nothing was returned."""
BACKENDS_REPEATED = """\
The bits of every backend in the tables are the same after programs of other sizes in the same process, and in four
threads that solve different programs at the same time.

ECOS, OSQP and SCS replace the handler of Ctrl-C during a solve. Two simultaneous solves of ECOS or of OSQP leave the
handler of the backend installed: `signal.getsignal` still returns Python's handler, but Ctrl-C no longer raises
KeyboardInterrupt. lavender therefore runs these three backends one solve at a time, also on several threads."""

BACKENDS_MISSING = """\
Some backends of qpsolvers have no row: `mosek` needs a licence, `nppro` has no public package, `hpipm` and `pdhcg`,
built from their sources, did not end within 100 s on the program *convex on rows*. `qpoases` and `qpswift` have no
package either, and were observed with builds of their sources."""


def backend_observations():
    """Return the parts of the page of backends that list their observed behaviour."""
    from lavender.programs import backends as b

    seen = [x for x in b.BACKENDS if x.behaviour is not None]
    verdicts = ["version", "triangle", "start", "repeated", "dependent", "contradictory"]
    verdicts += ["unbounded", "singular", "convex_on_rows", "saddle"]
    numbers = [
        "linear_term",
        "small_part",
        "smallest",
        "far_bound",
        "fixed_multiplier",
        "infeasible_x",
    ]
    numbers += ["conflict", "offset"]
    numbers += ["second_solve", "time_limit"]

    def cell(value):
        return "none" if value is None else value if isinstance(value, str) else f"{value:g}"

    def observed(names):
        rows = [(f"`{x.name}`", *(cell(getattr(x.behaviour, n)) for n in names)) for x in seen]
        return table(("backend", *(n.replace("_", " ") for n in names)), rows)

    def texts(head, by_name):
        return table(head, [(name.replace("_", " "), text) for name, text in by_name.items()])

    notes = [
        f"- `{x.name}` {x.behaviour.version}: {text}"
        for x in seen
        for text in x.behaviour.notes.values()
    ]
    return [
        "## Solvable and unsolvable programs",
        observed(verdicts),
        BACKENDS_VERDICTS,
        "## Accuracy",
        observed(numbers),
        BACKENDS_NUMBERS,
        BACKENDS_REPEATED,
        "## Programs",
        texts(("name", "program"), b.PROBE_PROGRAMS),
        "## Other observations",
        "\n".join(notes),
        "## Remedies in lavender",
        texts(("observation", "lavender"), b.ADAPTER_REMEDIES),
        BACKENDS_MISSING,
    ]


def load_engine_facts():
    """Return the facts about engines that probes check."""
    sys.path.insert(0, str(ROOT / "findings" / "probes"))
    from engine_facts import load_facts

    return load_facts()


def engine_arrays_page(site):
    """Write the page of all facts about engines."""
    parts = [
        "# Engines: what their arrays mean",
        "Facts that are easily guessed wrong, each found with the version in its heading and checked by a test.",
    ]
    for engine, group in itertools.groupby(load_engine_facts(), lambda f: f.engine):
        facts = list(group)
        rows = [(f.subject, f.text, f.handling) for f in facts]
        parts += [f"## {engine} {facts[0].version}", table(("subject", "fact", "lavender"), rows)]
    site.write("engine-arrays.md", "\n\n".join(parts))


def solver_pages(site, report, figures):
    """Write the page of each built-in solver, and one page for the backends."""
    specs = built_in()
    ours = [s for s in specs.values() if not s.external]
    others = [s for s in specs.values() if s.external]
    for spec in ours:
        solver_page(site, spec, report, figures)
    parts = [
        "# Backends of other packages",
        docstrings.markdown(sys.modules["lavender.programs.backends"].__doc__),
        "Each runs under its own name. One that is not installed says what to install. Options of all of them:",
        table(
            ("option", "meaning"),
            [(f"`{n}`", t) for n, t in next(s for s in others if s.options).options.items()],
        ),
    ]
    for s in others:
        parts += [f"## {s.name}", f"{s.summary[:1].upper() + s.summary[1:]}.", abilities(s)]
        if (report.frame["solver"] == s.name).any():
            parts.append(standing(report, s.name))
    parts += backend_observations()
    site.write("solvers/backends.md", "\n\n".join(parts))


# -- measured ---------------------------------------------------------------------------------------


def by_structure(report):
    """Return the report's table of the fastest solvers for each structure as markdown."""

    def cells(row):
        pairs = list(row)[3 : 3 + 2 * len(report.tolerances)]
        for names, number in zip(pairs[::2], pairs[1::2], strict=True):
            first, _, ties = names.partition(" ≈ ")
            number = "" if number != number else f" {format_seconds(number)}"
            yield f"**{first}**{number}" + (f"<br>≈ {ties.replace(' ≈ ', ', ')}" if ties else "")

    frame = tables.tabulate_structures(report)
    rows = [
        (f"{row[0].replace(' / ', '<br>')}<br>{row[1]} cases", *cells(row))
        for row in frame.itertuples(index=False)
    ]
    heads = [f"to {format_tolerance(x)}" for x in report.tolerances]
    return f"{ADVICE}\n\n{wide(table(('structure', *heads), rows))}"


def measured_page(site, report, figures):
    """Advice by structure and law from the records of this build, the curves behind it, and their report."""
    run = report.machine
    structures = f"{by_structure(report)}\n\n[A report's page](report.html) shows the same records."
    site.write("report.html", report.make_page().render())
    shown = ", ".join(f"{n} {v}" for n, v in run["versions"].items())
    drawn = []
    for law in LAWS:
        if law in figures:
            site.write(f"figures/all-{law}.svg", figures[law])
            shot = image(f"figures/all-{law}.svg", f"performance profile on {LAW_NAMES[law]}")
            drawn += [f"## {LAW_NAMES[law].capitalize()}", shot]
    parts = [
        "# Measured in this build",
        (
            f"{len(report.runs)} runs on {len(report.cases)} cases of `lavender.suite`, made while these pages were "
            f"built: {run['cpu']}, {run['threads']} thread,\nlavender {run['lavender']}, Python {run['python']}, "
            f"{shown}. "
            f"Minimum of {PLAN.repeats} repeats of the whole call of `lv.solve`,\nat most "
            f"{format_seconds(PLAN.time_limit)} a solve. This is a small measurement, not a benchmark: "
            "`lavender report` on your own problems says more. "
            "Every run, mean and claim, with the cases, is in\n[the report](report.html) of these records."
        ),
        "## By structure",
        structures,
        *drawn,
    ]
    site.write("measured.md", "\n\n".join(parts))


def wide(*tables):
    """Return tables in a block that scrolls in the built pages; on a forge the marks are not shown."""
    return "\n\n".join(('<div class="wide">', *tables, "</div>"))


def measured_tables(report):
    """Return the tables that are checked in, by the name of their place in a page."""
    run = report.machine
    note = (
        f"Measured with {len(report.runs)} runs on {len(report.cases)} cases ({run['cpu']}, {run['threads']} thread, "
        f"Python {run['python']}) by\n`python docs/generate.py --tables`."
    )
    return {"by_structure": f"{by_structure(report)}\n\n{note}"}


def fill_tables(text, tables):
    """Return a page with the text between `<!-- table: NAME -->` and `<!-- end of table -->` replaced."""
    return re.sub(
        r"(?<=<!-- table: )(\w+) -->.*?(?=<!-- end of table -->)",
        lambda found: f"{found[1]} -->\n\n{tables[found[1]]}\n\n",
        text,
        flags=re.DOTALL,
    )


def replace_tables(page, tables):
    """Replace the tables of the file of a page."""
    page.write_text(fill_tables(page.read_text(encoding="utf-8"), tables), encoding="utf-8")


# -- examples, scenes, cases, parts -----------------------------------------------------------------


def example_page(site, cache):
    """Every example: its docstring, what it prints, its figure, its source."""
    parts = [
        "# Output of the examples",
        "Those that need no simulator are run when these pages are built; a test checks what each shows.",
    ]
    for path in sorted((ROOT / "examples").glob("*.py")):
        spec = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        if not inspect.signature(
            module.main
        ).parameters:  # draws nothing, and needs what may not be installed
            first, _, rest = inspect.cleandoc(module.__doc__).partition("\n")
            source = f"Source: `examples/{path.name}`."
            parts += [f"## {path.stem}", f"**{first}**", docstrings.markdown(rest), source]
            continue
        printed = io.StringIO()
        if hasattr(module, "PANELS"):
            files = [f"figures/{path.stem}/{panel}.svg" for panel in module.PANELS]
            found = module.numbers()
            with contextlib.redirect_stdout(printed):
                module.print_numbers(found)
            for file in files:
                save(module.PANELS, found, str(site.path(file)))
            figure = site.path(files[0])
        else:
            files = [f"figures/example-{path.stem}.svg"]
            figure = site.path(files[0])
            with contextlib.redirect_stdout(printed):
                module.main(str(figure))
        first, _, rest = inspect.cleandoc(module.__doc__).partition("\n")
        rest = re.sub(r"\n+ +python examples/\S+ .*", "", rest)
        output = "\n".join(
            line for line in printed.getvalue().splitlines() if str(figure) not in line
        )
        output = output.replace(str(figure), figure.name)
        parts += [
            f"## {path.stem}",
            f"**{first}**",
            docstrings.markdown(rest),
            *(image(file, first) for file in files),
            f"```text\n{output}\n```",
            f"Source: `examples/{path.name}`.",
        ]
    site.write("examples.md", "\n\n".join(p for p in parts if p))


def _signature(function, leave=()):
    shown = []
    for name, p in inspect.signature(function).parameters.items():
        if name in leave:
            continue
        shown.append(name if p.default is inspect.Parameter.empty else f"{name}={p.default!r}")
    return ", ".join(shown)


def tabulate_scenes():
    """Return the table of the gallery of docs/engine.md."""
    lines = ["| scene, with its own parameters | description |", "|---|---|"]
    for name, build in SCENES.items():
        if build.__module__ != "lavender.sim.scene.gallery":  # a scene of a user or of a doctest
            continue
        text = docstrings.markdown(build.__doc__).partition("\n\n")[0].replace("|", "\\|")
        lines.append(f"| `{name}({_signature(build, ('scene',))})` | {' '.join(text.split())} |")
    return "\n".join(lines)


def suite_page(site):
    """Families and sets of cases."""
    parts = [
        "# Cases",
        (
            '`lavender.suite` makes problems from a name: `suite.case("pyramid(k=10, mass_ratio=1e6)")`, or the '
            "same text "
            "on the command\nline. Each says why it is there; where the exact solution is known, "
            "`case.reference` holds it."
        ),
        "## Families",
    ]
    seen = set()
    for name, family in sorted(suite.FAMILIES.items()):
        if family.make in seen:
            continue
        seen.add(family.make)
        others = [
            f"`{f.name}`"
            for f in suite.FAMILIES.values()
            if f.make is family.make and f.name != name
        ]
        text = next(t for t in suite.families() if t.partition("(")[0] == name)
        also = f"\n\nAlso as {', '.join(others)}." if others else ""
        parts += [f"### {name}", f"`{text}`", docstrings.markdown(family.make.__doc__ or "") + also]
    parts.append("## Sets")
    for name, cases in suite.SETS.items():
        parts += [f"`{name}`: {len(cases)} cases.", ", ".join(f"`{c}`" for c in cases) + "."]
    site.write("cases.md", "\n\n".join(parts))


def write_figures(folder):
    """Write the figures that pages show and that are checked in."""
    folder.mkdir(parents=True, exist_ok=True)
    stability.figure(folder / "stability.png")
    for name in FIGURES:
        spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        with contextlib.redirect_stdout(io.StringIO()):
            module.main(str(folder / f"{name}.png"))


#: Public modules beside `lavender` itself that have a page of their own in the interface.
API_MODULES = ("io", "suite", "report", "judge.certificates")
#: Package that defines a name of `lavender` -> title of the page that documents it, in the order of the contents.
API_TITLES = {
    "solving": "Solve",
    "problem": "Problems",
    "judge": "Judge",
    "batch": "Batches",
    "programs": "Quadratic programs",
    "gradient": "Derivatives",
    "causes": "Causes of differences between engines",
    "diagnostics": "Diagnostics",
    "solvers": "Registry of solvers",
    "audit": "Audit",
    "report": "Compare solvers",
    "sim": "LavenderSim",
    "io": "Files",
    "base": "Errors",
}
#: Names with which a page begins; the others follow in alphabetical order.
API_FIRST = ("solve", "prepare", "Problem", "Solution", "Residual", "residual")


def list_public_names():
    """Return (title, module, names) of each page of the interface: `lavender` by package, then other modules."""
    by_title = {title: [] for title in dict.fromkeys(API_TITLES.values())}
    for name in sorted(lv.__all__):
        thing = getattr(lv, name)
        if callable(thing):  # no constants, no modules
            package = thing.__module__.split(".")[1]
            by_title[API_TITLES[package]].append(name)
    for title, names in by_title.items():
        if names:
            first = [name for name in API_FIRST if name in names]
            yield title, lv, [*first, *(name for name in names if name not in first)]
    for module in API_MODULES:
        held = importlib.import_module(f"lavender.{module}")
        things = {
            name: getattr(held, name) for name in sorted(held.__all__) if name not in suite.FAMILIES
        }
        names = [
            name
            for name, thing in things.items()
            if callable(thing) and getattr(lv, name, None) is not thing
        ]
        yield f"lavender.{module}", held, names


def api_pages(site):
    """Write one page for each group of public names, and their contents."""
    pages = []
    for title, held, names in list_public_names():
        parts = [f"# {title}"]
        for name in names:
            thing = getattr(held, name)
            kind, members = "autofunction", ""
            if inspect.isclass(thing):
                plain = issubclass(thing, (Exception, lv.Status))
                kind = "autoclass"
                members = "" if plain else "\n   :members:"
            parts.append(f"```{{eval-rst}}\n.. {kind}:: {held.__name__}.{name}{members}\n```")
        page = re.sub(r"\W+", "-", title.lower())
        site.write(f"api/{page}.md", "\n\n".join(parts))
        pages.append((title, f"api/{page}", names))
    parts = [
        "# Python interface",
        "All arrays are float64 and C-contiguous. Begin with `solve`, `Problem` and `Solution`.",
    ]
    parts += [
        "\n".join(
            f"- [{title}]({page}.md): {', '.join(f'`{name}`' for name in names)}"
            for title, page, names in pages
        )
    ]
    parts += ["\n".join(["```{toctree}", ":hidden:", "", *(page for _, page, _ in pages), "```"])]
    site.write("api.md", "\n\n".join(parts))


def write(source, cache):
    """Write every generated page below `source`/generated; records are kept in `cache`."""
    site = Site(Path(source) / "generated")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of backends that talk while they are measured
        report = Report(measure(Path(cache)))
    figures = law_figures(report)
    solver_pages(site, report, figures)
    measured_page(site, report, figures)
    example_page(site, cache)
    suite_page(site)
    engine_arrays_page(site)
    api_pages(site)
    site.forget_others()


def committed_pages():
    """Return the texts of the pages that are checked in, by file name."""
    pages = {"solvers.md": solver_overview()}
    text = (Path(__file__).resolve().parent / "engine.md").read_text(encoding="utf-8")
    pages["engine.md"] = fill_tables(text, {"scenes": tabulate_scenes()})
    text = (Path(__file__).resolve().parent / "quadratic-programs.md").read_text(encoding="utf-8")
    record = Path(__file__).resolve().parent / "static" / "backends.json"
    lines = json.loads(record.read_text(encoding="utf-8"))["lines"]
    pages["quadratic-programs.md"] = fill_tables(text, {"backends": tabulate_programs(lines)})
    return {name: text.rstrip() + "\n" for name, text in pages.items()}


def main():
    """Run the command line that the docstring of this module describes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--pages", action="store_true", help="rewrite the pages of docs/ that are made from tables"
    )
    parser.add_argument(
        "--tables", action="store_true", help="measure; rewrite tables and figures of pages"
    )
    chosen = parser.parse_args()
    here = Path(__file__).resolve().parent
    if chosen.pages:
        for name, text in committed_pages().items():
            (here / name).write_text(text, encoding="utf-8")
    if chosen.tables:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of backends
            tables = measured_tables(measure(here / "_build"))
        replace_tables(here / "choose.md", tables)
        write_figures(here / "static" / "examples")
    if not (chosen.pages or chosen.tables):
        write(here, here / "_build")


if __name__ == "__main__":
    main()
