"""Figures without pyplot: pixels, files, no global state."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from i2i.viz.style import figure_to_array, new_figure, save_figure


def test_figure_becomes_pixels_of_its_size():
    figure = new_figure(3.0, 2.0)
    figure.set_facecolor((1.0, 0.0, 0.0))
    pixels = figure_to_array(figure)
    assert pixels.shape == (200, 300, 3)
    assert pixels.dtype == np.uint8
    assert (pixels[0, 0] == (255, 0, 0)).all()


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_saving_makes_folders_and_leaves_one_file(tmp_path, suffix):
    path = save_figure(new_figure(2.0, 1.0), tmp_path / "a" / f"figure{suffix}")
    assert list(path.parent.iterdir()) == [path]
    if suffix == ".png":
        assert Image.open(path).size == (240, 120)


def test_pyplot_is_never_imported():
    code = "import sys, i2i.viz; assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
