"""Scenes that no one would build, how they are stepped, and snapshots that were tampered with; as plain data."""

import base64
import hashlib
import json
import struct

import numpy as np
from draw import SPECIAL, numbers, positive

import lavender as lv

GALLERY = ("stack", "pyramid", "card_house", "pile", "chain", "bridge", "heavy_on_light", "table", "ramp", "spinner",
           "newtons_cradle", "four_bar")  # fmt: skip
SMALL = {"pyramid": {"base": 3}, "pile": {"n": 12}, "chain": {"n": 6}, "bridge": {"n": 4}, "stack": {"n": 3},
         "table": {"legs": 4}}  # fmt: skip
SOLVERS = ("newton", "auto", "pgs", "block_gauss_seidel", "nncg", "admm", "anderson", "jacobi")
ENGINE_ORDERS = ("given", "reverse", "symmetric", "random", "colored", "bottom_up", "top_down")
SIZES = (0.0, 1e-300, 1e-160, 1e-12, 1e-3, 0.1, 0.5, 1.0, 1e3, 1e8, 1e150, 1e300)


def scene_spec(draw, steps=40):
    """A scene and what is done with it."""
    gallery = draw.chance(0.3)
    parameters = {}
    if draw.chance(0.4):
        parameters["dt"] = draw.pick((1e-300, 1e-9, 1e-3, 1.0 / 240.0, 0.1, 1.0, 1e6, 1e300))
    if draw.chance(0.2):
        parameters["substeps"] = draw.pick((1, 2, 4))
    if draw.chance(0.3):
        parameters["gravity"] = numbers(draw, 3, draw.pick(("tame", "wild", "special"))).tolist()
    for name in ("friction", "patch_radius", "slop", "margin", "restitution_threshold"):
        if draw.chance(0.15):
            parameters[name] = draw.pick((0.0, 1e-300, 1e-12, 0.1, 0.5, 1.0, 10.0, 1e150, 1e300))
    if draw.chance(0.2):
        parameters["restitution"] = draw.pick((0.0, 0.5, 1.0))
    if draw.chance(0.3):
        parameters["order"] = draw.pick(ENGINE_ORDERS)
    if draw.chance(0.3):
        parameters["position_iterations"] = draw.pick((0, 1, 20))
    if draw.chance(0.3):
        parameters["warm_start"] = False
    parameters["seed"] = draw.whole(0, 3)
    if "order" not in parameters and draw.chance(0.15):
        parameters |= {"solver": draw.pick(SOLVERS), "solver_iterations": draw.pick((1, 10, 60))}
        parameters["on_failure"] = draw.pick(("use", "keep", "damp", "raise"))
        steps = min(steps, 10)
    spec = {"kind": "steps", "parameters": parameters}
    if gallery:
        spec["name"] = draw.pick(GALLERY)
        parameters.update(SMALL.get(spec["name"], {}))
    else:
        spec["bodies"] = bodies(draw)
        spec["joints"] = joints(draw, len(spec["bodies"]))
    spec["actions"] = actions(draw, steps)
    spec["again"] = draw.chance(0.25)
    return spec


def bodies(draw):
    """Up to nine; often on one another's place."""
    out = []
    if draw.chance(0.8):
        out.append(
            {"shape": "plane"}
            if draw.chance(0.8)
            else {"shape": "plane", "normal": numbers(draw, 3).tolist()}
        )
    same = numbers(draw, 3, draw.pick(("tame", "special"))).tolist()
    for _ in range(draw.whole(1, 8)):
        body = {"shape": draw.pick(("sphere", "sphere", "box", "box", "none"))}
        style = draw.pick(("tame", "tame", "scales", "special"))
        if body["shape"] == "sphere":
            body["radius"] = float(positive(draw, 1, style)[0])
        elif body["shape"] == "box":
            body["size"] = positive(draw, 3, style).tolist()
        body["mass"] = float(positive(draw, 1, draw.pick(("tame", "scales", "wild", "special")))[0])
        body["position"] = (
            same
            if draw.chance(0.3)
            else numbers(draw, 3, draw.pick(("tame", "tame", "whole", "wild"))).tolist()
        )
        if draw.chance(0.5):
            body["quaternion"] = numbers(draw, 4).tolist()
        if draw.chance(0.4):
            body["velocity"] = numbers(draw, 3).tolist()
            body["angular_velocity"] = numbers(draw, 3).tolist()
        if draw.chance(0.1):
            body["inertia"] = positive(draw, 3).tolist()
        if draw.chance(0.2):
            body["friction"] = draw.pick(SIZES)
            body["patch_radius"] = draw.pick(SIZES)
        if draw.chance(0.05):
            body = {key: value for key, value in body.items() if "velocity" not in key} | {"static": True}
        out.append(body)
    return out


