"""Draw single faults by operators from the lines of the sources, Python and Cython alike.

An operator is a pattern and a function of its match: the text in its place. Comments, texts, declarations and imports
are not changed. Further operators make the faults of a tired person (`list_human_places`): like-named variables, stale
values, wrong units, defaults and functions. A draw takes the operators in turn, then a place of one of them at random,
so that no operator is frequent because its places are; half of the faults are in kernels, C headers among them.
"""

import random
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

TEXTS = re.compile(
    r'"""[\s\S]*?"""|\'\'\'[\s\S]*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'|#[^\n]*'
)
#: Texts, comments and lines of the preprocessor in C.
C_TEXTS = re.compile(
    r'/\*[\s\S]*?\*/|//[^\n]*|"(?:\\.|[^"\\\n])*"|^ *#[^\n]*(?:(?<=\\)\n[^\n]*)*', re.MULTILINE
)
#: Lines of C that declare functions and types.
C_DECLARATION = re.compile(r"(ISA|static|typedef|enum|struct|extern)\b|LAVENDER_VECTOR\(|[{}]*;?$")
#: Statements without a computation that a fault could change.
SKIPPED = re.compile(
    r"(async def|def|cpdef|ctypedef|class|import|from|cimport|raise|assert|pass|global|@|[\w.]+: [\w\[\]]+ = field)\b|@"
)
#: Statements of kernels that declare; one with a value may be changed right of "=".
DECLARATION = re.compile(
    r"cdef\b(?!.*[^=!<>]=[^=])|cdef (inline|class|struct|enum|extern|cppclass)\b"
)
NAME = r"[A-Za-z_][\w.]*"
BOUNDS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
PAIRS = {
    "_a": "_b",
    "_b": "_a",
    "lower": "upper",
    "upper": "lower",
    "low": "high",
    "high": "low",
    "first": "last",
    "last": "first",
    "min": "max",
    "max": "min",
    "fmin": "fmax",
    "fmax": "fmin",
    "row": "column",
    "any": "all",
    "all": "any",
    "and": "or",
    "or": "and",
    "True": "False",
    "False": "True",
}


class Place(NamedTuple):
    """A possible fault: columns [begin, end) of a line get another text."""

    path: str
    line: int
    begin: int
    end: int
    text: str


#: Name of each operator: its pattern in code without texts, and the text in place of a match.
OPERATORS: dict[str, tuple[re.Pattern[str], Callable[[re.Match[str]], str]]] = {
    "sign": (
        re.compile(
            r"(?<=[\w)\]] )[+-](?= [\w(<&-])|(?<= )[+-](?==)|(?:(?<=\()|(?<=[=(,] ))-(?=[A-Za-z(])"
        ),
        lambda m: {"+": "-", "-": "+"}[m[0]] if m.string[m.end() : m.end() + 1] in " =" else "",
    ),
    "bound": (re.compile(r"(?<= )(<=|>=|==|!=|<|>)(?= )"), lambda m: BOUNDS[m[0]]),
    "row": (
        re.compile(
            r"(?<=\[)\d(?=[\],])|(?<=\[)[^\[\]]*(?<= )\+ \d+(?=\])|(?<=range\()(?=[\w.]+\))"
        ),
        lambda m: (
            "1, "
            if not m[0]
            else str(1 - int(m[0]) if m[0] in "01" else int(m[0]) - 1)
            if m[0].isdigit()
            else re.sub(r" \+ \d+$", "", m[0])
        ),
    ),
    "other of a pair": (
        re.compile(
            r"(?<=\w)_[ab]\b|\b(lower|upper|low|high|first|last|f?min|f?max|row|any|all|and|or|True|False)\b(?!=)"
        ),
        lambda m: PAIRS[m[0]],
    ),
    "swapped arguments": (
        re.compile(rf"(?<=\w\()({NAME}), ({NAME})(?=[,)])|(?<=, )({NAME}), ({NAME})(?=\))"),
        lambda m: f"{m[2]}, {m[1]}" if m[1] else f"{m[4]}, {m[3]}",
    ),
    "dropped branch": (
        re.compile(
            r"(?<=^)(?:\s*(?:el)?if )(?!TYPE_CHECKING)[^:]+(?=:\s*$)|(?<= )and [^:()]+(?=:\s*$)"
        ),
        lambda m: "" if m[0].startswith("and ") else m[0][: m[0].index("if ") + 3] + "False",
    ),
    "stale state": (
        re.compile(r"^\s*(?:\w+(?:\.\w+|\[[^\]]*\])+)(?:, [\w.\[\]]+)* [-+*/]?= \S.*$"),
        lambda m: m[0][: len(m[0]) - len(m[0].lstrip())] + "pass",
    ),
    "ignored argument": (
        re.compile(
            r", (\w+)=[\w.]+(?=[,)])|(?<=\()(\w+)=[\w.]+, "
            r"|(?<=, )deadline(?=[,)])|(?<= )1\.0 [-+] [A-Za-z]\w*(?![\w.(\[])"
        ),
        lambda m: "NULL" if m[0] == "deadline" else "1.0" if m[0].startswith("1.0") else "",
    ),
}


