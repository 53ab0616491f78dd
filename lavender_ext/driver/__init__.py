"""Calls of a method's functions (workspace size, start, step) on plain structs, for Python, C and WebAssembly."""
