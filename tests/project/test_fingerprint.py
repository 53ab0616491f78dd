"""The command that hashes what keeps its bits: stable across processes, and it sees what changed."""

import os

from worked import ROOT, python


def run(*arguments, seed="0", status=0):
    return python(
        ROOT / ".ci" / "fingerprint",
        *arguments,
        status=status,
        env={**os.environ, "PYTHONHASHSEED": seed},
    )


def test_fingerprint_is_the_same_in_another_process_and_names_a_change(tmp_path):
    file = tmp_path / "then.txt"
    only = ("--only", "box_stackF(n=10)")
    run(*only, "--out", file)
    before = file.read_text()
    items = [line.split("\t")[1] for line in before.splitlines()]
    assert items[1:] == sorted(items[1:]) or items == sorted(items)
    for word in (
        "problem box_stackF(n=10)",
        "solve box_stackF(n=10) | newton",
        "| random",
        "| colored",
    ):
        assert any(word in item for item in items), word
    run("--only", "two_particles | pgs", "--out", file)  # Only these items of the file are written.
    assert set(before.splitlines()) < set(file.read_text().splitlines())
    run(*only, "--out", file)
    lines = before.splitlines(keepends=True)
    named = []
    for word in ("| pgs | random", "| newton"):  # the second goes through LAPACK
        at = next(i for i, line in enumerate(lines) if word in line)
        kind, item, result, *rest = lines[at].split("\t")
        lines[at] = "\t".join((kind, item, "0" * len(result), *rest))
        named.append(f"changed  {item}: result {'0' * len(result)} -> {result}")
    lines.append("own\torder box_stackF(n=10) | none | given\t-\t-\t-\n")
    file.write_text("".join(lines))
    other = run(
        *only, "--compare", file, seed="77", status=1
    )  # in which everything else is the same
    for words in (*named, "gone     order box_stackF(n=10) | none | given", " 3 changed or gone"):
        assert words in other.stdout
    machine = next(line for line in lines if line.split("\t")[1] == "machine").split("\t")[2]
    file.write_text("".join(lines).replace(machine, "0" * len(machine)))
    elsewhere = run(*only, "--compare", file, status=1)
    assert named[0] in elsewhere.stdout
    assert named[1] not in elsewhere.stdout
    assert "another machine" in elsewhere.stdout
