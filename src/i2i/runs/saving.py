"""Writing checkpoints so that the last one is whole whatever happens."""

import os
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins import TorchCheckpointIO


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the target and renames, so that a reader sees the old or the new checkpoint.

    Lightning's own writes into the folder of temporary files; where that is another file system the
    move into place is a copy, and who is killed meanwhile is left with neither.
    """

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: str | os.PathLike[str],
        storage_options: Any = None,  # noqa: ANN401 - Lightning's own
    ) -> None:
        """Write a checkpoint.

        Raises:
            OSError: if it cannot be written, such as on a full disk; an earlier one is left whole.
        """
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            with temporary.open("wb") as stream:
                torch.save(checkpoint, stream)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
