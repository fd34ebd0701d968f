"""Likelihood, spread and calibration against closed forms and simulations."""

import math

import pytest
import torch

from i2i.geometry.densities import HAAR_VOLUME, cosine_defect, isotropic_samples
from i2i.geometry.rotations import axis_rotation, random_rotations
from i2i.metrics.likelihood import (
    ConcentrationFit,
    calibration_error,
    fit_concentration,
    probability_within,
    spread_deg,
)
from i2i.models.prediction import PosePrediction


def generator(seed):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("kappa", [1.0, 30.0, 1000.0])
def test_the_fit_finds_the_concentration_that_made_the_data(kappa):
    noise = isotropic_samples(kappa, (4000,), generator(0))
    defect = cosine_defect(noise, torch.eye(3).double())[:, None]
    assert fit_concentration(torch.zeros_like(defect), defect) == pytest.approx(kappa, rel=0.1)


def test_a_mixture_of_two_is_fitted_and_beats_the_point():
    centres = random_rotations(2, generator(1), dtype=torch.float64)
    which = torch.randint(2, (3000,), generator=generator(2))
    truth = isotropic_samples(200.0, (3000,), generator(3)) @ centres[which]
    log_mass = torch.full((3000, 2), math.log(0.5), dtype=torch.float64)
    fit = ConcentrationFit()
    for rows in torch.arange(3000).split(1000):
        fit.update(
            centres[0].expand(1000, 3, 3), truth[rows], log_mass[rows],
            centres.expand(1000, 2, 3, 3),
        )  # fmt: skip
    found = fit.compute()
    assert found["mixture"] == pytest.approx(200.0, rel=0.1)
    assert found["point"] < 20
    mixture = PosePrediction(
        centres[0].expand(3000, 3, 3), log_prob=log_mass, candidates=centres,
        concentration=torch.tensor(found["mixture"]),
    )  # fmt: skip
    point = PosePrediction(
        centres[0].expand(3000, 3, 3), concentration=torch.tensor(found["point"])
    )
    gain = mixture.log_density(truth[:, None]) - point.log_density(truth[:, None])
    assert gain.mean() > 3


def test_mixture_density_integrates_to_one():
    centres = random_rotations(4, generator(4), dtype=torch.float64).view(1, 4, 3, 3)
    mass = torch.tensor([[0.1, 0.2, 0.3, 0.4]]).double()
    prediction = PosePrediction(
        centres[:, 0], log_prob=mass.log(), candidates=centres, concentration=torch.tensor(8.0)
    )
    uniform = random_rotations(100_000, generator(5), dtype=torch.float64)
    density = prediction.log_density(uniform[None]).exp().mean() * HAAR_VOLUME
    assert density.item() == pytest.approx(1.0, abs=0.03)


def test_cells_of_equal_volume_are_a_density():
    cells = random_rotations(50, generator(6), dtype=torch.float64)
    uniform_mass = torch.full((2, 50), -math.log(50.0))
    prediction = PosePrediction(
        cells[:2], log_prob=uniform_mass, candidates=cells, equal_volume=True
    )
    found = prediction.log_density(random_rotations(7, generator(7), dtype=torch.float64)[None]
                                   .expand(2, 7, 3, 3))  # fmt: skip
    torch.testing.assert_close(found, torch.full((2, 7), -math.log(HAAR_VOLUME)).double(),
                               atol=1e-6, rtol=0)  # fmt: skip
    peaked = torch.full((1, 50), -50.0).double()
    peaked[0, 11] = 0.0
    one = PosePrediction(cells[:1], log_prob=peaked, candidates=cells, equal_volume=True)
    assert one.log_density(cells[None, 11:12]).item() == pytest.approx(math.log(50 / HAAR_VOLUME))


def test_a_density_without_its_concentration_is_refused():
    with pytest.raises(ValueError, match="val_fraction"):
        PosePrediction(torch.eye(3)[None]).log_density(torch.eye(3)[None, None])


def test_samples_follow_the_components():
    centre = random_rotations(1, generator(8))
    prediction = PosePrediction(centre, concentration=torch.tensor(400.0))
    drawn = prediction.sample(2000, generator(9))
    angle = torch.rad2deg(cosine_defect(drawn[0], centre).mul(2).sqrt())
    # Three axes of 1/√κ = 2.9° each.
    assert angle.square().mean().sqrt().item() == pytest.approx(math.sqrt(3) * 2.865, rel=0.05)


def test_spread_is_the_mean_angle_of_draws_and_knows_symmetry():
    truth = torch.eye(3)[None]
    samples = torch.stack([axis_rotation("z", a) for a in (0.0, 0.0, 90.0, 180.0)])[None]
    for symmetry, expected in {"none": 67.5, "z2": 22.5, "z": 0.0}.items():
        found = spread_deg(samples, truth, symmetry=symmetry).item()
        assert found == pytest.approx(expected, abs=1e-3)


def test_spread_holds_the_width_of_the_components():
    prediction = PosePrediction(torch.eye(3)[None], concentration=torch.tensor(400.0))
    drawn = prediction.sample(20_000, generator(13))
    # Three normal angles of 1/√κ rad: their norm has the mean 2√(2/π)/√κ.
    expected = math.degrees(2 * math.sqrt(2 / math.pi) / 20)
    assert spread_deg(drawn, torch.eye(3)[None]).item() == pytest.approx(expected, rel=0.02)


def test_probability_within_counts_samples():
    samples = torch.stack([axis_rotation("x", a) for a in (0.0, 20.0, 40.0, 180.0)])[None]
    assert probability_within(samples, torch.eye(3)[None]).item() == 0.5


def test_calibration_error_of_honest_and_of_boastful_forecasts():
    probability = torch.rand(20_000, generator=generator(10), dtype=torch.float64)
    honest = torch.rand(20_000, generator=generator(11)) < probability
    assert calibration_error(probability, honest) < 0.02
    boastful = torch.rand(20_000, generator=generator(12)) < probability / 2
    assert calibration_error(probability, boastful).item() == pytest.approx(0.25, abs=0.02)
    assert calibration_error(torch.tensor([1.0]), torch.tensor([True])) == 0
