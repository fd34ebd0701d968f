"""Networks for other programs: a torch.export program, an ONNX graph, or weights and a JSON."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from i2i.data.info import IMAGES, DataInfo
from i2i.data.noise import noise_batch
from i2i.errors import ConfigurationError
from i2i.models.prediction import PosePrediction
from i2i.nn.folding import fold
from i2i.prediction_results import FRAME
from i2i.runs.folder import versions
from i2i.runs.loading import load_task, locate, read_checkpoint
from i2i.runs.weights import write_weights
from i2i.tasks.base import Task

METADATA = "i2i.json"
"""Name of what a program says about itself: a file inside a .pt2, an entry of an ONNX graph."""

_ONNX_PACKAGES = ("onnx", "onnxscript")
_SUFFIXES = ".onnx, .pt2, or a folder (a name without a suffix)"
_TRACED_IMAGES = 2  # a batch of one would be taken for a constant


class ImageProgram(nn.Module):
    """A network of one image as a function of tensors, in place of batches and predictions.

    Args:
        network: Maps a batch to a `PosePrediction` or a `ClassPrediction`.

    Shape:
        Image (B, C, S, S) in [0, 1], and the index of the class (B,) for a pose network of several
        classes -> rotation (B, 3, 3), object -> camera, and the probabilities of the candidates
        (B, K) where the network has them (K = 60 for I2I); or logits (B, classes).
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor, class_id: Tensor | None = None) -> tuple[Tensor, ...]:
        """Call the network."""
        batch = {"image": image} if class_id is None else {"image": image, "class_id": class_id}
        prediction = self.network(batch)
        if not isinstance(prediction, PosePrediction):
            return (prediction.logits,)
        if prediction.log_prob is None:
            return (prediction.rotation,)
        return prediction.rotation, prediction.log_prob.exp()


def export_run(run: str | Path, output: str | Path, *, ckpt: str = "last") -> Path:
    """Write the network of a run for use elsewhere.

    Programs hold the network as `i2i.nn.folding.fold` leaves it, and take any number of images;
    what the images have to be is said in their metadata (see `describe`). A folder holds the
    weights as they were trained, and `i2i.load(folder)` loads it.

    Args:
        run: A run folder, a checkpoint file, or an exported folder.
        output: `<name>.onnx`, `<name>.pt2`, or a folder.
        ckpt: `last` or `best`, when a run folder is given.

    Returns:
        What was written.

    Raises:
        CheckpointError: if there is no checkpoint, or one of another format.
        ConfigurationError: if the output's suffix is unknown, the network does not see one image,
            a package is missing, or ONNX has no word for what the network computes.

    Example:
        >>> i2i.export_run("runs/chairs", "chairs.onnx")  # doctest: +SKIP
    """
    output = Path(output)
    if output.suffix not in ("", ".onnx", ".pt2") and not output.is_dir():
        raise ConfigurationError(f"output={output} is no kind of export; give {_SUFFIXES}")
    if output.suffix == ".onnx":
        _check_packages()
    folder, path = locate(run, ckpt)
    if output.is_dir() or not output.suffix:
        _write_folder(folder.reference_meshes, path, output)
        return output
    task = load_task(path)
    _check_image(task.info, output)
    output.parent.mkdir(parents=True, exist_ok=True)
    program, names = trace(task)
    said = {**describe(task), "checkpoint": path.name, "versions": versions()}
    if output.suffix == ".pt2":
        text = json.dumps(said, indent=1)
        _replace(output, lambda to: torch.export.save(program, to, extra_files={METADATA: text}))
    else:
        _write_onnx(program, names, said, output)
    return output


