"""Worlds of engines: audit a model, find settings for it, check engines' claims and explain why contacts slip."""
