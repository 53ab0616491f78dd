"""The engine of the library goes on from the package's state with the package's bits."""

import ctypes as ct

import numpy as np
import pytest

import lavender as lv
from lavender.export import engine_image
from lavender_ext.engine.arrays import make_array_views


def opened(library, image):
    c = library.c
    workspace = ct.c_uint64()
    at = ct.c_void_p()
    assert c.lav_engine_workspace_size(image, ct.c_uint64(len(image)), ct.byref(workspace)) == 0
    memory = (ct.c_double * (workspace.value // 8 + 2))()
    assert c.lav_engine_open(memory, workspace, image, ct.c_uint64(len(image)), ct.byref(at)) == 0
    return at, memory


def places(library, at):
    n = ct.c_int32()
    assert library.c.lav_engine_places(at, ct.byref(n), None, 0) == 0
    out = np.zeros((n.value, 7))
    assert library.c.lav_engine_places(at, ct.byref(n), ct.c_void_p(out.ctypes.data), out.size) == 0
    return out


def of_package(simulation):
    s = simulation.snapshot()
    found = make_array_views(s.size, s.real, s.index, s.keys)
    return np.concatenate([found["x"], found["q"]], axis=1)


@pytest.mark.parametrize("name", ["stack", "chain"])
def test_c_engine_steps_and_images_have_the_bits_of_the_package(library, name):
    scene = lv.Scene(name)
    simulation = lv.Simulation(scene)
    at, memory = opened(library, engine_image(simulation))
    values = np.zeros(8)
    for step in range(12):
        if step == 6:  # an image of it, and on from there
            size = ct.c_uint64()
            assert library.c.lav_engine_image(at, None, ct.c_uint64(0), ct.byref(size)) == 0
            image = (ct.c_double * (size.value // 8))()
            assert library.c.lav_engine_image(at, image, size, ct.byref(size)) == 0
            at, memory = opened(library, bytes(image))
        said = simulation.step()[0]["solver"]
        code = library.c.lav_engine_step(
            at, scene.parameters.substeps, ct.c_void_p(values.ctypes.data)
        )
        assert code == 0, library.c.lav_text(code)
        assert values.tobytes() == said.tobytes()
        assert places(library, at).tobytes() == of_package(simulation).tobytes()
    assert memory


def test_c_engine_image_with_a_changed_bit_is_rejected(library):
    image = bytearray(engine_image(lv.Simulation(lv.Scene("stack"))))
    workspace = ct.c_uint64()
    image[len(image) // 2] ^= 4
    assert (
        library.c.lav_engine_workspace_size(
            bytes(image), ct.c_uint64(len(image)), ct.byref(workspace)
        )
        == -4
    )
    assert (
        library.c.lav_engine_workspace_size(
            bytes(image), ct.c_uint64(len(image) - 8), ct.byref(workspace)
        )
        == -3
    )
    image[0] ^= 1
    assert (
        library.c.lav_engine_workspace_size(
            bytes(image), ct.c_uint64(len(image)), ct.byref(workspace)
        )
        == -2
    )
