"""Predictor: a fake network whose answer is known, against independent conversions and geometry."""

import json
import weakref

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import nn

from i2i.data.info import DataInfo
from i2i.errors import CheckpointError, ConfigurationError, ImageError
from i2i.models.prediction import ClassPrediction, PosePrediction
from i2i.network_input import see
from i2i.prediction_results import ClassResult
from i2i.predictor import Predictor
from i2i.rendering.mesh import prepare_mesh
from i2i.rendering.reference import save_mesh

INFO = DataInfo(("chair",), ("none",), channels=1, image_size=32, modality="gray")
JOINT = DataInfo(("chair", "stool"), ("none", "z"), channels=1, image_size=32, modality="gray")


def turned(*, about, by_deg, start=None):
    """A rotation, turned by an angle about an axis of the camera."""
    turn = Rotation.from_rotvec(np.radians(by_deg) * np.eye(3)["xyz".index(about)]).as_matrix()
    return turn if start is None else turn @ start


TRUE = Rotation.from_euler("xyz", [20.0, -35.0, 110.0], degrees=True).as_matrix()


class FakePose(nn.Module):
    """Says the same whatever it sees, and remembers what it was given."""

    def __init__(self, candidates, mass):
        super().__init__()
        self.candidates = torch.tensor(np.stack(candidates), dtype=torch.float32)
        self.mass = torch.tensor(mass, dtype=torch.float32)
        self.seen = {}

    def forward(self, batch):
        self.seen = batch
        best = int(self.mass.argmax())
        return PosePrediction(
            rotation=self.candidates[None, best],
            log_prob=self.mass.log()[None],
            candidates=self.candidates[None],
        )


class FakeRegressor(nn.Module):
    def forward(self, batch):
        return PosePrediction(rotation=torch.tensor(TRUE, dtype=torch.float32)[None])


class FakeClassifier(nn.Module):
    def forward(self, batch):
        return ClassPrediction(logits=torch.tensor([[0.0, 2.0]]), descriptor=torch.zeros(1, 2))


class FakeRows(nn.Module):
    """A classifier of any number of pictures."""

    def forward(self, batch):
        logits = torch.zeros(len(batch["image"]), 2)
        return ClassPrediction(logits=logits, descriptor=logits)


@pytest.fixture
def pose():
    others = [turned(about="x", by_deg=angle, start=TRUE) for angle in (5.0, 90.0, 150.0, -60.0)]
    return FakePose([others[0], TRUE, *others[1:]], [0.1, 0.5, 0.2, 0.15, 0.05])


@pytest.fixture
def picture():
    pixels = np.full((32, 32), 255, dtype=np.uint8)
    pixels[8:24, 12:20] = 90
    return Image.fromarray(pixels)


def l_shape():
    foot = trimesh.creation.box((1.0, 0.4, 0.2))
    post = trimesh.creation.box((0.2, 0.4, 1.2))
    post.apply_translation((0.4, 0.0, 0.6))
    return prepare_mesh(trimesh.util.concatenate([foot, post]))


def test_every_form_of_the_rotation_is_the_same_rotation(pose, picture):
    result = Predictor(pose, INFO).predict(picture)
    np.testing.assert_allclose(result.rotation, TRUE, atol=1e-6)
    from_quaternion = Rotation.from_quat(result.quaternion_xyzw).as_matrix()  # scipy: scalar last
    np.testing.assert_allclose(from_quaternion, TRUE, atol=1e-6)
    from_euler = Rotation.from_euler("xyz", result.euler_deg, degrees=True).as_matrix()
    np.testing.assert_allclose(from_euler, TRUE, atol=1e-6)
    assert result.class_name == "chair"
    assert result.warnings == ()


def test_candidates_that_agree_are_one_answer(pose, picture):
    result = Predictor(pose, INFO).predict(picture)
    assert result.confidence == pytest.approx(0.6)  # 0.5 and the one 5° beside it
    masses = [other.probability for other in result.alternatives]
    assert masses == pytest.approx([0.2, 0.15, 0.05])
    np.testing.assert_allclose(
        result.alternatives[0].rotation, turned(about="x", by_deg=90, start=TRUE), atol=1e-6
    )


def test_under_symmetry_turns_about_the_object_axis_are_one_answer(picture):
    spun = [TRUE @ turned(about="z", by_deg=angle) for angle in (0.0, 100.0, 200.0)]
    tipped = turned(about="x", by_deg=90.0, start=TRUE)
    network = FakePose([*spun, tipped], [0.4, 0.2, 0.2, 0.2])
    plain = Predictor(network, JOINT).predict(picture, class_name="chair")
    symmetric = Predictor(network, JOINT).predict(picture, class_name="stool")
    assert plain.confidence == pytest.approx(0.4)
    assert symmetric.confidence == pytest.approx(0.8)
    assert [other.probability for other in symmetric.alternatives] == pytest.approx([0.2])


