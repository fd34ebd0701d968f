"""Numbers of reports against NumPy, sections, comparisons, and whose numbers they are."""

import re

import numpy as np
import pytest
import yaml

from i2i.reports import build
from i2i.reports.build import build_report
from i2i.reports.csv_text import csv_text
from i2i.reports.paper import load_paper, parse_paper
from i2i.reports.results import Filters

from .conftest import made


@pytest.fixture(autouse=True)
def _no_sweeps(monkeypatch):
    """What is missing is tested elsewhere."""
    monkeypatch.setattr(build, "missing_at", lambda *_: ((), ""))
    monkeypatch.setattr(build, "missing_everywhere", lambda *_: (("model=i2i",), "python -m x"))


@pytest.fixture(scope="module")
def paper():
    return load_paper()


def row(report, key, *, section=0, seen=None):
    return next(
        r for r in report.sections[section].rows if r.key == key and seen in (None, r.input)
    )


def by_hand(groups, resamples):
    """Ends of the interval of the mean over classes of pooled medians, resampled by drawing."""
    random = np.random.default_rng(1)
    means = []
    for _ in range(resamples):
        medians = []
        for errors in groups:  # (instances, values)
            drawn = random.integers(0, len(errors), len(errors))
            medians.append(np.median(errors[drawn]))
        means.append(np.mean(medians))
    return np.quantile(means, [0.025, 0.975])


def errors_of(*contents):
    return np.concatenate([np.array(c["errors_deg"]) for c in contents], axis=1)


def test_a_cell_is_the_mean_over_seeds_with_spread_and_interval(read, paper):
    first, second = made(instances=20), made(seed=1, instances=20)
    cell = row(build_report(1, read(first, second), paper), "i2i").ours["chair"]
    medians = [np.median(c["errors_deg"]) for c in (first, second)]
    assert cell.value == pytest.approx(np.mean(medians))
    assert cell.spread == pytest.approx(np.std(medians, ddof=1))
    assert (cell.seeds, cell.instances, cell.classes) == ((0, 1), 20, ("chair",))
    expected = by_hand([errors_of(first, second)], 4000)
    np.testing.assert_allclose([cell.low, cell.high], expected, rtol=0.03)


def test_one_seed_has_no_spread(read, paper):
    assert row(build_report(1, read(made()), paper), "i2i").ours["chair"].spread is None


def test_means_go_over_the_classes_that_we_have(read, paper):
    jobs = [made(obj=o, seed=s, instances=20) for o in ("chair", "cabinet") for s in (0, 1)]
    report = build_report(1, read(*jobs), paper)
    ours = row(report, "i2i").ours
    assert [c.key for c in report.sections[0].columns][-2:] == ["cabinet", "mean"]
    assert not report.sections[0].columns[-2].paper
    mean = ours["mean"]
    assert mean.value == pytest.approx((ours["chair"].value + ours["cabinet"].value) / 2)
    per_seed = [np.mean([np.median(jobs[i + s]["errors_deg"]) for i in (0, 2)]) for s in (0, 1)]
    assert mean.spread == pytest.approx(np.std(per_seed, ddof=1))
    expected = by_hand([errors_of(*jobs[:2]), errors_of(*jobs[2:])], 4000)
    np.testing.assert_allclose([mean.low, mean.high], expected, rtol=0.04)
    assert mean.instances == 40
    assert any("over: cabinet, chair" in note for note in report.sections[0].notes)


def test_a_joint_network_fills_a_column_for_each_class(read, paper):
    content = made(obj=["chair", "sofa"])
    ours = row(build_report(1, read(content), paper), "i2i").ours
    for index, name in enumerate(("chair", "sofa")):
        errors = np.array(content["errors_deg"])[8 * index : 8 * (index + 1)]
        assert ours[name].value == pytest.approx(np.median(errors))


def test_settings_stand_apart_and_the_largest_comes_first(read, paper):
    jobs = [made(), made(data="sweethome"), made("cnn_gs", data="sweethome"), made(views=15),
            made(changes={"model.network.encoder.stem_mode": "odd"})]  # fmt: skip
    report = build_report(1, read(*jobs), paper)
    titles = [section.title for section in report.sections]
    assert titles[0] == "data=sweethome, scale=small, 600 steps, 32-true"
    assert len(titles) == 4
    assert [section.jobs for section in report.sections] == [2, 1, 1, 1]
    assert sum("model.encoder.stem_mode=odd" in title for title in titles) == 1
    assert len(build_report(4, read(*jobs), paper).sections) == 3  # there views are columns


