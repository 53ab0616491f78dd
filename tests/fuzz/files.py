"""Files of problems, damaged or made to deceive; as plain data."""

import base64
import functools
import io
import json
import tempfile
import warnings
import zipfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import scipy.sparse as sp
from strategies import chance

import lavender as lv

try:
    import h5py
except ImportError:
    h5py = None


def good_problems(n):
    """One of each operator, of about n contacts."""
    a = np.eye(3 * n) + 0.1
    contacts = lv.Cones.contacts(0.5, count=n)
    yield lv.Problem.lcp(a, np.ones(3 * n), guess=np.ones(3 * n))
    yield lv.Problem(np.ones(3 * n), contacts, sp.csr_array(a), friction="cone")
    yield lv.Problem.from_jacobian(
        a, np.eye(3 * n), np.ones(3 * n), cones=contacts, compliance=np.ones(3 * n)
    )
    simulation = lv.Simulation(lv.Scene("stack", n=n))
    simulation.step()
    yield simulation.constraint_problem()


@functools.cache
def bases():
    """Good files of every layout: (suffix, bytes)."""
    out = []
    with tempfile.TemporaryDirectory() as folder:
        for problem in (p for n in range(2, 5) for p in good_problems(n)):
            for suffix in (".npz", ".hdf5") if h5py else (".npz",):
                path = Path(folder, f"p{suffix}")
                try:
                    lv.io.save(problem, path, impulse=np.zeros(problem.m))
                except lv.LavenderError:  # a layout without a place for this kind
                    continue
                out.append((suffix, path.read_bytes()))
    for m in (1, 4):
        stream = io.BytesIO()
        np.savez_compressed(stream, b=np.ones(m), lo=np.zeros(m), hi=np.full(m, np.inf), A=np.eye(m), l_ref=np.ones(m),
                            w_ref=np.zeros(m), compare="l,w")  # fmt: skip
        out.append((".npz", stream.getvalue()))
    a = sp.csr_array(np.eye(3))
    stream = io.BytesIO()
    np.savez(stream, b=np.ones(3), lo=np.zeros(3), hi=np.ones(3), A_data=a.data, A_indices=a.indices, A_indptr=a.indptr,
             A_shape=np.array(a.shape),
             cone_start=np.array([0]), cone_dim=np.array([3]), cone_mu=np.array([0.5]))  # fmt: skip
    out.append((".npz", stream.getvalue()))
    if h5py:
        stream = io.BytesIO()
        with h5py.File(stream, "w") as file:
            for name, x in (("M", np.eye(6)), ("H", np.ones((6, 3)))):
                c = sp.csr_array(x)
                for key, value in (("m", c.shape[0]), ("n", c.shape[1]), ("nz", -2), ("nzmax", c.nnz)):
                    file[f"fclib_global/{name}/{key}"] = np.array([value], np.int32)
                file[f"fclib_global/{name}/p"], file[f"fclib_global/{name}/i"] = c.indptr, c.indices
                file[f"fclib_global/{name}/x"] = c.data
            file["fclib_global/spacedim"] = np.array([3], np.int32)
            file["fclib_global/vectors/f"], file["fclib_global/vectors/w"] = np.ones(6), np.zeros(3)
            file["fclib_global/vectors/mu"] = np.array([0.5])
        out.append((".hdf5", stream.getvalue()))
    return out


@st.composite
def file_specs(draw):
    """The bytes of a file."""
    suffix, data = draw(st.sampled_from(bases()))
    how = draw(st.sampled_from(("bytes", "bytes", "parts", "parts", "parts", "cut", "splice", "same")))
    if how == "bytes":
        out = bytearray(data)
        for _ in range(draw(st.sampled_from((1, 1, 2, 8)))):
            out[draw(st.integers(0, len(out) - 1))] = draw(st.integers(0, 255))
        data = bytes(out)
    elif how == "cut":
        data = data[: draw(st.integers(0, len(data)))]
    elif how == "splice":
        other = draw(st.sampled_from(bases()))[1]
        a, b = draw(st.integers(0, len(data))), draw(st.integers(0, len(other)))
        data = data[:a] + other[b:]
    elif how == "parts":
        data = draw(other_parts_npz(data)) if suffix == ".npz" else draw(other_parts_hdf5(data))
    return {"kind": "file", "suffix": suffix, "data": base64.b64encode(data).decode()}