def test_no_more_than_three_alternatives_the_most_probable_first(picture):
    rotations = [turned(about="y", by_deg=40.0 * k, start=TRUE) for k in range(9)]
    mass = np.array([1, 9, 2, 8, 3, 7, 4, 6, 5]) / 45
    result = Predictor(FakePose(rotations, mass), INFO).predict(picture)
    assert [a.probability for a in result.alternatives] == pytest.approx([8 / 45, 7 / 45, 6 / 45])


def test_network_gets_the_picture_in_training_form(pose, picture):
    Predictor(pose, JOINT).predict(picture, class_name="stool")
    assert pose.seen["class_id"].tolist() == [1]
    np.testing.assert_allclose(
        pose.seen["image"].numpy()[0, 0], np.asarray(picture) / 255.0, atol=1e-6
    )
    assert not pose.training


def test_intrinsics_agree_with_a_pinhole_camera(pose):
    """An object that is really turned by TRUE to its own viewing ray, off the optical axis."""
    pixels = np.zeros((240, 320, 4), dtype=np.uint8)
    pixels[20:60, 240:280] = 255
    focal, cx, cy = 280.0, 160.0, 120.0
    result = Predictor(pose, INFO).predict(pixels, intrinsics=(focal, focal, cx, cy))
    # What the crop calls "towards its camera" is, in the real camera, minus the viewing ray.
    ray = np.array([(260.0 - cx) / focal, -(40.0 - cy) / focal, -1.0])
    ray /= np.linalg.norm(ray)
    np.testing.assert_allclose(result.rotation @ (TRUE.T @ [0.0, 0.0, -1.0]), ray, atol=1e-6)
    # The turn between the two cameras is the angle between their axes: there is no roll.
    turn = Rotation.from_matrix(result.rotation @ TRUE.T)
    assert turn.magnitude() == pytest.approx(np.arccos(-ray[2]), abs=1e-6)
    for other, angle in zip(result.alternatives, (90.0, 150.0, -60.0), strict=True):
        expected = turn.as_matrix() @ turned(about="x", by_deg=angle, start=TRUE)
        np.testing.assert_allclose(other.rotation, expected, atol=1e-6)


def test_a_network_without_a_distribution_has_no_confidence(picture, tmp_path):
    result = Predictor(FakeRegressor(), INFO).predict(picture)
    assert result.confidence is None
    assert result.alternatives == ()
    assert "confidence" not in str(result)
    assert result.draw(tmp_path / "pose.png").stat().st_size > 1000


def test_classes_with_probabilities(picture, tmp_path):
    result = Predictor(FakeClassifier(), JOINT).predict(picture)
    assert result.class_name == "stool"
    assert result.confidence == pytest.approx(np.exp(2) / (1 + np.exp(2)))
    assert list(result.probabilities) == ["stool", "chair"]
    assert sum(result.probabilities.values()) == pytest.approx(1.0)
    assert json.loads(json.dumps(result.to_dict()))["class_name"] == "stool"
    assert result.draw(tmp_path / "class.png").stat().st_size > 1000


def test_text_and_plain_data_say_everything(pose, picture):
    result = Predictor(pose, INFO).predict(picture)
    text = str(result)
    for word in ("rotation", "quaternion xyzw", "Euler", "confidence      60.0%", "alternative 3"):
        assert word in text
    assert "20.0%, 90° away" in text
    plain = json.loads(json.dumps(result.to_dict()))
    np.testing.assert_allclose(plain["rotation"], TRUE, atol=1e-6)
    assert len(plain["alternatives"]) == 3


def test_drawing_shows_the_mesh_as_the_crop_shows_it(pose, picture, tmp_path):
    predictor = Predictor(pose, INFO, reference_meshes={"chair": l_shape()})
    result = predictor.predict(picture, intrinsics=(50.0, 50.0, 80.0, 0.0))
    without = Predictor(pose, INFO).predict(picture)
    with_mesh = np.asarray(Image.open(result.draw(tmp_path / "new" / "pose.png")).convert("RGB"))
    blank = np.asarray(Image.open(without.draw(tmp_path / "blank.png")).convert("RGB"))
    assert with_mesh.shape[1] > blank.shape[1]  # a panel for each alternative
    assert not list(tmp_path.rglob(".*"))  # nothing half-written is left behind


def test_reference_meshes_come_from_the_run_folder(pose, tmp_path):
    (tmp_path / "reference_meshes").mkdir()
    save_mesh(l_shape(), tmp_path / "reference_meshes" / "stool.npz")
    predictor = Predictor(pose, JOINT, run_folder=tmp_path)
    assert list(predictor.reference_meshes) == ["stool"]


def test_class_is_needed_and_must_be_known(pose, picture):
    with pytest.raises(ConfigurationError, match="class_name=, one of chair, stool"):
        Predictor(pose, JOINT).predict(picture)
    with pytest.raises(ConfigurationError, match="Allowed: chair, stool"):
        Predictor(pose, JOINT).predict(picture, class_name="sofa")


