"""Build of the compiled kernels; everything else about the package is in pyproject.toml.

Environment:

    LAVENDER_DEBUG=1        check every index of every memoryview, -Og -g1
    LAVENDER_DEBUG=asan     the same with the address and undefined-behaviour sanitizers, which also check raw
                            pointers (gcc; run Python with LD_PRELOAD="$(gcc -print-file-name=libasan.so)")
    LAVENDER_DEBUG=coverage processes count the lines of C that they run, for .ci/kernel_coverage (gcc, -Og)
    CYTHON_CACHE_DIR=D      cache translations in D by the hash of their sources, as ccache does for C
    LAVENDER_FILES_URL=U    base address of the files of this version: prefix of links and pictures in the long
                            description, since a package index shows only its text, and of the project's URLs
"""

import gc
import gzip
import json
import logging
import multiprocessing
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tarfile
from functools import cache
from pathlib import Path

import Cython
import numpy
from Cython.Build import cythonize
from Cython.Build.Dependencies import DependencyTree
from setuptools import Command, Extension, setup
from setuptools.command.build import build
from setuptools.command.build_ext import build_ext
from setuptools.command.sdist import sdist
from setuptools.errors import CompileError

# Time stamp of every file in an archive [s]: arbitrary, but the same on every machine. Wheels use it, too.
os.environ.setdefault("SOURCE_DATE_EPOCH", "1580601600")  # 2020-02-02, hatchling's value
MODE = os.environ.get("LAVENDER_DEBUG", "")
DEBUG = MODE not in ("", "0")
OPTIONS = runpy.run_path("lavender_ext/build_options.py")
WASM = runpy.run_path("lavender/sim/web/compile.py")
put = WASM["write_atomically"]
LIBRARY = runpy.run_path("lavender/export/amalgamate.py")
DIRECTIVES = OPTIONS["directives"](debug=DEBUG and MODE != "coverage")
if MODE == "coverage":
    DIRECTIVES["emit_code_comments"] = True  # They name the lines of the sources.
#: Module with Cython's utility code (memoryviews), which would otherwise be half of the code of every module.
SHARED = "lavender_ext._utility"

#: Modules whose loops need the update of a block inlined into them: -O3 and gcc's inlining limits raised (INLINE).
#: With lower limits they execute 2 to 12 % more instructions; at -O2 a sweep takes up to 1.7 times as long.
HOT = ("sweep/", "local/", "driver/driver", "engine/substep")
#: Modules compiled with -O3 and lower inlining limits: at -O2 a factorisation takes twice as long, and a solve of few
#: bodies by Newton's method 1.2 to 1.3 times, also with -fpeel-loops.
FAST = ("factor/linear", "program/rows", "judge/measure", "program/error", "newton/solve")
#: Modules without expensive loops: -O1, half of the compile time of -O2. All others are compiled at -O2 with gcc's full
#: vectoriser; solve times stay within 1 % of those at -O3, which takes a sixth longer to compile.
COLD = (
    "_utility",
    "driver/memory",
    "engine/arrays",
    "engine/newton_substep",
    "core/blocks",
    "core/checks",
    "core/method",
    "core/order",
    "factor/graph",
    "factor/sparse",
    "io/",
)

LINK_ARGS, INLINE, LIMITS = [], [], []
if sys.platform == "win32":
    COMPILE_ARGS = ["/Od", "/fp:precise"] if DEBUG else ["/O2", "/fp:precise"]
else:
    # -w: .ci/check_kernels.py checks the C code for warnings; here they would take 5 % of the compile time.
    COMPILE_ARGS = ["-Og", "-g1"] if DEBUG else ["-O3", "-g0", "-w"]
    if not DEBUG:
        INLINE = ["-finline-limit=2000", "--param=inline-unit-growth=70"]
        LIMITS = ["-finline-limit=600", "--param=inline-unit-growth=40"]
    COMPILE_ARGS += [*OPTIONS["COMPILE_FLAGS"], "-Wno-unused-function"]
    LINK_ARGS += OPTIONS["LINK_FLAGS"]
    if MODE == "asan":
        # Without the checks that a signal or the address sanitizer replaces: they take a third of the compile time.
        sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"]
        sanitizers += ["-fno-sanitize=null,object-size,pointer-overflow"]
        LINK_ARGS += sanitizers
        COMPILE_ARGS += [*sanitizers, "-fno-omit-frame-pointer"]
    if MODE == "coverage":
        LINK_ARGS.append("--coverage")
        COMPILE_ARGS += ["--coverage", "-fprofile-update=atomic"]


