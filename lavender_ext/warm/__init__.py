"""A warm start carried to the judge's tolerance, on a problem's data or in the engine's arrays."""
