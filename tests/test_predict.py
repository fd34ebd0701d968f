"""The predict door on folders: which answer is where, and whose."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from i2i.configuration import compose, plain
from i2i.predict import predict
from i2i.runs.building import build_task, info_of


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    config = compose(["scale=tiny", "data=synthetic"])
    task = build_task(plain(config), info_of(config, ("chair",)))
    checkpoint = {"state_dict": task.state_dict()}
    task.on_save_checkpoint(checkpoint)
    (folder / "checkpoints").mkdir()
    torch.save(checkpoint, folder / "checkpoints" / "last.ckpt")
    return folder


def save(path, level):
    path.parent.mkdir(exist_ok=True)
    pixels = np.full((32, 32), 255, np.uint8)
    pixels[8:24, 4 : 4 + level] = 90
    Image.fromarray(pixels).save(path)
    return path


def door(run, given, output, *words):
    return predict(
        compose(
            [f"run={run}", f"input={given}", f"output={output}", "pictures=false", *words],
            "predict",
        )
    )


def inputs_answered(output):
    return sorted(json.loads(path.read_text())["input"] for path in output.glob("*.json"))


def test_files_of_one_name_keep_their_own_answers(run, tmp_path):
    """a/x.png, a/x.jpg and b/x.png; also when a command is typed again."""
    given = [save(tmp_path / name, 8 + 4 * i)
             for i, name in enumerate(["a/x.png", "a/x.jpg", "b/x.png", "b/x_2.png"])]  # fmt: skip
    output = tmp_path / "out"
    for _ in range(2):
        written = {**door(run, tmp_path / "a", output), **door(run, tmp_path / "b", output)}
        assert inputs_answered(output) == sorted(map(str, given))
        for path in given:
            assert json.loads(written[str(path)].read_text())["input"] == str(path)
    assert len(list(output.glob("*.json"))) == 4


def test_answers_without_a_known_owner_are_not_overwritten(run, tmp_path):
    output = tmp_path / "out"
    output.mkdir()
    (output / "x_pose.json").write_text('{"rotation": 1}')
    (output / "x_2_pose.json").write_text("not JSON")
    written = door(run, save(tmp_path / "x.png", 8), output)
    assert [path.name for path in written.values()] == ["x_3_pose.json"]
    assert (output / "x_pose.json").read_text() == '{"rotation": 1}'


def test_a_folder_is_answered_in_order_whatever_the_batch(run, tmp_path):
    for index in range(5):
        save(tmp_path / "in" / f"{index}.png", 4 + 3 * index)
    rotations = []
    for size in (1, 3):
        written = door(run, tmp_path / "in", tmp_path / str(size), f"batch_size={size}")
        assert [path.name for path in written.values()] == [f"{i}_pose.json" for i in range(5)]
        rotations.append([json.loads(p.read_text())["rotation"] for p in written.values()])
    np.testing.assert_allclose(*rotations, atol=1e-4)


def test_a_picture_is_drawn_unless_refused(run, tmp_path):
    picture = save(tmp_path / "x.png", 8)
    door(run, picture, tmp_path / "none")
    assert not list((tmp_path / "none").glob("*.png"))
    door(run, picture, tmp_path / "some", "pictures=true", "optimize=true")
    assert (tmp_path / "some" / "x_pose.png").stat().st_size > 1000
