"""Hostile inputs for MINUTES: what tests/fuzz/test_fuzz.py draws for some seconds, each kind in a watched process.

    python tests/fuzz/fuzz.py MINUTES [--seed N] [--kinds solve,file,...] [--limit SECONDS] [--most N]
    python tests/fuzz/fuzz.py --replay [NAME ...]

Hypothesis draws the inputs and makes one that fails smaller. A worker writes each into a file before it starts on
it, and gives itself `limit` seconds of processor time: one that it does not end is a hang, one on which it ends by
another signal a crash, and the next worker goes on with another seed. For each place that fails, its smallest input
becomes a line of tests/fuzz/found.jsonl; --replay runs those that are there. The exit status is 1 where anything
failed.
"""

import argparse
import faulthandler
import hashlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import hypothesis

HERE = Path(__file__).resolve().parent
FOUND = Path(os.environ.get("LAVENDER_FUZZ_FOUND", HERE / "found.jsonl"))
# of the time
SHARE = {"solve": 0.3, "file": 0.1, "steps": 0.2, "snapshot": 0.1, "folder": 0.1, "door": 0.1, "promise": 0.1}
LIMIT = 20  # s of processor time on one input
ROOM = 3 * 2**30  # bytes of memory of a worker, beyond what it starts with
CHUNK = 200  # inputs, after which Hypothesis starts again with another seed
FAULTS = ("crash", "hang", "raw", "false claim", "wrong number", "overrun", "changed", "warning")


# -- the worker ------------------------------------------------------------------------------------------------


class Worker:
    """Checks inputs of one kind and leaves what it knows in a folder: the input, its counts, its findings."""

    def __init__(self, kind, folder, limit):
        self.kind, self.folder, self.limit = kind, Path(folder), limit
        self.inputs, self.known, self.told = 0, set(), 0.0

    def check(self, spec):
        """One input; a place that is not known yet fails, so that Hypothesis makes its input smaller."""
        write(self.folder / "input.json", spec)
        used = time.process_time()
        resource.setrlimit(resource.RLIMIT_CPU, (int(used + self.limit) + 1, resource.RLIM_INFINITY))
        found = [{"finding": what, "detail": detail, "spec": spec} for what, detail in checks.run(spec)]
        self.inputs += 1
        for finding in found:
            keep(finding)
            with (self.folder / "findings").open("a") as file:
                file.write(json.dumps({**finding, "spec": None, "name": signature(finding)}) + "\n")
        if found or time.monotonic() - self.told > 0.2:
            self.tell()
        assert not {signature(finding) for finding in found} - self.known

    def tell(self):
        """What was done so far; a worker may end without a last word."""
        self.told = time.monotonic()
        write(self.folder / "counts.json", {"inputs": self.inputs, "checks": checks.COUNTS})

    def property(self, seed, most):
        """What Hypothesis draws and checks."""
        settings = hypothesis.settings(
            max_examples=most,
            deadline=None,
            database=None,
            phases=[hypothesis.Phase.generate, hypothesis.Phase.shrink],
            suppress_health_check=list(hypothesis.HealthCheck),
        )
        return hypothesis.seed(seed)(settings(hypothesis.given(spec=checks.INPUTS[self.kind])(self.check)))

    def draw(self, seed, until, most):
        """Until a time, or a number of inputs."""
        while time.time() < until and self.inputs < most:
            try:
                self.property(seed, min(CHUNK, most - self.inputs))()
            except AssertionError:
                findings = (self.folder / "findings").read_text().splitlines()
                self.known |= {json.loads(line)["name"] for line in findings}
            seed += 1
        self.tell()


def work(kind, folder, seed, until, most, limit):
    """What a process of its own does."""
    global checks
    sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent.parent)]
    import checks

    faulthandler.enable()
    faulthandler.register(signal.SIGXCPU, all_threads=True, chain=True)
    if "libasan" not in os.environ.get("LD_PRELOAD", "") and kind != "folder":  # which starts processes
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + ROOM,) * 2)
    worker = Worker(kind, folder, limit)
    worker.draw(seed, until, most)


