"""Batches take arrays of other libraries: views of host memory, one copy from a device, an error for the rest."""

import numpy as np
import pytest

import lavender as lv

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
        self.array, self.shape, self.dtype = array, array.shape, array.dtype

    def __dlpack__(self, **options):
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


class DeviceArray:
    """An array on a device that the processor cannot address; `cpu()` copies it."""

    device = "cuda:0"

    def __init__(self, array):
        self.array, self.shape, self.copies = array, array.shape, 0

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
def test_arrays_of_other_libraries_give_the_same_answers(wrap):
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


def test_host_arrays_are_read_in_place():
    jac = ARRAYS["J"].copy()
    batch = lv.Batch(HostArray(jac), ARRAYS["M"], ARRAYS["v_free"], cones=CONES)
    jac[0, 0, 1] = 5.0
    assert batch[0].jacobian.toarray()[0, 1] == 5.0


def test_device_arrays_are_copied_once():
    jac = DeviceArray(ARRAYS["J"])
    lv.Batch(jac, ARRAYS["M"], ARRAYS["v_free"], cones=CONES)
    assert jac.copies == 1


def test_arrays_that_cannot_be_read_are_rejected_by_name():
    with pytest.raises(lv.InputError, match=r"J is a UnreadableArray on device cuda:0 that cannot be read"):
        lv.Batch(UnreadableArray(ARRAYS["J"]), ARRAYS["M"], ARRAYS["v_free"], cones=CONES)
    differentiable = HostArray(ARRAYS["M"])
    differentiable.requires_grad = True
    with pytest.raises(lv.InputError, match=r"M requires a gradient.*detach"):
        lv.Batch(ARRAYS["J"], differentiable, ARRAYS["v_free"], cones=CONES)


def test_tensors_of_pytorch():
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(solve(torch.from_numpy).impulse, solve(np.asarray).impulse)
    with pytest.raises(lv.InputError, match="requires a gradient"):
        lv.residual_many(
            lv.Batch(*ARRAYS.values(), cones=CONES),
            torch.zeros((3, 2), dtype=torch.float64, requires_grad=True),
        )
