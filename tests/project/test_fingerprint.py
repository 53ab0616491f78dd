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
        timeout=1800,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    return done


def test_the_same_in_another_process_and_a_change_is_named(tmp_path):
    file, only = tmp_path / "then.txt", ("--only", "box_stackF(n=10)")
    assert run(*only, "--out", file).returncode == 0
    before = file.read_text()
    items = [line.split("\t")[1] for line in before.splitlines()]
    assert items[1:] == sorted(items[1:]) or items == sorted(items)
    for word in ("problem box_stackF(n=10)", "solve box_stackF(n=10) | newton", "| random", "2 threads"):
        assert any(word in item for item in items), word
    same = run(*only, "--compare", file, seed="77")
    assert same.returncode == 0, same.stdout
    assert " 0 changed or gone" in same.stdout

    lines, named = before.splitlines(keepends=True), []
    for word in ("| pgs | random", "| newton"):  # the second goes through LAPACK
        at = next(i for i, line in enumerate(lines) if word in line)
        kind, item, result, *rest = lines[at].split("\t")
        lines[at] = "\t".join((kind, item, "0" * len(result), *rest))
        named.append(f"changed  {item}: result {'0' * len(result)} -> {result}")
    lines.append("own\torder box_stackF(n=10) | none | given\t-\t-\t-\n")
    file.write_text("".join(lines))
    other = run(*only, "--compare", file)
    assert other.returncode == 1
    for words in (*named, "gone     order box_stackF(n=10) | none | given", " 3 changed or gone"):
        assert words in other.stdout
    machine = next(line for line in lines if line.split("\t")[1] == "machine").split("\t")[2]
    file.write_text("".join(lines).replace(machine, "0" * len(machine)))
    elsewhere = run(*only, "--compare", file)
    assert named[0] in elsewhere.stdout
    assert named[1] not in elsewhere.stdout
    assert "another machine" in elsewhere.stdout