def mask_texts(text: str, is_c: bool = False) -> str:
    """Return the text with blanks in place of texts and comments."""
    return (C_TEXTS if is_c else TEXTS).sub(lambda m: re.sub(r"[^\n]", " ", m[0]), text)


def list_code_lines(text: str, is_c: bool = False) -> Iterator[tuple[int, str, bool]]:
    """Yield (number, code, whether it is a whole statement) of the lines with statements that may be changed."""
    if is_c:  # Without the braces, which end no expression.
        for number, code in enumerate(mask_texts(text, True).splitlines()):
            if not C_DECLARATION.match(code.strip()):
                yield number, code, code.rstrip().endswith(";") and code.count(";") == 1
        return
    depth = 0
    is_skipped = False
    for number, code in enumerate(mask_texts(text).splitlines()):
        before = depth
        depth += sum(map(code.count, "([{")) - sum(map(code.count, ")]}"))
        if before == 0:
            is_skipped = bool(SKIPPED.match(code.strip()) or DECLARATION.match(code.strip()))
        if code.strip() and not is_skipped:
            yield number, code, before == depth == 0


def read_types(text: str) -> dict[str, set[str]]:
    """Return the types with which each name is declared in a file."""
    types = defaultdict[str, set[str]](set)
    for m in re.finditer(
        r"\b(\w+): ([\w\[\], |.]+?)(?=,? *\w+: |, \*|\)| =|$)", text, re.MULTILINE
    ):
        types[m[1]].add(m[2])
    for m in re.finditer(
        r"(?:cdef|[(,]) *(?:const )?(\w+\*?) \**(\w+(?:, \w+)*)(?=[,)=\n ])", text
    ):
        for name in m[2].split(", "):
            types[name].add(m[1])
    return types


def list_places(path: str, text: str, lines: set[int] | None = None) -> dict[str, list[Place]]:
    """Return the places of each operator in a file; `lines` selects some of its lines, counted from 0."""
    places = defaultdict[str, list[Place]](list)
    own = text.splitlines()
    types = read_types(text)
    is_c = path.endswith(".h")
    for operator, place in list_human_places(path, text, lines):
        places[operator].append(place)
    for number, code, is_whole in list_code_lines(text, is_c):
        if lines is not None and number not in lines:
            continue
        for operator, (pattern, replace) in OPERATORS.items():
            if operator in ("stale state", "dropped branch") and (is_c or not is_whole):
                continue
            for m in pattern.finditer(code):
                if operator == "swapped arguments":
                    one, other = (types.get(name, set()) for name in (m[1] or m[3], m[2] or m[4]))
                    if not one or one != other:  # A swap of two kinds fails in each call.
                        continue
                new = own[number][: m.start()] + replace(m) + own[number][m.end() :]
                if new.strip() != own[number].strip():
                    places[operator].append(Place(path, number, m.start(), m.end(), replace(m)))
    return places


