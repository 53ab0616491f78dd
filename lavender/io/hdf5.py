"""Read and write datasets and sparse matrices of HDF5 files."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.io.npz import build_checked_csr


class HDF5Reader:
    """Reader of the datasets of one HDF5 file."""

    def __init__(self, h5py: Any, file: Any) -> None:
        self.h5py, self.file = h5py, file

    def find_node(self, path: str) -> Any:
        """Return the group or dataset at a path, or None."""
        node = self.file.get(path)
        # HDF5 would read beyond the end of a chunk that is shorter than its checksum of 4 bytes.
        has_checksum = isinstance(node, self.h5py.Dataset) and node.fletcher32
        if has_checksum and node.id.chunk_iter(lambda chunk: True if chunk.size < 4 else None):
            raise InputError(
                f"{path} has an incomplete chunk; the file is damaged: write or copy it again"
            )
        return node

    def has_path(self, path: str) -> bool:
        """Return whether the path exists."""
        return self.find_node(path) is not None

    def find_dataset(self, path: str, kinds: str, count: int | None = None) -> Any:
        """Return a dataset of `count` numbers (None: any number) without reading it."""
        data = self.find_node(path)
        if not isinstance(data, self.h5py.Dataset):
            found = "is a group" if data is not None else "is missing"
            raise InputError(f"{path} {found}; a dataset is needed")
        if data.dtype.kind not in kinds or data.shape is None:
            wanted = "whole numbers" if kinds == "iu" else "numbers"
            raise InputError(f"{path} has type {data.dtype}; {wanted} are needed")
        if count is not None and data.size != count:
            raise InputError(f"{path} has {data.size} entries; {count} are needed")
        return data

    def read_array(self, path: str, kinds: str, count: int | None = None) -> np.ndarray:
        """Read a dataset as a flat array of `count` numbers (None: any number)."""
        return np.asarray(self.find_dataset(path, kinds, count)[()]).reshape(-1)

    def read_integer(self, path: str) -> int:
        """Read a single 32-bit integer."""
        value = int(self.read_array(path, "iu", 1)[0])
        if not -(2**31) <= value < 2**31:
            raise InputError(f"{path} is {value}; a signed 32-bit integer is needed")
        return value

    def read_vector(self, path: str, count: int) -> FloatArray:
        """Read `count` finite numbers as float64."""
        return as_array(path, self.read_array(path, "iuf", count), (count,))

    def read_text(self, path: str) -> str:
        """Read a text; return an empty one if the dataset does not exist or is not a short single text."""
        data = self.find_node(path)
        if not isinstance(data, self.h5py.Dataset) or data.size != 1 or data.nbytes > 2**20:
            return ""
        value = data[()]
        value = value.flat[0] if isinstance(value, np.ndarray) else value
        return (
            value.decode("utf-8", "replace").rstrip("\0")
            if isinstance(value, bytes)
            else str(value)
        )

    def read_matrix_shape(self, path: str) -> tuple[int, int]:
        """Return the numbers of rows and columns that a matrix declares."""
        m, n = (self.read_integer(f"{path}/{name}") for name in ("m", "n"))
        if min(m, n) < 0:
            raise InputError(f"{path} declares {m} rows and {n} columns; both must be at least 0")
        return m, n

    def read_matrix(self, path: str, shape: tuple[int | None, int | None]) -> sp.csr_array:
        """Read a sparse matrix of the given shape; None accepts any number.

        FCLIB's `nz` selects the format: -2 compressed rows, -1 compressed columns, nz >= 0 triplets with columns p and
        rows i.
        """
        (m, n) = self.read_matrix_shape(path)
        nz = self.read_integer(f"{path}/nz")
        nzmax = self.read_integer(f"{path}/nzmax")
        if nzmax < 0 or nz < -2 or nz > nzmax:
            raise InputError(
                f"{path}: nz is {nz} and nzmax is {nzmax}; nz must be -2 (compressed rows), -1 (compressed "
                "columns), or the number of triplets, from 0 to nzmax"
            )
        if any(want is not None and have != want for have, want in zip((m, n), shape, strict=True)):
            wanted = " x ".join("any" if s is None else str(s) for s in shape)
            raise InputError(f"{path} is {m} x {n}; {wanted} is needed")
        x = as_array(f"{path}/x", self.read_array(f"{path}/x", "iuf"), (None,), finite=False)
        i, p = self.read_array(f"{path}/i", "iu"), self.read_array(f"{path}/p", "iu")
        try:
            if nz == -2:
                a = build_checked_csr(p, i, x, m, n)
            elif nz == -1:
                a = sp.csr_array(build_checked_csr(p, i, x, n, m).T)
            else:
                if min(len(p), len(i), len(x)) < nz:
                    sizes = f"{len(p)}, {len(i)} and {len(x)}"
                    raise InputError(f"nz announces {nz} triplets; p, i and x have {sizes}")
                p = p[:nz].astype(np.int64)
                i = i[:nz].astype(np.int64)
                x = x[:nz]
                if nz and (p.min() < 0 or i.min() < 0 or p.max() >= n or i.max() >= m):
                    raise InputError(
                        f"row indices i or column indices p are outside of the matrix ({m}, {n})"
                    )
                a = sp.csr_array(sp.coo_array((x, (i, p)), shape=(m, n)))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        as_array(f"{path}/x", a.data, (None,), copy=False)
        return a


def write_matrix(group: Any, a: sp.csr_array) -> None:
    """Write a matrix in compressed rows, as a group with FCLIB's names of the arrays."""
    for name, value in (("nzmax", a.nnz), ("m", a.shape[0]), ("n", a.shape[1]), ("nz", -2)):
        write_array(group, name, np.array([value], np.int32))
    for name, array in (
        ("p", a.indptr.astype(np.int32)),
        ("i", a.indices.astype(np.int32)),
        ("x", a.data),
    ):
        write_array(group, name, array)


def write_array(group: Any, name: str, value: Any) -> None:
    """Write an array with a checksum, so that damage is detected; HDF5 has no checksum for scalars."""
    value = np.asarray(value)
    group.create_dataset(name, data=value, fletcher32=bool(value.ndim and value.size))


def import_h5py() -> Any:
    """Return the module h5py; raise InputError if it is not installed."""
    try:
        import h5py
    except ImportError:
        raise InputError("FCLIB files need h5py: pip install 'lavender-contact[fclib]'") from None
    return h5py
