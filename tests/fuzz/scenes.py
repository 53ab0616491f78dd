"""Scenes that no one would build, how they are stepped, and snapshots that were tampered with; as plain data."""

import hashlib
import json
import struct

import hypothesis.strategies as st
import numpy as np
from strategies import SPECIAL, chance, numbers, optional, plain, positive

import lavender as lv

GALLERY = ("stack", "pyramid", "card_house", "pile", "chain", "bridge", "heavy_on_light", "table", "ramp", "spinner",
           "newtons_cradle", "four_bar")  # fmt: skip
SMALL = {"pyramid": {"base": 3}, "pile": {"n": 12}, "chain": {"n": 6}, "bridge": {"n": 4}, "stack": {"n": 3},
         "table": {"legs": 4}}  # fmt: skip
SOLVERS = ("newton", "auto", "pgs", "block_gauss_seidel", "nncg", "admm", "anderson", "jacobi")
ENGINE_ORDERS = ("given", "reverse", "symmetric", "random", "colored", "bottom_up", "top_down")
SIZES = (0.0, 1e-60, 1e-30, 1e-12, 1e-3, 0.1, 0.5, 1.0, 1e3, 1e8, 1e30, 1e60)


pick = st.sampled_from


@st.composite
def scene_specs(draw, steps=40):
    """A scene and what is done with it."""
    gravity = pick(("tame", "wild", "special")).flatmap(lambda style: numbers(3, style))
    parameters = {"seed": draw(st.integers(0, 3))}
    parameters |= draw(optional(0.4, dt=pick((1e-60, 1e-9, 1e-3, 1.0 / 240.0, 0.1, 1.0, 1e6, 1e60))))
    parameters |= draw(optional(0.2, substeps=pick((1, 2, 4)), restitution=pick((0.0, 0.5, 1.0))))
    parameters |= draw(optional(0.3, gravity=gravity, order=pick(ENGINE_ORDERS)))
    parameters |= draw(optional(0.3, position_iterations=pick((0, 1, 20)), warm_start=st.just(False)))
    names = ("friction", "patch_radius", "slop", "margin", "restitution_threshold")
    size = pick((0.0, 1e-60, 1e-12, 0.1, 0.5, 1.0, 10.0, 1e30, 1e60))
    parameters |= draw(optional(0.15, **dict.fromkeys(names, size)))
    if "order" not in parameters and draw(chance(0.15)):
        parameters |= {"solver": draw(pick(SOLVERS)), "solver_iterations": draw(pick((1, 10, 60)))}
        parameters["on_failure"] = draw(pick(("use", "keep", "damp", "raise")))
        steps = min(steps, 10)
    spec = {"kind": "steps", "parameters": parameters}
    if draw(chance(0.3)):
        spec["name"] = draw(pick(GALLERY))
        parameters.update(SMALL.get(spec["name"], {}))
    else:
        spec["bodies"] = draw(bodies())
        spec["joints"] = draw(st.lists(joints(len(spec["bodies"])), max_size=3))
    spec["actions"] = draw(actions(steps))
    return plain(spec | {"again": draw(chance(0.25))})


@st.composite
def bodies(draw):
    """Up to nine; often on one another's place."""
    planes = draw(pick(([], *[[{"shape": "plane"}]] * 3, [{"shape": "plane", "normal": draw(numbers(3))}])))
    same = draw(numbers(3, draw(pick(("tame", "special")))))
    return planes + draw(st.lists(body(same), min_size=1, max_size=8))


@st.composite
def body(draw, same):
    """One that moves, mostly."""
    style = draw(pick(("tame", "tame", "scales", "special")))
    made = {"shape": draw(pick(("sphere", "sphere", "box", "box", "none")))}
    if made["shape"] == "sphere":
        made["radius"] = draw(positive(1, style))[0]
    elif made["shape"] == "box":
        made["size"] = draw(positive(3, style))
    made["mass"] = draw(positive(1, draw(pick(("tame", "scales", "wild", "special")))))[0]
    at = numbers(3, draw(pick(("tame", "tame", "whole", "wild"))))
    made["position"] = same if draw(chance(0.3)) else draw(at)
    made |= draw(optional(0.5, quaternion=numbers(4))) | draw(optional(0.1, inertia=positive(3)))
    made |= draw(optional(0.2, friction=pick(SIZES), patch_radius=pick(SIZES)))
    if draw(chance(0.05)):
        return made | {"static": True}
    return made | draw(optional(0.4, velocity=numbers(3), angular_velocity=numbers(3)))


@st.composite
def joints(draw, n):
    """One between two of n bodies or the world."""
    kind, ends = draw(pick(("distance", "ball", "hinge"))), st.integers(-1, n - 1)
    joint = {"kind": kind, "a": draw(ends), "b": draw(ends)}
    joint["anchor_a" if kind == "distance" else "anchor"] = draw(numbers(3))
    soft = {"hertz": pick((0.0, 1e-9, 1.0, 1e9, 1e60)), "damping": pick((0.0, 1.0, 1e60))}
    motor = {"motor_speed": numbers(1).map(lambda x: x[0]), "motor_torque": pick((0.0, 1.0, 1e9, 1e60))}
    joint |= draw(optional(0.3, collide=st.just(True)))
    for p, fields in ((0.3, soft), (0.4, motor if kind == "hinge" else {})):
        joint |= draw(st.fixed_dictionaries(fields)) if draw(chance(p)) else {}
    if kind == "hinge":
        return joint | {"axis": draw(numbers(3))}
    return joint | (draw(optional(0.3, length=pick(SPECIAL))) if kind == "distance" else {})


