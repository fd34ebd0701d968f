"""Who may import whom: the layers of the package hold."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "i2i"
SHARED = {"errors", "i2i"}  # may be imported by everybody
DOORS = {"train", "evaluate", "predict", "render", "download", "report", "check", "export"}
ALLOWED = {
    "geometry": set(),
    "nn": {"geometry"},
    "metrics": {"geometry"},
    "rendering": {"geometry"},
    "testing": {"geometry", "nn"},
    "models": {"nn", "geometry"},
    "data": {"geometry", "rendering"},
    "tasks": {"models", "nn", "metrics", "data.info"},
    "runs": {"tasks", "data", "models", "metrics", "geometry", "configuration"},
    "reports": {"runs", "metrics", "configuration", "data.info", "viz"},
}  # fmt: skip


def imports(path: Path) -> set[str]:
    """Modules of i2i that a file imports, as `data.info` for i2i.data.info."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        found |= {n.removeprefix("i2i.") for n in names if n == "i2i" or n.startswith("i2i.")}
    return found


@pytest.mark.parametrize("layer", sorted(ALLOWED))
def test_a_layer_imports_only_what_lies_below_it(layer):
    for path in (PACKAGE / layer).rglob("*.py"):
        for name in imports(path):
            top = name.split(".")[0]
            allowed = ALLOWED[layer] | SHARED | {layer}
            assert top in allowed or name in allowed, f"{path} imports i2i.{name}"


def test_nothing_imports_a_door():
    for path in PACKAGE.rglob("*.py"):
        assert not {n.split(".")[0] for n in imports(path)} & DOORS, path


@pytest.mark.parametrize("module", ["data.render_worker", "train", "download"])
def test_rendering_processes_and_help_do_not_wait_for_torch(module):
    script = f"import sys, i2i.{module}; print('torch' in sys.modules)"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
