"""Many small problems side by side as one, plain data as in problems.py: what a solver may take apart again."""

from itertools import chain

import numpy as np
from scipy.linalg import block_diag


def joined(specs, rng=None):
    """One problem of several alike; `rng` mixes their blocks, of which joints of bodies stay first."""
    join = {"rows": rows, "general": general}.get(specs[0]["operator"], matrices)
    spec = join(specs)
    blocks = np.arange(len(spec["cones"]["kind"]))
    joints = len(spec["rows"]["joint_ptr"]) - 1 if spec["operator"] == "rows" else 0
    if rng is not None:
        blocks = np.concatenate([rng.permutation(blocks[:joints]), rng.permutation(blocks[joints:])])
    return reordered(spec, blocks, joints)


def one_list(lists):
    """Their items."""
    return list(chain.from_iterable(lists))


def cones(specs):
    """Blocks of all, one after the other."""
    found = {
        key: one_list(s["cones"][key] for s in specs)
        for key in ("kind", "lower", "upper", "mu", "patch_radius")
    }
    if any("rolling" in s["cones"] for s in specs):
        found["rolling"] = one_list(s["cones"].get("rolling", [0.0] * len(s["cones"]["kind"])) for s in specs)
    sizes = np.concatenate([np.diff(s["cones"]["ptr"]) for s in specs])
    return found | {"ptr": np.concatenate([[0], np.cumsum(sizes)]).astype(int).tolist()}


def common(specs):
    """What every operator has."""
    spec = {key: specs[0][key] for key in ("operator", "friction")} | {"cones": cones(specs)}
    for key in ("b", "v_free", "target"):
        if key in specs[0]:
            spec[key] = one_list(s[key] for s in specs)
    for key in ("guess", "compliance"):
        if any(key in s for s in specs):
            spec[key] = one_list(s.get(key) or [0.0] * s["cones"]["ptr"][-1] for s in specs)
    return spec


def matrices(specs):
    """A block diagonal."""
    a = [np.array(s["A"], float).reshape((len(s["b"]),) * 2) for s in specs]
    return common(specs) | {"A": block_diag(*a).tolist()}


def general(specs):
    """J and M block diagonal."""
    j = [np.array(s["J"], float).reshape(-1, len(s["v_free"])) for s in specs]
    mass = [np.array(s["M"], float) for s in specs]
    return common(specs) | {"J": block_diag(*j).tolist(), "M": block_diag(*mass).tolist()}


def rows(specs):
    """Bodies, joints and contacts of all; joints' blocks first, as `Rows` has them."""
    first = np.cumsum([0] + [len(s["rows"]["inv_mass"]) for s in specs])
    keys = ("inv_mass", "inv_inertia", "v_free", "jac", "normal", "tangent", "arm_a", "arm_b")
    body = {key: one_list(s["rows"][key] for s in specs) for key in keys}
    for key in ("joint_body", "contact_body"):
        body[key] = [
            [b + int(at) if b >= 0 else b for b in pair]
            for s, at in zip(specs, first, strict=False)
            for pair in s["rows"][key]
        ]
    sizes = np.concatenate([np.diff(s["rows"]["joint_ptr"]) for s in specs])
    body["joint_ptr"] = np.concatenate([[0], np.cumsum(sizes)]).astype(int).tolist()
    spec = common(specs) | {"rows": body}
    n_joints = [len(s["rows"]["joint_ptr"]) - 1 for s in specs]
    ends = np.cumsum([0] + [len(s["cones"]["kind"]) for s in specs])
    is_joint = np.concatenate(
        [np.arange(b - a) < n for a, b, n in zip(ends, ends[1:], n_joints, strict=False)]
    )
    order = np.argsort(~is_joint, kind="stable")
    # joints' and contacts' own arrays stand in this order already
    return reordered(spec, order, None)


def reordered(spec, order, joints):
    """Blocks in another order; `joints`: how many come first, whose arrays move with them, None where none moves."""
    c = spec["cones"]
    ptr = np.array(c["ptr"])
    of = [np.arange(ptr[i], ptr[i + 1]) for i in order]
    row = np.concatenate(of).astype(int) if of else np.zeros(0, int)
    out = dict(spec)
    out["cones"] = {
        "ptr": np.concatenate([[0], np.cumsum([len(x) for x in of])]).astype(int).tolist(),
        **{key: [c[key][i] for i in order] for key in ("kind", "mu", "patch_radius", "rolling") if key in c},
        **{key: [c[key][i] for i in row] for key in ("lower", "upper")},
    }
    for key in ("b", "target", "compliance", "guess"):
        if key in spec:
            out[key] = [spec[key][i] for i in row]
    if "A" in spec:
        out["A"] = np.array(spec["A"], float).reshape((len(row),) * 2)[np.ix_(row, row)].tolist()
    if "J" in spec:
        out["J"] = np.array(spec["J"], float).reshape(len(row), len(spec["v_free"]))[row].tolist()
    if spec["operator"] == "rows" and joints is not None:
        r = dict(spec["rows"])
        ends = r["joint_ptr"]
        moved = [np.arange(ends[i], ends[i + 1]) for i in order[:joints]]
        r["jac"] = [r["jac"][i] for rows_of in moved for i in rows_of]
        r["joint_ptr"] = np.concatenate([[0], np.cumsum([len(x) for x in moved])]).astype(int).tolist()
        r["joint_body"] = [r["joint_body"][i] for i in order[:joints]]
        for key in ("normal", "tangent", "arm_a", "arm_b", "contact_body"):
            r[key] = [r[key][i - joints] for i in order[joints:]]
        out["rows"] = r
    return out
