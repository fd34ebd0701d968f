"""Layers and loss functions: C4 and plain encoders, projectors, group convolutions, heads."""