def test_results_that_do_not_say_what_differs_are_left_out(read, paper):
    report = build_report(1, read(made(), made(seed=1) | {"identity": None}), paper)
    assert report.sections[0].jobs == 1
    assert any(note.startswith("Results that are left out: 1.") for note in report.notes)


def test_filters_are_told(read, paper):
    jobs = read(made(), made(seed=5))
    report = build_report(1, jobs, paper, filters=Filters(seeds=(5,)))
    assert row(report, "i2i").ours["chair"].seeds == (5,)
    assert any("seed=5" in note for note in report.notes)


def test_the_same_setting_and_seed_twice_is_told_and_counted_once(read, paper):
    report = build_report(1, read(made(number="a"), made(number="b")), paper)
    assert row(report, "i2i").ours["chair"].seeds == (0,)
    assert any("same settings and seed" in note for note in report.sections[0].notes)


def test_comparisons_are_made_in_pairs(read, paper):
    ours, worse, close = made(), made("cnn_gs"), made("e2cnn_eq")
    shift = np.where(np.arange(8) % 2, 0.3, -0.3)[:, None]
    close["errors_deg"] = (np.array(ours["errors_deg"]) + shift).tolist()
    section = build_report(1, read(ours, worse, close), paper).sections[0]
    made_of = {c.other: c for c in section.comparisons if c.column.key == "chair"}
    gain = made_of["CNN+GS"].gain
    difference = np.median(worse["errors_deg"]) - np.median(ours["errors_deg"])
    assert gain.value == pytest.approx(difference)
    assert made_of["CNN+GS"].verdict == "I2I ahead"
    assert not made_of["CNN+GS"].touch
    assert made_of["E2CNN-Eq"].verdict == "undecided"
    assert made_of["E2CNN-Eq"].touch
    assert not [c for c in section.comparisons if c.column.key == "mean"]  # one class only


def test_the_interval_of_a_difference_is_that_of_the_metrics(read, paper):
    import torch

    from i2i.metrics.bootstrap import instance_bootstrap, paired_median_difference

    ours, other = made(), made("cnn_gs")
    report = build_report(1, read(ours, other), paper)
    first, second = (
        torch.tensor(c["errors_deg"], dtype=torch.float64).ravel() for c in (other, ours)
    )
    instance = torch.arange(8).repeat_interleave(6)
    gain = paired_median_difference(first, second, instance)
    assert report.sections[0].comparisons[0].gain == gain
    cell, expected = row(report, "i2i").ours["chair"], instance_bootstrap(second, instance)
    assert (cell.low, cell.high) == (expected.low, expected.high)


def test_other_test_images_are_not_compared(read, paper):
    other = made("cnn_gs")
    other["instance_names"] = [f"{name}x" for name in other["instance_names"]]
    assert not build_report(1, read(made(), other), paper).sections[0].comparisons


def test_classes_are_scored_in_percent_with_three_precisions(read, paper):
    jobs = [made(m, obj=["chair", "sofa"], task="classification", seed=s)
            for m in ("i2i", "cnn") for s in (0, 1)]  # fmt: skip
    report = build_report(3, read(*jobs), paper)
    ours = row(report, "i2i", seen="gray").ours
    accuracy = [100 * np.mean(job["correct"]) for job in jobs[:2]]
    assert ours["accuracy"].value == pytest.approx(np.mean(accuracy), abs=0.01)
    assert ours["accuracy"].spread == pytest.approx(np.std(accuracy, ddof=1), abs=0.02)
    assert ours["map_class"].value == pytest.approx(83)
    assert ours["map_retrieval"].low is None
    assert not row(report, "i2i", seen="depth").ours
    (made_of,) = report.sections[0].comparisons
    other = 100 * np.mean([job["correct"] for job in jobs[2:]])
    assert made_of.gain.value == pytest.approx(np.mean(accuracy) - other, abs=0.02)
    assert "map_retrieval" in " ".join(report.notes)


