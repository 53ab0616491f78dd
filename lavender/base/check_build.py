"""Raise an ImportError with instructions if the kernels are not built. Imported before other modules."""

import importlib.util

# Only the module of the judge is tested: every solve calls it.
if importlib.util.find_spec("lavender_ext.judge.measure") is None:
    # Imported only for the message: it takes 4 % of the time of `import lavender`.
    from pathlib import Path

    spec = importlib.util.find_spec("lavender_ext")
    folder = Path(spec.origin).parent if spec is not None and spec.origin else Path("lavender_ext")
    raise ImportError(
        f"the kernels in {folder} are not built. From a clone: run `pip install -e .` in {folder.parent} (it needs a C "
        "compiler); with lavender installed elsewhere: start Python outside this folder, which hides it"
    )
