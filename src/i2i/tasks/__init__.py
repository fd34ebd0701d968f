"""LightningModules: they run a network's loss, metrics and optimiser, nothing else."""
