"""The loss terms against loops over samples and elements."""

import math

import pytest
import torch

from i2i.geometry.icosahedron import icosahedron
from i2i.geometry.rotations import geodesic_angle_rad, random_rotations
from i2i.nn.heads import candidate_rotations, split_group_output
from i2i.nn.losses import ClassifyThenRegressLoss, group_target

ELEMENTS = icosahedron().rotations


def make(n=12):
    generator = torch.Generator().manual_seed(0)
    target = random_rotations(n, generator)
    logits = torch.randn(n, 60, generator=generator, dtype=torch.float64)
    logits[: n // 2, :] += 10 * torch.nn.functional.one_hot(
        group_target(target, ELEMENTS).element[: n // 2], 60
    )
    return logits, random_rotations(n * 60, generator).view(n, 60, 3, 3), target


def loop(logits, residual, target, *, reg_on, labels, squared, width=0.35):
    """Both terms, written out."""
    classification = regression = 0.0
    for b in range(len(target)):
        angles = geodesic_angle_rad(target[b], ELEMENTS)
        nearest, best = int(angles.argmin()), int(logits[b].argmax())
        soft = torch.exp(-((angles / width) ** 2))
        soft = soft / soft.sum()
        log_prob = logits[b] - logits[b].exp().sum().log()
        hard = labels == "hard"
        classification -= log_prob[nearest] if hard else (soft * log_prob).sum()

        def distance(g, b=b):
            value = (target[b] @ ELEMENTS[g].T - residual[b, g]).pow(2).sum()
            return value if squared else value.sqrt()

        if reg_on == "correct_only":
            regression += distance(nearest) if best == nearest else 0.0
        elif reg_on == "gt_always":
            regression += distance(nearest)
        else:
            near = [g for g in range(60) if angles[g] < 1.0]
            parts = [(1 / len(near) if hard else soft[g]) * distance(g) for g in near]
            regression += sum(parts)
    return classification / len(target), regression / len(target)


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize("labels", ["hard", "soft"])
@pytest.mark.parametrize("reg_on", ["correct_only", "gt_always", "within_57deg"])
def test_terms(reg_on, labels, squared):
    logits, residual, target = make()
    criterion = ClassifyThenRegressLoss(
        regression_weight=3.0, reg_on=reg_on, labels=labels, squared=squared
    )
    terms = criterion(logits, residual, group_target(target, ELEMENTS))
    classification, regression = loop(
        logits, residual, target, reg_on=reg_on, labels=labels, squared=squared
    )
    assert terms["classification"].item() == pytest.approx(classification.item())
    assert terms["regression"].item() == pytest.approx(3.0 * regression.item(), rel=1e-6)


def test_auto_follows_the_labels():
    assert ClassifyThenRegressLoss().reg_on == "correct_only"
    assert ClassifyThenRegressLoss(labels="soft").reg_on == "within_57deg"
    assert ClassifyThenRegressLoss(labels="soft", reg_on="gt_always").reg_on == "gt_always"


def test_published_loss_trains_only_the_right_element():
    logits, residual, target = make()
    residual = residual.requires_grad_()
    label = group_target(target, ELEMENTS)
    ClassifyThenRegressLoss()(logits, residual, label)["regression"].backward()
    touched = residual.grad.abs().sum(dim=(2, 3)) > 0
    expected = torch.zeros(12, 60, dtype=torch.bool)
    right = logits.argmax(dim=1) == label.element
    expected[torch.arange(12), label.element] = right
    assert 6 <= right.sum() < 12
    assert torch.equal(touched, expected)


def test_gradient_is_finite_at_the_solution():
    _, _, target = make()
    label = group_target(target, ELEMENTS)
    residual = label.residual.clone().requires_grad_()
    logits = torch.zeros(12, 60, dtype=torch.float64)
    ClassifyThenRegressLoss(reg_on="gt_always")(logits, residual, label)["regression"].backward()
    assert torch.isfinite(residual.grad).all()


def test_identity_residual_statistics():
    """Angles to the nearest element: mean 29.5°, median 31.1°, at most 44.48°."""
    target = random_rotations(20_000, torch.Generator().manual_seed(0)).float()
    angle = torch.rad2deg(group_target(target, ELEMENTS.float()).angle_rad.min(dim=1).values)
    assert angle.mean().item() == pytest.approx(29.5, abs=0.2)
    assert angle.quantile(0.5).item() == pytest.approx(31.1, abs=0.3)
    assert 43.5 < angle.max().item() < math.degrees(0.7764) + 0.01


def test_head_splits_logit_and_six_numbers():
    generator = torch.Generator().manual_seed(0)
    wanted = random_rotations(2 * 60, generator).view(2, 60, 3, 3)
    columns = wanted[..., :2].mT.reshape(2, 60, 6)  # b1 then b2
    scores = torch.randn(2, 60, generator=generator, dtype=torch.float64)
    logits, residual = split_group_output(torch.cat([scores[..., None], 2.5 * columns], dim=-1))
    assert torch.equal(logits, scores)
    torch.testing.assert_close(residual, wanted)
    candidates = candidate_rotations(residual, ELEMENTS, "view")
    torch.testing.assert_close(candidates[1, 7], (wanted[1, 7] @ ELEMENTS[7]).T)
    candidates = candidate_rotations(residual, ELEMENTS, "rotation")
    torch.testing.assert_close(candidates[1, 7], wanted[1, 7] @ ELEMENTS[7])
    assert split_group_output(torch.randn(1, 60, 7).bfloat16())[0].dtype == torch.float32
