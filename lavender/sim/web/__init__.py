"""The kernels in WebAssembly, and a page that runs them; see docs/web.md."""
