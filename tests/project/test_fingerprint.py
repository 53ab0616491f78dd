"""The command that hashes what keeps its bits: stable across processes, and it sees what changed."""

import os
import subprocess
import sys
from pathlib import Path

COMMAND = Path(__file__).resolve().parent.parent.parent / ".ci" / "fingerprint"


def run(*arguments, seed="0"):
    done = subprocess.run(
        [sys.executable, str(COMMAND), *map(str, arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONHASHSEED": seed},
        timeout=300,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    return done


def test_the_same_in_another_process_and_a_change_is_named(tmp_path):
    file = tmp_path / "then.txt"
    assert run("--only", "box_stackF(n=10)", "--out", file).returncode == 0
    before = file.read_text()
    items = [line.split("\t")[1] for line in before.splitlines()]
    assert items[1:] == sorted(items[1:]) or items == sorted(items)
    for word in ("problem box_stackF(n=10)", "solve box_stackF(n=10) | newton", "| random", "2 threads"):
        assert any(word in item for item in items), word
    same = run("--only", "box_stackF(n=10)", "--compare", file, seed="77")
    assert same.returncode == 0, same.stdout
    assert " 0 changed or gone" in same.stdout

    lines = before.splitlines(keepends=True)
    at = next(i for i, line in enumerate(lines) if "| pgs | random" in line)
    kind, item, result, *rest = lines[at].split("\t")
    lines[at] = "\t".join((kind, item, "0" * len(result), *rest))
    lines.append("own\torder box_stackF(n=10) | none | given\t-\t-\t-\n")
    file.write_text("".join(lines))
    other = run("--only", "box_stackF(n=10)", "--compare", file)
    assert other.returncode == 1
    assert f"changed  {item}: result {'0' * len(result)} -> {result}" in other.stdout
    assert "gone     order box_stackF(n=10) | none | given" in other.stdout
    assert " 2 changed or gone" in other.stdout


def test_items_of_lapack_are_compared_on_one_machine_only(tmp_path):
    file = tmp_path / "then.txt"
    only = ("--only", "solve box_stack(n=10) |")
    run(*only, "--out", file)
    text = file.read_text()
    newton = next(line for line in text.splitlines() if "| newton" in line)
    changed = text.replace(newton, newton.replace(newton.split("\t")[2], "0000000000"))
    file.write_text(changed)
    assert run(*only, "--compare", file).returncode == 1
    machine = next(line for line in text.splitlines() if line.split("\t")[1] == "machine").split("\t")[2]
    file.write_text(changed.replace(machine, "0000000000"))
    elsewhere = run(*only, "--compare", file)
    assert elsewhere.returncode == 0
    assert "another machine" in elsewhere.stdout
