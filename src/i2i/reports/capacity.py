"""Parameter counts of every network of `conf/model`, built on the spot: nothing is trained."""

from pathlib import Path

from hydra.errors import InstantiationException

from i2i.configuration import compose, config_dir
from i2i.errors import I2IError
from i2i.reports.model import Cell, Column, Report, Row, Section
from i2i.reports.paper import Paper
from i2i.runs.building import build_network, info_of

POSE, CLASSIFICATION = "pose", "classification"
CLASSES = {POSE: 1, CLASSIFICATION: 40}
"""One network a class for poses; the forty classes of ModelNet40."""


def model_names() -> list[str]:
    """Every model of `conf/model`."""
    return sorted(path.stem for path in (Path(config_dir()) / "model").glob("*.yaml"))


def count_parameters(model: str, task: str, *, scale: str = "paper") -> int | None:
    """Trainable parameters of a fresh network.

    Args:
        model: Name of a model.
        task: `pose` (one class) or `classification` (forty).
        scale: Name of a scale.

    Returns:
        The count for the first modality that the model sees; None where the
        model has no network for the task.
    """
    cfg = compose([f"model={model}", f"task={task}", f"scale={scale}", "data=modelnet40"])
    if cfg.model.networks.get(task) is None:
        return None
    names = tuple(f"class {index}" for index in range(CLASSES[task]))
    network = build_network(cfg, info_of(cfg, names))
    return sum(p.numel() for p in network.parameters() if p.requires_grad)


def capacity_report(number: int, paper: Paper, *, scale: str = "paper") -> Report:
    """The paper's table of sizes with ours beside it, and all other models below.

    Args:
        number: Of the table.
        paper: The published numbers.
        scale: At which scale to count.
    """
    table = paper.table(number)
    printed = {row.key: row.values[0] for row in table.rows}
    columns = (
        Column(POSE, "pose, one class", unit="parameters", digits=0),
        Column(CLASSIFICATION, "40 classes", paper=False, unit="parameters", digits=0),
    )
    names = model_names()
    rows, notes = [], []
    for model in [*printed, *(name for name in names if name not in printed)]:
        ours = {}
        for task in (POSE, CLASSIFICATION):
            try:
                count = count_parameters(model, task, scale=scale) if model in names else None
            except (I2IError, ValueError, KeyError, InstantiationException) as error:
                notes.append(f"{model}, {task}: could not be built: {str(error).splitlines()[0]}")
                continue
            if count is not None:
                ours[task] = Cell(float(count))
        millions = printed.get(model)
        numbers = {} if millions is None else {POSE: millions}
        rows.append(Row("", model, paper.name(model), numbers, ours))
    section = Section(
        f"scale={scale}, one channel", columns, tuple(rows), notes=tuple(notes), jobs=len(rows)
    )
    return Report(number, table.title, (section,), with_parameters=False)
