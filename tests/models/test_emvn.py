"""EMVN: counts, learning, and what it does not notice."""

import copy
from functools import partial

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.rotations import random_rotations
from i2i.geometry.view_sets import camera_rotations, view_permutations
from i2i.models.emvn import EMVN
from i2i.models.views import CAMERA_SET_OF, ViewFeatures
from i2i.nn.alexnet import AlexNet
from i2i.nn.pretrained import IMAGENET_MEAN, IMAGENET_STD
from i2i.nn.resnet import ResNet18

GROUP = icosahedron(0)
START = random_rotations(1, torch.Generator().manual_seed(2))[0].double()
STANDARD = partial(ResNet18, stem_size=7, layer_strides=(1, 2, 2, 2))
SMALL = partial(STANDARD, width=4, max_pool=False)
# Without strides behind the stem, so that most rolls end near cells of the map.
UNSTRIDED = partial(ResNet18, width=2, stem_size=7, layer_strides=(1, 1, 1, 1), max_pool=False)


class Little(torch.nn.Conv2d):
    """A trunk of one layer, where the trunk does not matter."""

    def __init__(self, channels, **_):
        super().__init__(channels, 6, 5, stride=3)


def make(views=12, *, size=32, classes=4, channels=1, trunk=SMALL, **options):
    torch.manual_seed(0)
    options.setdefault("log_polar", views != 60)
    return EMVN(
        trunk, channels=channels, num_classes=classes, image_size=size, num_views=views,
        features=8, **options,
    )  # fmt: skip


def make_batch(n=8, *, views=12, size=32, classes=4, channels=1):
    generator = torch.Generator().manual_seed(0)
    pictures = torch.rand(n, views, channels, size, size, generator=generator)
    return {"views": pictures, "class_id": torch.arange(n) % classes}


def settled(network, batch):
    """In double precision, in evaluation mode, with statistics that are not the initial ones."""
    network = network.double().train()
    batch = {**batch, "views": batch["views"].double()}
    with torch.no_grad():
        for _ in range(10):
            network(batch)
    return network.eval(), batch


def relative(one, other):
    return ((one - other).norm() / other.norm()).item()


def scene(rotation, *, views=12, size=64):
    """Blobs in space as the cameras see them, by parallel projection: (1, V, 1, S, S)."""
    generator = torch.Generator().manual_seed(5)
    points = torch.randn(6, 3, generator=generator, dtype=torch.float64) * 0.35
    strength = torch.rand(6, generator=generator, dtype=torch.float64) + 0.3
    cameras = torch.from_numpy(camera_rotations(CAMERA_SET_OF[views]))
    seen = torch.einsum("vij,jk,pk->vpi", cameras, rotation, points)[..., None, None]
    axis = (torch.arange(size, dtype=torch.float64) + 0.5) / (size / 2) - 1
    x, y, z = seen.unbind(2)  # (V, P, 1, 1)
    blobs = torch.exp(-((axis - x) ** 2 + (-axis[:, None] - y) ** 2) / 0.03)
    return (strength[:, None, None] * (1.2 + z) * blobs).sum(1)[None, :, None]


@pytest.mark.parametrize(
    ("views", "expected"), [(60, 21_687_912), (20, 23_522_920), (12, 21_425_768)]
)
def test_parameters_of_the_published_network(views, expected):
    network = EMVN(STANDARD, channels=1, num_classes=40, image_size=224, num_views=views)
    assert sum(p.numel() for p in network.parameters()) == expected
    assert network.views.trunk.map_size == 7


@pytest.mark.parametrize("views", [12, 20, 60])
def test_one_step_changes_every_parameter_but_the_idle_biases(views):
    network, batch = make(views), make_batch(2, views=views)
    before = copy.deepcopy(dict(network.named_parameters()))
    network.loss(network(batch), batch)["classification"].backward()
    torch.optim.SGD(network.parameters(), lr=0.1).step()
    idle = {"embed.bias"} | {f"convs.{i}.bias" for i in range(3)}
    for name, parameter in network.named_parameters():
        change = (parameter - before[name]).abs().max()
        assert (change < 1e-6) if name in idle else (change > 0), name


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("size", [32, 64])
def test_batch_of_one_and_determinism(size, channels):
    network = make(size=size, channels=channels)
    batch = make_batch(3, size=size, channels=channels)
    alone = {key: value[:1] for key, value in batch.items()}
    assert torch.isfinite(network.train().loss(network(alone), alone)["classification"])
    network.eval()
    with torch.no_grad():
        first, second, one = network(batch), network(batch), network(alone)
    assert torch.equal(first.logits, second.logits)
    torch.testing.assert_close(one.logits, first.logits[:1], atol=1e-5, rtol=1e-5)
    assert first.descriptor.shape == (3, 8)
    torch.testing.assert_close(first.logits, network.classifier(first.descriptor))


def test_pictures_of_the_original():
    network = make(size=224, trunk=partial(STANDARD, width=4)).eval()
    with torch.no_grad():
        assert torch.isfinite(network(make_batch(1, size=224)).logits).all()


def test_mixed_precision_gives_float32():
    network, batch = make(), make_batch()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        loss = network.loss(prediction, batch)["classification"]
    loss.backward()
    assert prediction.logits.dtype == prediction.descriptor.dtype == loss.dtype == torch.float32
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


