"""Record which tests enter the functions of given files, Python and kernels alike.

Every function of a file gets a call of `mark(number)`, which sets a byte of a file in memory. As a plug-in of pytest
this module clears the bytes before each test and writes the test's name with the numbers that are set after it;
processes that a test starts count as well.
"""

import mmap
import os
import re
from collections.abc import Iterator
from pathlib import Path

MAX_FILES = 4096
HEADER = re.compile(r"\s*(async def|def|cpdef|cdef(?! class| extern)) [^=]*\(|\s*def ")
DECLARATION_PATH = "lavender_ext/core/reach.pxd"
IMPORT = "from lavender_ext.core.reach cimport mark"
DECLARATION = '''cdef extern from *:
    """
    #include <fcntl.h>
    #include <stdlib.h>
    #include <sys/mman.h>
    static void lavender_mark(int number) {
        static volatile char* bytes = NULL;
        if (!bytes) {
            const char* path = getenv("LAVENDER_REACH");
            int file = path ? open(path, O_RDWR) : -1;
            void* map = file < 0 ? MAP_FAILED : mmap(NULL, 4096, PROT_WRITE, MAP_SHARED, file, 0);
            bytes = map == MAP_FAILED ? (volatile char*)malloc(4096) : (volatile char*)map;
        }
        bytes[number] = 1;
    }
    """
    void mark "lavender_mark"(int number) noexcept nogil
'''
_bytes: mmap.mmap | bytearray = bytearray(MAX_FILES)


def mark(number: int) -> None:
    """Note that a function of the file with this number is entered."""
    _bytes[number] = 1


def insert_marks(text: str, number: int, is_kernel: bool) -> str:
    """Return the text of a file with a call of `mark` at the beginning of every function."""
    call = f"mark({number})" if is_kernel else f"__import__('fault_reach').mark({number})"
    lines = text.splitlines()
    out = list[str]()
    depth = 0
    is_header = False
    is_text = False
    waits = -1  # Indentation of a function whose first statement is yet to come.
    for line in lines:
        code = re.sub(r'"[^"]*"|#.*', "", line)
        if waits >= 0 and not is_text and line.strip() and not line.strip().startswith('"""'):
            indent = len(line) - len(line.lstrip())
            if indent > waits:
                out.append(" " * indent + call)
            waits = -1
        if line.count('"""') == 1:
            is_text = not is_text
        out.append(line)
        if is_text or '"""' in line:
            continue
        if depth == 0:
            is_header = bool(HEADER.match(code))
        depth += sum(map(code.count, "([{")) - sum(map(code.count, ")]}"))
        if depth == 0 and is_header and code.rstrip().endswith(":"):
            header = next(text for text in reversed(out) if HEADER.match(text))
            waits = len(header) - len(header.lstrip())
            is_header = False
    return "\n".join([*out, ""])


def pytest_configure() -> None:
    """Share the bytes of this process of pytest with kernels and with processes that tests start."""
    global _bytes
    path = Path(f"{os.environ['LAVENDER_REACH_OUT']}.{os.getpid()}")
    path.write_bytes(bytes(MAX_FILES))
    os.environ["LAVENDER_REACH"] = str(path)
    with path.open("r+b") as file:
        _bytes = mmap.mmap(file.fileno(), MAX_FILES)


def pytest_runtest_setup() -> None:
    """Clear the bytes before a test."""
    _bytes[:] = bytes(MAX_FILES)


def pytest_runtest_teardown(item: object) -> None:
    """Write the name of a test and the numbers of the files that it has entered."""
    numbers = " ".join(str(k) for k, x in enumerate(_bytes[:]) if x)
    with open(f"{os.environ['LAVENDER_REACH_OUT']}.{os.getpid()}.txt", "a") as file:
        file.write(f"{numbers}\t{item.nodeid}\n")  # type: ignore[attr-defined]


def read_reaching_tests(out: Path, paths: list[str]) -> dict[str, list[str]]:
    """Return the tests that enter each file."""
    found: dict[str, list[str]] = {path: [] for path in paths}
    for line in iterate_records(out):
        numbers, name = line.split("\t")
        for number in numbers.split():
            found[paths[int(number)]].append(name)
    return found


def iterate_records(out: Path) -> Iterator[str]:
    """Yield the lines of all processes."""
    for path in sorted(out.parent.glob(f"{out.name}.*.txt")):
        yield from path.read_text().splitlines()
