"""A warm start carried to the judge's tolerance, on a problem's data, in the engine's arrays, in a browser."""
