"""The kernels in WebAssembly, and a page that runs them; described in docs/engine.md."""

from lavender.sim.web.scenes import write_scene

__all__ = ["write_scene"]
