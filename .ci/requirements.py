"""Print what extras of the installed package ask for, one requirement a line, so that pip need not build it again.

python .ci/requirements.py EXTRA ...
python .ci/requirements.py --lowest        what is always needed, in the lowest version that is allowed
"""

import re
import sys
from collections.abc import Iterator
from importlib.metadata import requires


def of(extra: str) -> Iterator[str]:
    """Requirements of one extra; where it names other extras of the package, theirs."""
    found = 0
    for line in requires("lavender-contact") or []:
        requirement, _, marker = line.partition(";")
        if not re.search(rf"""extra == ["']{re.escape(extra)}["']""", marker):
            continue
        found += 1
        own = re.fullmatch(r"lavender-contact\[([\w,-]+)\]", requirement.strip())
        if own:
            for other in own[1].split(","):
                yield from of(other)
        else:
            yield requirement.strip()
    if not found:
        raise LookupError(f"lavender-contact has no extra {extra!r}")


def lowest() -> Iterator[str]:
    """NAME==VERSION of each package that is always needed."""
    for line in requires("lavender-contact") or []:
        requirement, _, marker = line.partition(";")
        if "extra" not in marker:
            yield requirement.strip().replace(">=", "==")


if __name__ == "__main__":
    asked = sys.argv[1:]
    lines = lowest() if asked == ["--lowest"] else (line for extra in asked for line in of(extra))
    print("\n".join(dict.fromkeys(lines)))
