"""Folders that a report or a campaign may be pointed at: names, files and records that nobody meant; as plain data."""

import base64
import contextlib
import io
import os
import re
import tempfile
from pathlib import Path
from unittest import mock

import hypothesis.strategies as st
import numpy as np
from strategies import chance

import lavender as lv
import lavender.cli
from lavender.lab.bench.running import alternating

NAMES = (
    "a.npz", "[/x].npz", "[bold].npz", "²1.npz", "a$\\frac$b.npz", "a$b.npz", "<img src=x onerror=alert(1)>.npz",
    "a\nb.npz",
    "a\tb.npz", "'; DROP.npz", '".npz', "&amp;.npz", "-x.npz", "--out.npz", "..npz", " .npz", "%s.npz",
    "{0}.npz", "ä\u0308.npz",
    "\u202ex.npz", "a|b.npz", "`a`.npz", "*_#.npz", "a\x1b[31m.npz", "x.hdf5", "x.jsonl", "case(n=1).npz", "1.npz",
    "01.npz",
    "step-1.npz", "step-٣.npz", "😀.npz",
)  # fmt: skip
RAW_NAMES = tuple(base64.b64encode(name).decode() for name in (b"\xff\xfe.npz", b"a\x80.npz"))
INSIDE = ("names", "name", "lone surrogate", "huge numbers", "infeasible", "empty", "zero", "garbage", "members",
          "good", "good")  # fmt: skip


def folder_specs():
    """Files by name, and the command."""

    def entry(names, raws, inside):
        fields = {"name": names, "raw": raws, "inside": inside}
        return st.fixed_dictionaries({key: st.sampled_from(values) for key, values in fields.items()})

    good, raw = entry(NAMES, (None,), INSIDE), entry((None,), RAW_NAMES, INSIDE)
    odd = entry(("loop",), (None,), ("link",)) | entry(("pipe.npz",), (None,), ("pipe",))
    return st.fixed_dictionaries(
        {
            "kind": st.just("folder"),
            "entries": st.lists(st.one_of(*[good] * 8, raw, odd), min_size=1, max_size=5),
            "command": st.sampled_from(("report", "report", "report", "check", "files")),
            "figures": chance(0.1),
            "twice": chance(0.3),
        }
    )


def quiet(arguments):
    """Exit status of a command, and what it wrote."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            lavender.cli.main(arguments)
        except SystemExit as end:
            return end.code, out.getvalue()
    return 0, out.getvalue()


def problem_of(inside):
    """A problem with something strange in it."""
    a = np.array([[2.0, 0.5], [0.5, 1.0]])
    if inside == "names":
        return lv.Problem.lcp(
            a,
            [1.0, 1.0],
            names=["[/x]", "<script>alert(1)</script>"],
            name="[bold]<img src=x onerror=alert(1)>",
        )
    if inside == "name":
        return lv.Problem.lcp(a, [1.0, -1.0], name="a\nb$\\frac$|`")
    if inside == "lone surrogate":
        return lv.Problem.lcp(a, [1.0, 1.0], names=["\ud800", "b"], name="\udcff")
    if inside == "huge numbers":
        return lv.Problem.lcp(1e59 * a, [1e59, -1e59])
    if inside == "infeasible":
        return lv.Problem.lcp(-np.eye(2), [1.0, 1.0])
    if inside == "empty":
        return lv.Problem.linear(np.zeros((0, 0)), [])
    if inside == "zero":
        return lv.Problem.lcp(np.zeros((2, 2)), [0.0, 0.0])
    return lv.Problem.contact(np.eye(3), [1.0, 0.2, 0.1], [0.5])


def lay_out(spec, folder):
    """Write the entries of a spec; names that this file system refuses are left out."""
    for entry in spec["entries"]:
        name = entry["name"] if entry["name"] is not None else os.fsdecode(base64.b64decode(entry["raw"]))
        path = Path(folder, name)
        try:
            if entry["inside"] == "link":
                path.symlink_to(folder)
            elif entry["inside"] == "pipe":
                os.mkfifo(path)
            elif entry["inside"] == "garbage":
                path.write_bytes(b"PK\x03\x04" + name.encode(errors="replace"))
            elif entry["inside"] == "members":
                with path.open("wb") as file:  # whose names an error may tell
                    np.savez(file, **{"[/x]": np.ones(2), "a\nb": np.ones(2), "\x1b[31m": np.ones(2)})
            else:
                whole = Path(folder, "whole.tmp.npz")
                lv.io.save(problem_of(entry["inside"]), whole)
                os.replace(whole, path)
        except OSError:
            continue


def check(spec):
    """What was broken."""
    with tempfile.TemporaryDirectory() as root:
        folder, out = Path(root, "problems"), Path(root, "out")
        folder.mkdir()
        lay_out(spec, folder)
        plan = ["--solvers", "pgs,nncg", "--levels", "1e-3", "--budgets", "4", "--repeats", "1"]
        files = [str(path) for path in sorted(folder.iterdir())]
        command = {
            "report": ["report", str(folder), *plan, "--out", str(out)],
            "check": ["check", str(folder), "--solvers", "pgs,nncg"],
            "files": ["report", *files, *plan, "--out", str(out)],
        }[spec["command"]]
        for turn in range(1 + spec["twice"]):
            # Figures cost most: where it is run twice, they are drawn of the records that were read.
            drawn = command[0] == "check" or (spec["figures"] and turn == spec["twice"])
            # What is timed again and again would take seconds, whatever a folder holds.
            with mock.patch.object(alternating, "MAX_REPETITIONS", 1):
                code, text = quiet(command if drawn else [*command, "--no-figures"])
            yield from told(code, text, command[0], spec.get("status", STATUS))
        for page in out.glob("*.html"):
            html = page.read_text(encoding="utf-8")
            for tag in ("<img src=x", "<script>alert"):
                if tag in html:
                    yield "not escaped", f"{tag} stands in {page.name}"
        for page in out.glob("*.md"):
            summary = page.read_text(encoding="utf-8")
            if "<img src=x" in summary:
                yield "not escaped", f"<img src=x stands in {page.name}"
            for table in re.split(r"\n\n+", summary):
                cells = {
                    len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines() if row.startswith("|")
                }
                if len(cells) > 1:
                    yield "not escaped", f"rows of unlike cells in {page.name}: {cells}"


STATUS = (0, 1, 2, 3)


def told(code, text, command, status=STATUS):
    """A status that is documented, or the one that is known; no traceback."""
    if code not in status:
        yield "raw exit", f"{command}: status {code}"
    if "Traceback (most recent call last)" in text:
        yield "raw traceback", f"{command}: {text[-300:]}"
    if "\x1b" in text:
        yield "not escaped", f"{command}: an escape of the terminal"
    if code == 2 and not text.strip():
        yield "raw exit", f"{command}: status 2 without a word"
