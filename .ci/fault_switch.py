"""Compile kernels with all faults of tests/mutants at once: the variable LAVENDER_FAULT selects one at run time.

A statement and its replacement become the two branches of `if fault_number() == N`; a condition, or the end of a range,
becomes one expression with both. Declarations cannot be switched, and their faults are compiled one by one.
"""

import re

#: Sources of `fault_number`, which kernels import from here.
DECLARATION_PATH = "lavender_ext/core/fault.pxd"
IMPORT = "from lavender_ext.core.fault cimport fault_number"
DECLARATION = '''cdef extern from *:
    """
    #include <stdlib.h>
    static int lavender_fault_number = -1;
    static int fault_number(void) {
        if (lavender_fault_number < 0) {
            const char* text = getenv("LAVENDER_FAULT");
            lavender_fault_number = text ? atoi(text) : 0;
        }
        return lavender_fault_number;
    }
    """
    int fault_number() noexcept nogil
'''
CONDITION = re.compile(r"(if|elif|while) (.*):")
RANGE = re.compile(r"for (\w+) in range\((.*)\):")
DECLARED_VALUE = re.compile(r"(cdef [\w *]+ = )([^,=]*(?:\(.*\)[^,=]*)?)")
# Lines that cannot be in a branch, or cannot begin one.
DECLARED = re.compile(r"(cdef|cpdef|ctypedef|def|cimport|from|import)\b")
CONTINUED = re.compile(r"(elif|else|except|finally)\b")


def switch_change(
    lines: list[str], begin: int, end: int, new: list[str], number: int
) -> list[str] | None:
    """Return the lines of a file in which [begin, end) and `new` are switched; None if they cannot be."""
    old = lines[begin:end]
    if len(old) == len(new):
        changes = [
            (begin + i, begin + i + 1, [new[i]])
            for i in range(len(new))
            if new[i].strip() != old[i].strip()
        ]
    else:
        head = tail = 0
        shorter = min(len(old), len(new))
        while head < shorter and old[head].strip() == new[head].strip():
            head += 1
        while tail < shorter - head and old[-1 - tail].strip() == new[-1 - tail].strip():
            tail += 1
        changes = [(begin + head, end - tail, new[head : len(new) - tail])]
    for first, last, replacement in reversed(changes):
        switched = _switch_statements(
            lines, first, last, replacement, f"fault_number() == {number}"
        )
        if switched is None:
            return None
        lines = switched
    return lines


def insert_import(text: str, added: str = IMPORT) -> str:
    """Return the text of a kernel with an import, by default of `fault_number`, before its first import."""
    lines = text.splitlines()
    first = next(
        k for k, line in enumerate(lines) if re.match(r"from [\w.]+ c?import |c?import ", line)
    )
    return "\n".join([*lines[:first], added, *lines[first:], ""])


def _switch_statements(
    lines: list[str], begin: int, end: int, new: list[str], condition: str
) -> list[str] | None:
    """Switch the statements of the lines [begin, end), which are completed to whole statements first."""
    depth = _count_open_brackets(lines)
    first, last = begin, end
    while depth[first] > 0:
        first -= 1
    while last < len(lines) and depth[last] > 0:
        last += 1
    new = [*lines[first:begin], *new, *lines[end:last]]
    old = lines[first:last]
    indent = _measure_indent((old or new)[0])
    pad = " " * indent
    if len(old) == len(new) == 1:
        one, other = (_remove_comment(line[0]).strip() for line in (old, new))
        a, b = CONDITION.fullmatch(one), CONDITION.fullmatch(other)
        if a and b and a[1] == b[1]:
            header = f"{pad}{a[1]} (({b[2]}) if {condition} else ({a[2]})):"
            return [*lines[:first], header, *lines[last:]]
        a, b = DECLARED_VALUE.fullmatch(one), DECLARED_VALUE.fullmatch(other)
        if a and b and a[1] == b[1]:
            return [
                *lines[:first],
                f"{pad}{a[1]}({b[2]}) if {condition} else ({a[2]})",
                *lines[last:],
            ]
        a, b = RANGE.fullmatch(one), RANGE.fullmatch(other)
        if a and b:
            ends = zip(a[2].split(", "), b[2].split(", "), strict=False)
            arguments = ", ".join(
                x if x == y else f"(({y}) if {condition} else ({x}))" for x, y in ends
            )
            return [*lines[:first], f"{pad}for {a[1]} in range({arguments}):", *lines[last:]]
    following = next((line for line in lines[last:] if line.strip()), "")
    for branch in (old, new):
        texts = [_remove_comment(line) for line in branch if line.strip()]
        if (
            any(_measure_indent(text) < indent or DECLARED.match(text.strip()) for text in texts)
            or (texts and (texts[-1].endswith(":") or CONTINUED.match(texts[0].strip())))
            or _measure_indent(following) > indent
            or (_measure_indent(following) == indent and CONTINUED.match(following.strip()))
        ):
            return None
    branches = [["    " + line for line in branch] or [f"{pad}    pass"] for branch in (new, old)]
    return [
        *lines[:first],
        f"{pad}if {condition}:",
        *branches[0],
        f"{pad}else:",
        *branches[1],
        *lines[last:],
    ]


def _count_open_brackets(lines: list[str]) -> list[int]:
    """Return the number of brackets that are open before each line, and after the last."""
    depth = 0
    is_text = False
    counts = [0]
    for line in lines:
        is_delimiter = line.count('"""') % 2 == 1
        if not is_text and not is_delimiter:
            code = _remove_comment(re.sub(r'"[^"]*"', '""', line))
            depth += sum(map(code.count, "([{")) - sum(map(code.count, ")]}"))
        is_text ^= is_delimiter
        counts.append(depth)
    return counts


def _remove_comment(line: str) -> str:
    return line.split("#")[0].rstrip()


def _measure_indent(line: str) -> int:
    return len(line) - len(line.lstrip())
