"""Test problems with the reason for each and its known solution: parametric families, named cases, and sets of cases.

```python
from lavender import suite

case = suite.pyramid(k=10, mass_ratio=1e6)
case = suite.case("pyramid(k=10, mass_ratio=1e6)")      # the same by name
case.problem, case.reason, case.reference
suite.families()                                        # every family with its parameters
suite.cases("default"), suite.cases("@hard")            # sets, or a single name
```
"""

from __future__ import annotations

from collections.abc import Iterator

from lavender.base.errors import UnknownName
from lavender.suite import friction, hard
from lavender.suite.case import (
    FAMILIES,
    MAX_SIZE,
    Case,
    Reference,
    format_parameter_value,
    parse_case_name,
)
from lavender.suite.families import (
    box_stack,
    boxed_friction,
    chain,
    granular,
    hang,
    pyramid,
    random_spd,
    stack,
    toy_stack,
    two_particles,
)
from lavender.suite.steps import (
    engine_step,
    explain_missing_packages,
    robot,
    walking,
)

__all__ = [
    "FAMILIES",
    "MAX_SIZE",
    "SETS",
    "Case",
    "Reference",
    "box_stack",
    "boxed_friction",
    "case",
    "cases",
    "chain",
    "default",
    "engine_step",
    "explain_missing_packages",
    "families",
    "friction",
    "get_case_names_of_set",
    "granular",
    "hang",
    "hard",
    "parse_case_name",
    "pyramid",
    "random_spd",
    "robot",
    "stack",
    "toy_stack",
    "two_particles",
    "walking",
]
__dir__ = sorted(__all__).copy  # Completion shows public names only.

# Models of each package in the set "robots".
ROBOTS = {
    "gymnasium": (
        "ant",
        "half_cheetah",
        "hopper",
        "humanoid",
        "humanoidstandup",
        "pusher_v5",
        "walker2d_v5",
    ),
    "dm_control": (
        "cheetah",
        "dog",
        "humanoid",
        "humanoid_CMU",
        "manipulator",
        "quadruped",
        "stacker",
        "walker",
    ),
}

#: Sets of cases by name. `lavender report` without files runs "default": one case for each property that separates
#: solvers, small enough for all of them.
SETS: dict[str, tuple[str, ...]] = {
    "default": (
        *("two_particles", "toy_stack", "stack(n=64)", "chain(n=33, tip_mass=1e4)", "hang(n=33)"),
        *("random_spd(n=100, condition=1e4)", "box_stack(n=10)", "box_stack(n=10, mass_ratio=1e6)"),
        *("pyramid(k=10)", "pyramid(k=10, mass_ratio=1e3)", "granular(n=4)", "granular(n=9)"),
        *("boxed_friction(n=3, scene=granular)", "box_stackF(n=10)", "pyramidF(k=6, sliding=0.5)"),
        *("granularF(n=3, sliding=0.5)", "granular(n=4, friction=cone)"),
    ),
    "hard": hard.SET,
    # Coulomb's law on about 3,000 and 20,000 rows, at rest and sliding.
    "large": (
        *("granularF(n=6)", "granularF(n=6, sliding=0.5)", "granularF(n=6, sliding=2, seed=4)"),
        *("wall(n=10)", "wall(n=10, sliding=0.5)", "pyramidF(k=16)", "pyramidF(k=16, sliding=0.5)"),
        *(
            "granularF(n=11)",
            "granularF(n=11, sliding=0.5)",
            "pyramidF(k=40)",
            "pyramidF(k=40, sliding=0.5)",
        ),
        *("wall(n=25)", "wall(n=25, sliding=0.1)", "wall(n=25, sliding=0.5)"),
    ),
    "engine": tuple(
        f"engine_step(scene={scene}, at={at})"
        for scene in ("stack", "pyramid", "bridge", "four_bar", "heavy_on_light", "table")
        for at in (3, 30)
    ),
    "walking": tuple(f"walking(seed={i})" for i in range(12)),
    "robots": tuple(
        f"robot(package={package}, model={model}, cone={cone}, at={at})"
        for package, models in ROBOTS.items()
        for model in models
        for cone in ("pyramidal", "elliptic")
        for at in (200, 400)
    ),
    "sequences": tuple(
        f"robot(package=gymnasium, model={model}, cone={cone}, at={at})"
        for model in ("ant", "humanoid")
        for cone in ("pyramidal", "elliptic")
        for at in range(200, 208)
    ),
}


def families() -> dict[str, str]:
    """Return {"name(parameter=default, ...)": one-line summary} of every family."""
    out = {}
    for f in FAMILIES.values():
        free = ((n, p.default) for n, p in f.signature.parameters.items() if n not in f.preset)
        shown = [f"{n}={format_parameter_value(value)}" for n, value in free]
        out[f"{f.name}({', '.join(shown)})"] = f.summary
    return out


def case(text: str) -> Case:
    """Build the case of a name such as "stack(n=64)"; missing parameters have their defaults.

    Raises
    ------
    UnknownName
        The family or parameter is unknown; the nearest names are listed.
    InputError
        The text is not a name with parameters, or a value is out of range.
    """
    name, values = parse_case_name(text)
    if name not in FAMILIES:
        raise UnknownName("case", name, [*FAMILIES, *SETS])
    family = FAMILIES[name]
    known = [
        parameter for parameter in family.signature.parameters if parameter not in family.preset
    ]
    for parameter in values:
        if parameter not in known:
            raise UnknownName(f"parameter of {name}", parameter, known)
    return family.make(**family.preset, **values)


def cases(text: str) -> Iterator[Case]:
    """Build the cases of a set ("default", "@hard") one by one, or the single case of that name.

    Raises
    ------
    UnknownName, InputError
        As `case`, when called.
    """
    if (selected := get_case_names_of_set(text)) == (text,):
        return iter([case(text)])
    return (case(name) for name in selected)


def get_case_names_of_set(text: str) -> tuple[str, ...]:
    """Return the names of a set's cases ("default", "@hard"), or the given name alone.

    Raises
    ------
    UnknownName
        The set is unknown.
    """
    if not isinstance(text, str):
        raise UnknownName("set of cases", text, SETS)
    name = text.removeprefix("@")
    if text.startswith("@") and name not in SETS:
        raise UnknownName("set of cases", name, SETS)
    return SETS.get(name, (text,))


def default() -> list[Case]:
    """Build the cases that `lavender report` runs if no file is named."""
    return list(cases("default"))
