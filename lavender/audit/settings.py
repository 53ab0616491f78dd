"""Settings of MuJoCo: options that differ from the model's, and lines to copy."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

MERGE_NOTE = (
    "Add the line after the model's own <option>: MuJoCo merges both, and a later attribute replaces an earlier one. "
    "If the line replaces the model's own <option>, its integrator and time step are lost."
)
# Prefixes of the names of MuJoCo's enumerators; the remaining part of a name is the MJCF keyword.
ENUMS = {"solver": "mjSOL_", "cone": "mjCONE_", "jacobian": "mjJAC_"}
OPTIONS = ("solver", "iterations", "tolerance", "ls_iterations", "ls_tolerance", "jacobian")
PROBLEM_OPTIONS = ("cone", "impratio", "noslip_iterations")  # Options that change the problem.


@dataclass(frozen=True)
class MujocoSetting:
    """Attributes of MuJoCo's `<option>` that differ from the model's."""

    options: tuple[tuple[str, Any], ...] = ()  # tuple of (str, value)
    is_default: bool = field(
        default=False, compare=False
    )  # Whether these are MuJoCo's default options.
    iterations: int = field(
        default=0, compare=False
    )  # Iteration limit, also if it is the model's own.

    @classmethod
    def from_options(cls, mj: Any, model: Any, **options: Any) -> MujocoSetting:
        """Create the setting of the options that differ from the model's, in the order of `OPTIONS`."""
        has = {name: get_option_value(mj, model, name) for name in (*OPTIONS, *PROBLEM_OPTIONS)}
        return cls(
            tuple(
                (name, options[name]) for name in has if options.get(name, has[name]) != has[name]
            ),
            iterations=options.get("iterations", has["iterations"]),
        )

    @property
    def short_name(self) -> str:
        """Options without the syntax of MJCF, for tables; or "MuJoCo's defaults"."""
        values = ((name, f"{x:g}" if isinstance(x, float) else str(x)) for name, x in self.options)
        short = " ".join(f"{name}={x}" for name, x in values) or "model's own setting"
        return f"MuJoCo's defaults ({short})" if self.is_default else short

    @property
    def changes_problem(self) -> bool:
        """Whether the setting changes the constraint problem, and not only how it is solved."""
        return any(name in PROBLEM_OPTIONS for name, _ in self.options)

    def apply_to(self, mj: Any, model: Any) -> Any:
        """Return a copy of the model with these options."""
        configured = copy.copy(model)
        for name, x in self.options:
            kind = ENUMS.get(name)
            setattr(
                configured.opt, name, x if kind is None else _map_keywords_to_values(mj, name)[x]
            )
        return configured

    @property
    def option_line(self) -> str:
        """`<option>` line to copy into the model; empty if no option differs."""
        texts = (
            f'{name}="{x:g}"' if isinstance(x, float) else f'{name}="{x}"'
            for name, x in self.options
        )
        return f"<option {' '.join(texts)}/>" if self.options else ""


def _map_keywords_to_values(mj: Any, name: str) -> dict[str, Any]:
    """Return {MJCF keyword: MuJoCo's value} of an enumerated option."""
    members: dict[str, Any] = getattr(mj, f"mjt{name.capitalize()}").__members__
    keywords = {"NEWTON": "Newton", "CG": "CG", "PGS": "PGS"}
    short = ((key.removeprefix(ENUMS[name]), value) for key, value in members.items())
    return {keywords.get(key, key.lower()): value for key, value in short}


def get_option_value(mj: Any, model: Any, name: str) -> Any:
    """Return the model's value of an option as MJCF writes it."""
    x = getattr(model.opt, name)
    if name not in ENUMS:
        return float(x) if isinstance(x, float) else int(x)
    return next(
        word for word, value in _map_keywords_to_values(mj, name).items() if int(value) == int(x)
    )
