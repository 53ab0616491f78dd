"""The matrix of MuJoCo's integrator "discrete", which solves the constraints with M + h D + h^2 K instead of M.

D are dampings and K stiffnesses of joints, tendons, actuators, fluid and flexes; h is the time step. MuJoCo stores the
added terms in arrays efm_*. They also add -h K v to the smooth force:

    (M + h D + h^2 K) a0 = qfrc_smooth + efm_c + efm_ca
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.problem.generalized import Compressed, Generalized

# Largest accepted residual of a0 relative to the smooth force: this multiple of opt.tolerance, at which MuJoCo stops
# its conjugate gradients in the 2-norm of their own residual, which differs from the recomputed one by rounding.
TOLERANCE_RATIO = 10.0
# Largest accepted difference of M a0 and the smooth force (the force without constraints), relative to their size: 64
# roundings. A larger difference means that MuJoCo computed a0 with another matrix.
MASS_TOLERANCE = 2.0**-46


class DiscreteMatrix(NamedTuple):
    """The matrix of a discrete step and the correction of its smooth acceleration.

    Parameters
    ----------
    lower : (indptr, indices, data)
        Lower triangle in compressed rows.
    change : (nv,) or None, m/s^2, rad/s^2
        Exact smooth acceleration minus qacc_smooth, if MuJoCo found it by an iteration.
    """

    lower: Compressed
    change: FloatArray | None

    def solve(self, force: FloatArray) -> FloatArray:
        """Return the acceleration (nv,) that a force (nv,) causes."""
        no_rows = np.zeros(1, np.int32), np.zeros(0, np.int32), np.zeros(0)
        return Generalized.from_compressed_rows(no_rows, self.lower, force).solve(force)


def compute_discrete_matrix(mj: Any, model: Any, data: Any, advice: str) -> DiscreteMatrix:
    """Build the matrix of the last forward pass from the arrays of MuJoCo.

    Parameters
    ----------
    mj : module
        MuJoCo.
    advice : str
        Sentence for data that were changed since their forward pass.

    Raises
    ------
    CapabilityError
        MuJoCo does not store the stiffness of a flex; or the matrix does not reproduce qacc_smooth.
    """
    n = int(model.nv)
    _check_flex_stiffness(mj, model, data)
    rows, columns, values = (
        np.concatenate(parts) for parts in zip(*_iterate_terms(model, data), strict=True)
    )
    lower = rows >= columns
    matrix = sp.csr_array((values[lower], (rows[lower], columns[lower])), shape=(n, n))
    matrix.sum_duplicates()
    whole = matrix + sp.triu(matrix.T, 1)
    force = data.qfrc_smooth + sum(x for x in (data.efm_c, data.efm_ca) if len(x) == n)
    residual = force - whole @ data.qacc_smooth
    gap, size = np.linalg.norm(residual), np.linalg.norm(force)
    # Couplings of tendons, actuators and flexes leave MuJoCo's sparsity of M: it then finds a0 by an iteration.
    is_iterative = bool(data.nefmT or data.nefmA or model.nflex)
    is_warned = bool(
        data.warning[int(mj.mjtWarning.mjWARN_INERTIA)].number
    )  # It used up its iterations.
    limit = TOLERANCE_RATIO * model.opt.tolerance if is_iterative else 0.0
    rounding = MASS_TOLERANCE * np.linalg.norm(abs(whole) @ abs(data.qacc_smooth))
    if not (gap <= limit * size + rounding or (is_iterative and is_warned and gap < np.inf)):
        added = (name for name in dir(data) if name.startswith("efm_") and name != "efm_active")
        names = ", ".join(name for name in added if np.any(getattr(data, name)))
        relative = gap / max(size, np.finfo(float).tiny)
        raise CapabilityError(
            f"(M + h D + h^2 K) qacc_smooth differs from qfrc_smooth + efm_c + efm_ca by {relative:.1e} of its "
            f"size. The step has integrator='discrete' and the arrays {names}. {advice}"
        )
    arrays = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data
    result = DiscreteMatrix(arrays, None)
    return result._replace(change=result.solve(residual)) if is_iterative else result


def _iterate_terms(model: Any, data: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield (rows, columns, values) of M and of each added term; entries above the diagonal may be left out."""
    n = int(model.nv)
    every = np.arange(n)
    tree_rows = np.repeat(every, model.M_rownnz)
    yield tree_rows, model.M_colind, data.M
    if len(data.efm_fluid):
        yield tree_rows, model.M_colind, data.efm_fluid
    if len(data.efm_diag):
        yield every, every, data.efm_diag
    if data.nefmK:
        count, first = data.efm_K_rownnz, data.efm_K_rowadr
        source = np.arange(count.sum()) + np.repeat(first - (np.cumsum(count) - count), count)
        yield np.repeat(every, count), data.efm_K_colind[source], data.efm_K_val[source]
    for scale, columns, row in _iterate_rank_one_terms(model, data):
        yield (
            np.repeat(columns, len(row)),
            np.tile(columns, len(row)),
            (scale * np.outer(row, row)).ravel(),
        )


