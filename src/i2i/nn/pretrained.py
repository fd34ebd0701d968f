"""Weights of a trunk from a local file, under the names that torchvision gives them."""

import pickle
import re
from collections.abc import Mapping
from functools import singledispatch
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from i2i.nn.alexnet import AlexNet
from i2i.nn.resnet import ResNet18

IMAGENET_MEAN = (0.485, 0.456, 0.406)
"""Mean of the pictures that torchvision's weights were trained on, for each colour."""
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Their standard deviation."""

_COUNTERS = "num_batches_tracked"  # older files lack them
_LISTED = 4  # names that a message spells out


def load_pretrained(trunk: nn.Module, path: str | Path) -> None:
    """Put the weights of a file into a trunk, all of them or none.

    The file holds a mapping from torchvision's names to tensors, for `resnet18` or `alexnet`; its
    last layer, made for other classes, is left out.

    Args:
        trunk: A `ResNet18` with `stem_size=7` or an `AlexNet`, for three channels and at full
            width.
        path: A `.pth` or `.pt` file, read without running code in it, or a `.safetensors` file.

    Raises:
        ValueError: If the file is missing or unreadable, a name is missing or unexpected, a shape
            differs, or the trunk is another.
    """
    wanted = {name: torchvision_name(trunk, name) for name in trunk.state_dict()}
    given = read_weights(path)
    last = last_layer(trunk)
    missing = [n for n in wanted.values() if n not in given and not n.endswith(_COUNTERS)]
    unexpected = [n for n in given if n not in wanted.values() and not n.startswith(f"{last}.")]
    if missing or unexpected:
        raise ValueError(
            f"pretrained={path} does not fit {type(trunk).__name__}: {_some('missing', missing)}, "
            f"{_some('unexpected', unexpected)}; expected torchvision's names, such as "
            f"{', '.join(list(wanted.values())[:2])}, with or without {last}.*"
        )
    own = trunk.state_dict()
    weights = {ours: given.get(theirs, own[ours]) for ours, theirs in wanted.items()}
    wrong = [
        f"{wanted[name]} {tuple(weights[name].shape)} instead of {tuple(own[name].shape)}"
        for name in own
        if weights[name].shape != own[name].shape
    ]
    if wrong:
        raise ValueError(
            f"pretrained={path} has other shapes than this {type(trunk).__name__}: "
            f"{_some('wrong', wrong)}; weights from torchvision want three channels and width 64 "
            "(scale.view_width=64)"
        )
    trunk.load_state_dict(weights)


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Tensors of a weight file by name, on the CPU.

    Raises:
        ValueError: If there is no such file, or it holds anything else.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise ValueError(
            f"pretrained={path} is not a file: give a local weight file (.pth, .pt or "
            ".safetensors), or null to train from scratch"
        )
    weights = _safetensors(path) if path.suffix == ".safetensors" else _pickled(path)
    if not isinstance(weights, Mapping) or not weights:
        raise ValueError(f"pretrained={path} holds no mapping from names to tensors")
    others = [str(n) for n, v in weights.items() if not (isinstance(n, str) and torch.is_tensor(v))]
    if others:
        raise ValueError(
            f"pretrained={path} holds {_some('entries that are no tensors', others)}: expected the "
            "weights alone, as torch.save(network.state_dict(), path) writes them"
        )
    return dict(weights)


def _pickled(path: Path) -> Any:  # noqa: ANN401 - whatever the file holds
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError) as error:
        raise ValueError(
            f"pretrained={path} cannot be read as tensors alone "
            f"({str(error).splitlines()[0] if str(error) else type(error).__name__})"
        ) from error


def _safetensors(path: Path) -> dict[str, Tensor]:
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError as error:
        raise ValueError(
            f"pretrained={path} needs a package that is not here: pip install safetensors"
        ) from error
    try:
        return load_file(path)
    except SafetensorError as error:
        raise ValueError(f"pretrained={path} cannot be read as safetensors ({error})") from error


@singledispatch
def torchvision_name(trunk: nn.Module, name: str) -> str:
    """What torchvision calls a weight of a trunk.

    Raises:
        ValueError: If no weight files are known for trunks of this class.
    """
    raise ValueError(
        f"pretrained weights fit a ResNet18 or an AlexNet, not a {type(trunk).__name__}: "
        "set pretrained=null"
    )


@torchvision_name.register
def _(trunk: ResNet18, name: str) -> str:
    name = re.sub(r"^stem\.", "conv1.", name)
    name = re.sub(r"^norm\.", "bn1.", name)
    name = re.sub(r"\.norm(\d)\.", r".bn\1.", name)
    name = name.replace(".shortcut.", ".downsample.")
    # Two blocks a layer, which torchvision numbers from 1.
    return re.sub(
        r"^blocks\.(\d+)\.", lambda m: f"layer{int(m[1]) // 2 + 1}.{int(m[1]) % 2}.", name
    )


@torchvision_name.register
def _(trunk: AlexNet, name: str) -> str:
    return name


def last_layer(trunk: nn.Module) -> str:
    """The name of the layer that a weight file has beyond the trunk."""
    return "classifier.6" if isinstance(trunk, AlexNet) else "fc"


def _some(what: str, names: list[str]) -> str:
    """`2 missing (a, b)`, at most a few of them by name."""
    shown = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
    return f"{len(names)} {what} ({shown})" if names else f"0 {what}"
