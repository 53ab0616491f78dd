"""Common parts of the commands: option types, options of a plan, console output."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from lavender.base.errors import InputError, LavenderError
from lavender.base.exits import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_UNMET
from lavender.cli.completion import complete_file_or_word, complete_solver

if TYPE_CHECKING:
    from rich.console import Console

    from lavender.report import Item

    # Type checkers need the generic form of click 8.2, which 8.1 does not have.
    _ParamType = click.ParamType[Any]
else:
    _ParamType = click.ParamType

MIN_TERMINAL_WIDTH = 60  # [columns] Tables are formatted for at least this width.
PATH = click.Path(path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
Option = tuple[
    tuple[str, ...], dict[str, Any]
]  # Positional (names) and keyword arguments of `click.option`.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)
NUMBER = re.compile(r"[\d.]+(e[-+]?\d+)?", re.IGNORECASE)  # Matches a word of a list of numbers.


class ListType(_ParamType):
    """Option type: values of another type, separated by commas or blanks."""

    def __init__(self, kind: Any) -> None:
        self.kind = click.types.convert_type(kind)  # str, int and float are types, too.
        self.name = "x,x,..." if kind in (int, float) else "a,b,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the values as a tuple."""
        words = value.replace(",", " ").split() if isinstance(value, str) else value
        return tuple(self.kind.convert(word, param, ctx) for word in words)


def _is_solver(word: str) -> bool:
    """Return whether a word names a solver, perhaps misspelt, and no family of the suite and no file."""
    from lavender import suite

    return (
        word not in suite.FAMILIES and not set(word) & set("(*?[/\\.") and not Path(word).exists()
    )


class ListCommand(click.Command):
    """Command that takes lists with blanks, `--budgets 4 8`, as well as with commas, `--budgets 4,8`."""

    #: Options with lists: whether a word after the first one belongs to the list.
    TESTS: Mapping[str, Callable[[str], Any]] = {
        **dict.fromkeys(("--tolerances", "--budgets", "--time-budgets"), NUMBER.fullmatch),
        "--solvers": _is_solver,
    }

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Join the words of each list by commas, then parse as click does."""
        joined: list[str] = []
        belongs: Callable[[str], Any] | None = None
        for i, word in enumerate(args):
            if (
                belongs
                and args[i - 1] not in self.TESTS
                and not word.startswith("-")
                and belongs(word)
            ):
                joined[-1] += f",{word}"
                continue
            joined.append(word)
            if word in self.TESTS:
                belongs = self.TESTS[word]
            elif i == 0 or args[i - 1] not in self.TESTS:
                belongs = None
        return super().parse_args(ctx, joined)


def limit_to_one_thread() -> None:
    """Limit numerical libraries that are loaded later to one thread.

    `lavender.report.timing` limits libraries that are loaded already, while it measures.
    """
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, "1")


def make_console(stderr: bool = False) -> Console:
    """Return a console that does not cut off names; in a file or pipe, lines are as long as the tables need."""
    from rich.console import Console

    has_width = (
        Console(stderr=stderr).is_terminal or os.environ.get("COLUMNS", "0").strip("0").isdigit()
    )
    width = max(shutil.get_terminal_size().columns, MIN_TERMINAL_WIDTH) if has_width else 10_000
    return Console(stderr=stderr, width=width)


def is_option_set(context: click.Context, name: str) -> bool:
    """Return whether an option is set on the command line or in the environment, with any value."""
    return context.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT)


def add_options(
    options: Sequence[Option], **common: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds options to a command in this order, all with the settings `common`."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for names, settings in reversed(options):
            command = click.option(*names, **common, **settings)(command)
        return command

    return decorate


def add_worlds_options(
    worlds: int | None,
    steps: int,
    control: str = "random",
    default_worlds: str = "as many as take about a minute",
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator with the options for simulating worlds of a MuJoCo model; the arguments are defaults.

    `default_worlds` says how many worlds there are if `worlds` is None.
    """
    options: list[Option] = [
        (
            ("--worlds",),
            {
                "default": worlds,
                "type": int,
                "help": "Number of worlds; the first is the one of `lavender record`."
                + f" Default: {default_worlds}." * (worlds is None),
            },
        ),
        (("--steps",), {"default": steps, "help": "Steps of each world."}),
        (
            ("--spread",),
            {
                "default": None,
                "type": float,
                "metavar": "M/S",
                "help": "Standard deviation by which the initial velocities of the other worlds differ. "
                "Default: the largest of 0.1, 0.01, 0.001 and 0 with which trial worlds do not diverge.",
            },
        ),
    ]
    for names, more in RECORDING_OPTIONS:
        if names[0] in ("--controls", "--seed", "--states"):
            own = {"default": control} if names[0] == "--controls" else {}
            options.append((names, more | own))
    return add_options(options, show_default=True)


