"""Check the origin of the installed lavender, solve a small problem and compare with the solution by hand.

python .ci/smoke.py [FOLDER]        lavender and its kernels must be imported from below FOLDER, else this environment
"""

import sys
from pathlib import Path

import numpy as np

import lavender as lv
import lavender_ext.sweep.serial


def main(folder: Path) -> None:
    """Raise AssertionError if a solution or the origin of a module is wrong."""
    for module in (lv, lavender_ext.sweep.serial):
        origin = Path(module.__file__).resolve()
        assert origin.is_relative_to(folder.resolve()), (
            f"{module.__name__} came from {origin}, not from {folder}"
        )

    # Row 1 separates: impulse (1/2, 0), slack (0, 1/2 + 1).
    problem = lv.Problem.lcp(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0]))
    for solver in ("pgs", "direct"):
        solution = lv.solve(problem, solver, tol=1e-12)
        assert solution.success, solution
        # tol 1e-12 times the condition number 3 of A bounds the error by 1e-11.
        np.testing.assert_allclose(solution.impulse, [0.5, 0.0], rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(solution.slack, [0.0, 1.5], rtol=0.0, atol=1e-11)
    print(f"lavender {lv.__version__} from {Path(lv.__file__).parent}: {solution}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else sys.prefix))
