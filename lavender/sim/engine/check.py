"""Checks of a snapshot before the kernels use it.

The kernels do not check indices that they read from arrays. Every array therefore belongs to one of four groups:

    given      defined by the scene; must equal the simulation's own array, bit for bit
    carried    carried from one substep to the next; must be finite, in range and sorted
    judged     the problem of the last substep, which `Simulation.residual` reads; must be complete and in range
    scratch    written before it is read in every substep; is not checked

The list of pairs of bodies that may touch is not restored; the next substep builds it again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.errors import InputError
from lavender.problem.cones import get_block_kinds
from lavender.sim.engine.layout import HEAD, ORDER_NUMBER, SETTING, SIZE
from lavender.sim.engine.state import State
from lavender_ext.engine.arrays import CAP_CONTACT, CAP_PAIR, N_SIZES

GIVEN = (
    "inv_mass_body",
    "inertia",
    "inv_inertia_body",
    "shape",
    "friction",
    "restitution",
    "patch",
    "joint",
    "inv_mass",
    "kind_of_shape",
    "dyn",
    "uneven",
    "body_of",
    "joint_kind",
    "joint_motor",
    "joint_bodies",
    "joint_body",
    "excluded",
)
FIXED_HEAD = ("position_iterations", "order", "seed", "friction_shape", "substeps")
WRITTEN_SETTINGS = {
    "out": 8,
    "depth": 1,
    "joint_error": 1,
}  # Entries of `setting` that the engine writes.
# Largest accepted deviation of a squared quaternion norm from 1 [-]; quaternions are normalised in every substep.
QUATERNION_TOLERANCE = 1e-9


def check_state_sizes(own: State, size: np.ndarray) -> None:
    """Raise InputError if entries of `size`, other than capacities of arrays, differ from the simulation's own."""
    free = (CAP_PAIR, CAP_CONTACT)
    fixed = [k for k in range(N_SIZES) if k not in free]
    is_same = np.array_equal(size[fixed], own.size[fixed]) and size[list(free)].min() >= 0
    require_intact(is_same, "its sizes differ from the sizes of this scene")


def check_state(own: State, new: State, sweeps: tuple[int, int], is_lost: bool) -> None:
    """Raise InputError if `new` is not a state of the scene of `own`; call `check_state_sizes` first.

    Parameters
    ----------
    own, new : State
        State of the simulation and state to check.
    sweeps : (int, int)
        Smallest and largest sweep budget.
    is_lost : bool
        Whether the snapshot is marked as not finite. Its numbers are then not checked, because no step can follow.
    """
    a, b = own.a, new.a
    for name in GIVEN:
        is_same = a[name].tobytes() == b[name].tobytes()
        require_intact(is_same, f"{name} differs from the value of this scene")
    kj = int(own.size[SIZE["joints"]])
    is_same = np.array_equal(a["ptr"][: kj + 1], b["ptr"][: kj + 1])
    require_intact(is_same, "the rows of the joints differ from the rows of this scene")
    settings = np.ones(len(own.setting), bool)
    for name, width in WRITTEN_SETTINGS.items():
        settings[SETTING[name] : SETTING[name] + width] = False
    is_same = own.setting[settings].tobytes() == new.setting[settings].tobytes()
    require_intact(is_same, "settings differ from the ones of this scene")
    _check_head(own, new, sweeps, is_lost)
    _check_contacts(new)
    if is_lost:
        return
    # Check that numbers are finite, quaternions are normalised, and inertias belong to the scene.
    cached = int(new.head[HEAD["cached"]])
    names = "x", "v", "joint_impulse", "inv_inertia", "cache_impulse", "cache_local", "cache_roll"
    for name in names:
        values = b[name][:cached] if name.startswith("cache") else b[name]
        require_intact(np.isfinite(values).all(), f"{name} is not finite")
    with np.errstate(over="ignore", invalid="ignore"):
        is_unit = np.abs((b["q"] ** 2).sum(axis=1) - 1.0) <= QUATERNION_TOLERANCE
    require_intact(is_unit.all(), "q holds a quaternion that does not have length 1")
    require_intact(not b["v"][b["dyn"] < 0].any(), "v gives a static body a velocity")
    even = ~b["uneven"][b["body_of"]].astype(bool)
    is_same = b["inv_inertia"][even].tobytes() == a["inv_inertia"][even].tobytes()
    require_intact(is_same, "inv_inertia differs from the value of this scene")


def _check_head(own: State, new: State, sweeps: tuple[int, int], is_lost: bool) -> None:
    """Check the counters and the settings in `head`."""
    n = int(own.size[SIZE["bodies"]])
    top = 2**31 - 1
    contacts = int(new.size[CAP_CONTACT])
    per = int(own.size[SIZE["rows_per_contact"]])
    counters = dict.fromkeys(
        ("step", "need_pairs", "need_contacts", "rebuilds", "projected"), (0, top)
    )
    ranges = {
        **counters,
        **dict.fromkeys(("contacts", "matches", "cached"), (0, contacts)),
        **dict.fromkeys(("pairs_valid", "warm_start", "solved", "rebuilt"), (0, 1)),
        "kept": (0, int(own.setting[SETTING["recycle"]] > 0.0 and new.head[HEAD["solved"]] == 1)),
        "phase": (0, 0),
        "contact_rows": (0, contacts * per),
        "pairs": (0, int(new.size[CAP_PAIR])),
        "iterations": sweeps,
        "lost": (0, n - 1) if is_lost else (-1, -1),
    }
    for name, (low, high) in ranges.items():
        value = new.head[HEAD[name]]
        require_intact(low <= value <= high, f"{name} is {value}, not {low} to {high}")
    for name in FIXED_HEAD:
        is_same = new.head[HEAD[name]] == own.head[HEAD[name]]
        require_intact(is_same, f"{name} differs from the value of this scene")


