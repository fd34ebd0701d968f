"""What installing compiles: `hatch_build.py`."""

import importlib.util
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def hatch_build():
    pytest.importorskip("hatchling", reason="what builds the package is not here")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def sources(tmp_path):
    (tmp_path / "some.cpp").write_text('extern "C" int answer() { return 42; }')
    return tmp_path


def test_libraries_are_made_once_for_their_sources(hatch_build, sources):
    if not (shutil.which("c++") or shutil.which("g++")):
        pytest.skip("no C++ compiler here")
    warnings = []
    built = hatch_build.build(warnings.append, sources)
    assert built
    assert not warnings
    times = [path.stat().st_mtime_ns for path in built]
    assert hatch_build.build(warnings.append, sources) == built
    assert [path.stat().st_mtime_ns for path in built] == times
    (sources / "some.cpp").write_text('extern "C" int answer() { return 43; }')
    assert not {path.name for path in hatch_build.build(warnings.append, sources)} & {
        path.name for path in built
    }
    assert not any(path.exists() for path in built)  # the old ones are gone


@pytest.mark.parametrize("compiler", ["/nowhere/c++", "false --really"])
def test_a_compiler_that_fails_is_a_warning(hatch_build, sources, monkeypatch, compiler):
    monkeypatch.setenv("CXX", compiler)
    warnings = []
    assert hatch_build.build(warnings.append, sources) == []
    assert all("is not built" in text for text in warnings)
    assert warnings
    assert [path.name for path in sources.iterdir()] == ["some.cpp"]


def test_it_can_be_declined(hatch_build, sources, monkeypatch):
    monkeypatch.setenv("I2I_NO_COMPILER", "1")
    assert hatch_build.build(lambda text: None, sources) == []


def test_the_package_finds_what_was_built(hatch_build):
    from i2i.nn import native

    library = native.library()
    if library is None:
        pytest.skip("no compiler was found when i2i was installed")
    assert hatch_build.digest_of(hatch_build.FOLDER) in library._name
