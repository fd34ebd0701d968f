"""Mesh sources, the rendered store, datasets and Lightning data modules."""
