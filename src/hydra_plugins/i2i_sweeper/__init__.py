"""Hydra's sweeper of i2i: resumable unions of grids."""
