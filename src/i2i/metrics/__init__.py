"""Rotation error, classification and retrieval scores: a function and a torchmetrics class each."""
