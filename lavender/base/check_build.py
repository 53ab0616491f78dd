"""Raise an ImportError with the command to run if the kernels are not built. It is imported before other modules."""

try:
    import lavender_ext.core.checks
except ImportError as error:
    if not (error.name or "").startswith("lavender_ext"):
        raise  # A package that the kernels need is missing.
    from pathlib import Path

    import lavender_ext

    folder = Path(lavender_ext.__path__[0])
    raise ImportError(
        f"the kernels in {folder} are not built for this Python.\n"
        f"In a clone, build them (needs a C compiler): pip install -e {folder.parent}\n"
        f"If lavender is installed elsewhere: start Python outside of {folder.parent}, which hides it."
    ) from None