# -- faults of a tired person ------------------------------------------------------------------------------

#: Number of lines on either side in which a like-named variable is looked for.
NEIGHBOURHOOD = 30
LITERAL = re.compile(r"(?<![\w.])\d+(?:\.\d*)?[eE][-+]?\d+(?![\w.])")
DEFAULT = re.compile(
    r"(\w+): [\w\[\]| .\"]+ = ([-\w.]+)(?=[,)]|$)|(?<=\.get\()\"?\w*\"?, ([A-Z_\d.]+)(?=\))"
)


def list_like_names(name: str, others: Iterable[str]) -> list[str]:
    """Return the names with as many parts between underscores, of which one differs."""
    parts = name.split("_")
    found = []
    for other in others:
        own = other.split("_")
        if len(own) == len(parts) > 1 and sum(x != y for x, y in zip(own, parts, strict=True)) == 1:
            found.append(other)
    return sorted(found)


def change_literal(text: str) -> str:
    """Return a number in another unit: in thousandths, or in thousands if it is below 1."""
    mantissa, exponent = re.split("[eE]", text)
    return f"{mantissa}e{int(exponent) + (3 if int(exponent) < 0 else -3)}"


def change_default(text: str) -> str:
    """Return another default: the other truth value, or a number 1000 times as large."""
    if text in ("True", "False"):
        return "False" if text == "True" else "True"
    try:
        return repr(1000 * float(text)) if "." in text or "e" in text else str(int(text) + 1)
    except ValueError:
        return text


