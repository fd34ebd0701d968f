"""Procedural furniture, vehicles, bottles and guitars: the source of meshes that is built in."""

from i2i.data.sources.synthetic.source import SyntheticSource

__all__ = ["SyntheticSource"]
