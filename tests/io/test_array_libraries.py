"""Batches take arrays of other libraries: views of host memory, one copy from a device, an error for the rest.

Results return in the caller's library with `like=`.
"""

import pickle

import numpy as np
import pytest

import lavender as lv
from lavender.base.arrays import to_numpy

MASS = np.array([1.0, 2.0, 3.0])
ARRAYS = {
    "J": np.broadcast_to(np.eye(2)[::-1], (3, 2, 2)).copy(),
    "M": MASS[:, None, None] * np.eye(2),
    "v_free": np.tile([2.0, -1.0], (3, 1)),
}
CONES = lv.Cones.contacts(0.5, tangents=1)


class HostArray:
    """An array of another library in host memory, which only the DLPack protocol can read."""

    def __init__(self, array):
        self.array = array
        self.shape = array.shape
        self.dtype = array.dtype

    def __dlpack__(self, **options):
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


class NegativeView(HostArray):
    """A view with the negative bit, such as `z.conj().imag` of PyTorch: DLPack passes it with the wrong sign."""

    def resolve_neg(self):
        return HostArray(-self.array)


class DeviceArray:
    """An array on a device that the processor cannot address; `cpu()` copies it."""

    device = "cuda:0"

    def __init__(self, array):
        self.array = array
        self.shape = array.shape
        self.copies = 0

    def __dlpack__(self, **options):
        raise BufferError("the device is not supported")

    def __dlpack_device__(self):
        return (2, 0)

    def cpu(self):
        self.copies += 1
        return self

    def numpy(self):
        if not self.copies:
            raise TypeError("copy it to the host first")
        return self.array


class UnreadableArray(DeviceArray):
    """An array on a device without any way to the host."""

    def cpu(self):
        raise NotImplementedError("no host copy")


def solve(wrap):
    return lv.solve_many(lv.Batch(*(wrap(x) for x in ARRAYS.values()), cones=CONES), tol=1e-9)


@pytest.mark.parametrize("wrap", [HostArray, DeviceArray])
def test_solve_with_arrays_of_other_libraries_gives_the_same_answers(wrap):
    expected = solve(np.asarray)
    many = solve(wrap)
    np.testing.assert_array_equal(many.impulse, expected.impulse)
    batch = lv.Batch(*ARRAYS.values(), cones=CONES)
    np.testing.assert_array_equal(
        lv.residual_many(batch, wrap(many.impulse.copy())).relative,
        lv.residual_many(batch, many.impulse).relative,
    )
    problem = lv.Problem.lcp(wrap(np.eye(2)), wrap(np.ones(2)))
    assert lv.solve(problem, tol=1e-9).impulse.tolist() == pytest.approx([1.0, 1.0])


def test_solve_with_host_arrays_reads_them_in_place():
    jac = ARRAYS["J"].copy()
    batch = lv.Batch(HostArray(jac), ARRAYS["M"], ARRAYS["v_free"], cones=CONES)
    jac[0, 0, 1] = 5.0
    assert batch[0].jacobian.toarray()[0, 1] == 5.0


def test_solve_with_device_arrays_copies_them_once():
    jac = DeviceArray(ARRAYS["J"])
    lv.Batch(jac, ARRAYS["M"], ARRAYS["v_free"], cones=CONES)
    assert jac.copies == 1


def test_solve_with_an_unreadable_array_raises_its_name():
    with pytest.raises(
        lv.InputError, match=r"J is a UnreadableArray on device cuda:0 that cannot be read"
    ):
        lv.Batch(UnreadableArray(ARRAYS["J"]), ARRAYS["M"], ARRAYS["v_free"], cones=CONES)
    differentiable = HostArray(ARRAYS["M"])
    differentiable.requires_grad = True
    with pytest.raises(lv.InputError, match=r"M requires a gradient.*detach"):
        lv.Batch(ARRAYS["J"], differentiable, ARRAYS["v_free"], cones=CONES)


def test_solve_with_tensors_of_pytorch_gives_the_same_answers():
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(solve(torch.from_numpy).impulse, solve(np.asarray).impulse)
    with pytest.raises(lv.InputError, match="requires a gradient"):
        lv.residual_many(
            lv.Batch(*ARRAYS.values(), cones=CONES),
            torch.zeros((3, 2), dtype=torch.float64, requires_grad=True),
        )


class StandardArray(HostArray):
    """An array of a library with the array API standard, which results can return to."""

    def __array_namespace__(self):
        return StandardArray

    @staticmethod
    def from_dlpack(array):
        return StandardArray(np.from_dlpack(array))


