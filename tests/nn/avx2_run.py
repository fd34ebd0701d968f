"""A test file again with the library for AVX2, where the processor would take AVX-512."""

import os
import subprocess
import sys

import pytest
import torch


def run_with_avx2(file: str, *words: str) -> None:
    """Fails where the file's tests do."""
    if torch.backends.cpu.get_cpu_capability() != "AVX512":
        pytest.skip("the library for AVX2 is the one that the other tests take, or there is none")
    subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", *words, file],
        env={**os.environ, "ATEN_CPU_CAPABILITY": "avx2", "I2I_EXPECT": "avx2"}, check=True,
    )  # fmt: skip
