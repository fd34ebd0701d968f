"""The paper's tables with ours beside them: `python -m i2i.report table=1`."""

from pathlib import Path

from omegaconf import DictConfig

from i2i.cli import door
from i2i.configuration import register_resolvers
from i2i.errors import ConfigurationError
from i2i.reports.build import build_report
from i2i.reports.capacity import capacity_report
from i2i.reports.csv_text import csv_text
from i2i.reports.figures import report_figures
from i2i.reports.latex import latex
from i2i.reports.markdown import markdown
from i2i.reports.model import Report
from i2i.reports.paper import Paper, load_paper
from i2i.reports.results import Filters, Result, read_results
from i2i.viz.style import save_figure


def report(cfg: DictConfig) -> dict[int, Report]:
    """Make the reports and write their files.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        Reports by the number of their table.

    Raises:
        ConfigurationError: if the paper has no such table, or a filter is no number.
    """
    register_resolvers()
    paper = load_paper()
    numbers = _numbers(cfg.table, paper)
    folders = [cfg.results] if isinstance(cfg.results, str) else list(cfg.results or [])
    results, problems = read_results(folders, cfg.runs)
    made = {n: _one(n, paper, cfg, results, problems) for n in numbers}
    for number, content in made.items():
        write(content, Path(cfg.output) / f"table{number}")
    return made


def write(content: Report, stem: Path) -> list[Path]:
    """Write a report as Markdown, LaTeX and CSV, and its figures as PNG and SVG.

    Args:
        content: The report.
        stem: Path of the files without their endings, such as `reports/table1`.

    Returns:
        The files.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    texts = {"md": markdown(content), "tex": latex(content), "csv": csv_text(content)}
    paths = []
    for ending, text in texts.items():
        path = stem.with_name(f"{stem.name}.{ending}")
        path.write_text(text, encoding="utf-8")
        paths.append(path)
    for name, figure in report_figures(content).items():
        for ending in ("png", "svg"):
            paths.append(save_figure(figure, stem.with_name(f"{stem.name}_{name}.{ending}")))
    return paths


def _one(
    number: int, paper: Paper, cfg: DictConfig, results: list[Result], problems: list[str]
) -> Report:
    if paper.table(number).columns_are == "parameters":
        return capacity_report(number, paper, scale=_chosen(cfg, "scale") or "paper")
    return build_report(number, results, paper, filters=_filters(cfg), problems=problems)


def _numbers(table: int | str, paper: Paper) -> list[int]:
    if table == "all":
        return list(paper.tables)
    if not str(table).isdigit():
        raise ConfigurationError(
            f"table={table}: type table=1 … table={max(paper.tables)}, or table=all"
        )
    return [paper.table(int(table)).number]


def _chosen(cfg: DictConfig, group: str) -> str | None:
    """Name of the file that was chosen of a group; nothing else of it matters here."""
    return None if cfg.get(group) is None else str(cfg[group].name)


def _filters(cfg: DictConfig) -> Filters:
    seeds = cfg.seeds if cfg.seeds is not None else ()
    seeds = [seeds] if isinstance(seeds, int) else seeds
    try:
        return Filters(
            data=_chosen(cfg, "data"),
            scale=_chosen(cfg, "scale"),
            steps=None if cfg.steps is None else int(cfg.steps),
            seeds=tuple(int(seed) for seed in seeds),
        )
    except (TypeError, ValueError) as error:
        raise ConfigurationError(
            f"steps={cfg.steps} seeds={cfg.seeds}: type whole numbers, such as steps=1500 "
            "seeds=[0,1]"
        ) from error


@door("report")
def main(cfg: DictConfig) -> None:
    """Print the reports and say where they were written."""
    for number, content in report(cfg).items():
        print(markdown(content))
        print(f"written to {Path(cfg.output) / f'table{number}'}.md and its like\n")


if __name__ == "__main__":
    main()