def trace(task: Task) -> tuple[torch.export.ExportedProgram, tuple[list[str], list[str]]]:
    """The folded network of a task as a program for any number of images.

    Returns:
        The program, and the names of its inputs and outputs.

    Raises:
        ConfigurationError: if it cannot be traced, such as for a component of somebody else that
            looks at numbers in its tensors.
    """
    program = ImageProgram(fold(task.network)).eval()
    batch = noise_batch(task.info, _TRACED_IMAGES)
    inputs = ["image", "class_id"] if _takes_class(task) else ["image"]
    given = tuple(batch[name] for name in inputs)
    count = torch.export.Dim("batch", min=1)
    with torch.no_grad():
        # Called once before it is traced: tables that are kept are then constants of the program.
        answers = program(*given)
        pose = task.run_config["task"]["name"] == "pose"
        outputs = ["rotation", "probability"][: len(answers)] if pose else ["logits"]
        shapes = {name: {0: count} for name in inputs}
        try:
            traced = torch.export.export(program, given, dynamic_shapes=shapes)
        except RuntimeError as error:  # base of all that the tracer raises
            raise ConfigurationError(
                f"{type(task.network).__name__} cannot be traced as a program for any number of "
                f"images ({str(error).splitlines()[0]}); give output=<folder> for its weights"
            ) from error
    return traced, (inputs, outputs)


def describe(task: Task) -> dict[str, Any]:
    """What a program has to be fed and what it answers, in plain words and numbers."""
    info = task.info
    return {
        "model": task.run_config["model"]["name"],
        "task": task.run_config["task"]["name"],
        "class_names": list(info.class_names),
        "symmetry": list(info.symmetry),
        "frame": FRAME,
        "input": {
            "shape": ["batch", info.channels, info.image_size, info.image_size],
            "values": "0 black to 1 white, row down; one channel is the mean of red, green, blue",
            "modality": info.modality,
            "channels": info.channels,
            "image_size": info.image_size,
            "background": info.background,
            "camera_distance": info.camera_distance,
            "camera_fov_deg": info.camera_fov_deg,
            "class_id": "index into class_names" if _takes_class(task) else None,
        },
    }


def _takes_class(task: Task) -> bool:
    """Whether the network looks at each class with its own weights."""
    pose: bool = task.run_config["task"]["name"] == "pose"
    return pose and task.info.num_classes > 1


def _check_image(info: DataInfo, output: Path) -> None:
    if info.modality not in IMAGES:
        raise ConfigurationError(
            f"output={output}: programs are of networks that see one image (data.modality="
            f"{' | '.join(IMAGES)}), and this one sees {info.modality}; its weights can be "
            f"written: output={output.with_suffix('')}"
        )


def _check_packages() -> None:
    missing = [name for name in _ONNX_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigurationError(
            f"ONNX needs packages that are not here ({', '.join(missing)}): "
            "pip install 'i2i[onnx]', or write output=model.pt2"
        )


def _write_onnx(
    program: torch.export.ExportedProgram,
    names: tuple[list[str], list[str]],
    said: dict[str, Any],
    output: Path,
) -> None:
    """Write the graph as one file."""
    inputs, outputs = names
    with _quiet():
        try:
            graph = torch.onnx.export(
                program, dynamo=True, verbose=False, input_names=inputs, output_names=outputs
            )
        except torch.onnx.OnnxExporterError as error:
            missing = str(error.__cause__ or error).strip().splitlines()[0]
            raise ConfigurationError(
                f"model={said['model']} computes what ONNX has no operation for ({missing}); "
                f"write output={output.with_suffix('.pt2')}"
            ) from error
    assert graph is not None
    graph.model.metadata_props[METADATA] = json.dumps(said)
    _replace(output, lambda to: graph.save(to, external_data=False))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's notes on packages that it does not need."""
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _write_folder(meshes: Path, checkpoint: Path, output: Path) -> None:
    """Weights, configuration, and the meshes that answers are drawn with."""
    write_weights(read_checkpoint(checkpoint), output, made_from=checkpoint.name)
    if meshes.is_dir() and meshes.resolve() != (output / meshes.name).resolve():
        shutil.copytree(meshes, output / meshes.name, dirs_exist_ok=True)


def _replace(output: Path, write: Callable[[Path], object]) -> None:
    """Write a file so that a reader sees the old or the new one, never a half."""
    # The suffix stays: it says what is written.
    temporary = output.with_name(f".{os.getpid()}-{output.name}")
    try:
        write(temporary)
        temporary.replace(output)
    finally:
        temporary.unlink(missing_ok=True)
