"""The built wheel brings its configuration along and runs without the clone."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with nothing but the unpacked wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation",
         "--wheel-dir", str(folder), str(ROOT)],
        check=True,
    )  # fmt: skip
    (wheel,) = folder.glob("i2i-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def run(installed, *words):
    # -P and the path in front: the editable install of the clone must not be what is found.
    script = f"import sys; sys.path.insert(0, {str(installed)!r}); "
    done = subprocess.run(
        [sys.executable, "-P", "-c", script + words[0], *words[1:]],
        cwd=installed.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_configuration_file_is_in_the_wheel(installed):
    shipped = {
        p.relative_to(installed / "i2i" / "conf")
        for p in (installed / "i2i" / "conf").rglob("*.yaml")
    }
    tracked = {p.relative_to(ROOT / "conf") for p in (ROOT / "conf").rglob("*.yaml")}
    assert {p for p in tracked if p.parts[0] != "local"} <= shipped
    assert (installed / "i2i" / "reports" / "paper.yaml").is_file()
    assert list((installed / "hydra_plugins" / "i2i_sweeper").glob("*.py"))


def test_the_installed_package_composes_and_shows_its_help(installed):
    printed = run(
        installed,
        "import i2i.configuration as c; print(c.config_dir()); "
        "print(c.plain(c.compose(['data=shapenet_bed']))['scale']['name']); "
        "words = {'download': ['data=modelnet40']}; "
        "doors = ('train', 'evaluate', 'predict', 'render', 'download', 'report', 'check', "
        "'export'); "
        "print(sum(len(c.compose(words.get(door, []), door)) > 0 for door in doors)); "
        "groups = {'data': 'data=', 'model': 'model=', 'scale': 'scale=', 'task': 'task='}; "
        "print(all(c.compose([word + p.stem]) for g, word in groups.items() "
        "for p in sorted((__import__('pathlib').Path(c.config_dir()) / g).glob('*.yaml'))))",
    ).split()
    assert printed == [str(installed / "i2i" / "conf"), "paper", "8", "True"]
    text = run(installed, "from i2i.train import main; main()", "--help")
    assert "model=i2i task=pose data=shapenet_bed" in text
    assert "shapenet55" in text


def test_the_installed_package_brings_its_compiled_code(installed):
    from i2i.nn import native

    printed = run(installed, "from i2i.nn import native; print(native.library())")
    assert ("None" in printed) == (native.library() is None)
    assert native.library() is None or str(installed) in printed
