"""Scenes, the step of an engine, and its page in a browser: the floor above files and importers."""
