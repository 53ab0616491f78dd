"""Names and indices of the entries of the engine's arrays `size`, `head`, `setting` and `joint`.

They are defined in `lavender_ext/engine/arrays.pxd`.
"""

from lavender_ext.engine import arrays

_NUMBERS = {name: number for name, number in vars(arrays).items() if isinstance(number, int)}
HEAD, SETTING, JOINT = (
    {
        name.removeprefix(prefix).lower(): x
        for name, x in _NUMBERS.items()
        if name.startswith(prefix)
    }
    for prefix in ("H_", "S_", "J_")
)
SIZE = {
    "bodies": arrays.N_BODY,
    "dynamic": arrays.N_DYNAMIC,
    "joints": arrays.N_JOINT,
    "joint_rows": arrays.N_JOINT_ROW,
    "excluded": arrays.N_EXCLUDED,
    "buckets": arrays.N_BUCKET,
    "frames": arrays.N_FRAME,
    "rows_per_contact": arrays.ROWS_PER_CONTACT,
}
JOINT_KINDS = {"distance": arrays.DISTANCE, "ball": arrays.BALL, "hinge": arrays.HINGE}
ORDER_NUMBER = {
    "given": arrays.AS_GIVEN,
    "reverse": arrays.REVERSED,
    "symmetric": arrays.SYMMETRICALLY,
    "random": arrays.AT_RANDOM,
    "bottom_up": arrays.BOTTOM_UP,
    "top_down": arrays.TOP_DOWN,
    "colored": arrays.COLORED,
    "alternating": arrays.ALTERNATING,
    "colored_pairs": arrays.COLORED_PAIRS,
}
