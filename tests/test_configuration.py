"""Every configuration file composes, and the choices that files make for each other hold."""

from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from i2i.cli import readable
from i2i.configuration import compose, config_dir, plain, slug

CONF = Path(config_dir())
NEEDS_ROOT = {"meshes": ["data.root=parts"], "images": ["data.root=pictures"]}


def options(group: str) -> list[str]:
    return sorted(p.stem for p in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize("name", options("data"))
def test_every_data_file_composes(name):
    config = plain(compose([f"data={name}", *NEEDS_ROOT.get(name, [])]))
    assert config["data"]["_target_"].startswith("i2i.data.")
    assert config["trainer"]["max_steps"] or config["trainer"]["max_epochs"]


@pytest.mark.parametrize("group", ["scale", "trainer", "callbacks", "logger", "renderer", "paths",
                                   "debug", "experiment", "model", "model/encoder",
                                   "model/projector", "model/group_conv", "task"])  # fmt: skip
def test_every_option_of_a_group_composes(group):
    assert options(group)
    for option in options(group):
        plain(compose([f"{group}={option}"]))


@pytest.mark.parametrize(
    ("door", "words"),
    [
        ("render", []),
        ("evaluate", []),
        ("predict", []),
        ("download", ["data=modelnet40"]),
        ("check", []),
        ("export", []),
        ("report", ["table=1"]),
    ],
)
def test_every_door_composes(door, words):
    assert compose(words, door)


def test_every_file_opens_with_what_it_is_and_the_command_that_uses_it():
    for path in CONF.rglob("*.yaml"):
        if path.parent.name in ("hydra", "local", "base"):
            continue
        first = path.read_text().split("\n\n")[0]
        assert first.startswith("#"), path
        assert "=" in first or "--" in first, f"{path}: no command in the first lines"


def test_the_papers_rows_are_at_paper_scale_unless_told_otherwise():
    assert compose(["data=shapenet_bed"]).scale.name == "paper"
    assert compose(["data=modelnet_desk"]).scale.name == "paper"
    assert compose(["data=shapenet_bed", "scale=small"]).scale.name == "small"
    assert compose(["scale=small", "data=shapenet_bed"]).scale.name == "small"
    assert compose([]).scale.name == "small"


def test_the_papers_row_is_the_papers_recipe():
    config = plain(compose(["model=i2i", "task=pose", "data=shapenet_bed"]))
    assert config["data"]["modality"] == "rgb"
    assert config["data"]["image_size"] == 128
    assert config["data"]["views_per_instance"] == 60
    assert config["data"]["val_fraction"] == 0
    assert config["trainer"]["max_epochs"] == 40
    assert config["trainer"]["gradient_clip_val"] is None
    assert config["task"]["optimizer"]["lr"] == 1e-3
    assert config["task"]["scheduler"]["milestones"] == [15, 30]
    assert config["model"]["networks"]["pose"]["regression_weight"] == 100
    assert plain(compose(["task=classification", "data=modelnet40"]))["trainer"]["max_epochs"] == 20


def test_label_frame_sets_three_fields_and_each_can_be_set_alone():
    reference = compose(["model.label_frame=reference"]).model
    assert (reference.target, reference.group_frame, reference.projector_axes) == (
        "rotation", "standard", "published",
    )  # fmt: skip
    mixed = compose(["model.target=rotation"]).model
    assert (mixed.target, mixed.group_frame, mixed.projector_axes) == (
        "rotation", "conjugated", "raster",
    )  # fmt: skip
    with pytest.raises(OmegaConfBaseException) as error:
        plain(compose(["model.label_frame=wrong"]))
    assert readable(error.value).startswith("label_frame=wrong: allowed are consistent, reference")
    assert "full_key" not in readable(error.value)


def test_the_odd_stem_takes_one_pixel_more_and_a_smaller_coverage():
    config = compose(["scale=paper", "model.encoder.stem_mode=odd"])
    assert config.data.image_size == 129
    assert config.model.projector.coverage == 0.8
    assert compose(["scale=paper", "model/encoder=resnet18"]).data.image_size == 128


def test_an_unknown_option_is_refused_with_the_list_of_what_there_is():
    with pytest.raises(HydraException, match="modelnet40"):
        compose(["data=modelnet50"])
    with pytest.raises(HydraException, match="i2i"):
        compose(["model=i3i"])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("chair", "chair"),
        (["chair", "night stand"], "chair-night-stand"),
        ("a/b=c,d", "a-b-c-d"),
        ("", "none"),
    ],
)
def test_slugs_hold_only_characters_that_hydra_accepts_unquoted(given, expected):
    assert slug(given) == expected