def is_part_of_cython(path):
    """Return whether a file belongs to Cython. These depend on its version only; pip installs them anew each time."""
    return Path(path).is_relative_to(Path(Cython.__file__).parent)


def changed_at(_, path):
    """Return the time stamp of a source, 0 for Cython's own files."""
    return 0.0 if is_part_of_cython(path) else os.path.getmtime(path)


DependencyTree.timestamp = changed_at


class BuildKernels(build_ext):
    """Translate .pyx to C under build/, in parallel, only when an extension is built (not for an sdist)."""

    def finalize_options(self):
        """Add the extensions of the kernel benchmarks to builds in place; wheels do not contain them.

        An editable install compiles in the folders of `build_ext --inplace`, not in temporary folders, in which every
        later `pip install -e` would compile all kernels again.
        """
        if self.inplace or self.editable_mode:
            self.distribution.ext_modules += map(
                extension, sorted(Path("benchmarks").rglob("*.pyx"))
            )
        if self.editable_mode:
            folders = build(self.distribution)
            folders.ensure_finalized()
            self.build_lib, self.build_temp = folders.build_lib, folders.build_temp
        super().finalize_options()

    def run(self):
        """Translate, then compile; rebuild everything if flags or directives have changed."""
        check_compiler()
        out = Path("build", "cython")
        stamp = out / "how.json"
        how = json.dumps(
            [
                Cython.__version__,
                SHARED,
                DIRECTIVES,
                COMPILE_ARGS,
                LINK_ARGS,
                INLINE,
                LIMITS,
                HOT,
                FAST,
                COLD,
            ]
        )
        current = stamp.exists() and stamp.read_text() == how
        if not current:
            self.force = True  # file times do not show changed flags
        # A killed build leaves incomplete files that are newer than their sources. Without the stamp,
        # lavender/sim/web/extract_c.py makes its own translations instead of reading incomplete ones.
        stamp.unlink(missing_ok=True)
        if self.force:
            for translated in out.rglob("*.c"):
                translated.unlink()
        out.mkdir(parents=True, exist_ok=True)
        try:
            self.translate_and_compile(out)
        except Exception:  # the error was reported, and no output of the failed step exists
            if current:
                put(stamp, how.encode())
            raise
        put(stamp, how.encode())

    def translate_and_compile(self, out):
        """Translate into a folder, then compile."""
        workers = os.cpu_count() or 1
        forks = (
            multiprocessing.get_start_method() == "fork"
        )  # with other methods workers would execute this file again
        gc.disable()  # syntax trees live until the end: collecting garbage would take two fifths of the translation
        translated = cythonize(
            self.extensions,
            build_dir=str(out),
            compiler_directives=DIRECTIVES,
            cache=os.environ.get("CYTHON_CACHE_DIR", False),
            nthreads=workers if forks else 0,
            shared_utility_qualified_name=SHARED,
        )
        gc.enable()
        for module, c_module in zip(self.extensions, translated, strict=True):
            # Cython does not know which headers a header includes.
            text = Path(c_module.sources[0]).read_text(encoding="utf-8")
            headers = [str(h) for h in Path("lavender_ext").glob("*/*.h") if f'{h.name}"' in text]
            headers += [h.replace(".h", "_body.h") for h in headers]
            module.sources = c_module.sources
            module.depends = [
                path for path in c_module.depends if not is_part_of_cython(path)
            ] + headers
        # Compile the largest modules first: a long one that starts last would delay the end of the build.
        self.extensions.sort(key=lambda module: -os.path.getsize(module.sources[0]))
        self.parallel = self.parallel or workers
        super().run()


def find_compiler():
    """Return the command of the C compiler that setuptools selects; empty on Windows."""
    return shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "")


@cache
def is_known(option):
    """Return whether the C compiler knows an option; clang stops at some of gcc's."""
    command = [*find_compiler(), "-Werror", option, "-E", "-x", "c", os.devnull]
    try:
        return not subprocess.run(command, capture_output=True, check=False).returncode
    except OSError:  # check_compiler says so, if something is to be compiled.
        return False


