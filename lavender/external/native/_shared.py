"""What several native backends need."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError


def set_all(target: Any, settings: Mapping[str, Any], name: str) -> None:
    """Put settings on an object of the backend `name`; InputError for one that it does not have."""
    for key, value in settings.items():
        if not hasattr(target, key):
            known = sorted(k for k in dir(target) if not k.startswith("_"))
            raise InputError(f"{name} has no setting {key!r}; known: {', '.join(known)}")
        setattr(target, key, value)


def certificate(y: Any, size: int) -> FloatArray | None:
    """A proof of infeasibility as the backend gave it, where it is one by its shape."""
    if y is None or np.size(y) != size or not np.isfinite(y).all() or not np.any(y):
        return None
    return np.array(y, float)