KINDS = ("<f8", "<f4", "<f2", "<i4", "<i8", "<u8", "|i1", "|b1", "<c16", "|S3", "<U2", ">f8", ">i4")


@st.composite
def other(draw, x):
    """An array in the place of another: other numbers, shape or type."""
    x = np.array(x)
    how = draw(st.sampled_from(("number", "number", "number", "shape", "kind", "scalar", "empty", "longer")))
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if how == "number" and x.size and x.dtype.kind in "iufb":
            flat = x.reshape(-1)
            whole = (-(2**31), -2, -1, 0, 1, 2, 3, 100, 2**31 - 1)
            reals = (np.nan, np.inf, -np.inf, -0.0, 1e-310, 1e308, -1.0, 0.5)
            value = draw(st.sampled_from(whole if x.dtype.kind in "iu" else reals))
            flat[draw(st.integers(0, flat.size - 1))] = np.array(value).astype(x.dtype)
            return flat.reshape(x.shape)
        if how == "shape":
            return x.reshape(draw(st.sampled_from(((-1,), (1, -1), (-1, 1), (-1, 1, 1)))))
        if how == "kind" and x.dtype.kind in "iufb":
            return x.astype(draw(st.sampled_from(KINDS)))
        if how == "scalar":
            return np.array(draw(st.sampled_from((0, 1, -1, 0.5, np.nan, 2**31 - 1))))
        if how == "empty":
            return x.reshape(-1)[:0]
    return np.concatenate([x.reshape(-1), x.reshape(-1)[:1]])


@st.composite
def other_parts_npz(draw, data):
    try:
        with np.load(io.BytesIO(data)) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception:  # a base of another layout
        return data
    for _ in range(draw(st.sampled_from((1, 1, 2)))):
        name = draw(st.sampled_from(sorted(arrays)))
        if name == "meta" and draw(chance(0.8)):
            try:
                meta = json.loads(arrays[name].tobytes())
            except ValueError:  # changed already
                continue
            meta[draw(st.sampled_from(sorted(meta)))] = draw(
                st.sampled_from((None, "", "rows", "csr", "dense", "cone", [], [1], ["a"], {}, 1, True))
            )
            arrays[name] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
        elif draw(chance(0.05)):
            del arrays[name]
        elif draw(chance(0.05)):
            arrays[draw(st.sampled_from(("b", "A", "extra", "guess")))] = arrays[name]
        else:
            arrays[name] = draw(other(arrays[name]))
        if not arrays:
            break
    stream = io.BytesIO()
    with zipfile.ZipFile(
        stream, "w", draw(st.sampled_from((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    ) as out:
        for name, x in arrays.items():
            part = io.BytesIO()
            np.lib.format.write_array(part, np.asarray(x), allow_pickle=False)
            out.writestr(f"{name}.npy", part.getvalue())
    return stream.getvalue()


@st.composite
def other_parts_hdf5(draw, data):
    stream = io.BytesIO(data)
    with h5py.File(stream, "a") as file:
        names = []
        file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
        for _ in range(draw(st.sampled_from((1, 1, 2)))):
            name = draw(st.sampled_from(sorted(names)))
            if name not in file:
                continue
            value = draw(other(file[name][()]))
            del file[name]
            if value.dtype.kind == "U" or draw(chance(0.05)):
                continue
            if draw(chance(0.1)) and value.ndim:
                file.create_dataset(
                    name, value.shape, value.dtype, chunks=True, maxshape=(None,) * value.ndim
                )
            else:
                file[name] = value
    return stream.getvalue()
