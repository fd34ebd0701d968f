"""A task and a data module of two pixels, run by the real Trainer."""

import lightning
import numpy as np
import torch
import trimesh
from lightning.pytorch.loggers import TensorBoardLogger
from scipy.spatial.transform import Rotation
from torch.utils.data import DataLoader

from i2i.data.info import DataInfo
from i2i.models.prediction import ClassPrediction, PosePrediction
from i2i.rendering.mesh import prepare_mesh

INFO = DataInfo(("chair",), ("none",), channels=1, image_size=16, modality="gray")
ERRORS_DEG = np.array([1.0, 10.0, 40.0, 90.0, 170.0, 3.0])


class Samples(torch.utils.data.Dataset):
    def __init__(self, broken=None):
        self.true = Rotation.random(6, random_state=1).as_matrix()
        self.broken = broken

    def __len__(self):
        return 6

    def __getitem__(self, index):
        image = torch.full((1, 16, 16), index / 10)
        if index == self.broken:
            image[0, 0, 0] = float("nan")
        return {
            "image": image,
            "rotation": torch.tensor(self.true[index], dtype=torch.float32),
            "class_id": torch.tensor(0),
            "instance_id": torch.tensor(100 + index),
            "view_id": torch.tensor(index),
        }


class FakeTask(lightning.LightningModule):
    """Predicts every sample with the error that `ERRORS_DEG` says."""

    def __init__(self, *, explode_at=None, classes=False):
        super().__init__()
        self.info = INFO
        self.run_config = {"model": {"name": "fake"}, "paths": {"root": "/x"}, "seed": 0}
        self.layer = torch.nn.Linear(1, 1)
        self.explode_at, self.classes = explode_at, classes

    def predict(self, batch):
        if self.classes:
            count = len(batch["image"])
            return ClassPrediction(torch.ones(count, 1), torch.ones(count, 1))
        off = torch.deg2rad(torch.tensor(ERRORS_DEG, dtype=torch.float32)[batch["view_id"]])
        turn = Rotation.from_rotvec(off[:, None].numpy() * [[0.0, 1.0, 0.0]]).as_matrix()
        return PosePrediction(torch.tensor(turn, dtype=torch.float32) @ batch["rotation"])

    def training_step(self, batch, batch_idx):
        loss = self.layer(batch["image"].mean(dim=(1, 2, 3))[:, None]).square().mean()
        if self.explode_at == ("loss", batch_idx):
            loss = loss * float("inf")
        if self.explode_at == ("gradient", batch_idx):  # finite loss, infinite slope at zero
            loss = loss + (self.layer.weight - self.layer.weight.detach()).abs().sqrt().sum()
        self.log("train/loss", loss)
        return loss

    def validation_step(self, batch, batch_idx):
        self.log("val/score", 1.0)
        return {"prediction": self.predict(batch), "batch": batch}

    def test_step(self, batch, batch_idx):
        self.log("test/median_error_deg", 25.0)
        self.log("test/odd", float("nan"))
        return {"prediction": self.predict(batch), "batch": batch}

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.01)


class FakeData(lightning.LightningDataModule):
    def __init__(self, *, mesh=True, broken=None):
        super().__init__()
        self.broken, self.asked = broken, []
        self.mesh = prepare_mesh(trimesh.creation.icosphere(1)) if mesh is True else mesh

    def reference_mesh(self, class_name):
        self.asked.append(class_name)
        return self.mesh

    def train_dataloader(self):
        return DataLoader(Samples(self.broken), batch_size=2)

    def val_dataloader(self):
        return DataLoader(Samples(), batch_size=2)

    test_dataloader = val_dataloader


def make_trainer(folder, *callbacks, **settings):
    logger = TensorBoardLogger(folder, name="", version="", default_hp_metric=False)
    return lightning.Trainer(
        **{
            "max_epochs": 1, "accelerator": "cpu", "logger": logger, "callbacks": list(callbacks),
            "enable_progress_bar": False, "enable_model_summary": False, "log_every_n_steps": 1,
            "num_sanity_val_steps": 0, "default_root_dir": str(folder),
            "enable_checkpointing": False, **settings,
        }
    )  # fmt: skip
