"""Orientation and shape class of an object from a single image, by icosahedral projection."""

from typing import Any

__version__ = "0.1.0"
__all__ = ["__version__", "export_run", "load"]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - whatever the attribute is
    """Import what is asked for when it is first: rendering processes never pay for torch."""
    if name == "load":
        from i2i.predictor import load

        return load
    if name == "export_run":
        from i2i.exporting import export_run

        return export_run
    raise AttributeError(f"module 'i2i' has no attribute {name!r}")
