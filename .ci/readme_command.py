"""Print commands of a page: the one marked `<!-- command: NAME -->`, or all that its text shows, one a line.

python .ci/readme_command.py NAME [PAGE.md]
python .ci/readme_command.py --all PAGE.md

PAGE.md is README.md where none is given. `--all` lists what stands in backticks and begins with python, or with
lavender and more than one word of a command that ends (`lavender web` alone serves a page until Ctrl-C).
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def command(name: str, page: str = "README.md") -> str:
    """The command marked `name`; LookupError unless it stands there once, on one line."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.findall(rf"<!-- command: {re.escape(name)} -->\n```sh\n([^\n]+)\n```\n", text)
    if len(found) != 1:
        raise LookupError(f"{page} holds {len(found)} one-line commands marked {name!r}, not 1")
    return found[0]


def every(page: str) -> list[str]:
    """Every command that the page shows within its text, once, in its order."""
    text = re.sub(r"<!--.*?-->", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    found = re.findall(r"`((?:python (?:examples/|-m )|lavender [a-z]+ )[^`]*|lavender web check)`", text)
    return list(dict.fromkeys(found))


if __name__ == "__main__":
    print("\n".join(every(sys.argv[2])) if sys.argv[1] == "--all" else command(*sys.argv[1:]))
