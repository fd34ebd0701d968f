"""Reading pictures of every kind (file, PIL image, array) into plain arrays, with clear errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from i2i.errors import ImageError

Picture = str | Path | Image.Image | np.ndarray
"""What a picture or a mask can be given as."""

_EXIF_ORIENTATION = 0x0112


def read_picture(
    picture: Picture, *, what: str, warnings: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Read a picture as colour and alpha.

    Args:
        picture: Path, PIL image, or array (H, W), (H, W, 1 | 3 | 4), uint8, uint16 or float.
        what: What the messages call it, such as ``"image"``.
        warnings: Sentences for the user are appended here.

    Returns:
        Colour, shape (H, W, 3), and alpha, shape (H, W), float32 in [0, 1].

    Raises:
        ImageError: if it cannot be read, with what to do about it.
    """
    if isinstance(picture, np.ndarray):
        values = _array_values(picture, what=what)
    elif isinstance(picture, Image.Image):
        values = _image_values(picture, warnings=warnings)
    elif isinstance(picture, str | Path):
        values = _file_values(Path(picture), what=what, warnings=warnings)
    else:
        raise ImageError(
            f"The {what} is a {type(picture).__name__}; give a path, a PIL image or a numpy array."
        )
    if min(values.shape[:2]) < 2:
        raise ImageError(f"The {what} has {values.shape[1]}×{values.shape[0]} px: too small.")
    alpha = values[..., 3] if values.shape[2] == 4 else np.ones(values.shape[:2], dtype=np.float32)
    return np.broadcast_to(values[..., :3], (*values.shape[:2], 3)), alpha


def _file_values(path: Path, *, what: str, warnings: list[str]) -> np.ndarray:
    """Decode a file; every way in which that fails becomes an `ImageError`."""
    if not path.is_file():
        kind = "is a folder" if path.is_dir() else "does not exist"
        raise ImageError(f"The {what} {str(path)!r} {kind}. Give the path of a PNG or JPEG file.")
    try:
        with Image.open(path) as image:
            return _image_values(image, warnings=warnings)
    except UnidentifiedImageError as error:
        raise ImageError(
            f"The {what} {str(path)!r} is not a picture that can be read ({path.stat().st_size} "
            "bytes). Give a PNG, JPEG, WebP, BMP or TIFF file; a mesh goes into data.root=."
        ) from error
    except Image.DecompressionBombError as error:
        raise ImageError(f"The {what} {str(path)!r} is too large: scale it down first.") from error
    except (OSError, SyntaxError, ValueError) as error:  # PIL reports broken files as any of these
        raise ImageError(
            f"The {what} {str(path)!r} is truncated or damaged ({error}). Copy or save it again."
        ) from error


def _image_values(image: Image.Image, *, warnings: list[str]) -> np.ndarray:
    """Pixels of a PIL image of any mode, upright, (H, W, 1 | 3 | 4) in [0, 1]."""
    if image.getexif().get(_EXIF_ORIENTATION, 1) != 1:
        warnings.append(
            "The picture carries an EXIF orientation and was put upright: mask, box and "
            "intrinsics are read in pixels of the upright picture."
        )
        image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I;16") or image.mode == "I":
        return _array_values(np.asarray(image, dtype=np.uint16), what="image")
    if image.mode == "F":
        return _array_values(np.asarray(image), what="image")
    has_alpha = "A" in image.getbands() or "transparency" in image.info
    is_gray = image.mode == "L" and not has_alpha
    shown = image if is_gray else image.convert("RGBA" if has_alpha else "RGB")
    values = np.asarray(shown).astype(np.float32)
    values /= 255.0
    return values[..., None] if is_gray else values


def _array_values(array: np.ndarray, *, what: str) -> np.ndarray:
    """Pixels of an array as (H, W, 1 | 3 | 4) float32 in [0, 1]."""
    values = array[..., None] if array.ndim == 2 else array
    if values.ndim != 3 or values.shape[2] not in (1, 3, 4):
        raise ImageError(
            f"The {what} is an array of shape {array.shape}; allowed are (H, W), (H, W, 1), "
            "(H, W, 3) and (H, W, 4): channels last."
        )
    if values.dtype == bool:
        return values.astype(np.float32)
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float32) / (65535.0 if values.dtype == np.uint16 else 255.0)
    values = values.astype(np.float32)
    if not np.isfinite(values).all() or values.min() < 0.0 or values.max() > 1.0:
        raise ImageError(
            f"The {what} is an array of floats outside [0, 1] or not finite "
            f"(min {values.min():.3g}, max {values.max():.3g}); divide by 255 first."
        )
    return values


def read_mask(mask: Picture, *, shape: tuple[int, ...]) -> np.ndarray:
    """Read a mask as coverage; its alpha where it has one, else its brightness.

    Args:
        mask: Picture that is non-zero on the object; its largest value counts as fully covered.
        shape: (height, width) that it must have.

    Returns:
        Coverage, shape (H, W), float32 in [0, 1].

    Raises:
        ImageError: if it cannot be read, has another size or is empty.
    """
    if isinstance(mask, np.ndarray) and np.issubdtype(mask.dtype, np.signedinteger):
        mask = mask != 0  # label maps
    color, alpha = read_picture(mask, what="mask", warnings=[])
    values = color.mean(axis=2) if alpha.min() == 1.0 else alpha
    if values.shape != shape:
        raise ImageError(
            f"The mask has {values.shape[1]}×{values.shape[0]} px, the picture "
            f"{shape[1]}×{shape[0]}: give a mask of the same size."
        )
    if values.max() <= 0.0:
        raise ImageError("The mask is empty: it must be non-zero (white) where the object is.")
    return values / values.max()
