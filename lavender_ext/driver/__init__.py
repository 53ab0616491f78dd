"""Functions of a method (workspace size, start, step) and memory of the engine, for Python, C and WebAssembly."""