@st.composite
def actions(draw, steps):
    """What is done, in turn."""
    others = pick((["sweeps", 4], ["sweeps", 64], ["warm", 0], ["warm", 1], ["snapshot"], ["restore"], ["file"],
                   ["problem"], ["residual"], ["reset"], ["reseed", 5]))  # fmt: skip
    out = []
    for n in draw(st.lists(st.integers(1, 20), min_size=1, max_size=4)):
        out.append(["step", min(n, steps)])
        if draw(chance(0.4)):
            out.append(draw(others))
    return out


def build(spec):
    """The Scene of a spec; what lavender refuses, it raises."""
    scene = lv.Scene(spec.get("name"), **spec["parameters"])
    for body in spec.get("bodies", ()):
        body = dict(body)
        shape = body.pop("shape")
        if shape == "plane":
            scene.add_plane(**body)
        elif shape == "sphere":
            scene.add_sphere(body.pop("radius"), body.pop("mass"), **body)
        elif shape == "box":
            scene.add_box(body.pop("size"), body.pop("mass"), **body)
        else:
            scene.add_body(body.pop("mass"), **body)
    for joint in spec.get("joints", ()):
        scene.add_joint(**joint)
    return scene


# -- snapshots -------------------------------------------------------------------------------------------------

MAGIC = b"LAVENDER-SNAPSHOT\n"
WILD_WHOLE = (-(2**31), -(10**8), -1000, -2, -1, 0, 1, 2, 3, 7, 100, 65536, 10**8, 2**31 - 1)


@st.composite
def snapshot_specs(draw):
    """A snapshot file of a scene, some of whose numbers are others, with a checksum that is right (mostly)."""
    name = draw(pick(GALLERY))
    newton, order = (
        st.just({"solver": "newton", "solver_iterations": 60}),
        pick(("given", "random", "colored")),
    )
    parameters = SMALL.get(name, {}) | draw(st.one_of(newton, *[st.fixed_dictionaries({"order": order})] * 4))
    place = st.integers(0, 10**6)
    real = st.tuples(st.just("real"), place, pick((*SPECIAL, float("nan"), float("inf"), -1.0, 1e9)))
    index = st.tuples(pick(("size", "index", "index", "index")), place, pick(WILD_WHOLE))
    keys = st.tuples(st.just("keys"), place, st.integers(0, 2**62) | pick((0, 1, 2**64 - 1, 2**63)))
    key = pick(("version", "fingerprint", "steps", "failed", "lost", "lengths", "extra", None))
    value = pick(
        (None, -1, 0, 1, 2, 10**30, 1.5, "x", "1", [], [[]], [1, 2, 3, 4], {}, True, float("inf"), "\ud800")
    )
    at = st.integers(0, 4000)
    raw = pick(
        (
            ["deep", 100_000],
            ["long", 2**62],
            ["text", "{"],
            ["checksum"],
            ["cut", draw(at)],
            ["flip", draw(at)],
        )
    )
    return {
        "kind": "snapshot",
        "name": name,
        "parameters": parameters,
        "steps": draw(st.integers(0, 6)),
        "edits": draw(st.lists(st.one_of(index, index, index, real, keys), max_size=5)),
        "header": draw(st.lists(st.tuples(key, value), max_size=1)) if draw(chance(0.3)) else [],
        "raw": [draw(raw)] if draw(chance(0.15)) else [],
    }


def tampered(data, spec):
    """Bytes of a snapshot file, with the edits of a spec."""
    start = len(MAGIC) + 8
    end = start + int.from_bytes(data[len(MAGIC) : start], "little")
    header = json.loads(data[start:end])
    arrays, at = {}, end
    for (name, code), n in zip(
        (("size", "<i4"), ("real", "<f8"), ("index", "<i4"), ("keys", "<u8")), header["lengths"], strict=True
    ):
        arrays[name] = np.frombuffer(data, code, n, at).copy()
        at += arrays[name].nbytes
    for name, place, value in spec["edits"]:
        if len(arrays[name]):
            arrays[name][place % len(arrays[name])] = value
    for key, value in spec["header"]:
        if key is None:
            header = value
        else:
            header[key] = value
    text = json.dumps(header).encode()
    length = len(text)
    for edit in spec["raw"]:
        if edit[0] == "deep":
            text = b"[" * edit[1]
            length = len(text)
        elif edit[0] == "text":
            text = edit[1].encode()
            length = len(text)
        elif edit[0] == "long":
            length = edit[1]
    body = MAGIC + struct.pack("<Q", length) + text + b"".join(x.tobytes() for x in arrays.values())
    for edit in spec["raw"]:
        if edit[0] == "cut":
            body = body[: max(len(MAGIC), len(body) - edit[1])]
        elif edit[0] == "flip":
            place = edit[1] % len(body)
            body = body[:place] + bytes([body[place] ^ 255]) + body[place + 1 :]
    digest = hashlib.sha256(body).digest()
    return body + (bytes(32) if ["checksum"] in spec["raw"] else digest)
