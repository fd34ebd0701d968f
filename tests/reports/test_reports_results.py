"""Reading results, and telling settings apart."""

import json

from hydra.core.override_parser.overrides_parser import OverridesParser

from i2i.reports.results import Filters, hydra_value, one_a_seed, read_results, setting_of

from .conftest import made


def test_a_job_counts_once_and_the_newest_format_wins(keep, tmp_path):
    old, new = made(number="abc"), made(number="abc") | {"format": 2}
    results = keep(old, made("cnn_gs"), {"unrelated": 1}, folder="results")
    run = tmp_path / "runs" / "sweep" / "one"
    run.mkdir(parents=True)
    (run / "result.json").write_text(json.dumps(new))
    (run / "metrics.json").write_text("{}")
    (results / "broken.json").write_text("{")
    found, problems = read_results([results, results], tmp_path / "runs")
    assert sorted(r.content["format"] for r in found) == [1, 2]
    assert len(problems) == 1
    assert "broken.json" in problems[0]


def test_folders_that_do_not_exist_are_empty(tmp_path):
    assert read_results([tmp_path / "none"], tmp_path / "nothing") == ([], [])


def test_settings_forget_axes_and_keep_everything_else(read):
    plain, other, views, frame = read(
        made(),
        made("cnn_gs", obj="sofa", seed=3, modality="rgb"),
        made(views=15),
        made(changes={"model.network.target": "rotation"}),
    )
    same = setting_of(plain, "object")
    assert setting_of(other, "object") == same
    assert setting_of(views, "object") != same
    assert setting_of(views, "views") == same
    assert setting_of(frame, "object") != same
    assert same.words() == ["scale=small", "data=synthetic", "trainer.max_steps=600"]
    assert "model.target=rotation" in setting_of(frame, "object").words()
    pooling = read(made(changes={"model.network.pooling": "mean"}))[0]
    assert "model.networks.pose.pooling=mean" in setting_of(pooling, "object").words()
    assert setting_of(frame, "object").title([600, 600]) == (
        "data=synthetic, scale=small, 600 steps, 32-true, model.target=rotation"
    )


def test_a_joint_network_is_another_setting(read):
    alone, together = read(made(), made(obj=["chair", "sofa"]))
    assert setting_of(alone, "object") != setting_of(together, "object")
    assert together.classes == ["chair", "sofa"]
    assert [n.split("/")[0] for n in together.only("sofa")["instance_names"]] == ["sofa"] * 8


def test_a_sampler_seed_of_its_own_is_a_setting(read):
    follows, own = read(made(seed=1), made(seed=2, changes={"data.sampler_seed": 7}))
    assert setting_of(follows, "object") != setting_of(own, "object")


def test_two_results_of_a_seed_leave_the_longer_one(read):
    short, long, second = read(made(steps=10), made(steps=600), made(seed=1))
    assert one_a_seed([short, second, long]) == ([long, second], [short])


def test_filters_keep_what_was_asked_for(read):
    small, paper = read(made(), made(scale="paper", data="modelnet40", seed=1, steps=5))
    for filters in (
        Filters(data="modelnet40"), Filters(scale="paper"), Filters(steps=5), Filters(seeds=(1, 2)),
    ):  # fmt: skip
        assert filters.keep(paper)
        assert not filters.keep(small)
    words = Filters("modelnet40", "paper", 5, (1, 2)).words()
    assert words == ["scale=paper", "data=modelnet40", "trainer.max_steps=5", "seed=1,2"]


def test_values_are_written_as_hydra_reads_them():
    for value in (
        1,
        0.5,
        True,
        None,
        "a_b",
        "a b",
        'say "x"',
        ["a", 1],
        {"k": [None, 2.0]},
        "1e-3",
        "true",
        "32-true",
    ):
        parsed = OverridesParser.create().parse_override(f"key={hydra_value(value)}")
        assert parsed.value() == value
