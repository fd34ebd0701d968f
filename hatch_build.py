"""Compiles `src/i2i/nn/native` while i2i is installed, where a C++ compiler is found.

One library for each instruction set; at run time i2i takes the one of the processor. Without a
compiler nothing is built, and torch does what the library would: the same function, slower.
"""

import os
import platform
import shutil
import subprocess
import tempfile
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
        built = self._build()
        if built and version != "editable":
            build_data["artifacts"] += [f"/{path.relative_to(self.root)}" for path in built]
            build_data["pure_python"], build_data["infer_tag"] = False, True

    def _build(self) -> list[Path]:
        compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++")
        if not compiler:
            self.app.display_warning("i2i: no C++ compiler, so its fast transforms are not built")
            return []
        variants = X86 if platform.machine().lower() in ("x86_64", "amd64") else OTHERS
        targets = {FOLDER / f"c4_spectral_{name}.so": flags for name, flags in variants.items()}
        stale = {path: flags for path, flags in targets.items() if not _is_current(path)}
        with ThreadPoolExecutor() as pool:
            list(pool.map(partial(self._compile, compiler), stale, stale.values()))
        return [path for path in targets if _is_current(path)]

    def _compile(self, compiler: str, target: Path, flags: list[str]) -> None:
        # Replaced in one move: a process that has the old library open keeps it.
        with tempfile.TemporaryDirectory(dir=FOLDER) as folder:
            new = Path(folder) / target.name
            command = [compiler, *FLAGS, *flags, "-o", str(new), *map(str, FOLDER.glob("*.cpp"))]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                self.app.display_warning(f"i2i: {target.name} is not built: {done.stderr[-500:]}")
            else:
                new.replace(target)


def _is_current(target: Path) -> bool:
    sources = [Path(__file__), *FOLDER.glob("*.cpp"), *FOLDER.glob("*.h")]
    return target.exists() and all(p.stat().st_mtime < target.stat().st_mtime for p in sources)
