"""Texts that people read, compared with approved copies in tests/approved.

LAVENDER_APPROVED=write replaces the copies by the present texts, without workers: read the change before a commit.
"""

import os
import re
from pathlib import Path

FOLDER = Path(__file__).parent / "approved"


def check_text(file, section, text):
    """Require that a text equals a section of a file in tests/approved, but for blanks at the ends of lines."""
    path = FOLDER / file
    parts = (
        re.split(r"^== (.+)\n", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        if path.exists()
        else [""]
    )
    approved = {
        title: body.rstrip("\n") for title, body in zip(parts[1::2], parts[2::2], strict=True)
    }
    text = "\n".join(line.rstrip() for line in text.strip("\n").split("\n"))
    if os.environ.get("LAVENDER_APPROVED") == "write":
        approved[section] = text
        path.write_text(
            "\n".join(f"== {title}\n{body}\n" for title, body in approved.items()), encoding="utf-8"
        )
    assert text == approved[section]