def test_shifts_are_columns_and_a_centred_test_belongs_to_both(read, paper):
    depth = {"modality": "depth", "obj": "airplane"}
    pixel = made(**depth, shift_px=30, test_shift_px=30, changes={"data.shift_px": 30})
    far = made(**depth, depth_shift=5, test_depth_shift=5, changes={"data.depth_shift": 5})
    mixed = made(**depth, depth_shift=5, test_depth_shift=10, changes={"data.depth_shift": 5})
    report = build_report(7, read(pixel, far, mixed, made(**depth)), paper)
    assert len(report.sections) == 1
    assert [c.key for c in report.sections[0].columns] == ["0", "5", "10", "15", "20", "25", "30"]
    assert set(row(report, "pixel_shift").ours) == {"0", "30"}
    assert set(row(report, "depth_shift").ours) == {"0", "5"}
    assert row(report, "pixel_shift").paper["30"] == 2.32


def test_views_are_columns_of_the_ablations(read, paper):
    jobs = [made(m, views=v) for m in ("i2i", "i2i_no_groupconv") for v in (60, 15)]
    report = build_report(4, read(*jobs), paper)
    assert row(report, "i2i").ours["15"].value == pytest.approx(np.median(jobs[1]["errors_deg"]))
    assert {c.column.key for c in report.sections[0].comparisons} == {"60", "15"}


def test_without_results_the_papers_table_stands_alone(paper):
    for number in (1, 2, 3, 4, 6, 7):
        (section,) = build_report(number, [], paper).sections
        assert not any(r.ours for r in section.rows)
        assert section.command == "python -m x"


def test_no_paper_number_ever_stands_in_our_column(read, paper):
    """Other published numbers leave every number of ours as it was."""
    from importlib import resources

    text = resources.files("i2i.reports").joinpath("paper.yaml").read_text()
    content = yaml.safe_load(text)
    for table in content["tables"].values():
        for methods in table["rows"].values():
            for key, values in methods.items():
                methods[key] = [None if v is None else v * 1.37 + 1000 for v in values]
    perturbed = parse_paper(yaml.safe_dump(content, sort_keys=False))
    jobs = read(
        *(made(m, obj=o) for m in ("i2i", "cnn_gs") for o in ("chair", "sofa")),
        made(views=15), made("i2i", obj="all", task="classification"),
        made(modality="depth", shift_px=5, test_shift_px=5),
    )  # fmt: skip
    for number in (1, 2, 3, 4, 6, 7):
        before, after = (build_report(number, jobs, p) for p in (paper, perturbed))
        ours = [[r.ours for s in report.sections for r in s.rows] for report in (before, after)]
        assert ours[0] == ours[1]
        assert [s.comparisons for s in before.sections] == [s.comparisons for s in after.sections]
        numbers = [re.findall(r",1\d\d\d\.\d", csv_text(report)) for report in (before, after)]
        assert not numbers[0]
        assert numbers[1]


@pytest.mark.parametrize("model", ["epn", "kpconv", "kpconv_rigid"])
def test_clouds_stand_with_the_images_of_the_same_views(read, paper, model):
    cloud = made(model, modality="partial_points")
    report = build_report(1, read(made(), cloud), paper)
    assert len(report.sections) == 1
    cell = row(report, model, seen="partial_points").ours["chair"]
    assert cell.value == pytest.approx(np.median(cloud["errors_deg"]))


@pytest.mark.parametrize(
    ("model", "modality"),
    [("pointnet2", "full_points"), ("epn", "full_points"), ("kpconv", "full_points"),
     ("rotationnet_20", "views"), ("emvn_12", "views")],
)  # fmt: skip
def test_classes_of_clouds_and_views_stand_with_those_of_images(read, paper, model, modality):
    options = {"task": "classification", "obj": ["chair", "sofa"]}
    views = 6 if modality == "views" else 1
    other = made(model, modality=modality, views=views, **options)
    image = made("i2i", modality="depth", changes=[("data.modality", "depth")], **options)
    report = build_report(3, read(image, other), paper)
    assert len(report.sections) == 1
    cell = row(report, model, seen=modality).ours["accuracy"]
    assert cell.value == pytest.approx(100 * np.mean(other["correct"]), abs=0.01)
