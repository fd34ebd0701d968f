"""PointNet++: counts, learning, the definition of its layers, and what it does not notice."""

import copy

import pytest
import torch

from i2i.configuration import compose
from i2i.geometry.points import farthest_point_sample, normalize_points
from i2i.geometry.rotations import random_rotations
from i2i.models.pointnet2 import PointNet2Classifier
from i2i.nn.point_sets import RowNorm, SetAbstraction


def make(points=64, *, classes=4, width=4, **options):
    torch.manual_seed(0)
    return PointNet2Classifier(num_points=points, num_classes=classes, width=width, **options)


def make_batch(n=8, *, points=64, classes=4, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    cloud = torch.randn(n, points, 3, generator=generator, dtype=dtype)
    return {"points": normalize_points(cloud), "class_id": torch.arange(n) % classes}


def settled(network, batch):
    """In double precision, in evaluation mode, with statistics that are not the initial ones."""
    network, batch = network.double().train(), {**batch, "points": batch["points"].double()}
    with torch.no_grad():
        for _ in range(5):
            network(batch)
    return network.eval(), batch


def change(network, batch, points):
    """Relative change of the descriptor by other points."""
    with torch.no_grad():
        one, other = network(batch).descriptor, network({**batch, "points": points}).descriptor
    return ((one - other).norm() / one.norm()).item()


def test_parameters_of_the_published_network():
    network = make(1024, classes=40, width=64)
    assert sum(parameter.numel() for parameter in network.parameters()) == 1_475_688


def test_configured_networks():
    for scale, width in (("paper", 64), ("small", 16), ("tiny", 4)):
        config = compose(["model=pointnet2", "task=classification", f"scale={scale}"])
        assert config.model.networks.classification.width == width
        assert config.model.num_points.classification == config.scale.num_points


def test_an_abstraction_against_loops():
    torch.manual_seed(0)
    layer = SetAbstraction(2, (5, 6), centres=7, radius=0.5, neighbours=4).double().eval()
    points = normalize_points(torch.randn(2, 30, 3, dtype=torch.float64))
    features = torch.randn(2, 30, 2, dtype=torch.float64)
    with torch.no_grad():
        centres, out = layer(points, features)
        index = farthest_point_sample(points, 7)
        for b in range(2):
            for m in range(7):
                centre = points[b, index[b, m]]
                inside = ((points[b] - centre).norm(dim=1) < 0.5).nonzero()[:4, 0]
                inputs = torch.cat([points[b, inside] - centre, features[b, inside]], dim=1)
                assert torch.equal(centres[b, m], centre)
                torch.testing.assert_close(out[b, m], layer.mlp(inputs).amax(dim=0))


def test_one_step_changes_every_parameter_but_biases_that_a_norm_takes_away():
    network, batch = make(dropout=0.0).double(), make_batch(dtype=torch.float64)
    before = copy.deepcopy(dict(network.named_parameters()))
    network.loss(network(batch), batch)["classification"].backward()
    torch.optim.SGD(network.parameters(), lr=0.1).step()
    gradients = {name: p.grad.abs().max() for name, p in network.named_parameters()}
    idle = {
        f"{name}.bias"
        for part in ("fine.mlp", "coarse.mlp", "whole", "hidden")
        for name, layer in network.named_modules()
        if name.startswith(part) and isinstance(layer, torch.nn.Linear)
    }
    assert len(idle) == 11
    assert all(gradients[name] < 1e-10 for name in idle)
    same = {n for n, p in network.named_parameters() if torch.equal(p, before[n])}
    assert same <= idle


@pytest.mark.parametrize("nearest", [False, True])
def test_batch_of_one_and_determinism(nearest):
    network, batch = make(nearest=nearest), make_batch(4)
    alone = {key: value[:1] for key, value in batch.items()}
    network.train()(batch)
    loss = network.loss(network(alone), alone)["classification"]
    loss.backward()
    assert torch.isfinite(loss)
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())
    network.eval()
    with torch.no_grad():
        first, second, one = network(batch), network(batch), network(alone)
        more = network({"points": make_batch(2, points=100)["points"]})
    assert torch.equal(first.logits, second.logits)
    torch.testing.assert_close(one.logits, first.logits[:1], atol=1e-5, rtol=1e-5)
    assert more.logits.shape == (2, 4)


def test_one_row_takes_the_running_statistics():
    norm, rows = RowNorm(3), torch.randn(5, 3)
    norm(rows)
    expected = copy.deepcopy(norm).eval()(rows[:1])
    assert torch.equal(norm.train()(rows[:1]), expected)


def test_training_starts_anywhere_and_evaluation_does_not():
    network, batch = make(dropout=0.0), make_batch(points=100)
    with torch.no_grad():
        torch.manual_seed(0)
        first = network(batch).logits
        assert not torch.equal(network(batch).logits, first)
        torch.manual_seed(0)
        assert torch.equal(network(batch).logits, first)
        network.eval()
        assert torch.equal(network(batch).logits, network(batch).logits)
        fixed = make(dropout=0.0, random_start=False)
        assert torch.equal(fixed(batch).logits, fixed(batch).logits)


def test_descriptor_is_what_the_classifier_sees():
    network, batch = make().eval(), make_batch()
    with torch.no_grad():
        prediction = network(batch)
        logits = network.classifier(prediction.descriptor)
    assert prediction.descriptor.shape == (8, 16)
    torch.testing.assert_close(prediction.logits, logits)


def test_mixed_precision_gives_float32():
    network, batch = make(), make_batch()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        loss = network.loss(prediction, batch)["classification"]
    assert prediction.logits.dtype == prediction.descriptor.dtype == loss.dtype == torch.float32
    loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


ORDER = torch.randperm(128, generator=torch.Generator().manual_seed(1))


def test_the_order_of_the_points_has_no_influence_where_the_nearest_are_looked_at():
    batch = make_batch(4, points=128)
    network, batch = settled(make(128, width=8, nearest=True), batch)
    assert change(network, batch, batch["points"][:, ORDER]) < 1e-12


def test_the_order_of_the_points_has_an_influence_only_where_balls_are_full():
    """The second layer's points come in the order of farthest points, so it has none there."""
    batch = make_batch(4, points=128)
    roomy, batch = settled(make(128, width=8, neighbours=(128, 4)), batch)
    assert change(roomy, batch, batch["points"][:, ORDER]) < 1e-12
    full, batch = settled(make(128, width=8, radii=(0.4, 0.4), neighbours=(4, 64)), batch)
    assert change(full, batch, batch["points"][:, ORDER]) > 1e-5


def test_duplicates_have_no_influence_where_balls_are_not_full():
    """A cloud of 64 points given 64 more copies: farthest points are distinct places first."""
    batch = make_batch(points=64)
    network, batch = settled(make(64, neighbours=(128, 128)), batch)
    doubled = torch.cat([batch["points"], batch["points"]], dim=1)
    assert change(network, batch, doubled) < 1e-12


def test_turned_clouds_are_other_clouds():
    """PointNet++ sees coordinates: nothing makes it invariant."""
    network, batch = settled(make(128, width=8), make_batch(4, points=128))
    turn = random_rotations(1, torch.Generator().manual_seed(0))[0]
    assert change(network, batch, batch["points"] @ turn.T) > 1e-2


def test_bad_choices():
    with pytest.raises(ValueError, match="at least 8"):
        make(7)
    with pytest.raises(ValueError, match="cannot pick 32 of 20"):
        make(64)(make_batch(points=20))