def check_compiler():
    """Raise CompileError without a C compiler or Python's headers, before minutes of translation."""
    command = find_compiler()
    if command and not shutil.which(command[0]):
        raise CompileError(
            f"the kernels are C, and no compiler {command[0]!r} is found: install one (Debian and Ubuntu: "
            "apt install build-essential; macOS: xcode-select --install), or name yours, as CC=clang"
        )
    headers = Path(sysconfig.get_path("include"))
    if not (headers / "Python.h").is_file():
        raise CompileError(
            f"the kernels need Python's headers, and {headers} has none: install them (Debian and Ubuntu: "
            "apt install python3-dev; Fedora: dnf install python3-devel)"
        )


class BuildWasm(Command):
    """Compile the kernels to WebAssembly if a compiler for it is installed (the extra `wasm`)."""

    user_options = [("build-lib=", None, "folder of what is installed")]  # noqa: RUF012 - as the base class asks

    def initialize_options(self):
        """Initialise the options."""
        self.build_lib = None
        self.editable_mode = False

    def finalize_options(self):
        """Take the options of `build`."""
        self.set_undefined_options("build", ("build_lib", "build_lib"))

    def run(self):
        """Copy the modules that are up to date; build the others, or report why they cannot be built."""
        if self.editable_mode:
            return  # `lavender web` builds it when it is first needed
        for name, part in WASM["PARTS"].items():
            here = Path("lavender", "sim", "web", f"{name}.wasm")
            out = Path(self.build_lib, here)
            out.parent.mkdir(parents=True, exist_ok=True)
            if WASM["is_current"](here, Path(), part):
                out.write_bytes(here.read_bytes())
                continue
            reason = WASM["explain_missing_requirement"]()
            if reason:
                self.announce(f"no WebAssembly module {name}: {reason}", level=logging.INFO)
            else:
                WASM["build"](
                    out, Path().resolve(), part.modules, imports_memory=part.imports_memory
                )

    def get_outputs(self):
        """Return the paths of the modules that were built."""
        modules = (
            Path(self.build_lib, "lavender", "sim", "web", f"{name}.wasm") for name in WASM["PARTS"]
        )
        return [str(out) for out in modules if out.exists()]

    def get_output_mapping(self):
        """Return {}: outputs have no single source file."""
        return {}

    def get_source_files(self):
        """Return []: the sources are listed by the extensions."""
        return []


class BuildLibrary(Command):
    """Build the C library of the kernels (lavender/export/amalgamate.py) and add its files to the wheel."""

    user_options = [("build-lib=", None, "folder of what is installed")]  # noqa: RUF012 - as the base class asks

    def initialize_options(self):
        """Initialise the options."""
        self.build_lib = None
        self.editable_mode = False
        self.written = []

    def finalize_options(self):
        """Take the options of `build`."""
        self.set_undefined_options("build", ("build_lib", "build_lib"))

    def run(self):
        """Write the single C source from the translations of this build, and copy the other files of the library."""
        if self.editable_mode:
            return  # `lavender export` builds it when it is first needed
        for path in [*sorted(Path("lavender/export").rglob("*.*")), make_library()]:
            if path.is_file() and path.suffix not in (".py", ".pyc", ".part"):
                out = Path(self.build_lib, path)
                out.parent.mkdir(parents=True, exist_ok=True)
                out.write_bytes(path.read_bytes())
                self.written.append(str(out))

    def get_outputs(self):
        """Return the paths of source, header and the other files of the library."""
        return self.written

    def get_output_mapping(self):
        """Return {}: outputs have no single source file."""
        return {}

    def get_source_files(self):
        """Return []: the sources are listed by the extensions."""
        return []


def make_library():
    """Bring lavender/export/c/lavender.c up to date with the kernels and return its path."""
    out = Path("lavender", "export", "c", "lavender.c")
    if not (
        out.exists() and LIBRARY["hash_sources"](Path()) in out.read_text(encoding="utf-8")[:1000]
    ):
        put(out, LIBRARY["amalgamate"](Path().resolve(), Path("build", "cython")).encode())
    return out