def _check_contacts(new: State) -> None:
    """Check the contact cache and the rows and blocks of the last substep's contacts."""
    b, size = new.a, new.size
    kj, mj = int(size[SIZE["joints"]]), int(size[SIZE["joint_rows"]])
    c, rows = int(new.head[HEAD["contacts"]]), int(new.head[HEAD["contact_rows"]])
    per, n = int(size[SIZE["rows_per_contact"]]), int(size[SIZE["bodies"]])
    cached = b["cache_key"][: new.head[HEAD["cached"]]] >> np.uint64(16)
    is_sorted = (cached[1:] >= cached[:-1]).all() and (cached >> np.uint64(24) < n).all()
    require_intact(is_sorted, "cache_key is not sorted")
    if not new.head[HEAD["solved"]]:
        return
    ptr = b["ptr"][kj : kj + c + 1].astype(np.int64)
    blocks = np.diff(ptr)
    friction = b["mu"][kj : kj + c] > 0.0
    box = friction & bool(new.head[HEAD["friction_shape"]])
    max_rows = np.where(box, 3, np.where(friction, 6, 1))
    has_rows = (blocks >= np.where(friction, 3, 1)).all() and (
        blocks <= np.minimum(max_rows, per)
    ).all()
    is_valid = has_rows and ptr[0] == mj and ptr[-1] == mj + rows
    require_intact(
        is_valid,
        f"ptr does not give each of the {c} contacts the rows of its kind, {rows} in total",
    )
    contact = np.arange(kj + c) >= kj
    size = np.concatenate([np.ones(kj, np.int64), blocks])
    is_box = np.concatenate([np.zeros(kj, bool), box])
    kinds = get_block_kinds(contact, box=is_box, spin=size == 4, rolling=size > 4)
    require_intact(
        c == 0 or (b["kind"][: kj + c] == kinds).all(), "kind does not match the rows of a block"
    )
    pair = b["contact_pair"][:c]
    is_body = ((pair >= 0) & (pair < n)).all() and np.array_equal(
        b["contact_body"][:c], b["dyn"][pair]
    )
    require_intact(c == 0 or is_body, "contact_pair names bodies that the scene does not have")
    if new.head[HEAD["kept"]]:
        _check_kept_contacts(new, pair.astype(np.int64))


def _check_kept_contacts(new: State, pair: np.ndarray) -> None:
    """Check the contacts between the bodies `pair` (c, 2) that the next step keeps."""
    b, c = new.a, len(pair)
    is_body = np.array_equal(b["key"][:c] >> np.uint64(16), (pair[:, 0] << 24) | pair[:, 1])
    require_intact(c == 0 or is_body, "key names other bodies than contact_pair")
    own = pair[:, 0] * len(b["dyn"]) + pair[:, 1]
    # From the last pair to the first if an alternating order began the step so; the number of substeps is even then.
    alternates = new.head[HEAD["order"]] == ORDER_NUMBER["alternating"]
    if alternates and new.head[HEAD["step"]] % 2:
        own = own[::-1]
    require_intact((own[1:] >= own[:-1]).all(), "contact_pair is not sorted")
    for name in ("gap", "normal", "tangent", "arm_a", "arm_b", "local"):
        require_intact(np.isfinite(b[name][:c]).all(), f"{name} is not finite")
    rows = int(new.size[SIZE["joint_rows"]]), int(new.head[HEAD["contact_rows"]])
    is_finite = np.isfinite(b["impulse"][rows[0] : sum(rows)]).all()
    require_intact(is_finite, "impulse is not finite")
    is_path = np.isfinite(b["moved"]).all() and (b["moved"] >= 0.0).all()
    require_intact(is_path, "moved has a value that is negative or not finite")


def require_intact(is_valid: Any, reason: str) -> None:
    """Raise InputError with the reason unless the condition holds."""
    if not is_valid:
        raise InputError(f"the snapshot is damaged: {reason}; take a new one with sim.snapshot()")


def check_snapshot_fields(snapshot: Any) -> None:
    """Raise InputError if the fields of a snapshot have wrong types or lengths."""
    for name in ("steps", "failed"):
        x = getattr(snapshot, name)
        require_intact(type(x) is int and 0 <= x < 2**53, f"{name} is {str(x)[:40]}, not a count")
    for name in ("fingerprint", "lost"):
        x = getattr(snapshot, name)
        require_intact(isinstance(x, str), f"{name} is a {type(x).__name__}, not text")
    for name, dtype in (
        ("size", np.int32),
        ("real", np.float64),
        ("index", np.int32),
        ("keys", np.uint64),
    ):
        x = getattr(snapshot, name)
        is_vector = isinstance(x, np.ndarray) and x.dtype == dtype and x.ndim == 1
        require_intact(is_vector, f"{name} is not a vector of {np.dtype(dtype).name}")
    require_intact(
        len(snapshot.size) == N_SIZES, f"size has {len(snapshot.size)} entries, not {N_SIZES}"
    )
