"""A host of the WebAssembly module in Python, by wasmtime: the twin of lavender/web/page/lavender.js."""

import ctypes
import functools
import json

import numpy as np
import wasmtime

SIZES = 10  # entries of size[]
NEED_ROOM = 1


ENGINE = wasmtime.Engine()  # one for all: a module runs in the stores of its engine alone


@functools.cache
def compiled(data):
    """A module: compiling takes longer than most of what the tests then run."""
    return wasmtime.Module(ENGINE, data)


class Kernels:
    """An instance of the module, its memory, and places in it."""

    def __init__(self, data, layout):
        module = compiled(data)
        self.store = wasmtime.Store(ENGINE)
        self.exports = wasmtime.Instance(self.store, module, []).exports(self.store)
        self.memory = self.exports["memory"]
        self.layout = layout
        self.top = self.exports["__heap_base"].value(self.store)
        self.offsets = {}
        self.sizes = {}
        names = [(name, field) for name, fields in layout["structs"].items() for field in (None, *fields)]
        place = self.alloc(4 * len(names))
        self.call("lav_layout", place)
        for (name, field), at in zip(names, self.view(place, len(names), np.int32).tolist(), strict=True):
            if field is None:
                self.sizes[name] = at
            else:
                self.offsets[name, field] = at

    def call(self, name, *arguments):
        return self.exports[name](self.store, *arguments)

    def alloc(self, size):
        """Zeroed bytes (memory starts as zeros and is never given back)."""
        place = -(-self.top // 16) * 16
        self.top = place + size
        missing = self.top - self.memory.data_len(self.store)
        if missing > 0:
            self.memory.grow(self.store, -(-missing // 65536))
        return place

    def view(self, place, n, dtype):
        """A live view of memory; growing detaches it."""
        start = ctypes.addressof(self.memory.data_ptr(self.store).contents) + place
        size = n * np.dtype(dtype).itemsize
        return np.frombuffer((ctypes.c_ubyte * size).from_address(start), dtype)

    def put(self, values):
        values = np.ascontiguousarray(values)
        place = self.alloc(max(values.nbytes, 8))
        self.view(place, values.size, values.dtype)[:] = values.ravel()
        return place

    def put_struct(self, name, **values):
        """A struct of pointers and 32-bit integers."""
        place = self.alloc(self.sizes[name])
        for field, value in values.items():
            self.view(place + self.offsets[name, field], 1, np.int32)[0] = value
        return place

    def read_struct(self, name, place):
        """A struct without arrays."""
        kinds = {"i4": np.int32, "f8": np.float64}
        return {
            field: self.view(place + self.offsets[name, field], 1, kinds[kind])[0].item()
            for field, kind in self.layout["structs"][name].items()
        }


class Simulation:
    """A scene as lavender.web.scenes.describe gives it."""

    def __init__(self, kernels, scene):
        self.k = kernels
        self.substeps = scene["substeps"]
        self.allocate(np.array(scene["size"], np.int32))
        for name, values in scene["arrays"].items():
            self.array(name)[:] = values
        self.done = kernels.alloc(8)
        self.out = kernels.alloc(64)
        self.settings_place = kernels.alloc(kernels.sizes["settings_t"])
        self.curve = kernels.alloc(16 * 65)

    def allocate(self, size):
        k = self.k
        self.size = k.put(size)
        used = k.alloc(12)
        k.call("lav_engine_lengths", self.size, used)
        self.lengths = k.view(used, 3, np.int32).tolist()
        self.real, self.index, self.keys = (
            k.alloc(width * max(n, 1)) for width, n in zip((8, 4, 8), self.lengths, strict=True)
        )
        self.buffers = (self.size, self.real, self.index, self.keys)
        number = k.layout["size"]
        rows = size[number["joint_rows"]] + size[number["rows_per_contact"]] * size[number["cap_contact"]]
        self.scratch = k.alloc(16 * (int(rows) + 1))
        # for packed blocks, more than is asked for
        self.room = k.alloc(
            8 * (64 * (int(rows) + int(size[number["cap_contact"]])) + 32 * int(size.sum()) + 64)
        )
        lists = list(k.layout["arrays"].values())
        place = k.alloc(4 * sum(map(len, lists)))
        k.call("lav_engine_offsets", *self.buffers, place)
        first = iter(k.view(place, sum(map(len, lists)), np.int32).tolist())
        self.places = {}
        for base, dtype, names, n in zip(
            self.buffers[1:], (np.float64, np.int32, np.uint64), lists, self.lengths, strict=True
        ):
            starts = [next(first) for _ in names]
            for name, start, end in zip(names, starts, [*starts[1:], n], strict=True):
                self.places[name] = (base + start * np.dtype(dtype).itemsize, end - start, dtype)

    def array(self, name):
        return self.k.view(*self.places[name])

    def read_settings(self):
        self.k.call("lav_engine_read_settings", *self.buffers, self.settings_place)
        return self.k.view(self.settings_place, self.k.sizes["settings_t"], np.uint8).tobytes()

    def set(self, **changes):
        """Settings that are whole numbers."""
        self.read_settings()
        for name, value in changes.items():
            self.k.view(self.settings_place + self.k.offsets["settings_t", name], 1, np.int32)[0] = value
        self.k.call("lav_engine_write_settings", *self.buffers, self.settings_place)

    def values(self):
        self.k.call("lav_engine_values", *self.buffers, self.out)
        return self.k.view(self.out, 8, np.float64).copy()

    def grow(self):
        old = self.buffers
        room = self.k.alloc(4 * SIZES)
        self.k.call("lav_engine_more_room", *old, room)
        self.allocate(self.k.view(room, SIZES, np.int32).copy())
        self.k.call("lav_engine_move", *old, *self.buffers)

    def step(self, packed=False):
        left, status = self.substeps, NEED_ROOM
        while status == NEED_ROOM:
            if packed:
                status = self.k.call("lav_engine_substeps_packed", *self.buffers, left, self.room, self.done)
            else:
                status = self.k.call("lav_engine_substeps", *self.buffers, left, self.done)
            left -= int(self.k.view(self.done, 1, np.int32)[0])
            if status == NEED_ROOM:
                self.grow()
        return status

    def step_watched(self, sweeps):
        """One substep; the error along the sweeps (sweeps + 1, 2)."""
        while self.k.call("lav_engine_prepare", *self.buffers) == NEED_ROOM:
            self.grow()
        self.k.call("lav_engine_solve_watched", *self.buffers, self.curve, self.scratch)
        self.k.call("lav_engine_finish", *self.buffers)
        return self.k.view(self.curve, 2 * (sweeps + 1), np.float64).reshape(-1, 2).copy()

    def everything(self):
        """The three buffers as bytes."""
        sizes = (8 * self.lengths[0], 4 * self.lengths[1], 8 * max(self.lengths[2], 1))
        return [self.k.view(at, n, np.uint8).tobytes() for at, n in zip(self.buffers[1:], sizes, strict=True)]

    def restore(self, everything):
        for at, data in zip(self.buffers[1:], everything, strict=True):
            self.k.view(at, len(data), np.uint8)[:] = np.frombuffer(data, np.uint8)


class Newton:
    """The module newton.wasm in the memory of `kernels`."""

    def __init__(self, data, kernels):
        module = compiled(data)
        self.k = kernels
        self.exports = wasmtime.Instance(kernels.store, module, [kernels.memory]).exports(kernels.store)
        assert self.exports["__heap_base"].value(kernels.store) <= kernels.exports["__heap_base"].value(
            kernels.store
        )
        self.said, self.trace = kernels.alloc(32), kernels.alloc(24 * 256)

    def call(self, name, *arguments):
        return self.exports[name](self.k.store, *arguments)

    def step(self, simulation, tol):
        """One step; what its last solve said (4,): sweeps, factorisations, relative residual, scores."""
        k, s = self.k, simulation
        for _ in range(s.substeps):
            while k.call("lav_engine_prepare", *s.buffers) == NEED_ROOM:
                s.grow()
            k.call("lav_engine_solve", *s.buffers, 0)
            top = k.top  # scratch is given back after each solve
            whole = k.alloc(4 * self.call("lav_newton_index_room", *s.buffers, 1))
            room = k.alloc(8 * self.call("lav_newton_plan", *s.buffers, 1, whole))
            self.call("lav_newton_substep", *s.buffers, tol, 1, whole, room, self.trace, self.said)
            k.top = top
            assert k.call("lav_engine_finish", *s.buffers) == 0
        return k.view(self.said, 4, np.float64).copy()


class Recording:
    def __init__(self, folder):
        self.contents = json.loads((folder / "recording.json").read_text())
        self.numbers = (folder / "recording.bin").read_bytes()

    def array(self, place):
        at, n, kind = place
        return np.frombuffer(self.numbers, np.dtype(f"<{kind}" if kind != "u1" else "u1"), n, at)


def run_scene(k, scene, recorded):
    """Eight values and x, q, v after every step of a recorded scene."""
    simulation = Simulation(k, scene)
    values, states = [], []
    for step in range(scene["steps"]):
        if str(step) in scene["changes"]:
            simulation.set(**scene["changes"][str(step)])
        assert simulation.step() == 0
        values.append(simulation.values())
        states.append(np.concatenate([simulation.array(name) for name in recorded.contents["body_arrays"]]))
    return np.array(values), np.array(states)


def run_problem(k, problem, recorded):
    """What was recorded of a problem, computed again: d, nu, step, impulse, slack, error and the score."""
    n = problem["counts"]
    put = {name: k.put(recorded.array(at)) for name, at in (problem["ints"] | problem["reals"]).items()}
    out = {name: k.alloc(8 * (n["rows"] + 1)) for name in ("d", "nu", "step", "slack", "error")}
    out["impulse"] = put["start"]
    blocks = k.put_struct(
        "blocks_t", n_blocks=n["blocks"], n_rows=n["rows"], law=problem["law"],
        **{key: put[key] for key in ("ptr", "kind", "lower", "upper", "mu", "patch_radius", "b")},
        **{key: out[key] for key in ("d", "nu", "step")},
    )  # fmt: skip
    empty, rng = k.alloc(4 * (n["rows"] + 1)), k.put(np.array([int(problem["seed"])], np.uint64))
    score = k.alloc(k.sizes["score_t"])
    order = (put["order"], problem["split"], problem["mode"], rng, 1, problem["sweeps"])
    if problem["factored"]:
        more = {
            "minv_jac": 96 * (n["rows"] + 1),
            "coupling": 40 * (n["contacts"] + 1),
            "swing": 48 * (n["rows"] + 1),
        }
        put |= {name: k.alloc(size) for name, size in more.items()}
        fields = recorded.contents["layout"]["structs"]["rows_t"]
        rows = k.put_struct(
            "rows_t", n_bodies=n["bodies"], n_joints=n["joints"], n_contacts=n["contacts"],
            **{key: put[key] for key in fields if not key.startswith("n_")},
        )  # fmt: skip
        velocity, scratch = k.alloc(48 * (n["bodies"] + 1)), k.alloc(96 * (n["bodies"] + 1))
        k.call(
            "lav_rows_diagonal",
            blocks,
            rows,
            out["d"],
            out["nu"],
            out["step"],
            empty,
            *(put[m] for m in more),
        )
        judge = ("lav_judge_rows", blocks, rows, out["impulse"], out["slack"], out["error"])
        k.call("lav_rows_velocity", blocks, rows, out["impulse"], velocity)
        k.call("lav_impulse_sweeps", blocks, rows, out["impulse"], velocity, *order)
        k.call(*judge, scratch, 1, score)
    else:
        csr = k.put_struct("csr_t", **{key: put[key] for key in ("indptr", "indices", "data")})
        k.call("lav_csr_diagonal", blocks, csr, out["d"], out["step"], empty)
        k.call("lav_matrix_nu", blocks, out["nu"])
        k.call("lav_pgs_sweeps", blocks, csr, out["impulse"], *order)
        k.call("lav_judge_csr", blocks, csr, out["impulse"], out["slack"], out["error"], 1, score)
    said = k.read_struct("score_t", score)
    found = {name: k.view(out[name], n["rows"], np.float64).copy() for name in problem["expected"]}
    return found | {key: said[key] for key in ("energy", "velocity", "worst")}
