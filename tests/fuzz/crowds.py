"""Many small problems side by side as one, plain data as in problems.py: what a solver may take apart again."""

from itertools import chain

import numpy as np
from scipy.linalg import block_diag

OF_BLOCK, OF_ROW = ("kind", "mu", "patch_radius", "rolling"), ("lower", "upper")
BODY = ("inv_mass", "inv_inertia", "v_free")
CONTACT = ("normal", "tangent", "arm_a", "arm_b", "contact_body")


def ends(sizes):
    """Pointers of pieces of these sizes."""
    return np.cumsum([0, *sizes]).astype(int).tolist()


def pieces(ptr, order):
    """Entries of pieces, taken in an order."""
    return list(chain.from_iterable(range(ptr[i], ptr[i + 1]) for i in order))


def taken(lists, which):
    """Items of all lists behind each other, by their numbers there."""
    items = list(chain.from_iterable(lists))
    return [items[i] for i in which]


def joined(specs, rng=None):
    """One problem of several alike; `rng` mixes their blocks, of which joints of bodies stay first."""
    cones, first = [s["cones"] for s in specs], specs[0]
    n_joints = [len(s["rows"]["joint_ptr"]) - 1 if "rows" in s else 0 for s in specs]
    is_joint = np.concatenate([np.arange(len(c["kind"])) < n for c, n in zip(cones, n_joints, strict=True)])
    order = np.arange(len(is_joint)) if rng is None else rng.permutation(len(is_joint))
    order = order[np.argsort(~is_joint[order], kind="stable")]
    sizes = np.concatenate([np.diff(c["ptr"]) for c in cones]).astype(int)
    row = pieces(ends(sizes), order)

    out = {key: first[key] for key in ("operator", "friction")}
    out["cones"] = {"ptr": ends(sizes[order])}
    for key in OF_BLOCK:
        if any(key in c for c in cones):
            out["cones"][key] = taken([c.get(key, [0.0] * len(c["kind"])) for c in cones], order)
    for key in OF_ROW:
        out["cones"][key] = taken([c[key] for c in cones], row)
    for key in ("b", "target", "compliance", "guess"):
        if any(key in s for s in specs):
            out[key] = taken([s.get(key) or [0.0] * s["cones"]["ptr"][-1] for s in specs], row)
    if "v_free" in first:
        out["v_free"] = list(chain.from_iterable(s["v_free"] for s in specs))
    kept = {"m": row, "v": range(len(out.get("v_free", ())))}
    for key, shape in {"A": "mm", "J": "mv", "M": "vv"}.items():
        if key in first:
            sizes_of = [{"m": s["cones"]["ptr"][-1], "v": len(s.get("v_free", ()))} for s in specs]
            of = [
                np.array(s[key], float).reshape([n[k] for k in shape])
                for s, n in zip(specs, sizes_of, strict=True)
            ]
            out[key] = block_diag(*of)[np.ix_(*(kept[k] for k in shape))].tolist()
    if "rows" in first:
        out["rows"] = rows([s["rows"] for s in specs], is_joint, order)
    return out


def rows(of, is_joint, order):
    """Bodies of all, joints and contacts as their blocks stand."""
    at, of = 0, [dict(r) for r in of]
    for r in of:
        for key in ("joint_body", "contact_body"):
            r[key] = [[b + at if b >= 0 else b for b in pair] for pair in r[key]]
        at += len(r["inv_mass"])
    joints, contacts = (np.cumsum(x)[order[x[order]]] - 1 for x in (is_joint, ~is_joint))
    sizes = np.concatenate([np.diff(r["joint_ptr"]) for r in of]).astype(int)
    out = {key: list(chain.from_iterable(r[key] for r in of)) for key in BODY}
    out["joint_body"] = taken([r["joint_body"] for r in of], joints)
    out |= {key: taken([r[key] for r in of], contacts) for key in CONTACT}
    return out | {
        "jac": taken([r["jac"] for r in of], pieces(ends(sizes), joints)),
        "joint_ptr": ends(sizes[joints]),
    }
