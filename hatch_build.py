"""Compiles `src/i2i/nn/native` while i2i is installed, where a C++ compiler is found.

One library for each instruction set; at run time i2i takes the one of the processor. Without a
compiler, or with I2I_NO_COMPILER=1, nothing is built, and torch does what the library would: the
same function, slower.
"""

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sysconfig
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = Path(__file__).parent / "src" / "i2i" / "nn" / "native"
FLAGS = ["-std=gnu++17", "-O3", "-fopenmp", "-shared", "-fPIC"]
# Named as torch names the processor's capability.
X86 = {
    "avx512": ["-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl", "-mfma",
               "-mprefer-vector-width=512"],
    "avx2": ["-mavx2", "-mfma"],
}  # fmt: skip
OTHERS: dict[str, list[str]] = {"default": []}


class BuildHook(BuildHookInterface):
    """Adds the libraries to a wheel, or puts them beside the sources of an editable install."""

    def initialize(self, version: str, build_data: dict) -> None:
        """Called by hatchling before the wheel is written."""
        built = build(self.app.display_warning)
        if built and version != "editable":
            build_data["artifacts"] += [f"/{path.relative_to(self.root)}" for path in built]
            build_data["pure_python"] = False
            # They know nothing of Python: one wheel a platform.
            tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
            build_data["tag"] = f"py3-none-{tag}"


def build(warn: Callable[[str], None], folder: Path = FOLDER) -> list[Path]:
    """Compile what is missing in ``folder``; what cannot be compiled is told to ``warn``."""
    compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++")
    if os.environ.get("I2I_NO_COMPILER") or not compiler:
        warn("i2i: no C++ compiler, so its fast transforms are not built")
        return []
    variants = X86 if platform.machine().lower() in ("x86_64", "amd64") else OTHERS
    digest = digest_of(folder)
    targets = {folder / f"c4_spectral_{name}_{digest}.so": name for name in variants}
    for old in set(folder.glob("c4_spectral_*.so")) - set(targets):
        old.unlink(missing_ok=True)
    missing = {path: variants[name] for path, name in targets.items() if not path.exists()}
    with ThreadPoolExecutor() as pool:
        list(pool.map(partial(_compile, shlex.split(compiler), warn), missing, missing.values()))
    return [path for path in targets if path.exists()]


def digest_of(folder: Path) -> str:
    """Of the sources: a library is found only by those that it was made from."""
    sources = sorted([*folder.glob("*.cpp"), *folder.glob("*.h")])
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


def _compile(
    compiler: list[str], warn: Callable[[str], None], target: Path, flags: list[str]
) -> None:
    sources = [str(path) for path in target.parent.glob("*.cpp")]
    try:
        # Moved to its place in one step: another build may be making the same.
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            new = Path(folder) / target.name
            subprocess.run(
                [*compiler, *FLAGS, *flags, "-o", str(new), *sources],
                capture_output=True, text=True, check=True,
            )  # fmt: skip
            new.replace(target)
    except subprocess.CalledProcessError as error:
        warn(f"i2i: {target.name} is not built: {error.stderr[-500:]}")
    except OSError as error:
        warn(f"i2i: {target.name} is not built: {error}")
