"""A sweeper for Hydra that runs a union of grids and does only what is left to do.

Every program that uses Hydra in this environment imports this file: it must stay light, so i2i and
torch are imported when a sweep begins.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

if TYPE_CHECKING:
    from i2i.sweeping import Planned, Rules


class GridSweeper(Sweeper):
    """Runs the union of some grids, changed by what is typed, with any launcher.

    Args:
        grids: Each a dict of key → value or list of values (`i2i.runs.sweeps`); none for the
            combinations of what is typed.
        rules: Where the door's `i2i.sweeping.Rules` are, as a dotted path.
    """

    def __init__(
        self,
        grids: Sequence[Mapping[str, Any]] | None = None,
        rules: str = "i2i.sweeping.TRAINING",
    ) -> None:
        super().__init__()
        self.grids = grids or []
        self.rules = rules
        self.config: DictConfig | None = None
        self.context: HydraContext | None = None
        self.launcher: Launcher | None = None

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Keep what Hydra gives, and make the launcher."""
        from hydra.core.plugins import Plugins

        self.config = config
        self.context = hydra_context
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:  # noqa: ANN401 - as Hydra declares it
        """Launch the jobs that are left to do; exit with status 1 if one of them fails."""
        from hydra.utils import get_object

        from i2i.runs.sweeps import expand
        from i2i.sweeping import plan, tell_end, tell_plan

        assert self.context is not None
        rules: Rules = get_object(self.rules)
        loader = self.context.config_loader
        grids = OmegaConf.to_container(OmegaConf.create(list(self.grids)), resolve=True)
        jobs = expand(grids, arguments, config_loader=loader)  # type: ignore[arg-type]
        planned = plan(jobs, self._compose, rules)
        tell_plan(planned)
        launch = [p for p in planned if p.state in ("continue", "start")]
        returns: Sequence[JobReturn] = []
        failures: dict[str, str] = {}
        if launch:
            returns, failures = self._launch(launch, rules)
        if not tell_end(planned, failures, rules):
            sys.exit(1)
        return returns

    def _compose(self, words: Sequence[str]) -> DictConfig:
        """A job's configuration as its task will get it."""
        assert self.context is not None
        assert self.config is not None
        cfg = self.context.config_loader.load_sweep_config(self.config, list(words))
        with open_dict(cfg):
            del cfg["hydra"]
        return cfg

    def _launch(
        self, launch: list[Planned], rules: Rules
    ) -> tuple[Sequence[JobReturn], dict[str, str]]:
        """Run jobs; gives what the launcher gave, and reasons by identity."""
        from i2i.sweeping import one_line

        assert self.launcher is not None
        # Its lines would repeat those of the jobs.
        logging.getLogger("hydra._internal.core_plugins.basic_launcher").setLevel(logging.WARNING)
        try:
            returns = self.launcher.launch([p.job.overrides for p in launch], initial_job_idx=0)
        except (KeyboardInterrupt, SystemExit):
            print("sweep stopped; the same command again goes on", file=sys.stderr)
            raise
        except Exception as error:  # a process died: what the others did is on the disk
            reason = f"the launcher gave up, jobs may still run: {one_line(error)}"
            left = [p.identity for p in launch if not rules.done(p.config, p.identity)]
            return [], dict.fromkeys(left, reason)
        failures = {
            planned.identity: one_line(returned._return_value)
            for planned, returned in zip(launch, returns, strict=True)
            if returned.status == JobStatus.FAILED
        }
        return returns, failures
