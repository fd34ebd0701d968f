"""RotationNet: the latent assignment against brute force, counts, learning, invariance."""

import copy
import itertools
from functools import partial

import pytest
import torch
from hydra.utils import instantiate

from i2i.configuration import compose
from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.view_sets import view_permutations
from i2i.models.rotationnet import (
    RotationNet,
    assignment_scores,
    pair_targets,
    scores_under,
)
from i2i.nn.alexnet import AlexNet
from i2i.nn.resnet import ResNet18

STANDARD = partial(ResNet18, stem_size=7, layer_strides=(1, 2, 2, 2))


class Little(torch.nn.Conv2d):
    """A trunk of one layer, where the trunk does not matter."""

    def __init__(self, channels, **_):
        super().__init__(channels, 6, 5, stride=3)


TRUNKS = {
    "resnet18": partial(STANDARD, width=4, max_pool=False),
    "alexnet": partial(AlexNet, width=4),
    "dry alexnet": partial(AlexNet, width=4, dropout=0.0),
    "little": Little,
}
SQUARE = torch.stack([(torch.arange(4) + turn) % 4 for turn in range(4)])
"""Cameras on the corners of a square: under turn j camera v took view v + j."""
every = pytest.mark.parametrize("trunk", ["resnet18", "alexnet"])


def make(*, trunk="resnet18", size=32, classes=4, channels=1, views=20, **options):
    torch.manual_seed(0)
    return RotationNet(
        TRUNKS[trunk], channels=channels, num_classes=classes, image_size=size, num_views=views,
        **options,
    )  # fmt: skip


def make_batch(n=8, *, size=32, classes=4, channels=1, views=20):
    generator = torch.Generator().manual_seed(0)
    pictures = torch.rand(n, views, channels, size, size, generator=generator)
    return {"views": pictures, "class_id": torch.arange(n) % classes}