def list_human_places(path: str, text: str, lines: set[int] | None) -> Iterator[tuple[str, Place]]:
    """Yield (operator, place) of the faults of a tired person.

    like-named: another variable of the neighbourhood whose name differs in one part and whose declared type is equal.
    wrong door: another function of the file whose name differs in one part, with as many parameters.
    stale value: a variable that has a value keeps it, or an array that the caller may change is not copied.
    wrong unit: a number is 1000 times too large or too small, a square or root is forgotten.
    wrong default: of a parameter, a field, or a missing entry.
    """
    is_c = path.endswith(".h")
    types, own = read_types(text), mask_texts(text, is_c).splitlines()
    functions = {
        m[1]: m[2].count(",")
        for m in re.finditer(r"\bdef (?:\w+ )?(\w+)\(([^)]*)\)", mask_texts(text))
    }
    size = NEIGHBOURHOOD
    words = [
        set(
            re.findall(r"\b[a-z]\w*_\w+\b", "\n".join(own[max(first - size, 0) : first + 2 * size]))
        )
        for first in range(0, len(own), size)
    ]
    for number, code, is_whole in list_code_lines(text, is_c):
        if lines is not None and number not in lines:
            continue
        near = words[number // size]
        for m in re.finditer(r"\b[a-z]\w*_\w+\b", code):
            is_call = code[m.end() : m.end() + 1] == "("
            if re.match(
                r" = | \w+ = |:|=", code[m.end() :]
            ):  # A target, a type or the name of an argument.
                continue
            if is_call and m[0] in functions:
                for other in list_like_names(m[0], functions):
                    if functions[other] == functions[m[0]]:
                        yield "wrong door", Place(path, number, m.start(), m.end(), other)
            elif not is_call:
                for other in list_like_names(m[0], near - functions.keys()):
                    if types.get(other, set()) == types.get(m[0], set()):
                        yield "like-named", Place(path, number, m.start(), m.end(), other)
        m = re.match(r"( +)([a-z]\w*) (?:[-+*/|&]?=) \S.*$", code)
        if m and is_whole and not is_c and any(
            re.match(rf" +(?:cdef [\w *]+)?{m[2]}(?:: [\w\[\], |.]+)? = ", line)
            for line in own[max(number - NEIGHBOURHOOD, 0) : number]
        ):  # fmt: skip
            yield "stale value", Place(path, number, len(m[1]), len(own[number]), "pass")
        for m in re.finditer(r"\.copy\(\)", code):
            yield "stale value", Place(path, number, m.start(), m.end(), "")
        for m in LITERAL.finditer(code):
            yield "wrong unit", Place(path, number, m.start(), m.end(), change_literal(m[0]))
        for m in re.finditer(r"(?<![\w.])(?:np\.|math\.)?sqrt(?=\()| \*\* 2(?![\w.])", code):
            yield "wrong unit", Place(path, number, m.start(), m.end(), "")
    for number, code in enumerate(own):
        if lines is None or number in lines:
            for m in DEFAULT.finditer(code):
                group = 2 if m[2] else 3
                value = "0.0" if m[group].isupper() else change_default(m[group])
                if value != m[group]:
                    yield "wrong default", Place(path, number, *m.span(group), value)


# -- the draw ----------------------------------------------------------------------------------------------


def draw_places(
    places: dict[str, list[Place]], count: int, rng: random.Random
) -> Iterator[tuple[str, Place]]:
    """Yield (operator, place): operators in turn in a random order, each line once."""
    order = sorted(places)
    used = set[tuple[str, int]]()
    rng.shuffle(order)
    pools = {operator: rng.sample(places[operator], len(places[operator])) for operator in order}
    for turn in range(len(order) * count):
        pool = pools[order[turn % len(order)]]
        while pool and (pool[-1].path, pool[-1].line) in used:
            pool.pop()
        if pool and len(used) < count:
            place = pool.pop()
            used.add((place.path, place.line))
            yield order[turn % len(order)], place


def make_lines(text: str, place: Place) -> list[str]:
    """Return the lines of a fault, with as many lines around the change as make them unique in the file."""
    own = text.splitlines()
    stripped = [line.strip() for line in own]
    old = own[place.line]
    changed = f"{old[: place.begin]}{place.text}{old[place.end :]}".rstrip()
    for margin in range(1, len(own)):
        begin = max(place.line - margin, 0)
        end = min(place.line + margin + 1, len(own))
        block = stripped[begin:end]
        if sum(stripped[k : k + len(block)] == block for k in range(len(own))) == 1:
            break
    return [
        *(f" {line}" for line in own[begin : place.line]),
        f"-{old}",
        f"+{changed}",
        *(f" {line}" for line in own[place.line + 1 : end]),
    ]


def draw_faults(
    root: Path, count: int, seed: int, changed: dict[str, set[int]] | None = None
) -> Iterator[tuple[str, str, str, list[str]]]:
    """Yield (name, sentence, path, lines) of `count` faults of the packages, half of them in kernels.

    `changed` selects lines by path, counted from 0.
    """
    rng = random.Random(seed)
    for folder, suffixes, share in (
        ("lavender", {".py"}, count - count // 2),
        ("lavender_ext", {".pyx", ".pxd", ".h"}, count // 2),
    ):
        places = defaultdict[str, list[Place]](list)
        texts = dict[str, str]()
        for path in sorted((root / folder).rglob("*")):
            name = path.relative_to(root).as_posix()
            if path.suffix in suffixes and (changed is None or name in changed):
                texts[name] = path.read_text()
                for operator, own in list_places(
                    name, texts[name], changed and changed[name]
                ).items():
                    places[operator] += own
        for number, (operator, place) in enumerate(draw_places(places, share, rng)):
            lines = make_lines(texts[place.path], place)
            sentence = f"{operator}, line {place.line + 1} of {place.path}"
            yield f"{Path(folder).name}_{seed}_{number:03}", sentence, place.path, lines
