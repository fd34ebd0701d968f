"""EPN and KPConv (A): sizes, the 60 rotations, the convention of the residual, learning."""

from functools import partial

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.points import normalize_points
from i2i.geometry.rotations import geodesic_angle_rad, random_rotations
from i2i.models.epn import EPNClassifier, EPNPose
from i2i.models.kpconv_pose import SingleAnchorPose
from i2i.nn import anchor_conv
from i2i.nn.anchor_conv import AnchorPointConv, turned_kernel

MESH = icosahedron(0)
ROTATIONS = MESH.rotations
TOYS = {
    "epn": partial(EPNPose, width=2),
    "epn_six": partial(EPNPose, width=2, representation="six"),
    "kpconv": partial(SingleAnchorPose, width=2),
    "classifier": partial(EPNClassifier, width=2),
}
every = pytest.mark.parametrize("name", list(TOYS))
of_pose = pytest.mark.parametrize("name", ["epn", "epn_six", "kpconv"])


def make(name, *, classes=None, **options):
    torch.manual_seed(0)
    classes = classes or (4 if name == "classifier" else 1)
    return TOYS[name](num_points=64, num_classes=classes, **options)


def make_batch(n=4, *, size=64, classes=4, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n, size, 3, generator=generator, dtype=torch.float64)
    return {
        "points": normalize_points(points).to(dtype),
        "rotation": random_rotations(n, generator).to(dtype),
        "class_id": torch.arange(n) % classes,
    }


def exact(network):
    """A network in float64, with kernels and elements that modules keep in float32."""
    network = network.double()
    for module in network.modules():
        if isinstance(module, AnchorPointConv):
            anchors = ROTATIONS[: len(module.kernel)]
            module.kernel = turned_kernel(anchors, radius=module.radius)
    network.elements = ROTATIONS
    return network


def randomise(network):
    """Weights that no initialisation makes small or symmetric, and running statistics."""
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    network.train()(make_batch(classes=network.num_classes))
    return network.eval()


def total(network, batch):
    return sum(network.loss(network(batch), batch).values())


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_parameters_of_the_originals():
    network = EPNPose(num_points=1024, num_classes=1)
    assert (count(network.trunk), count(network)) == (2_916_832, 3_024_101)
    assert count(EPNPose(num_points=1024, num_classes=1, representation="six")) == 3_024_231
    network = EPNClassifier(num_points=1024, num_classes=40)
    assert (count(network.trunk), count(network)) == (7_670_976, 7_814_889)
    network = SingleAnchorPose(num_points=1024, num_classes=1)
    assert (count(network.trunk), count(network)) == (1_549_056, 1_656_260)
    joint = EPNPose(num_points=1024, num_classes=10)
    assert count(joint) == 3_024_101 + 10 * 5