@torch.no_grad()
def changes_by_permutations(views, tables):
    """Largest relative change of descriptor and logits under permutations of the views."""
    network, batch = settled(make(views, trunk=Little), make_batch(2, views=views))
    still, found = network(batch), []
    for table in tables:
        moved = network({"views": batch["views"][:, table]})
        found.append(
            max(relative(moved.descriptor, still.descriptor), relative(moved.logits, still.logits))
        )
    return torch.tensor(found)


@pytest.mark.parametrize("views", [12, 20, 60])
def test_permutations_by_the_group_change_nothing_and_others_do(views):
    tables = view_permutations(CAMERA_SET_OF[views])
    assert changes_by_permutations(views, tables).max() < 1e-12
    generator = torch.Generator().manual_seed(0)
    others = [torch.randperm(views, generator=generator) for _ in range(5)]
    assert changes_by_permutations(views, others).min() > 1e-4
    if views == 60:  # the group from the other side is no motion of the object
        assert changes_by_permutations(60, tables.T[1:6]).min() > 1e-4


@torch.no_grad()
def changes_by_turning(network, turns, *, views, size=64):
    """Relative changes of the descriptor when the object itself is turned."""
    still = network({"views": scene(START, views=views, size=size)}).descriptor
    turned = (network({"views": scene(turn @ START, views=views, size=size)}) for turn in turns)
    return torch.tensor([relative(one.descriptor, still) for one in turned])


def test_sixty_views_of_a_turned_object_give_the_same_descriptor():
    network, _ = settled(make(60), {"views": scene(torch.eye(3).double(), views=60, size=32)})
    turns = GROUP.rotations[1::11]
    assert changes_by_turning(network, turns, views=60, size=32).max() < 1e-12
    others = random_rotations(3, torch.Generator().manual_seed(3)).double()
    assert changes_by_turning(network, others, views=60, size=32).min() > 1e-2


def test_twelve_views_of_a_turned_object_give_nearly_the_same_descriptor():
    """Rolls of any angle are left, which are shifts of the rows that fall between the cells."""
    network = make(12, size=64, trunk=UNSTRIDED)
    network, _ = settled(network, {"views": scene(torch.eye(3).double())})
    assert changes_by_turning(network, GROUP.rotations[1::17], views=12).max() < 0.05
    others = random_rotations(3, torch.Generator().manual_seed(3)).double()
    assert changes_by_turning(network, others, views=12).min() > 0.1


@pytest.mark.parametrize("log_polar", [True, False])
@torch.no_grad()
def test_quarter_rolls_are_noticed_only_without_log_polar(log_polar):
    network = make(size=64, log_polar=log_polar)
    network, batch = settled(network, make_batch(2, size=64))
    rolled = batch["views"].clone()
    for view in range(12):
        rolled[:, view] = rolled[:, view].rot90(view, dims=(2, 3))
    change = relative(network({"views": rolled}).descriptor, network(batch).descriptor)
    assert (change < 1e-12) if log_polar else (change > 1e-2)


def test_log_polar_makes_the_trunk_circular():
    assert type(make().views.trunk.stem).__name__ == "CircularRowsConv2d"
    assert type(make(log_polar=False).views.trunk.stem).__name__ == "Conv2d"


def test_gray_is_three_equal_channels():
    network = make().eval()
    gray = make_batch(2)
    colour = make(channels=3).eval()
    colour.load_state_dict(network.state_dict())
    with torch.no_grad():
        one = network(gray).logits
        other = colour({"views": gray["views"].expand(-1, -1, 3, -1, -1)}).logits
    torch.testing.assert_close(one, other)


def test_pretrained_weights_bring_their_normalisation_and_checkpoints_keep_it(tmp_path):
    source = AlexNet(3, width=2, image_size=32)
    torch.save(source.state_dict(), tmp_path / "alexnet.pth")
    options = dict(channels=1, image_size=32, num_views=12)
    trunk = partial(AlexNet, width=2)
    scratch = ViewFeatures(trunk, **options).eval()
    loaded = ViewFeatures(trunk, **options, pretrained=tmp_path / "alexnet.pth").eval()
    views = make_batch(2)["views"]
    mean, std = (torch.tensor(v).view(3, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
    pictures = (views.flatten(0, 1).expand(-1, 3, -1, -1) - mean) / std
    source.eval()
    torch.testing.assert_close(loaded(views).flatten(0, 1), source(pictures))
    assert scratch.mean.abs().max() == 0
    assert (scratch.std == 1).all()
    # Rebuilt without the file, as from a checkpoint.
    scratch.load_state_dict(loaded.state_dict())
    torch.testing.assert_close(scratch(views), loaded(views))


def test_bad_choices():
    with pytest.raises(ValueError, match="max, mean"):
        make(pooling="sum")
    with pytest.raises(ValueError, match="at least 1"):
        make(layers=0)
    with pytest.raises(ValueError, match=r"12 \(icosahedron_12\), 20 \(dodecahedron_20\)"):
        make(views=13)
    with pytest.raises(ValueError, match="gray"):
        make(channels=2)
    with pytest.raises(TypeError, match="out_channels"):
        make(trunk=torch.nn.Identity())
    with pytest.raises(ValueError, match=r"\(B, \(12, 1, 32, 32\)\), got \(8, 20, 1, 32, 32\)"):
        make()(make_batch(views=20))
