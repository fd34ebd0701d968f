"""Weight files: torchvision's names against a network written down here with those names."""

import sys
from functools import partial

import pytest
import torch
from torch import nn

from i2i.nn.alexnet import AlexNet
from i2i.nn.pretrained import load_pretrained, read_weights
from i2i.nn.resnet import ResNet18
from i2i.nn.resnet50 import ResNet50


class TheirBlock(nn.Module):
    """A basic block with torchvision's names."""

    def __init__(self, inside, outside, stride):
        super().__init__()
        self.conv1 = nn.Conv2d(inside, outside, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outside)
        self.conv2 = nn.Conv2d(outside, outside, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outside)
        self.downsample = None
        if stride != 1 or inside != outside:
            self.downsample = nn.Sequential(
                nn.Conv2d(inside, outside, 1, stride, bias=False), nn.BatchNorm2d(outside)
            )

    def forward(self, x):
        out = self.bn2(self.conv2(torch.relu(self.bn1(self.conv1(x)))))
        return torch.relu(out + (x if self.downsample is None else self.downsample(x)))


class TheirResNet18(nn.Module):
    """ResNet-18 with torchvision's names and order of layers."""

    def __init__(self, width):
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        widths = [width, width, 2 * width, 4 * width, 8 * width]
        for layer in range(1, 5):
            inside, outside = widths[layer - 1 : layer + 1]
            blocks = (
                TheirBlock(inside, outside, 1 if layer == 1 else 2),
                TheirBlock(outside, outside, 1),
            )
            setattr(self, f"layer{layer}", nn.Sequential(*blocks))
        self.fc = nn.Linear(8 * width, 1000)

    def forward(self, x):
        x = nn.functional.max_pool2d(torch.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        return self.layer4(self.layer3(self.layer2(self.layer1(x))))


OURS = partial(ResNet18, 3, width=2, image_size=64, stem_size=7, layer_strides=(1, 2, 2, 2))


@pytest.fixture
def theirs():
    torch.manual_seed(3)
    net = TheirResNet18(2)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            for tensor in (module.weight.data, module.running_mean, module.running_var):
                tensor.uniform_(0.5, 1.5)
    return net.eval()


def test_names_known_by_heart():
    """A few of the names in torchvision's own file, which has 102 tensors without counters."""
    names = [n for n in TheirResNet18(2).state_dict() if not n.endswith("num_batches_tracked")]
    assert len(names) == 102
    assert {"conv1.weight", "layer2.0.downsample.1.running_var", "layer4.1.bn2.bias"} <= set(names)


@pytest.mark.parametrize("counters", [True, False], ids=["new file", "old file"])
@pytest.mark.parametrize("head", [True, False], ids=["with fc", "without fc"])
def test_resnet_computes_what_the_file_says(theirs, tmp_path, counters, head):
    weights = {
        name: value
        for name, value in theirs.state_dict().items()
        if (counters or not name.endswith("num_batches_tracked")) and (head or name[:3] != "fc.")
    }
    torch.save(weights, tmp_path / "resnet18.pth")
    ours, x = OURS(), torch.rand(2, 3, 64, 64)
    before = ours.eval()(x)
    load_pretrained(ours, tmp_path / "resnet18.pth")
    torch.testing.assert_close(ours(x), theirs(x))
    assert not torch.allclose(before, ours(x))


def test_circular_rows_take_the_same_file(theirs, tmp_path):
    torch.save(theirs.state_dict(), tmp_path / "resnet18.pth")
    ours = OURS(circular_rows=True).eval()
    load_pretrained(ours, tmp_path / "resnet18.pth")
    assert torch.equal(ours.stem.weight, theirs.conv1.weight)


def test_alexnet_with_and_without_its_last_layer(tmp_path):
    source, target = AlexNet(3, width=2, image_size=64), AlexNet(3, width=2, image_size=32)
    weights = source.state_dict() | {
        "classifier.6.weight": torch.zeros(10, 128),
        "classifier.6.bias": torch.zeros(10),
    }
    assert "classifier.4.weight" in weights
    assert "features.10.bias" in weights
    torch.save(weights, tmp_path / "alexnet.pt")
    load_pretrained(target, str(tmp_path / "alexnet.pt"))
    assert all(torch.equal(v, weights[k]) for k, v in target.state_dict().items())


def test_safetensors(theirs, tmp_path):
    safetensors = pytest.importorskip("safetensors.torch")
    safetensors.save_file(theirs.state_dict(), tmp_path / "resnet18.safetensors")
    ours, x = OURS().eval(), torch.rand(2, 3, 64, 64)
    load_pretrained(ours, tmp_path / "resnet18.safetensors")
    torch.testing.assert_close(ours(x), theirs(x))
    (tmp_path / "bad.safetensors").write_bytes(b"not that")
    with pytest.raises(ValueError, match=r"bad\.safetensors cannot be read as safetensors"):
        load_pretrained(ours, tmp_path / "bad.safetensors")


def test_safetensors_without_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "safetensors", None)
    (tmp_path / "some.safetensors").touch()
    with pytest.raises(ValueError, match="pip install safetensors"):
        read_weights(tmp_path / "some.safetensors")


def test_names_that_do_not_fit_are_told_and_nothing_changes(theirs, tmp_path):
    weights = theirs.state_dict()
    weights["encoder.weight"] = weights.pop("layer1.0.conv1.weight")
    torch.save(weights, tmp_path / "other.pth")
    ours = OURS()
    before = {name: value.clone() for name, value in ours.state_dict().items()}
    with pytest.raises(ValueError, match="does not fit ResNet18") as error:
        load_pretrained(ours, tmp_path / "other.pth")
    for part in (
        "1 missing (layer1.0.conv1.weight)", "1 unexpected (encoder.weight)", "such as conv1.weight"
    ):  # fmt: skip
        assert part in str(error.value)
    assert all(torch.equal(value, before[name]) for name, value in ours.state_dict().items())


def test_other_widths_are_told(theirs, tmp_path):
    torch.save(theirs.state_dict(), tmp_path / "resnet18.pth")
    with pytest.raises(ValueError, match=r"conv1\.weight \(2, 3, 7, 7\) instead of \(4, 3, 7, 7\)"):
        load_pretrained(OURS(width=4), tmp_path / "resnet18.pth")
    with pytest.raises(ValueError, match=r"conv1\.weight .* instead of \(2, 3, 5, 5\)"):
        load_pretrained(OURS(stem_size=5), tmp_path / "resnet18.pth")


class Harmful:
    """Would run code where pickles are trusted."""

    def __reduce__(self):
        return print, ("harm",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (Harmful(), "cannot be read as tensors alone"),
        (b"nothing of the kind", "cannot be read as tensors alone"),
        ([torch.zeros(1)], "no mapping from names to tensors"),
        ({}, "no mapping from names to tensors"),
        ({"state_dict": {"conv1.weight": torch.zeros(1)}}, r"no tensors \(state_dict\).*alone"),
    ],
)
def test_files_that_are_something_else(tmp_path, capsys, content, message):
    path = tmp_path / "weights.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(ValueError, match=message):
        load_pretrained(OURS(), path)
    assert "harm" not in capsys.readouterr().out


def test_missing_file_and_foreign_trunk(tmp_path):
    with pytest.raises(ValueError, match=r"none\.pth is not a file: give a local weight file"):
        load_pretrained(OURS(), tmp_path / "none.pth")
    with pytest.raises(ValueError, match="not a ResNet50: set pretrained=null"):
        load_pretrained(ResNet50(3, width=2, image_size=64), tmp_path / "none.pth")
