"""The same generators, led by coverage: libFuzzer, through atheris, looks for choices that reach new lines.

    python tests/fuzz/guided.py KIND [--runs N] [--seconds S] [--seed N]

KIND is file, snapshot, steps or solve. The bytes that libFuzzer changes are the choices of the generator (`Led`),
so that what it makes is a whole file or scene and not noise that the first checksum refuses; the lines that it
counts are those of lavender's Python. Failing inputs become files in tests/fuzz/found/, as those of fuzz.py, which
replays them. The exit status is 1 where anything failed. Needs the package atheris, which no extra installs: there
is one for Linux alone.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import atheris
import numpy as np

HERE = Path(__file__).resolve().parent
#: What a kind is to cover; the rest of the package runs at full speed.
COVERED = {
    "file": ["lavender.io", "lavender.problem", "lavender.cones", "lavender.rows", "lavender.generalized"],
    "snapshot": ["lavender.engine"],
    "steps": ["lavender.engine", "lavender.scene"],
    "solve": ["lavender.solve", "lavender.solvers", "lavender.problem", "lavender.residuals"],
}
LIMIT = 60  # s on one input, after which it is a hang


class Led:
    """Choices that libFuzzer makes; beyond its bytes the first of each."""

    def __init__(self, data):
        self.data = atheris.FuzzedDataProvider(data)

    def whole(self, low, high):
        return self.data.ConsumeIntInRange(low, high)

    def pick(self, options):
        return options[self.whole(0, len(options) - 1)]

    def chance(self, p):
        return self.whole(0, 99) >= 100 - round(100 * p)

    def normals(self, n):
        return np.array([self.whole(-(2**15), 2**15) / 2.0**13 for _ in range(n)], float)


class Told:
    """Findings and counts, written where the parent reads them: libFuzzer ends its process without a last word."""

    def __init__(self, path):
        self.path, self.inputs, self.last = path, 0, 0.0

    def add(self, finding):
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(json.dumps(finding) + "\n")

    def count(self, counts):
        self.inputs += 1
        if time.monotonic() - self.last > 0.2:
            self.last = time.monotonic()
            self.add({"counts": counts, "inputs": self.inputs})


def fuzz(given, folder, told):
    """Until libFuzzer ends this process."""
    with atheris.instrument_imports(include=COVERED[given.kind]):
        import checks

    checks.MAKE[given.kind](Led(b""))  # the files that others are made of

    def check(data):
        spec = checks.MAKE[given.kind](Led(data))
        for what, detail in checks.run(spec):
            told.add({"finding": what, "detail": detail, "spec": spec})
        told.count(checks.COUNTS)

    corpus = folder / "corpus"
    corpus.mkdir()
    rng = np.random.default_rng(given.seed)
    for i in range(64):  # choices to begin with
        (corpus / str(i)).write_bytes(rng.bytes(int(rng.integers(16, 2000))))
    atheris.Setup(
        [sys.argv[0], f"-max_total_time={given.seconds}", f"-runs={given.runs}", f"-seed={given.seed}",
         f"-timeout={LIMIT}", f"-artifact_prefix={folder}/ended-", "-max_len=4000", "-rss_limit_mb=6000", str(corpus)],
        check,
    )  # fmt: skip
    atheris.Fuzz()


def main():
    """Command line; libFuzzer's own report goes to stderr."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("kind", choices=tuple(COVERED))
    parser.add_argument("--runs", type=int, default=-1, help="inputs; default: until the time is over")
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    sys.path[:0] = [str(HERE), str(HERE.parent.parent)]
    with tempfile.TemporaryDirectory(prefix="lavender-guided.") as name:
        folder = Path(name)
        child = os.fork()
        if not child:
            fuzz(given, folder, Told(folder / "told"))
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return report(given, folder, status)


def report(given, folder, status):
    """Counts and findings of the child; those that ended it from what libFuzzer left of them."""
    import checks
    from fuzz import Campaign

    campaign = Campaign(keep=True)
    place = {"kind": given.kind, "seed": given.seed, "number": -1}
    for line in (folder / "told").read_text(encoding="utf-8").splitlines():
        message = json.loads(line)
        if "counts" in message:
            campaign.counts, campaign.inputs[given.kind] = message["counts"], message["inputs"]
        else:
            campaign.add({**message, **place})
    for path in folder.glob("ended-*"):
        what = path.name.split("-")[1]
        spec = checks.MAKE[given.kind](Led(path.read_bytes()))
        what = {"timeout": "hang"}.get(what, what)
        campaign.add({"finding": what, "detail": f"status {status}", "spec": spec, **place})
    if status and not campaign.findings:
        campaign.add({"finding": "crash", "detail": f"status {status}, no input left", "spec": {}, **place})
    print("\n".join(campaign.report()))
    return 1 if campaign.findings else 0


if __name__ == "__main__":
    sys.exit(main())
