"""Docstrings of lavender as pages: formulas in indented blocks stay as they are, in markdown and in Sphinx.

The docstrings are plain text first: an indented block after an empty line is a formula or a table.
"""

import ast
import dataclasses
import inspect
import re
import textwrap

SECTION = re.compile(r"^-{3,}\s*$")
# |x| would be a substitution in reStructuredText, and x_ a link.
BARS = re.compile(r"\|")
LINKS = re.compile(r"(?<=\w)_(?![\w`])")


def blocks(text):
    """(is_formula, lines) in turn, of a docstring without its common indentation."""
    found = []
    for paragraph in re.split(r"\n\s*\n", inspect.cleandoc(text)):
        lines = paragraph.split("\n")
        if not lines[0].strip():
            continue
        formula = lines[0].startswith("    ")
        if formula and found and found[-1][0]:
            found[-1][1].extend(["", *lines])
        else:
            found.append((formula, lines))
    return found


def markdown(text):
    """Convert a plain-text docstring to markdown: formulas in fences, everything else unchanged."""
    out = []
    for formula, lines in blocks(text):
        body = textwrap.dedent("\n".join(lines)) if formula else _escaped("\n".join(lines))
        out.append(f"```text\n{body}\n```" if formula else body)
    return "\n\n".join(out)


def _escaped(text):
    """Escape markdown markup outside of code: stars, angle brackets, bars of lists."""
    parts = re.split(r"(`[^`]*`)", text)
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"([*<>_\[\]])", r"\\\1", parts[i])
    return "".join(parts)


def process(app, what, name, obj, options, lines):
    """Sphinx event: literal blocks for formulas, no accidental markup, fields of data classes as a table."""
    end = next((i - 1 for i, line in enumerate(lines) if SECTION.match(line)), len(lines))
    head, tail = lines[:end], lines[end:]
    out = []
    if head:
        for formula, block in blocks("\n".join(head)):
            if formula:
                out += ["::", "", *(line and "    " + line for line in block), ""]
            else:
                out += [*map(_plain, block), ""]
    lines[:] = out + [line if SECTION.match(line) else _plain(line) for line in tail]


def add_fields(app, what, name, obj, options, lines):
    """Sphinx event, after numpydoc: the fields of a data class with their comments."""
    if what == "class" and dataclasses.is_dataclass(obj):
        lines += ["", *_fields(obj), ""]


def _plain(line):
    parts = re.split(r"(`[^`]*`)", line)
    for i in range(0, len(parts), 2):
        parts[i] = LINKS.sub(r"\\_", BARS.sub(r"\\|", parts[i]))
    return "".join(parts)


def field_comments(cls):
    """Name -> (type, comment above and on the line), of the public fields of a data class, as its source has them."""
    source = textwrap.dedent(inspect.getsource(cls))
    lines = source.split("\n")
    found = {}
    definition = ast.parse(source).body[0]
    assert isinstance(definition, ast.ClassDef)
    for node in definition.body:
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
            continue
        if node.target.id.startswith("_"):
            continue
        comments = [
            re.search(r"\s#\s(?!type:|noqa|fmt:)(.*)$", lines[n - 1])
            for n in range(node.lineno, node.end_lineno + 1)
        ]
        n = node.lineno - 2
        while comment := re.match(r"\s*#\s(.*)$", lines[n]):
            comments.insert(0, comment)
            n -= 1
        text = " ".join(c.group(1) for c in comments if c)
        found[node.target.id] = (ast.unparse(node.annotation), text)
    return found


def _fields(cls):
    rows = field_comments(cls)
    if not any(text for _, text in rows.values()):
        return []
    out = [
        ".. list-table::",
        "   :header-rows: 1",
        "",
        "   * - field",
        "     - type",
        "     - shape, unit, meaning",
    ]
    for name, (kind, text) in rows.items():
        out += [f"   * - `{name}`", f"     - `{kind}`", f"     - {_plain(text)}"]
    return out
