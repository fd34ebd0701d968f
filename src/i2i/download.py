"""Fetch the meshes of a dataset: `python -m i2i.download data=modelnet40`."""

from pathlib import Path

from omegaconf import DictConfig

from i2i.cli import door
from i2i.data.download import download_dataset


def download(cfg: DictConfig) -> Path:
    """Download, verify and unpack; goes on with a transfer that was broken off.

    Args:
        cfg: The composed configuration of this door.

    Returns:
        The folder that holds the class folders.

    Raises:
        DownloadError: if the dataset cannot be had this way, or the transfer failed.
    """
    return download_dataset(
        cfg.data.name,
        cfg.data.root,
        urls=cfg.urls,
        checksum=cfg.checksum,
        keep_archive=cfg.keep_archive,
    )


@door("download")
def main(cfg: DictConfig) -> None:
    """Fetch the meshes of a dataset."""
    print(f"meshes {download(cfg)}")


if __name__ == "__main__":
    main()