def test_depth_network_says_that_photographs_are_no_depth(pose, picture):
    info = DataInfo(("chair",), ("none",), channels=1, image_size=32, modality="depth")
    assert any("depth" in text for text in Predictor(pose, info).predict(picture).warnings)


def test_diverged_network_and_bad_picture(pose, tmp_path):
    with pytest.raises(ImageError, match="does not exist"):
        Predictor(pose, INFO).predict(tmp_path / "nothing.png")
    pose.candidates = pose.candidates * float("nan")
    with pytest.raises(CheckpointError, match="not a finite number"):
        Predictor(pose, INFO).predict(np.full((32, 32), 255, np.uint8))


def test_many_pictures_are_answered_in_their_order_as_one_by_one(tmp_path):
    """A network whose answer depends on the picture; the last batch is not full."""

    class Brightness(nn.Module):
        def forward(self, batch):
            sizes.append(len(batch["image"]))
            mean = batch["image"].mean(dim=(1, 2, 3))
            logits = torch.stack([torch.zeros_like(mean), 5 * mean], dim=1)
            return ClassPrediction(logits=logits, descriptor=logits)

    sizes: list[int] = []
    predictor = Predictor(Brightness(), JOINT)
    pictures = [np.full((32, 32), level, np.uint8) for level in range(0, 250, 25)]
    many = [r.probabilities["stool"] for r in predictor.predict_many(pictures, batch_size=4)]
    assert sizes == [4, 4, 2]
    one_by_one = [predictor.predict(picture).probabilities["stool"] for picture in pictures]
    assert many == pytest.approx(one_by_one, abs=1e-6)
    assert many == sorted(many)
    assert many[0] < many[-1]


def test_candidates_of_each_picture_stay_with_it():
    class Turning(nn.Module):
        """One candidate a picture, turned by its brightness."""

        def forward(self, batch):
            degrees = (90 * batch["image"].mean(dim=(1, 2, 3))).tolist()
            found = torch.tensor(np.stack([turned(about="z", by_deg=d) for d in degrees])).float()
            other = found @ torch.tensor(turned(about="x", by_deg=90.0)).float()
            mass = torch.tensor([0.75, 0.25]).log().expand(len(found), 2)
            return PosePrediction(found, log_prob=mass, candidates=torch.stack([found, other], 1))

    pictures = [np.full((32, 32), level, np.uint8) for level in (0, 85, 170, 255)]
    results = list(Predictor(Turning(), INFO).predict_many(pictures))
    for degrees, result in zip((0, 30, 60, 90), results, strict=True):
        expected = turned(about="z", by_deg=degrees)
        np.testing.assert_allclose(result.rotation, expected, atol=1e-5)
        np.testing.assert_allclose(
            result.alternatives[0].rotation, expected @ turned(about="x", by_deg=90.0), atol=1e-5
        )
        assert result.confidence == pytest.approx(0.75, abs=1e-6)


def test_a_bad_picture_is_told_in_its_turn(tmp_path):
    pictures = [np.full((32, 32), 255, np.uint8), np.zeros((32, 32), np.uint8), tmp_path / "no.png"]
    answered = []
    with pytest.raises(ImageError, match=r"no\.png"):
        answered.extend(Predictor(FakeRows(), JOINT).predict_many(pictures))
    stream = Predictor(FakeRows(), JOINT).predict_many(pictures)
    assert [type(next(stream)), type(next(stream))] == [ClassResult, ClassResult]
    with pytest.raises(ImageError, match=r"no\.png"):
        next(stream)


@pytest.mark.parametrize("read_ahead", [None, False, True])
def test_pictures_are_taken_no_more_than_two_batches_ahead(read_ahead):
    """A folder of any size fits into memory."""
    taken = 0

    def endless():
        nonlocal taken
        while True:
            taken += 1
            yield np.full((32, 32), 255, np.uint8)

    stream = Predictor(FakeRows(), JOINT).predict_many(
        endless(), batch_size=4, read_ahead=read_ahead
    )
    for number in range(20):
        next(stream)
        assert taken == 4 * (number // 4 + (2 if read_ahead else 1))


@pytest.mark.parametrize("read_ahead", [False, True])
def test_no_more_than_two_batches_are_held(read_ahead, monkeypatch):
    """Of what was read, counted whenever one more is."""
    alive, counts = set(), []

    def watched(*given, **how):
        seen = see(*given, **how)
        alive.add(id(seen))
        weakref.finalize(seen, alive.discard, id(seen))
        counts.append(len(alive))
        return seen

    monkeypatch.setattr("i2i.predictor.see", watched)
    picture = np.full((32, 32), 255, np.uint8)
    predictor = Predictor(FakeRows(), JOINT)
    results = predictor.predict_many([picture] * 40, batch_size=4, read_ahead=read_ahead)
    for result in results:
        del result
    assert max(counts) == (8 if read_ahead else 4)


def test_batches_of_nothing_are_refused():
    with pytest.raises(ConfigurationError, match="batch_size=0"):
        next(Predictor(FakeRows(), JOINT).predict_many([], batch_size=0))
