"""Places of numbers in the engine's small arrays, as `lavender_ext/engine/arrays.pxd` numbers them."""

SIZE = {
    "bodies": 0, "dynamic": 1, "joints": 2, "joint_rows": 3, "excluded": 4, "buckets": 5, "frames": 6,
    "rows_per_contact": 7,
}  # fmt: skip
CAP_PAIR, CAP_CONTACT, N_SIZES = 8, 9, 10
HEAD = {
    "contacts": 0, "contact_rows": 1, "pairs": 2, "pairs_valid": 3, "matches": 4, "cached": 5, "iterations": 6,
    "warm_start": 7, "position_iterations": 8, "order": 9, "seed": 10, "step": 11, "need_pairs": 12,
    "need_contacts": 13, "rebuilds": 14, "projected": 15, "lost": 16, "solved": 17,
}  # fmt: skip
SETTING = {
    "h": 0, "gravity": 1, "slop": 4, "margin": 5, "skin": 6, "beta": 7, "max_push": 8, "bounce": 9, "match": 10,
    "out": 12, "depth": 20, "joint_error": 21,
}  # fmt: skip
JOINT = {
    "anchor_a": 0, "anchor_b": 3, "axis_a": 6, "axis_b": 9, "side_a": 12, "length": 15, "hertz": 16, "damping": 17,
    "speed": 18, "torque": 19,
}  # fmt: skip
JOINT_KINDS = {"distance": 0, "ball": 1, "hinge": 2}
OK, NEED_ROOM, NOT_FINITE = 0, 1, 2
MOST_PAIRS, TOO_MANY = 2**24, 2**31 - 1  # pairs that end the broad phase, and the need that it then names
