"""Draw inputs from seeds, check each in a process of its own that is watched, count, keep what fails.

    python tests/fuzz/fuzz.py MINUTES [--seed N] [--kinds solve,file,...] [--limit SECONDS] [--count KIND=N ...]
    python tests/fuzz/fuzz.py --replay [FILE ...]
    python tests/fuzz/fuzz.py --again SEED KIND NUMBER

A worker writes the number of each input and the time into shared memory before it starts on it. The parent looks
there: a worker that stays on one input beyond the limit is a hang, one that ends by a signal a crash, and a new one
goes on behind that input. Failing inputs become files in tests/fuzz/found/, one for each place that fails; --replay
runs those that are there. The exit status is 1 where anything failed.
"""

import argparse
import faulthandler
import hashlib
import json
import mmap
import os
import re
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
FOUND = Path(os.environ.get("LAVENDER_FUZZ_FOUND", HERE / "found"))
KINDS = ("solve", "file", "steps", "snapshot", "folder", "door", "promise")
# of the time
SHARE = {"solve": 0.3, "file": 0.1, "steps": 0.2, "snapshot": 0.1, "folder": 0.1, "door": 0.1, "promise": 0.1}
LIMIT = 20.0  # s of processor time on one input
ROOM = 3 * 2**30  # bytes of memory of a worker, beyond what it starts with
FIELDS = struct.Struct("<qqd")  # input, inputs done, processor time at its start


def make(kind, seed, number):
    """The input of a number."""
    sys.path.insert(0, str(HERE))
    import checks
    from draw import Seeded

    return checks.MAKE[kind](Seeded(seed, KINDS.index(kind), number))


# -- the worker ------------------------------------------------------------------------------------------------


def work(kind, seed, first, until, shared):
    """Check inputs from `first` on, until a time or a number; findings and counts go to stdout, a line each."""
    faulthandler.enable()
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    sys.path.insert(0, str(HERE))
    sys.path.insert(0, str(HERE.parent.parent))
    import checks

    make(kind, seed, 0)  # imports, and the files that others are made of
    if "libasan" not in os.environ.get("LD_PRELOAD", "") and kind != "folder":
        with open("/proc/self/statm") as file:
            used = int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + ROOM,) * 2)
    number, last = first, time.monotonic()
    with open(shared, "r+b") as file:
        view = mmap.mmap(file.fileno(), FIELDS.size)
        parent = os.getppid()
        while time.time() < until["time"] and number < until["number"] and os.getppid() == parent:
            # At once: pack_into clears the buffer first, and zeros read as an input that has lasted since the start.
            view[:] = FIELDS.pack(number, number - first, time.process_time())
            spec = make(kind, seed, number)
            for what, detail in checks.run(spec):
                say(
                    {
                        "finding": what,
                        "detail": detail,
                        "kind": kind,
                        "seed": seed,
                        "number": number,
                        "spec": spec,
                    }
                )
            number += 1
            if time.monotonic() - last > 1.0:
                say({"counts": checks.COUNTS})
                last = time.monotonic()
        view[:] = FIELDS.pack(number, number - first, -1.0)
    say({"counts": checks.COUNTS})


def say(message):
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


# -- the parent ------------------------------------------------------------------------------------------------


