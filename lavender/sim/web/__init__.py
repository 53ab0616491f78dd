"""The kernels in WebAssembly, and a page that runs them; described in docs/web.md."""
