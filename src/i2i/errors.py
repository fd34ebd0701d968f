"""Errors that a user can cause; each says what was given, what is allowed, what to type next."""


class I2IError(Exception):
    """Base class of the errors that i2i raises on purpose; doors print them without a traceback."""


class ConfigurationError(I2IError):
    """Settings that do not fit together, such as a model that has no network for the task."""


class DatasetNotFoundError(I2IError):
    """Meshes or images that are not where the configuration says."""


class MeshError(I2IError):
    """A mesh file that is empty, truncated, not a mesh, or holds non-finite numbers."""


class ImageError(I2IError):
    """A picture that cannot be read as one."""


class RendererUnavailableError(I2IError):
    """A renderer whose system library is missing."""


class StoreMismatchError(I2IError):
    """A rendered store that was made with other settings than the ones asked for."""


class StoreError(I2IError):
    """A rendered store that cannot be read or written."""


class DownloadError(I2IError):
    """A transfer that failed or brought something else than the archive."""


class CheckpointError(I2IError):
    """A checkpoint of another version, or one that does not fit the network."""


class NonFiniteLossError(I2IError):
    """Training met a loss that is not a finite number."""