def log_probs(n, views, classes, *, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (n, views, views, classes + 1)
    return torch.randn(shape, generator=generator, dtype=torch.float64).log_softmax(dim=-1)


@pytest.mark.parametrize(("trunk", "expected"), [(STANDARD, 11_597_172), (AlexNet, 60_363_380)])
def test_parameters_of_the_published_network(trunk, expected):
    network = RotationNet(trunk, channels=1, num_classes=40, image_size=224, num_views=20)
    assert sum(p.numel() for p in network.parameters()) == expected


@pytest.mark.parametrize("table", [SQUARE, view_permutations("dodecahedron_20")[::7]])
def test_scores_against_loops(table):
    views, classes = table.shape[1], 3
    log_prob = log_probs(2, views, classes)
    scores = assignment_scores(log_prob, table)
    for b, j, c in itertools.product(range(2), range(len(table)), range(classes)):
        expected = sum(
            log_prob[b, table[j, v], v, c] - log_prob[b, table[j, v], v, classes]
            for v in range(views)
        )
        torch.testing.assert_close(scores[b, j, c], expected)
    torch.testing.assert_close(scores_under(log_prob, table[[1, 2]])[0], scores[0, 1])
    torch.testing.assert_close(scores_under(log_prob, table[[1, 2]])[1], scores[1, 2])


def test_targets_of_the_square_by_hand():
    # Camera 0 took view 1, camera 1 view 2, camera 2 view 3, camera 3 view 0.
    target = pair_targets(SQUARE[[1]], torch.tensor([2]), 5)[0]
    expected = torch.tensor([[5, 5, 5, 2], [2, 5, 5, 5], [5, 2, 5, 5], [5, 5, 2, 5]])
    assert torch.equal(target, expected)
    assert not torch.equal(target, expected.T)  # the other direction


@pytest.mark.parametrize("name", ["square", "dodecahedron_20"])
def test_targets_make_the_chosen_assignment_likelier(name):
    """What is trained is what is scored: the classic mistake is one of them transposed."""
    table = SQUARE if name == "square" else view_permutations(name)
    views, classes = table.shape[1], 3
    chosen = torch.arange(1, len(table), max(1, len(table) // 9))
    class_id = chosen % classes
    target = pair_targets(table[chosen], class_id, classes)
    assert ((target == class_id[:, None, None]).sum(dim=1) == 1).all()
    assert ((target == classes).sum(dim=(1, 2)) == views * (views - 1)).all()
    ideal = torch.nn.functional.one_hot(target, classes + 1).double() + 1e-3
    log_prob = ideal.log()
    scores = assignment_scores(log_prob, table)
    best = scores.flatten(1).argmax(dim=1)
    assert torch.equal(best, chosen * classes + class_id)
    wrong = assignment_scores(log_prob.transpose(1, 2), table)
    assert (wrong.flatten(1).argmax(dim=1) != best).any()


def test_loss_chooses_the_best_assignment_for_the_true_class():
    network = make(views=4, classes=3, permutations=SQUARE).double()
    batch = make_batch(5, views=4, classes=3)
    batch["views"] = batch["views"].double()
    prediction = network(batch)
    found = network.loss(prediction, batch)["classification"]
    log_prob, total = prediction.pair_log_prob.detach(), 0.0
    for b, true in enumerate(batch["class_id"].tolist()):
        score = [
            sum(log_prob[b, row[v], v, true] - log_prob[b, row[v], v, 3] for v in range(4))
            for row in SQUARE.tolist()
        ]
        row = SQUARE[int(torch.tensor(score).argmax())].tolist()
        for i, v in itertools.product(range(4), repeat=2):
            total -= log_prob[b, i, v, true if row[v] == i else 3]
    torch.testing.assert_close(found.detach(), total / (5 * 16))
    torch.testing.assert_close(log_prob.exp().sum(-1), torch.ones(5, 4, 4).double())


def test_prediction_is_the_best_pair_of_assignment_and_class():
    network, batch = make().eval(), make_batch()
    with torch.no_grad():
        prediction = network(batch)
    scores = assignment_scores(prediction.pair_log_prob, network.permutations)
    best = scores.flatten(1).argmax(dim=1)
    assert torch.equal(prediction.assignment, best // 4)
    assert torch.equal(prediction.logits.argmax(dim=1), best % 4)
    torch.testing.assert_close(prediction.logits.amax(dim=1), scores.flatten(1).amax(dim=1))


def square_objects(n, *, seed):
    """Toy: an object shows four pictures in a ring; which comes first is arbitrary."""
    generator = torch.Generator().manual_seed(seed)
    class_id = torch.arange(n) % 2
    # The same four pictures, one after the other or with two exchanged: only the order tells.
    order = torch.tensor([[0, 1, 2, 3], [0, 2, 1, 3]])[class_id]
    turn = torch.randint(4, (n,), generator=generator)
    place = (torch.arange(4) + turn[:, None]) % 4
    level = order.gather(1, place)
    views = torch.zeros(n, 4, 1, 32, 32)
    for b, v in itertools.product(range(n), range(4)):
        column = 8 * int(level[b, v])
        views[b, v, 0, :, column : column + 8] = 1
    return {"views": views, "class_id": class_id}, turn


def test_learns_classes_that_only_the_assignment_tells_apart():
    """All views of both classes are the same pictures, so no view alone knows the class."""
    batch, _ = square_objects(16, seed=0)
    fresh, turn = square_objects(16, seed=1)
    correct = {}
    for name, table in (("ring", SQUARE), ("one", SQUARE[:1])):
        network = make(views=4, classes=2, permutations=table)
        optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
        for _ in range(40):
            optimiser.zero_grad()
            network.loss(network(batch), batch)["classification"].backward()
            optimiser.step()
        with torch.no_grad():
            prediction = network.eval()(fresh)
        correct[name] = (prediction.logits.argmax(1) == fresh["class_id"]).float().mean().item()
        if name == "ring":  # the pose came out as well, up to a constant turn for each class
            for c in (0, 1):
                mine = fresh["class_id"] == c
                offset = (prediction.assignment + turn)[mine] % 4
                assert (offset == offset[0]).all()
    assert correct["ring"] == 1.0
    assert correct["one"] < 0.9


@torch.no_grad()
def changes(tables):
    """Largest relative change of logits and descriptor under permutations of the views."""
    network, views = make(trunk="little").double(), make_batch(4)["views"].double()
    still, found = network({"views": views}), []
    for table in tables:
        moved = network({"views": views[:, table]})
        pairs = ((moved.logits, still.logits), (moved.descriptor, still.descriptor))
        found.append([((one - two).norm() / two.norm()).item() for one, two in pairs])
    return torch.tensor(found)


def test_permutations_by_the_group_change_nothing_and_others_do():
    tables = view_permutations("dodecahedron_20")
    assert changes(tables).max() < 1e-12
    generator = torch.Generator().manual_seed(0)
    others = [torch.randperm(20, generator=generator) for _ in range(5)]
    by_others = changes(others)
    assert by_others[:, 0].min() > 1e-6  # the scores notice, at random weights too
    assert by_others[:, 1].max() < 1e-12  # the mean of the features does not


def test_permuted_views_are_assigned_as_permuted():
    group, tables = icosahedron(0), view_permutations("dodecahedron_20")
    network, views = make(trunk="little").double(), make_batch(4)["views"].double()
    with torch.no_grad():
        still = network({"views": views}).assignment
        for element in range(0, 60, 11):
            moved = torch.empty_like(views)
            moved[:, tables[element]] = views  # the object turned by the element
            expected = group.multiplication[element][still]
            assert torch.equal(network({"views": moved}).assignment, expected)


@every
def test_one_step_changes_every_parameter(trunk):
    network, batch = make(trunk=trunk), make_batch()
    before = copy.deepcopy(dict(network.named_parameters()))
    network.loss(network(batch), batch)["classification"].backward()
    torch.optim.SGD(network.parameters(), lr=0.1).step()
    assert [n for n, p in network.named_parameters() if torch.equal(p, before[n])] == []


def test_alexnet_overfits_eight_objects_without_dropout():
    network = make(trunk="dry alexnet", views=4, classes=2, permutations=SQUARE)
    batch, _ = square_objects(8, seed=0)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(80):
        optimiser.zero_grad()
        prediction = network(batch)
        loss = network.loss(prediction, batch)["classification"]
        loss.backward()
        optimiser.step()
    assert torch.equal(prediction.logits.argmax(dim=1), batch["class_id"])
    assert loss < 0.4  # 0.73 where nothing tells one view from another


@every
@pytest.mark.parametrize(("size", "channels"), [(32, 1), (64, 3)])
def test_batch_of_one_and_determinism(trunk, size, channels):
    network = make(trunk=trunk, size=size, channels=channels)
    batch = make_batch(3, size=size, channels=channels)
    alone = {key: value[:1] for key, value in batch.items()}
    assert torch.isfinite(network.train().loss(network(alone), alone)["classification"])
    network.eval()
    with torch.no_grad():
        first, second, one = network(batch), network(batch), network(alone)
    assert torch.equal(first.logits, second.logits)
    torch.testing.assert_close(one.logits, first.logits[:1], atol=1e-4, rtol=1e-4)
    assert first.descriptor.shape == (3, network.views.out_channels)


@every
def test_mixed_precision_gives_float32(trunk):
    network, batch = make(trunk=trunk), make_batch()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        loss = network.loss(prediction, batch)["classification"]
    loss.backward()
    assert prediction.logits.dtype == prediction.descriptor.dtype == loss.dtype == torch.float32
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


def test_the_original_trunk_by_configuration():
    words = ["model=rotationnet_20", "model/trunk=alexnet", "task=classification", "scale=tiny"]
    config = compose([*words, "data=synthetic"]).model
    assert config.camera_set == "dodecahedron_20"
    network = instantiate(
        config.networks.classification, channels=1, num_classes=4, image_size=32, num_views=20
    )
    assert isinstance(network.views.trunk, AlexNet)
    assert network.views.trunk.out_channels == 256


def test_bad_choices():
    with pytest.raises(ValueError, match="not of num_views=20"):
        make(permutations=SQUARE)
    with pytest.raises(ValueError, match="fits no camera set"):
        make(views=7)
