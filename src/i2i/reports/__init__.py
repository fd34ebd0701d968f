"""The paper's tables with ours beside them: reading results, selecting, statistics, writers."""