RESIDUAL_ARRAYS = (
    "relative",
    "energy",
    "velocity_error",
    "velocity_at_zero",
    "impulse_error",
    "roundoff_floor",
    "worst_row",
)
SOLUTION_ARRAYS = (*RESIDUAL_ARRAYS, "impulse", "velocity", "iterations", "success")


def check_results(like, to_numpy, rtol=0.0):
    """Compare all arrays of results in the library of `like` with those in NumPy."""
    batch = lv.Batch(*ARRAYS.values(), cones=CONES)
    impulse = np.full((3, 2), 0.25)
    for expected, results, names in (
        (
            lv.solve_many(batch, tol=1e-9),
            lv.solve_many(batch, tol=1e-9, like=like),
            SOLUTION_ARRAYS,
        ),
        (
            lv.residual_many(batch, impulse),
            lv.residual_many(batch, impulse, like=like),
            (*RESIDUAL_ARRAYS, "excess"),
        ),
    ):
        for name in names:
            array, own = getattr(results, name), getattr(expected, name)
            assert type(array) is type(like), name
            np.testing.assert_allclose(to_numpy(array), own, rtol=rtol, err_msg=name)
        assert results[1].__class__ is expected[1].__class__
        np.testing.assert_array_equal(
            pickle.loads(pickle.dumps(results)).relative, expected.relative
        )
    return lv.solve_many(batch, tol=1e-9, like=like)


def test_solve_returns_arrays_of_the_library_of_its_arguments():
    many = check_results(StandardArray(np.zeros(1)), lambda x: x.array)
    assert "3 to 1e-09" in repr(many)
    assert isinstance(
        lv.solve_many(lv.Batch(*ARRAYS.values(), cones=CONES), like=np.zeros(1)).impulse, np.ndarray
    )


def test_impulses_of_from_efc_return_in_the_callers_library():
    efc = {
        "efc_J": np.eye(2)[None],
        "efc_D": np.ones((1, 2)),
        "efc_aref": np.zeros((1, 2)),
        "efc_type": [3, 3],
        "M": np.eye(2)[None],
        "qvel": np.zeros((1, 2)),
        "qacc_smooth": -np.ones((1, 2)),
        "timestep": 0.01,
        "efc_force": np.ones((1, 2)),
    }
    impulse = lv.io.from_efc(**efc, like=StandardArray(np.zeros(1))).impulse
    assert isinstance(impulse, StandardArray)
    np.testing.assert_array_equal(impulse.array, lv.io.from_efc(**efc).impulse)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_results_return_as_tensors_of_pytorch(dtype):
    torch = pytest.importorskip("torch")
    like = torch.zeros(1, dtype=getattr(torch, dtype), requires_grad=True)
    many = check_results(like, lambda x: x.numpy(), 0.0 if dtype == "float64" else 1e-6)
    assert many.impulse.dtype == like.dtype and many.iterations.dtype == torch.int32
    many.impulse[0, 0] = 7.0  # a copy
    assert many.impulse[0, 0] != 7.0
    with pytest.raises(lv.InputError, match="device meta"):
        _ = lv.solve_many(
            lv.Batch(*ARRAYS.values(), cones=CONES), like=torch.zeros(1, device="meta")
        ).impulse
    with pytest.raises(lv.InputError, match="J is a Tensor on device meta that cannot be read"):
        solve(lambda x: torch.zeros(x.shape, device="meta", dtype=torch.float64))


def test_results_return_as_arrays_of_jax():
    jax = pytest.importorskip("jax")
    like = jax.numpy.zeros(1)
    check_results(like, np.asarray, 1e-6)
    with pytest.raises(lv.InputError, match="abstract array"):
        jax.jit(lambda x: lv.solve_many(lv.Batch(*ARRAYS.values(), cones=CONES), like=x).impulse)(
            like
        )


def test_results_return_as_arrays_of_warp():
    warp = pytest.importorskip("warp")
    check_results(warp.zeros(1, dtype=warp.float32, device="cpu"), lambda x: x.numpy(), 1e-6)


def test_solve_with_a_view_of_a_negative_bit_reads_its_sign():
    assert to_numpy("x", NegativeView(np.array([1.0, -2.0]))).tolist() == [-1.0, 2.0]


def test_solve_with_the_imaginary_part_of_a_conjugated_tensor_reads_its_sign():
    torch = pytest.importorskip("torch")
    view = torch.tensor([1.0 + 2.0j, 3.0 - 4.0j]).conj().imag
    assert view.is_neg() and to_numpy("x", view).tolist() == [-2.0, 4.0]
