"""Runs doors for the tests, each in a fork of this process, which has imported them once.

A door that starts afresh spends most of a tiny job's time on imports. From here each gets what it
would get from `python -m i2i.<door>`: its own process, words, folder, environment and output files.

Reads requests as lines of JSON (`name`, `words`, `cwd`, `environment`, `stdout`, `stderr`) and
answers each with the line of its exit status.
"""

import importlib
import json
import os
import runpy
import sys

DOORS = ("train", "evaluate", "predict", "render", "report", "check")


def main() -> None:
    importlib.import_module("i2i.training")  # of the train door, when it has something to do
    for name in DOORS:
        importlib.import_module(f"i2i.{name}")
        del sys.modules[f"i2i.{name}"]  # runpy executes it again, as -m does
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            run(**request)
            return
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def run(name, words, cwd, environment, stdout, stderr) -> None:
    """Be `python -m i2i.<name> <words>`."""
    for descriptor, path in ((1, stdout), (2, stderr)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[0] = cwd
    sys.argv = [f"i2i.{name}", *words]
    runpy.run_module(f"i2i.{name}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