class ReproducibleArchive(sdist):
    """Source distribution with bytes that depend on its files only, not on clock, owner, umask or directory order."""

    def run(self):
        """Make the C library and the WebAssembly modules first: an unpacked archive needs no compiler for them."""
        make_library()
        for name, part in WASM["PARTS"].items():
            path = Path("lavender", "sim", "web", f"{name}.wasm")
            if not WASM["is_current"](path, Path(), part):
                if reason := WASM["explain_missing_requirement"]():
                    raise CompileError(
                        f"a source distribution contains {path}, which cannot be built here: {reason}"
                    )
                WASM["build"](
                    path, Path().resolve(), part.modules, imports_memory=part.imports_memory
                )
        super().run()

    def make_archive(self, base_name, format, root_dir=None, base_dir=None, owner=None, group=None):  # noqa: A002
        """Make a reproducible archive (`gztar`, the format of frontends) and return its path."""
        if format != "gztar":
            return super().make_archive(base_name, format, root_dir, base_dir, owner, group)
        out = Path(f"{base_name}.tar.gz")
        epoch = int(os.environ["SOURCE_DATE_EPOCH"])
        out.parent.mkdir(parents=True, exist_ok=True)
        top = Path(root_dir or ".", base_dir)
        with (
            out.open("wb") as raw,
            gzip.GzipFile("", "wb", compresslevel=9, fileobj=raw, mtime=epoch) as packed,
            tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive,
        ):
            for path in sorted((p for p in top.rglob("*") if p.is_file()), key=Path.as_posix):
                entry = tarfile.TarInfo(f"{base_dir}/{path.relative_to(top).as_posix()}")
                entry.size = path.stat().st_size
                entry.mtime = epoch
                entry.mode = 0o755 if path.stat().st_mode & 0o100 else 0o644
                with path.open("rb") as data:
                    archive.addfile(entry, data)
        return str(out)


build.sub_commands = [*build.sub_commands, ("build_wasm", None), ("build_library", None)]


def extension(path):
    """Return the extension module of a .pyx file, with its compiler options."""
    name = path.as_posix().removeprefix("lavender_ext/")
    options = []
    if LIMITS and name.startswith(COLD):
        options = ["-O1"]
    elif LIMITS and name.startswith(HOT):
        options = INLINE
    elif LIMITS:
        level = [] if name.startswith(FAST) else ["-O2", "-fvect-cost-model=dynamic"]
        options = [*level, *LIMITS]
    return Extension(
        ".".join(path.with_suffix("").parts),
        [path.as_posix()],
        # headers of C that several widths of vectors share, and those of NumPy
        include_dirs=[path.parent.as_posix(), ".", numpy.get_include()],
        extra_compile_args=[*COMPILE_ARGS, *filter(is_known, options)],
        extra_link_args=LINK_ARGS,
    )


FILES_URL = os.environ.get("LAVENDER_FILES_URL", "").rstrip("/")


def long_description():
    """Return README.md, with absolute links and pictures if LAVENDER_FILES_URL is set."""
    text = Path("README.md").read_text(encoding="utf-8")
    return (
        re.sub(r"\]\((?![a-z]+:|#)([^)\s]+)\)", rf"]({FILES_URL}/\1)", text) if FILES_URL else text
    )


def project_urls():
    """Return `[project.urls]`, below LAVENDER_FILES_URL; none if it is not set."""
    pages = {
        "Documentation": "docs/index.md",
        "Changelog": "CHANGELOG.md",
        "Citation": "CITATION.cff",
    }
    return (
        {"Source": FILES_URL} | {k: f"{FILES_URL}/{p}" for k, p in pages.items()}
        if FILES_URL
        else {}
    )


setup(
    long_description=long_description(),
    long_description_content_type="text/markdown",
    project_urls=project_urls(),
    ext_modules=[
        *(extension(path) for path in sorted(Path("lavender_ext").rglob("*.pyx"))),
        # written by cythonize
        extension(Path(*SHARED.split(".")).with_suffix(".c")),
    ],
    # Make an editable install a line of a .pth file. Setuptools' finder would come after the folders of sys.path, so
    # that a clone named lavender in one of them would be imported as an empty package.
    options={"editable_wheel": {"mode": "compat"}},
    cmdclass={
        "build_ext": BuildKernels,
        "build_wasm": BuildWasm,
        "build_library": BuildLibrary,
        "sdist": ReproducibleArchive,
    },
)
