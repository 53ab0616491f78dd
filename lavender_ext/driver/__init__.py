"""Dispatch of solver methods (workspace size, start, step) on plain structs, for any host."""
