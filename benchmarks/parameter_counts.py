"""Trainable parameters and build time of each system against the numbers of the paper.

    python benchmarks/parameter_counts.py

Ends with status 1 if a count is not the expected one.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from rich.console import Console
from rich.table import Table
from torch import nn

from i2i.configuration import compose
from i2i.models.i2i import I2IClassifier, I2IPose
from i2i.nn.encoders import C4ResNet18, ResNet18
from i2i.nn.group_convs import DynamicFilterConv
from i2i.nn.projectors import IcosahedralProjector
from i2i.runs.building import build_network, info_of


@dataclass(frozen=True)
class System:
    """One row.

    Attributes:
        name: What it is called in the tables.
        paper: What the paper prints, rounded, or an empty string.
        expected: The exact number.
        build: Makes the network.
    """

    name: str
    paper: str
    expected: int
    build: Callable[[], nn.Module]


def pose(
    *,
    encoder: Callable[..., nn.Module] | None = None,
    level: int = 1,
    classes: int = 1,
    channels: int = 1,
) -> I2IPose:
    """I2I at the paper's scale."""
    return I2IPose(
        encoder or partial(C4ResNet18, width=38),
        partial(IcosahedralProjector, mesh_level=level),
        partial(DynamicFilterConv, 128, mesh_level=level),
        channels=channels,
        num_classes=classes,
        image_size=128,
    )


def classifier() -> I2IClassifier:
    """I2I for the forty classes of ModelNet40."""
    return I2IClassifier(
        partial(C4ResNet18, width=38),
        IcosahedralProjector,
        partial(DynamicFilterConv, 128),
        channels=1,
        num_classes=40,
        image_size=128,
    )


def composed(model: str, task: str = "pose", *, classes: int = 1, words: str = "") -> nn.Module:
    """A network of `conf/model` at the paper's scale."""
    config = compose([f"model={model}", f"task={task}", "scale=paper", *words.split()])
    return build_network(config, info_of(config, tuple(f"class {i}" for i in range(classes))))


SYSTEMS = (
    System("I2I, one class", "10.9 M", 10_861_283, pose),
    System("I2I, ten classes", "10.9 M", 10_909_730, partial(pose, classes=10)),
    System("I2I, one class, RGB", "", 10_862_119, partial(pose, channels=3)),
    System("I2I, sparse projection", "", 10_857_443, partial(pose, level=0)),
    System("I2I without E2CNN", "", 11_637_959, partial(pose, encoder=ResNet18)),
    System(
        "I2I, full basis, width 31",
        "",
        10_709_339,
        partial(pose, encoder=partial(C4ResNet18, width=31, basis="full")),
    ),
    System("I2I without GroupConv", "", 10_864_040, partial(composed, "i2i_no_groupconv")),
    System("I2I, full group", "", 10_863_587, partial(composed, "i2i_full_group")),
    System("I2I, vector projection", "", 10_659_299, partial(composed, "i2i_vector")),
    System("I2Sphere", "", 10_854_492, partial(composed, "i2sphere")),
    System("CNN+GS", "11.2 M", 11_176_006, partial(composed, "cnn_gs")),
    System("CNN+Proc", "11.2 M", 11_177_545, partial(composed, "cnn_procrustes")),
    System("CNN+S3exp", "27.6 M", 27_595_332, partial(composed, "cnn_s3exp")),
    System(
        "CNN+S3exp, RGB",
        "27.6 M",
        27_601_604,
        partial(composed, "cnn_s3exp", words="data.modality=rgb"),
    ),
    System("CNN+IER", "11.4 M", 11_444_818, partial(composed, "cnn_ier")),
    System("E2CNN-Eq", "", 10_585_058, partial(composed, "e2cnn_eq")),
    System("I2I, classification", "", 12_149_636, classifier),
    System("CNN", "", 11_193_448, partial(composed, "cnn", "classification", classes=40)),
    System(
        "E2CNN-Inv", "", 10_594_820, partial(composed, "e2cnn_inv", "classification", classes=40)
    ),
    System("KPConv, pose, one anchor", "", 1_656_260, partial(composed, "kpconv")),
    System("EPN, pose", "", 3_024_101, partial(composed, "epn")),
    System(
        "EPN, pose, six numbers",
        "",
        3_024_231,
        partial(composed, "epn", words="model.networks.pose.representation=six"),
    ),
    *(
        System(name, "", expected, partial(composed, model, "classification", classes=40))
        for name, expected, model in (
            ("PointNet++", 1_475_688, "pointnet2"),
            ("KPConv, classification", 6_143_688, "kpconv"),
            ("EPN, classification", 7_814_889, "epn"),
            ("RotationNet-20", 11_597_172, "rotationnet_20"),
            ("EMVN-12", 21_425_768, "emvn_12"),
            ("EMVN, 60 views", 21_687_912, "emvn_60"),
        )
    ),
    System(
        "RotationNet-20, AlexNet",
        "",
        60_363_380,
        partial(
            composed, "rotationnet_20", "classification", classes=40, words="model/trunk=alexnet"
        ),
    ),
)


def main() -> int:
    table = Table("system", "paper", "expected", "ours", "build, s")
    wrong = 0
    SYSTEMS[0].build()  # the first one also computes the kernel bases
    for system in SYSTEMS:
        start = time.perf_counter()
        network = system.build()
        seconds = time.perf_counter() - start
        ours = sum(p.numel() for p in network.parameters() if p.requires_grad)
        wrong += ours != system.expected
        mark = "" if ours == system.expected else "  WRONG"
        table.add_row(
            system.name, system.paper, f"{system.expected:,}", f"{ours:,}{mark}", f"{seconds:.2f}"
        )
    Console().print(table)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
