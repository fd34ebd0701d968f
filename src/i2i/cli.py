"""The shell around every door: Hydra on the outside, plain error messages on the way out."""

import errno
import os
import sys
from collections.abc import Callable

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from i2i.configuration import config_dir, register_resolvers
from i2i.errors import ConfigurationError, I2IError
from i2i.memory import reuse_memory

# OSError: a disk that is full, a file that may not be read; the rest are settings that do not fit.
_CAUSED_BY_USERS = (I2IError, ValueError, OSError, HydraException, OmegaConfBaseException)
# Lightning's, by its name: importing it takes seconds, and `--help` has no need of it.
_OF_LIGHTNING = "MisconfigurationException"


def door(config_name: str) -> Callable[[Callable[[DictConfig], object]], Callable[[], None]]:
    """Make a command of a function that takes a configuration.

    Errors that a user can cause are printed without a traceback and end the process with status 1;
    HYDRA_FULL_ERROR=1 shows the traceback. In a sweep Hydra reports the job.

    Args:
        config_name: The YAML file at the top of `conf/` that belongs to the command.
    """

    def decorate(function: Callable[[DictConfig], object]) -> Callable[[], None]:
        @hydra.main(version_base="1.3", config_path=config_dir(), config_name=config_name)
        def shell(cfg: DictConfig) -> None:
            try:
                function(cfg)
            except KeyboardInterrupt:
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    raise
                print("stopped; the same command again goes on", file=sys.stderr)
                sys.exit(130)
            except Exception as error:
                if not _caused_by_user(error):
                    raise
                if HydraConfig.get().mode == RunMode.MULTIRUN or "HYDRA_FULL_ERROR" in os.environ:
                    raise
                print(f"error: {readable(error)}", file=sys.stderr)
                sys.exit(1)

        def main() -> None:
            reuse_memory()
            register_resolvers()
            shell()

        main.__doc__ = function.__doc__
        return main

    return decorate


def _caused_by_user(error: Exception) -> bool:
    return isinstance(error, _CAUSED_BY_USERS) or type(error).__name__ == _OF_LIGHTNING


def readable(error: BaseException) -> str:
    """The message of the error inside what Hydra and OmegaConf wrapped around it."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return (
            f"the disk is full ({error}). Make room, or put runs and data elsewhere "
            "(paths.runs_dir=, paths.data_dir=); what is made is kept, and the same command or "
            "resume=<the run's folder> goes on"
        )
    inner: BaseException | None = error
    while inner is not None:
        if isinstance(inner, I2IError) or (
            inner is not error and type(inner).__name__ in ("ValueError", _OF_LIGHTNING)
        ):
            return str(inner)
        inner = inner.__cause__
    if "raised while resolving interpolation: " in str(error):  # OmegaConf names no cause
        return (
            str(error).split("raised while resolving interpolation: ")[1].split("\n    full_key")[0]
        )
    if "Missing mandatory value" in str(error):
        key = str(error).split("Missing mandatory value:")[-1].strip().splitlines()[0]
        return f"{key} is not set: give it as {key}=... on the command line"
    return str(error)


def given_overrides() -> list[str]:
    """What was typed on the command line; empty when called from Python."""
    if not HydraConfig.initialized():
        return []
    return list(HydraConfig.get().overrides.task)


def refuse(overrides: list[str], *, allowed: tuple[str, ...], reason: str) -> None:
    """Refuse command-line words whose key does not start with one of the allowed prefixes.

    Raises:
        ConfigurationError: naming the words, the reason and what is allowed.
    """
    bad = [o for o in overrides if not o.lstrip("+~").startswith(allowed)]
    if bad:
        raise ConfigurationError(
            f"{reason}: leave out {' '.join(bad)} (allowed: {', '.join(allowed)})"
        )
