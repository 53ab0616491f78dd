"""Run findings with the newest releases of their packages in place of the pinned ones, and write what has changed.

    python findings/at_newest.py [NAME ...] > findings/newest.md

Each script is copied to a temporary folder, where the pins of its pip and npm commands are lifted; the scripts
themselves stay as they are. A script ends with 0 if the behaviour is that of its header, and with 1 after it has
printed another behaviour. Scripts of which no package in the first line of the header has a newer release are listed
without a run, unless they are named.
"""

import functools
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).parent
PIN = re.compile(r"(?<![\w.$/-])([A-Za-z][\w.-]*)==(\d[\w.]*)")
NPM_PIN = re.compile(r"((?:@[\w-]+/)?[\w.-]+)@(\d[\w.]*)")
# pip or npm, with the lines that continue it.
COMMAND = re.compile(r'^.*(?:bin/pip" install|npm install)(?:.*\\\n)*.*$', re.MULTILINE)
TIME_LIMIT = 900  # s, for the installation and the run of one script


@functools.cache
def find_newest(name, is_npm):
    """Return the newest release of a package for this interpreter, or "" if the registry does not answer."""
    if is_npm:
        command = ["npm", "view", name, "version"]
    else:
        command = [sys.executable, "-m", "pip", "index", "versions", name]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    if run.returncode:
        return ""
    return (
        run.stdout.strip() if is_npm else re.search(r"\(([^)]+)\)", run.stdout)[1]
    )  # name (version)


def read_pins(text):
    """Return (name, version, is_npm) of each package that a script pins."""
    pins = []
    for command in COMMAND.findall(text):
        is_npm = "npm install" in command
        pins += [(*pin, is_npm) for pin in (NPM_PIN if is_npm else PIN).findall(command)]
    return list(dict.fromkeys(pins))


def lift_pins(text):
    """Return the script without the versions of its packages."""

    def lift(match):
        is_npm = "npm install" in match[0]
        return NPM_PIN.sub(r"\1@latest", match[0]) if is_npm else PIN.sub(r"\1", match[0])

    return COMMAND.sub(lift, text)


def read_subject(text):
    """Return the header of a script up to its behaviour, which names the packages under test with their versions."""
    header = text.split("\n", 1)[1]
    return header.split("# Behaviour", 1)[0]


def run_lifted(path):
    """Run a copy of a script with lifted pins, and return its outcome and its last line."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, path.name)
        copy.write_text(lift_pins(path.read_text()))
        environment = {
            **os.environ,
            "PYTHON": os.environ.get("PYTHON", sys.executable),
            "TMPDIR": folder,
        }
        try:
            run = subprocess.run(
                ["bash", copy],
                capture_output=True,
                text=True,
                timeout=TIME_LIMIT,
                env=environment,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return "not run", f"more than {TIME_LIMIT} s"
        printed = run.stdout.strip().splitlines()
        if run.returncode == 0:
            return "as in the header", printed[-1] if printed else ""
        if printed:  # Scripts print what they found before they judge it.
            return "changed", printed[-1]
        return "does not run", (run.stderr.strip().splitlines() or ["no output"])[-1]


def main(names):
    """Print the table of the named findings, or of all."""
    print("# Findings with the newest releases\n\nWritten by `python findings/at_newest.py`.\n")
    print(
        "| finding | pinned | newest | outcome | last line of the output |\n|---|---|---|---|---|"
    )
    for path in sorted(FOLDER.glob("*.sh")):
        if names and path.stem not in names:
            continue
        text = path.read_text()
        subject = read_subject(text)
        pins = [pin for pin in read_pins(text) if pin[1] in subject] or read_pins(text)
        newest = [find_newest(name, is_npm) for name, _, is_npm in pins]
        if not names and [pin[1] for pin in pins] == newest:
            outcome, line = "no newer release", ""
        elif not pins:
            outcome, line = "two versions by design", ""
        else:
            outcome, line = run_lifted(path)
        pinned = ", ".join(f"{name} {version}" for name, version, _ in pins)
        line = line.replace("|", "/")[:200]
        print(f"| {path.stem} | {pinned} | {', '.join(newest)} | {outcome} | {line} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