def reject_options_without_effect(context: click.Context, **conditions: Any) -> None:
    """Raise InputError if an option is set that has no effect under one of the `conditions` that are true.

    The conditions are keys of `OPTIONS_WITHOUT_EFFECT`.
    """
    for name, (words, names) in OPTIONS_WITHOUT_EFFECT.items():
        for parameter in context.command.params if conditions.get(name) else ():
            is_listed = (
                parameter.name in names if names[0] != "all but" else parameter.name not in names
            )
            if parameter.name and is_listed and is_option_set(context, parameter.name):
                raise InputError(f"{parameter.opts[0]} has no effect {words}: leave it out")


#: Option of commands that judge solutions of an engine.
precision_option = click.option(
    "--precision",
    type=click.Choice(["float64", "float32"]),
    help="Precision in which the engine computed its solutions; default: the precision of the problem, or float64.",
)
THRESHOLD: Option = (
    ("--threshold",),
    {
        "type": float,
        "default": 1e-6,
        "help": "Velocity error [m/s] up to which an engine's solution is close enough.",
    },
)
threshold_option = add_options([THRESHOLD], show_default=True)
#: Option of the commands with pages that compare with a velocity error.
LIMIT: Option = (
    ("--max-velocity-error",),
    {
        "type": float,
        "metavar": "M/S",
        "help": "Velocity error with which the page compares [m/s, rad/s on angular rows]; default: 1 mm/s. If given, "
        "an audit exits with 1 above it, and tune recommends a setting within it.",
    },
)
limit_option = add_options([LIMIT])
#: Option of the commands that write a page.
quiet_option = click.option(
    "-q", "--quiet", is_flag=True, help="Print only the path of the page, and errors."
)
#: Option of the commands that simulate worlds in processes.
workers_option = click.option(
    "--workers", type=int, default=-1, help="Processes, for mujoco; -1: one for each core."
)
#: Options of all commands that simulate and record a MuJoCo model.
RECORDING_OPTIONS: tuple[Option, ...] = (
    (("--steps",), {"default": 500, "help": "MODEL.xml: number of simulation steps."}),
    (("--record-every", "every"), {"default": 5, "help": "MODEL.xml: record every n-th step."}),
    (
        ("--controls", "control"),
        {
            "default": "random",
            "metavar": "zero|random|hold|FILE",
            "shell_complete": complete_file_or_word("zero", "random", "hold"),
            "help": "MODEL.xml: its controls. hold: those of the start state. FILE: .npy of shape "
            "(any, nu), repeated.",
        },
    ),
    (("--seed",), {"default": 0, "help": "MODEL.xml: seed of random controls."}),
    (
        ("--states",),
        {
            "default": None,
            "metavar": "FILE|keyframes",
            "shell_complete": complete_file_or_word("keyframes"),
            "help": "MODEL.xml: start from these states. FILE: an .npz, best with `state`, vectors of "
            "mjSTATE_INTEGRATION (with warm start and controls) in its rows; else qpos and qvel, and other "
            "arrays of MjData, such as `lavender audit` writes. keyframes: the keyframes of the model.",
        },
    ),
)
# Parameters of RECORDING_OPTIONS.
RECORDING_NAMES = ("steps", "every", "control", "seed", "states", "threshold")
recording_options = add_options([THRESHOLD, *RECORDING_OPTIONS], show_default=True)
#: Conditions under which options have no effect: the words of the message, and the options' parameters.
OPTIONS_WITHOUT_EFFECT: dict[str, tuple[str, tuple[str, ...]]] = {
    "is_list": ("with --list", ("all but", "listed")),
    "shows_records": (
        "if records are shown again, since nothing is solved",
        (
            "all but",
            "files",
            "out",
            "compare",
            "time_budgets",
            "tables",
            "no_figures",
            "solvers",
            "figure_kinds",
            "columns",
            "quiet",
        ),
    ),
    "is_campaign": (
        "with --workers, which measures no times and ends by iterations",
        ("repeats", "time_limit", "sequence_time_limit", "time_budgets", "sequence"),
    ),
    "sweeps": (
        "with --sweeps, which measures fixed numbers of sweeps",
        ("tolerances", "repeats", "time_budgets", "workers", "backend"),
    ),
    "without_model": ("without a MODEL.xml", RECORDING_NAMES),
    "without_random": ("without --controls random", ("seed",)),
    "without_record": ("without --record", ("replace",)),
    "without_budgets": ("on solvers that cannot stop after any iteration", ("budgets",)),
    "other_engine": ("with another --engine than mujoco", ("workers", "backend", "precision")),
}

