"""What the tests of layers share; makes `joint_processes` importable from beside them."""

import sys
from pathlib import Path

import pytest

from i2i.nn import native

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(params=["compiled", "torch"])
def both_forms(request):
    """What holds for the compiled transforms and for torch's."""
    if request.param == "compiled":
        if native.library() is None:
            pytest.skip("no compiler was found when i2i was installed")
        yield
    else:
        with native.torch_only():
            yield
