"""Whole networks, put together from `i2i.nn`; one file per system of the paper."""