@pytest.mark.parametrize("name", ["kpconv", "classifier"])
def test_the_table_of_the_original(name, monkeypatch):
    """Points, radius and neighbours of the seven layers; small clouds have fewer neighbours."""
    seen, query = [], anchor_conv.ball_query

    def record(centres, points, *, radius, count):
        seen.append((points.shape[1], centres.shape[1], round(radius, 3), count))
        return query(centres, points, radius=radius, count=count)

    monkeypatch.setattr(anchor_conv, "ball_query", record)
    network, half = make(name), 2 if name == "classifier" else 1
    with torch.no_grad():
        network(make_batch(1, size=1024))
        network(make_batch(1, size=256))
    radii = [0.2, 0.283, 0.4, 0.4, 0.566, 0.566, 0.8]
    into = [512, 512, 256, 256, 128, 128, 64]
    counts = [64, 32, 64, 32, 64, 32, 64]
    table = [
        (n, p, r, j // half) for n, p, r, j in zip([1024, *into], into, radii, counts, strict=False)
    ]
    assert seen[:7] == table
    assert seen[7:] == [(n // 4, p // 4, r, max(8, j // 4)) for n, p, r, j in table]
    widths = [layer.point_conv.weight.shape[0] // 2 for layer in network.trunk.layers]
    factors = [1, 1, 2, 2, 4, 4, 8] if name == "kpconv" else [2, 2, 4, 4, 8, 8, 8]
    assert widths == factors
    assert all(layer.point_conv.weight.shape[2] == 24 for layer in network.trunk.layers)


def turn_errors(network, dtype, rotations=ROTATIONS):
    """Relative errors for 60 turns of a cloud: of the anchors' features, and of their maximum."""
    points = make_batch(1, dtype=dtype)["points"]
    with torch.no_grad():
        still = network.anchor_features(points)[0]
        turned = network.anchor_features(points @ rotations.mT.to(dtype))
    back = torch.stack([got[MESH.multiplication[h]] for h, got in enumerate(turned)])
    anchors = (back - still).norm(dim=(1, 2)) / still.norm()
    best = still.amax(dim=0)
    maxima = (turned.amax(dim=1) - best).norm(dim=1) / best.norm()
    return anchors.tolist(), maxima.tolist()


@pytest.mark.parametrize("name", ["epn", "classifier"])
def test_turning_the_cloud_permutes_the_anchors(name):
    network = randomise(make(name))
    assert max(map(max, turn_errors(network, torch.float32))) < 5e-5  # 2e-6 measured
    assert max(map(max, turn_errors(exact(network), torch.float64))) < 1e-11  # 5e-15 measured


@pytest.mark.parametrize("name", ["epn", "classifier"])
def test_other_rotations_and_the_wrong_side_do_not(name):
    network = exact(randomise(make(name)))
    tilt = random_rotations(1, torch.Generator().manual_seed(3))[0]
    for errors in turn_errors(network, torch.float64, ROTATIONS @ tilt):
        assert min(errors) > 1e-2
    for layer in network.trunk.layers:
        table = layer.group_conv.table
        layer.group_conv.table = MESH.multiplication[table[MESH.identity]].T.contiguous()
    assert min(turn_errors(network, torch.float64)[0][1:]) > 1e-2


@pytest.mark.parametrize("name", ["epn", "epn_six"])
def test_the_predicted_rotation_turns_with_the_cloud(name):
    network, batch = randomise(make(name)), make_batch(3)
    with torch.no_grad():
        still = network(batch)
        for h in range(0, 60, 7):
            turn = ROTATIONS[h].float()
            turned = network(batch | {"points": batch["points"] @ turn.T})
            angle = geodesic_angle_rad(turned.rotation, turn @ still.rotation)
            assert torch.rad2deg(angle).max() < 1e-2


def test_the_class_does_not_turn_with_the_cloud():
    network, batch = randomise(make("classifier")), make_batch(3)
    with torch.no_grad():
        still = network(batch)
        for h in range(0, 60, 7):
            turned = network(batch | {"points": batch["points"] @ ROTATIONS[h].T.float()})
            torch.testing.assert_close(turned.logits, still.logits, atol=1e-4, rtol=0)
            torch.testing.assert_close(turned.descriptor, still.descriptor, atol=1e-4, rtol=0)
            moved = turned.attention_logits[:, MESH.multiplication[h]]
            torch.testing.assert_close(moved, still.attention_logits, atol=1e-4, rtol=0)


@every
def test_the_order_of_the_points_does_not_matter(name):
    network, batch = randomise(make(name)), make_batch(3)
    order = torch.randperm(64, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        one, other = network(batch), network(batch | {"points": batch["points"][:, order]})
    field = "logits" if name == "classifier" else "rotation"
    assert torch.equal(getattr(one, field), getattr(other, field))


def written_out(network, features, rotation):
    """Score, candidate and losses of anchors R_a with residuals on the right, by loops."""
    scores, candidates = torch.zeros(len(features), 60), torch.zeros(len(features), 60, 3, 3)
    classification = regression = 0.0
    for b, true in enumerate(rotation):
        angles = geodesic_angle_rad(ROTATIONS.float(), true)
        for a in range(60):
            scores[b, a] = 3 * network.score(features[b, a])
            delta = network.residual(features[b, a])
            candidates[b, a] = ROTATIONS[a].float() @ delta
            if angles[a] < 1:
                wanted = ROTATIONS[a].float().T @ true
                regression += 10 * (delta - wanted).square().sum() / len(rotation)
        log_prob = scores[b] - scores[b].exp().sum().log()
        classification -= log_prob[angles.argmin()] / len(rotation)
    return scores, candidates, {"classification": classification, "regression": regression}


@pytest.mark.parametrize("name", ["epn", "epn_six"])
def test_right_residuals_of_the_rotation_in_the_projects_convention(name, monkeypatch):
    network, batch = make(name), make_batch(5)
    features = torch.randn(5, 60, network.score.in_features)
    monkeypatch.setattr(network, "anchor_features", lambda points: features)
    with torch.no_grad():
        prediction = network(batch)
        losses = network.loss(prediction, batch)
        scores, candidates, expected = written_out(network, features, batch["rotation"])
    for a in range(60):
        # The group element of an anchor is its inverse.
        g = int((ROTATIONS - ROTATIONS[a].T).abs().amax(dim=(1, 2)).argmin())
        torch.testing.assert_close(prediction.logits[:, g], scores[:, a])
        torch.testing.assert_close(prediction.candidates[:, g], candidates[:, a])
        recomposed = prediction.extras["residual"][:, g] @ ROTATIONS[g].float()
        torch.testing.assert_close(recomposed.mT, candidates[:, a])
    for b in range(5):
        torch.testing.assert_close(prediction.rotation[b], candidates[b, scores[b].argmax()])
    torch.testing.assert_close(losses, expected, rtol=1e-4, atol=1e-4)
    nearest = (ROTATIONS.float()[:, None] * batch["rotation"]).sum(dim=(2, 3)).argmax(dim=0)
    assert torch.equal(network.group_target(batch).element, MESH.inverse[nearest])
    assert torch.equal(network.group_correct(prediction, batch), scores.argmax(dim=1) == nearest)


def test_the_mean_over_near_anchors_is_a_third_of_the_sum():
    network = make("epn", reg_on="within_57deg", regression_weight=30.0)
    batch = make_batch(400)
    target = network.group_target(batch)
    near = (target.angle_rad < 1).sum(dim=1)
    assert near.double().mean() == pytest.approx(3.03, abs=0.2)
    residual = random_rotations(400 * 60).view(400, 60, 3, 3).float()
    means = network.criterion(torch.zeros(400, 60), residual, target)["regression"]
    sums = make("epn").criterion(torch.zeros(400, 60), residual, target)["regression"]
    assert means.item() == pytest.approx(sums.item(), rel=0.1)


def test_losses_of_the_classifier():
    network, batch = make("classifier"), make_batch(5)
    prediction = network(batch)
    losses = network.loss(prediction, batch)
    log_prob = torch.log_softmax(prediction.logits, dim=1)
    attention = torch.log_softmax(prediction.attention_logits, dim=1)
    classification = anchor = 0.0
    for b in range(5):
        nearest = geodesic_angle_rad(ROTATIONS.float(), batch["rotation"][b]).argmin()
        classification -= log_prob[b, batch["class_id"][b]] / 5
        anchor -= attention[b, nearest] / 5
    expected = {"classification": classification, "attention": anchor}
    torch.testing.assert_close(losses, expected)
    doubled = make("classifier", attention_weight=2.0).loss(prediction, batch)
    torch.testing.assert_close(doubled["attention"], 2 * anchor)


def test_the_descriptor_is_the_attended_mean_that_the_last_layer_sees():
    network, batch = randomise(make("classifier")), make_batch(3)
    with torch.no_grad():
        prediction, features = network(batch), network.anchor_features(batch["points"])
    weights = prediction.attention_logits.softmax(dim=1)
    torch.testing.assert_close(
        prediction.descriptor, sum(weights[:, a, None] * features[:, a] for a in range(60))
    )
    torch.testing.assert_close(prediction.logits, network.classifier(prediction.descriptor))


@every
def test_checkpointed_gradients_are_the_plain_ones(name):
    batch, found = make_batch(dtype=torch.float64), []
    for checkpointing in (False, True):
        network = make(name, checkpointing=checkpointing).double()
        loss = total(network, batch)
        loss.backward()
        found.append([loss.detach(), *(p.grad for p in network.parameters())])
    torch.testing.assert_close(found[0], found[1], atol=1e-9, rtol=1e-9)


@every
def test_batch_of_one_and_determinism(name):
    network, batch = make(name), make_batch(4)
    alone = {key: value[:1] for key, value in batch.items()}
    total(network.train(), alone).backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())
    network.eval()
    with torch.no_grad():
        first, second, one = network(batch), network(batch), network(alone)
    field = "logits" if name == "classifier" else "rotation"
    assert torch.equal(getattr(first, field), getattr(second, field))
    torch.testing.assert_close(getattr(one, field), getattr(first, field)[:1], atol=1e-4, rtol=1e-4)


@every
def test_mixed_precision(name):
    network, batch = make(name), make_batch(4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = network(batch)
        losses = network.loss(prediction, batch)
    assert {value.dtype for value in losses.values()} == {torch.float32}
    sum(losses.values()).backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())
    if name == "classifier":
        assert prediction.logits.dtype == prediction.descriptor.dtype == torch.float32
    else:
        product = prediction.rotation @ prediction.rotation.mT
        torch.testing.assert_close(product, torch.eye(3).expand_as(product), atol=1e-5, rtol=0)


@of_pose
def test_joint_networks_see_the_class(name):
    network, batch = randomise(make(name, classes=3)), make_batch(6, classes=3)
    other = {**batch, "class_id": (batch["class_id"] + 1) % 3}
    with torch.no_grad():
        moved = geodesic_angle_rad(network(batch).rotation, network(other).rotation)
    assert moved.min() > 1e-4
    with pytest.raises(ValueError, match="class_id"):
        network({"points": batch["points"]})


@every
def test_clouds_of_other_sizes(name):
    network = make(name)
    for size in (32, 100):
        assert torch.isfinite(total(network, make_batch(2, size=size)))
    with pytest.raises(ValueError, match="needs 32"):
        network(make_batch(2, size=31))


def test_a_zero_quaternion_is_the_identity():
    network = make("kpconv")
    torch.nn.init.zeros_(network.head.linear.weight)
    torch.nn.init.zeros_(network.head.linear.bias)
    rotation = network(make_batch(2)).rotation
    torch.testing.assert_close(rotation, torch.eye(3).expand(2, 3, 3))
    rotation.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


def test_unknown_choices_are_refused():
    with pytest.raises(ValueError, match="quaternion, six"):
        make("epn", representation="euler")
    with pytest.raises(ValueError, match="frobenius, mse"):
        make("kpconv", loss="l1")
    with pytest.raises(ValueError, match="sum_within_57deg"):
        make("epn", reg_on="all")
