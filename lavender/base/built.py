"""Imported before everything else: are the kernels built? If not, what to do is said, not which module is missing."""

import importlib.util

#: Every solve passes through the judge; where its module is there, the build has run to its end.
MODULE = "lavender_ext.judge.measure"


def check(module: str = MODULE) -> None:
    """Raise ImportError where a compiled module of the kernels cannot be found."""
    if importlib.util.find_spec(module) is None:
        from pathlib import Path  # with what it imports 4 % of `import lavender`

        spec = importlib.util.find_spec("lavender_ext")
        where = Path(spec.origin).parent if spec is not None and spec.origin else Path("lavender_ext")
        raise ImportError(
            f"the kernels in {where} are not built. From a clone: run `pip install -e .` in {where.parent} (it needs "
            "a C compiler); with lavender installed elsewhere: start Python outside this folder, which hides it"
        )


check()