def write(path, data):
    """At once, so that a reader finds the old or the new."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(data), encoding="utf-8")
    os.replace(part, path)


# -- the parent ------------------------------------------------------------------------------------------------


class Campaign:
    """Counts and findings of all workers."""

    def __init__(self):
        self.inputs, self.checks, self.findings = Counter(), Counter(), {}

    def add(self, kind, finding):
        """Count it, and tell it once."""
        known = self.findings.setdefault(finding["name"], {**finding, "times": 0})
        known["times"] += 1
        if known["times"] == 1:
            print(f"FOUND {finding['finding']}: {finding['detail']}  [{kind}]", flush=True)

    def run(self, kind, given, seed, seconds):
        """Workers of one kind, one after the other, for a time or a number of inputs."""
        until = time.time() + seconds
        while time.time() < until and self.inputs[kind] < given.most:
            with tempfile.TemporaryDirectory(prefix="lavender-fuzz-") as folder:
                self.run_worker(kind, given, Path(folder), seed, until)
            seed += 10**6

    def run_worker(self, kind, given, folder, seed, until):
        """Until it ends, by itself or not."""
        options = [kind, folder, seed, until, given.most - self.inputs[kind], given.limit]
        script = os.environ.get("LAVENDER_FUZZ_SCRIPT", str(HERE / "fuzz.py"))
        command = [sys.executable, script, "--work", *(str(option) for option in options)]
        done = subprocess.run(command, stdout=sys.stderr, stderr=subprocess.PIPE, check=False)
        told = done.stderr.decode(errors="replace")
        if (folder / "counts.json").exists():
            counts = json.loads((folder / "counts.json").read_text())
            self.inputs[kind] += counts["inputs"]
            self.checks.update(counts["checks"])
        if (folder / "findings").exists():
            for line in (folder / "findings").read_text().splitlines():
                self.add(kind, json.loads(line))
        if done.returncode == 0:
            return
        self.inputs[kind] += 1
        print(told[-3000:], file=sys.stderr)
        where = re.search(r'File ".*?(lavender[^"]*)", line \d+ in (\w+)', told)
        last = folder / "input.json"
        finding = {
            "finding": "hang" if done.returncode == -signal.SIGXCPU else "crash",
            "detail": f"{':'.join(where.groups()) if where else '?'}, status {done.returncode}",
            "spec": json.loads(last.read_text()) if last.exists() else {"kind": kind},
        }
        self.add(kind, {**finding, "name": keep(finding)})

    def report(self):
        """Lines of counts."""
        found = Counter(dict.fromkeys(FAULTS, 0))
        for finding in self.findings.values():
            word = finding["finding"]
            found[next((fault for fault in FAULTS if word.startswith(fault)), word)] += finding["times"]
        titles = {"inputs": self.inputs, "done": self.checks, "found": found}
        return [
            f"{title}: " + ", ".join(f"{n} {key}" for key, n in of.items()) for title, of in titles.items()
        ]


def signature(finding):
    """A short name of the place that fails: digits and quoted texts say nothing about it."""
    text = re.sub(r"'[^']*'|\d[\d.e+-]*|inf|nan", "#", finding["detail"])
    spec = finding["spec"]
    digest = hashlib.sha256(f"{finding['finding']} {spec.get('solver', '')} {text}".encode()).hexdigest()[:10]
    words = re.sub(r"[^a-z]+", "-", finding["finding"].lower()).strip("-")
    return f"{spec['kind']}-{words}-{digest}"


def kept():
    """Name to line of what was found."""
    lines = FOUND.read_text(encoding="utf-8").splitlines() if FOUND.exists() else []
    return {json.loads(line)["name"]: line for line in lines}


def keep(finding):
    """Its name; its input is kept, if it is the smallest of this name."""
    name, lines = signature(finding), kept()
    line = json.dumps({"name": name, **finding})
    if name not in lines or len(line) < len(lines[name]):
        FOUND.write_text(
            "".join(f"{line}\n" for _, line in sorted({**lines, name: line}.items())), encoding="utf-8"
        )
    return name


def replay(names):
    """Those of FOUND, or all of them, each in this process; what still fails."""
    sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent.parent)]
    import checks

    lines, failed = kept(), 0
    for name in names or lines:
        for what, detail in checks.run(json.loads(lines[name])["spec"]):
            print(f"{name}: {what}: {detail}")
            failed += 1
    print(f"{len(names or lines)} inputs replayed, {failed} findings")
    return failed


def main():
    """Command line."""
    if sys.argv[1:2] == ["--work"]:
        kind, folder, seed, until, most, limit = sys.argv[2:]
        work(kind, folder, int(seed), float(until), int(most), float(limit))
        return 0
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("minutes", nargs="?", type=float, default=2.0)
    parser.add_argument("--seed", type=int, help="default: drawn, and printed")
    parser.add_argument("--kinds", help=f"default: {','.join(SHARE)}")
    parser.add_argument("--limit", type=float, default=LIMIT, help="s of processor time on one input")
    parser.add_argument("--most", type=int, default=10**9, help="inputs of each kind")
    parser.add_argument("--replay", nargs="*", metavar="NAME")
    given = parser.parse_args()
    if given.replay is not None:
        return 1 if replay(given.replay) else 0
    seed = given.seed if given.seed is not None else int.from_bytes(os.urandom(6), "little")
    kinds = given.kinds.split(",") if given.kinds else list(SHARE)
    print(f"seed {seed}", flush=True)
    campaign = Campaign()
    total = sum(SHARE[kind] for kind in kinds)
    for kind in kinds:
        campaign.run(kind, given, seed, 60.0 * given.minutes * SHARE[kind] / total)
    print("\n".join(campaign.report()))
    return 1 if campaign.findings else 0


if __name__ == "__main__":
    sys.exit(main())