def _iterate_rank_one_terms(model: Any, data: Any) -> Iterator[tuple[float, IntArray, FloatArray]]:
    """Yield (scale, columns, row) of each term scale row^T row: tendons, actuators and passive contacts of flexes."""
    for tendon, scale in zip(data.efm_tid[: data.nefmT], data.efm_ts, strict=False):
        first = model.ten_J_rowadr[tendon]
        entries = slice(first, first + model.ten_J_rownnz[tendon])
        yield scale, model.ten_J_colind[entries], data.ten_J[entries]
    for actuator, scale in zip(data.efm_aid[: data.nefmA], data.efm_as, strict=False):
        output = model.actuator_outadr[actuator]
        for i in range(output, output + model.actuator_outnum[actuator]):
            entries = slice(data.moment_rowadr[i], data.moment_rowadr[i] + data.moment_rownnz[i])
            yield scale, data.moment_colind[entries], data.actuator_moment[entries]
    first = 0
    while (
        first < data.nefmcon
    ):  # Each contact has two numbers before its entries: their number, and its index.
        entries = slice(first + 2, first + 2 + data.efm_con_ind[first])
        yield data.efm_con_val[first], data.efm_con_ind[entries], data.efm_con_val[entries]
        first = entries.stop


def _check_flex_stiffness(mj: Any, model: Any, data: Any) -> None:
    """Raise CapabilityError if a velocity of an elastic flex has no row of efm_K: MuJoCo then stores no matrix."""
    for flex in range(model.nflex):
        is_elastic = _has_stiffness(model, flex, "stiffness") or _has_stiffness(
            model, flex, "bending"
        )
        if model.flex_rigid[flex] or not is_elastic:
            continue
        points, address, count = (
            (model.flex_nodebodyid, model.flex_nodeadr, model.flex_nodenum)
            if model.flex_interp[flex]
            else (model.flex_vertbodyid, model.flex_vertadr, model.flex_vertnum)
        )
        bodies = points[address[flex] : address[flex] + count[flex]]
        if np.any(data.efm_K_rownnz[np.isin(model.dof_bodyid, bodies)] == 0):
            name = mj.mj_id2name(model, mj.mjtObj.mjOBJ_FLEX, flex) or flex
            raise CapabilityError(
                f"the matrix of integrator='discrete' contains the stiffness of flex {name}, which MuJoCo does not "
                'store with this solver (efm_K has no entries of its velocities): use solver="Newton", which stores it'
            )


def _has_stiffness(model: Any, flex: int, name: str) -> bool:
    """Return whether the stiffness or bending array of a flex has a number other than 0."""
    address = getattr(model, f"flex_{name}adr")
    values = getattr(model, f"flex_{name}")
    if address[flex] < 0:
        return False
    later = address[address > address[flex]]
    return bool(np.any(values[address[flex] : later.min() if len(later) else None]))