def joints(draw, n):
    """Up to three."""
    out = []
    for _ in range(draw.pick((0, 0, 1, 2, 3))):
        a, b = draw.whole(-1, n - 1), draw.whole(-1, n - 1)
        joint = {"kind": draw.pick(("distance", "ball", "hinge")), "a": a, "b": b}
        if joint["kind"] == "hinge":
            joint["axis"] = numbers(draw, 3).tolist()
        joint["anchor_a" if joint["kind"] == "distance" else "anchor"] = numbers(draw, 3).tolist()
        if draw.chance(0.3):
            joint["hertz"], joint["damping"] = (
                draw.pick((0.0, 1e-9, 1.0, 1e9, 1e300)),
                draw.pick((0.0, 1.0, 1e300)),
            )
        if joint["kind"] == "hinge" and draw.chance(0.4):
            joint["motor_speed"] = float(numbers(draw, 1)[0])
            joint["motor_torque"] = draw.pick((0.0, 1.0, 1e9, 1e300))
        if joint["kind"] == "distance" and draw.chance(0.3):
            joint["length"] = draw.pick(SPECIAL)
        if draw.chance(0.3):
            joint["collide"] = True
        out.append(joint)
    return out


def actions(draw, steps):
    """What is done, in turn."""
    out = []
    left = steps
    while left > 0:
        n = draw.whole(1, 20)
        out.append(["step", n])
        left -= n
        if draw.chance(0.4):
            out.append(draw.pick((["sweeps", 4], ["sweeps", 64], ["warm", 0], ["warm", 1], ["snapshot"],
                                  ["restore"], ["file"],
                                  ["problem"], ["residual"], ["reset"], ["reseed", 5])))  # fmt: skip
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


def snapshot_spec(draw):
    """A snapshot file of a scene, some of whose numbers are others, with a checksum that is right (mostly)."""
    name = draw.pick(GALLERY)
    parameters = {**SMALL.get(name, {}), "order": draw.pick(("given", "random", "colored"))}
    if draw.chance(0.2):
        del parameters["order"]
        parameters |= {"solver": "newton", "solver_iterations": 60}
    edits = []
    for _ in range(draw.pick((0, 1, 1, 1, 2, 5))):
        array = draw.pick(("size", "real", "index", "index", "index", "keys"))
        place = draw.whole(0, 10**6)
        if array == "real":
            value = draw.pick((*SPECIAL, float("nan"), float("inf"), -1.0, 1e9))
        elif array == "keys":
            value = draw.whole(0, 2**62) if draw.chance(0.5) else draw.pick((0, 1, 2**64 - 1, 2**63))
        else:
            value = draw.pick(WILD_WHOLE)
        edits.append([array, place, value])
    header = []
    if draw.chance(0.3):
        key = draw.pick(("version", "fingerprint", "steps", "failed", "lost", "lengths", "extra", None))
        header.append(
            [key, draw.pick((None, -1, 0, 1, 2, 10**30, 1.5, "x", "1", [], [1, 2, 3, 4], {}, True))]
        )
    raw = []
    if draw.chance(0.15):
        raw.append(draw.pick((["cut", draw.whole(0, 4000)], ["flip", draw.whole(0, 4000)], ["deep", 100_000],
                              ["long", 2**62], ["text", "{"], ["checksum"])))  # fmt: skip
    return {"kind": "snapshot", "name": name, "parameters": parameters, "steps": draw.whole(0, 6), "edits": edits,
            "header": header, "raw": raw}  # fmt: skip


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


def text_of(data):
    """Bytes as JSON can hold them."""
    return base64.b64encode(data).decode()
