"""Run folders: what a run leaves behind, its identity, and how it is loaded again."""
