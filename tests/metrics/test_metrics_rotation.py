"""Rotation errors against angles that are known, and their scores against numpy."""

import numpy as np
import pytest
import torch

from i2i.geometry.rotations import axis_rotation, random_rotations
from i2i.metrics.rotation import PoseErrors, error_deg


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "angle", [0.0, 1e-5, 1e-3, 0.5, 30.0, 90.0, 150.0, 179.99, 179.99999, 180.0]
)
def test_known_angles(angle, dtype):
    base = random_rotations(50, torch.Generator().manual_seed(0))
    turned = base @ axis_rotation("y", angle).double()
    error = error_deg(turned.to(dtype), base.to(dtype))
    assert error.dtype == torch.float64
    tolerance = 2e-5 if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(error, torch.full_like(error, angle), atol=tolerance, rtol=0)


def test_chance_level():
    generator = torch.Generator().manual_seed(0)
    error = error_deg(random_rotations(200_000, generator), torch.eye(3))
    assert error.quantile(0.5).item() == pytest.approx(132.3, abs=0.5)
    assert error.mean().item() == pytest.approx(126.5, abs=0.5)
    assert (error < 30).double().mean().item() == pytest.approx(0.0075, abs=0.001)


def turned_by(angles):
    return torch.stack([axis_rotation("x", float(angle)).float() for angle in angles])


def test_scores():
    errors = {"car": [1.0, 10.0, 20.0, 170.0], "bowl": [5.0, 40.0]}
    metric = PoseErrors(["car", "bowl", "cone"], ["none", "z", "z"])
    eye = torch.eye(3).expand(2, 3, 3)
    for index, (name, first) in enumerate([("car", 0), ("car", 2), ("bowl", 0)]):
        angles = errors[name][first : first + 2]
        metric.update(
            turned_by(angles),
            eye,
            class_id=torch.full((2,), ["car", "bowl"].index(name)),
            instance_id=torch.full((2,), index),
            group_correct=torch.tensor([True, index == 0]),
        )
    scores = {key: value.item() for key, value in metric.compute().items()}
    everything = np.array(errors["car"] + errors["bowl"])
    assert scores["median_error_deg"] == pytest.approx(np.median(everything), abs=1e-4)
    assert scores["mean_error_deg"] == pytest.approx(everything.mean(), abs=1e-4)
    assert scores["acc_at_15deg"] == pytest.approx(3 / 6)
    assert scores["acc_at_30deg"] == pytest.approx(4 / 6)
    assert scores["flip_rate"] == pytest.approx(1 / 6)
    assert scores["group_accuracy"] == pytest.approx(4 / 6)
    assert scores["car/median_error_deg"] == pytest.approx(15.0, abs=1e-4)  # the averaging median
    assert scores["car/group_accuracy"] == pytest.approx(3 / 4)
    assert scores["bowl/median_symmetric_error_deg"] == pytest.approx(22.5, abs=1e-4)
    assert scores["mean_class_median_error_deg"] == pytest.approx((15 + 22.5) / 2, abs=1e-4)
    assert "car/median_symmetric_error_deg" not in scores
    assert not any(key.startswith("cone") for key in scores)
    intervals = metric.median_intervals(num_resamples=200)
    assert intervals["car"].num_instances == 2
    assert intervals["car"].low <= 15 <= intervals["car"].high
    metric.reset()
    metric.update(eye, eye)
    assert metric.compute()["median_error_deg"] == 0


def test_half_precision_and_bad_arguments():
    eye = torch.eye(3)[None]
    assert error_deg(eye.bfloat16(), eye).item() == 0
    with pytest.raises(ValueError, match="one for each class"):
        PoseErrors(["a", "b"], ["z"])