#: Options of the commands that measure, as fields of `lavender.report.Plan`.
PLAN_OPTIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    (
        "--solvers",
        {
            "type": ListType(str),
            "shell_complete": complete_solver,
            "help": "Solvers by name; default: all that are installed.",
        },
    ),
    (
        "--tolerances",
        {
            "type": ListType(float),
            "default": "1e-3,1e-6,1e-9",
            "show_default": True,
            "help": "Relative residuals to reach.",
        },
    ),
    (
        "--budgets",
        {
            "type": ListType(int),
            "default": "4,8,16,32,64",
            "show_default": True,
            "help": "Numbers of iterations to run exactly.",
        },
    ),
    (
        "--repeats",
        {
            "type": int,
            "default": 3,
            "show_default": True,
            "help": "Repetitions of each solve; minimum and median are recorded.",
        },
    ),
    (
        "--time-limit",
        {
            "type": float,
            "default": None,
            "metavar": "S",
            "help": "Limit of one solve; default: 1 s, or 0.25 s for the built-in suite.",
        },
    ),
    (
        "--sequence-time-limit",
        {
            "type": float,
            "default": None,
            "metavar": "S",
            "help": "Time limit of a solver over all steps of a sequence with one setting; default: 5 s.",
        },
    ),
)
plan_options = add_options([((name,), more) for name, more in PLAN_OPTIONS])


def escape_markup(text: str) -> str:
    """Return text with rich's markup escaped and control characters written as their codes."""
    from rich.markup import escape

    from lavender.report.text import escape_unprintable

    return escape(escape_unprintable(text, lines=True))


def print_escaped(text: str, err: bool = False, style: str = "") -> None:
    """Print text that may contain names of files and problems; control characters are written as their codes."""
    from lavender.report.text import escape_unprintable

    if style:
        make_console(err).print(escape_markup(text), style=style, highlight=False, soft_wrap=True)
    else:
        click.echo(escape_unprintable(text, lines=True), err=err)


def exit_after_interrupt() -> NoReturn:
    """Exit with the code of Ctrl-C. Commands call this after they have written the completed part."""
    print_escaped("Stopped: the results contain only the completed part.", style="yellow")
    raise click.exceptions.Exit(EXIT_INTERRUPTED)


class ErrorReporter:
    """Handles the errors of the problems of a command: it prints them and determines the exit code.

    An instance is called with each problem and returns a context manager for the work on it.
    """

    def __init__(self, report: Callable[[str], Any] | None = None) -> None:
        self.report = report or partial(print_escaped, err=True)
        self.code = 0

    @contextlib.contextmanager
    def __call__(self, item: Item) -> Iterator[None]:
        """Print errors that the block raises for one problem, and release the problem's memory at the end."""
        try:
            yield
        except LavenderError as error:
            self.report(f"{item.name}: {error}")
            is_bad_argument = isinstance(error, InputError) and item.named
            self.code = max(self.code, EXIT_BAD_INPUT if is_bad_argument else EXIT_UNMET)
        finally:
            item.release_problem()

    def exit(self, unmet: Any = False) -> None:
        """Exit with 2 if a named problem could not be read, else with 1 after another error or if `unmet` is true."""
        if code := self.code or (EXIT_UNMET if unmet else 0):
            raise click.exceptions.Exit(code)


def parse_parameters(assignments: tuple[str, ...]) -> dict[str, Any]:
    """Return {"n": 20} for `n=20`. Values are numbers, true, false, none, or else texts."""
    parameters: dict[str, Any] = {}
    for word in assignments:
        name, equals, value = word.partition("=")
        if not equals or not name:
            raise InputError(
                f"--set {word!r} has no name or no value; NAME=VALUE is needed, such as n=4"
            )
        constants = {"true": True, "false": False, "none": None}
        if value.lower() in constants:
            parameters[name] = constants[value.lower()]
            continue
        try:
            parameters[name] = float(value) if not value.lstrip("+-").isdigit() else int(value)
        except ValueError:
            parameters[name] = value
    return parameters
