"""Scenes, the steps of an engine, and its page in a browser: the layer above files and importers."""
