"""lavender.h through ctypes: structs field by field, problems of the package as problems of the library."""

import ctypes as ct
import re
import subprocess
from pathlib import Path

import numpy as np
from header import parse_struct_fields, strip_comments
from vectors import METHODS, make_problem_view

from lavender.export import HEADER

STRUCTS = ("lav_problem", "lav_options", "lav_budget", "lav_verdict", "lav_motion", "lav_result")
SWEEPS = (
    "sequential_impulses",
    "pgs",
    "block_gauss_seidel",
    "anderson",
    "nncg",
)  # under friction too
COUNTS = (
    "form",
    "law",
    "n_blocks",
    "n_rows",
    "n_entries",
    "n_bodies",
    "n_joints",
    "n_velocities",
    "n_mass_entries",
)


def functions(header):
    """Return (type, name, arguments) of every function of the header."""
    found = re.findall(
        r"LAV_API ((?:const )?\w+ \*?)(\w+)\((.*?)\);", strip_comments(header), re.DOTALL
    )
    return [
        (
            kind.strip(),
            name,
            [] if args.strip() == "void" else [" ".join(a.split()) for a in args.split(",")],
        )
        for kind, name, args in found
    ]


def _struct(name):
    kinds = {
        "int32_t": ct.c_int32,
        "uint32_t": ct.c_uint32,
        "uint64_t": ct.c_uint64,
        "double": ct.c_double,
    }
    fields = []
    for kind, field in parse_struct_fields(HEADER.read_text(), name):
        fields.append((field, Verdict if kind == "lav_verdict" else kinds.get(kind, ct.c_void_p)))
    return type(name, (ct.Structure,), {"_fields_": fields})


Verdict, Motion = _struct("lav_verdict"), _struct("lav_motion")
Problem, Options, Budget, Result = (
    _struct(f"lav_{name}") for name in ("problem", "options", "budget", "result")
)


class Library:
    """A shared library that was built from lavender.c."""

    def __init__(self, path: Path):
        self.path = path
        self.c = ct.CDLL(str(path))
        self.c.lav_velocity.argtypes = [ct.c_void_p, ct.c_void_p, ct.c_int32]
        self.c.lav_islands.argtypes = [ct.c_void_p, ct.c_void_p, ct.c_int32]
        self.c.lav_text.restype = self.c.lav_name.restype = self.c.lav_outcome.restype = ct.c_char_p
        self.c.lav_refused.restype = ct.c_char_p
        self.c.lav_refused.argtypes = [ct.c_void_p, ct.c_void_p]
        self.c.lav_hash.restype = self.c.lav_needed.restype = ct.c_uint64
        self.c.lav_needed.argtypes = [ct.c_void_p]
        self.c.lav_hash.argtypes = [ct.c_void_p, ct.c_int32, ct.c_uint64]

    def options(self, method, **given):
        made = Options()
        assert self.c.lav_default_options(METHODS[method], ct.byref(made)) == 0
        for key, value in given.items():
            setattr(made, key, value)
        return made

    def budget(self, iterations, tol, velocity_tol=0.0):
        made = Budget()
        assert self.c.lav_default_budget(ct.byref(made)) == 0 and made.velocity_tol == 0.0
        made.iterations, made.tol, made.velocity_tol = iterations, tol, velocity_tol
        return made

    def problem(self, given, **more):
        """A problem of the package as the library takes it, with the arrays that it points to."""
        found = make_problem_view(given)
        made = Problem()
        made.size = ct.sizeof(Problem)
        for key, value in zip(COUNTS, found.counts, strict=True):
            setattr(made, key, value)
        made.keep = found.arrays | more
        for key, values in made.keep.items():
            setattr(made, key, None if values is None or not values.size else values.ctypes.data)
        return made

    def workspace(self, problem, options):
        """Bytes that a solver asks for."""
        workspace = ct.c_uint64()
        code = self.c.lav_workspace_size(ct.byref(problem), ct.byref(options), ct.byref(workspace))
        if code:
            raise Refused(self, code)
        return workspace

    def open(self, problem, options, extra=0):
        workspace = self.workspace(problem, options)
        while True:
            memory = (ct.c_double * ((workspace.value + extra) // 8 + 2))()
            solver = ct.c_void_p()
            code = self.c.lav_open(
                memory,
                ct.c_uint64(ct.sizeof(memory)),
                ct.byref(problem),
                ct.byref(options),
                ct.byref(solver),
            )
            if code:
                raise Refused(self, code)
            code = self.c.lav_set(solver, ct.byref(problem))
            if code != -10:
                break
            workspace.value = self.c.lav_needed(solver)
        if code:
            raise Refused(self, code)
        return Solver(self, solver, memory, problem)


class Refused(Exception):
    def __init__(self, library, code):
        super().__init__(f"{code}: {library.c.lav_text(code).decode()}")
        self.code = code


class Solver:
    def __init__(self, library, at, memory, problem):
        self.library = library
        self.at = at
        self.memory = memory
        self.m = problem.n_rows

    def set(self, problem):
        code = self.library.c.lav_set(self.at, ct.byref(problem))
        self.m = problem.n_rows
        return code

    def run(self, iterations, tol, velocity_tol=0.0):
        out = Result()
        out.size = ct.sizeof(Result)
        budget = self.library.budget(iterations, tol, velocity_tol)
        code = self.library.c.lav_run(self.at, ct.byref(budget), ct.byref(out))
        if code:
            raise Refused(self.library, code)
        return out

    def impulse(self):
        out = np.zeros(self.m)
        code = self.library.c.lav_impulse(
            self.at, out.ctypes.data_as(ct.c_void_p), ct.c_int32(self.m)
        )
        if code:
            raise Refused(self.library, code)
        return out


def run(*command, **more):
    """What a command prints; it has to succeed."""
    done = subprocess.run(
        [str(c) for c in command], capture_output=True, text=True, check=False, **more
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