class Campaign:
    """Counts and findings of all workers."""

    def __init__(self, keep):
        self.counts, self.inputs, self.findings, self.keep = {}, {}, {}, keep

    def add(self, finding):
        name = signature(finding)
        known = self.findings.setdefault(name, {**finding, "times": 0})
        known["times"] += 1
        if known["times"] == 1:
            print(
                f"FOUND {finding['finding']}: {finding['detail']}  "
                f"[{finding['kind']} {finding['seed']} {finding['number']}]",
                flush=True,
            )
            if self.keep:
                FOUND.mkdir(exist_ok=True)
                text = {key: finding[key] for key in ("finding", "detail", "spec")}
                (FOUND / f"{name}.json").write_text(json.dumps(text) + "\n", encoding="utf-8")

    def run(self, kind, seed, seconds, limit, most):
        """Workers of one kind, one after the other, for a time or a number of inputs."""
        deadline = time.time() + seconds
        number = 0
        while time.time() < deadline and number < most:
            number = self.one_worker(kind, seed, number, deadline, limit, most)
        self.inputs[kind] = self.inputs.get(kind, 0) + number

    def one_worker(self, kind, seed, first, deadline, limit, most):
        """Until it ends; the number of the input to go on with."""
        with tempfile.NamedTemporaryFile() as shared, tempfile.TemporaryFile() as errors:
            shared.write(FIELDS.pack(first, 0, -1.0))
            shared.flush()
            script = os.environ.get("LAVENDER_FUZZ_SCRIPT", str(HERE / "fuzz.py"))
            command = [
                sys.executable,
                script,
                "--work",
                kind,
                str(seed),
                str(first),
                str(deadline),
                str(most),
                shared.name,
            ]
            worker = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, start_new_session=True)
            os.set_blocking(worker.stdout.fileno(), False)
            text, counts, hung = b"", {}, False
            number, started = first, -1.0
            while True:
                ended = worker.poll() is not None
                text += worker.stdout.read() or b""
                *lines, text = text.split(b"\n")
                for line in lines:
                    message = json.loads(line)
                    if "counts" in message:
                        counts = message["counts"]
                    else:
                        self.add(message)
                before, seen = (number, started), FIELDS.unpack(Path(shared.name).read_bytes())
                number, started = seen[0], seen[2]
                if ended:
                    break
                # Twice the same: a look in the middle of a write sees zeros.
                if started >= 0.0 and (number, started) == before and used(worker.pid) - started > limit:
                    hung = True
                    os.kill(worker.pid, signal.SIGUSR1)  # where it is
                    time.sleep(0.5)
                    os.killpg(worker.pid, signal.SIGKILL)
                    worker.wait()
                    break
                time.sleep(0.05)
            for key, n in counts.items():
                self.counts[key] = self.counts.get(key, 0) + n
            if worker.returncode == 0 and not hung:
                return number
            errors.seek(0)
            told = errors.read().decode(errors="replace")
            what = "hang" if hung else "crash"
            where = next(
                (s for s in re.findall(r'File ".*?(lavender[^"]*)", line \d+ in (\w+)', told)), ("?", "?")
            )
            finding = {
                "finding": what,
                "detail": f"{where[0]}:{where[1]}, status {worker.returncode}",
                "kind": kind,
            }
            try:
                spec = make(kind, seed, number)
            except Exception as error:  # the generator itself
                spec = {"kind": kind, "not made": repr(error)}
            self.add({**finding, "seed": seed, "number": number, "spec": spec})
            print(told[-3000:], file=sys.stderr)
            return number + 1

    def report(self):
        """Lines of counts."""
        inputs = ", ".join(f"{n} {kind}" for kind, n in self.inputs.items())
        lines = [f"inputs: {inputs}", "done: " + ", ".join(f"{n} {key}" for key, n in self.counts.items())]
        kinds = {
            "crash": 0,
            "hang": 0,
            "raw": 0,
            "false claim": 0,
            "wrong number": 0,
            "overrun": 0,
            "changed": 0,
            "warning": 0,
        }
        for finding in self.findings.values():
            word = finding["finding"]
            word = next((kind for kind in kinds if word.startswith(kind)), word)
            kinds[word] = kinds.get(word, 0) + finding["times"]
        lines.append("found: " + ", ".join(f"{kind} {n}" for kind, n in kinds.items()))
        return lines


def signature(finding):
    """A short name of the place that fails: digits and quoted texts say nothing about it."""
    text = re.sub(r"'[^']*'|\d[\d.e+-]*|inf|nan", "#", finding["detail"])
    solver = finding["spec"].get("solver", "") if isinstance(finding["spec"], dict) else ""
    digest = hashlib.sha256(f"{finding['finding']} {solver} {text}".encode()).hexdigest()[:10]
    words = re.sub(r"[^a-z]+", "-", finding["finding"].lower()).strip("-")
    return f"{finding['kind']}-{words}-{digest}"


def used(pid):
    """Processor time of a process, s."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def replay(paths):
    """Files of found/, each in this process; what still fails."""
    sys.path.insert(0, str(HERE))
    import checks

    failed = 0
    for path in paths:
        spec = json.loads(Path(path).read_text(encoding="utf-8"))["spec"]
        for what, detail in checks.run(spec):
            print(f"{path}: {what}: {detail}")
            failed += 1
    print(f"{len(paths)} inputs replayed, {failed} findings")
    return failed


def main():
    """Command line."""
    if sys.argv[1:2] == ["--work"]:
        kind, seed, first, deadline, most, shared = sys.argv[2:]
        work(kind, int(seed), int(first), {"time": float(deadline), "number": int(most)}, shared)
        return 0
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("minutes", nargs="?", type=float, default=2.0)
    parser.add_argument("--seed", type=int, help="default: drawn, and printed")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--limit", type=float, default=LIMIT, help="s of processor time on one input")
    parser.add_argument("--most", type=int, default=10**9, help="inputs of each kind")
    parser.add_argument("--keep", action="store_true", help="leave failing inputs in tests/fuzz/found/")
    parser.add_argument("--replay", nargs="*", metavar="FILE")
    parser.add_argument("--again", nargs=3, metavar=("SEED", "KIND", "NUMBER"))
    given = parser.parse_args()
    if given.replay is not None:
        return 1 if replay(given.replay or sorted(FOUND.glob("*.json"))) else 0
    if given.again:
        seed, kind, number = given.again
        spec = make(kind, int(seed), int(number))
        import checks

        print(json.dumps(spec))
        for finding in checks.run(spec):
            print(*finding, sep=": ")
        return 0
    seed = given.seed if given.seed is not None else int.from_bytes(os.urandom(6), "little")
    kinds = given.kinds.split(",")
    print(f"seed {seed}", flush=True)
    campaign = Campaign(given.keep)
    total = sum(SHARE[kind] for kind in kinds)
    for kind in kinds:
        campaign.run(kind, seed, 60.0 * given.minutes * SHARE[kind] / total, given.limit, given.most)
    print("\n".join(campaign.report()))
    return 1 if campaign.findings else 0


if __name__ == "__main__":
    sys.exit(main())
