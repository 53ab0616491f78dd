"""Print a command of README.md: the one line in the code block after `<!-- command: NAME -->`.

python .ci/readme_command.py NAME
"""

import re
import sys
from pathlib import Path

README = Path(__file__).resolve().parent.parent / "README.md"


def command(name: str) -> str:
    """The command marked `name`; LookupError unless it stands there once, on one line."""
    text = README.read_text(encoding="utf-8")
    found = re.findall(rf"<!-- command: {re.escape(name)} -->\n```sh\n([^\n]+)\n```\n", text)
    if len(found) != 1:
        raise LookupError(f"README.md holds {len(found)} one-line commands marked {name!r}, not 1")
    return found[0]


if __name__ == "__main__":
    print(command(sys.argv[1]))
