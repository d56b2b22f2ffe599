"""The wheel, installed outside the checkout; ``make wheel`` installs all dependencies, too."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from email import message_from_string
from zipfile import ZipFile

import pytest
from packaging.specifiers import SpecifierSet

import core
from tests.browser import ROOT
from tests.wheel import (
    build,
    describe_sample,
    install,
    outside,
    pythons,
    start_page,
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build(tmp_path_factory.mktemp("wheel"))


def test_the_wheel_has_types_and_data_and_no_tests(wheel):
    names = ZipFile(wheel).namelist()
    assert {"core/py.typed", "app/py.typed", "assets/car.npz"} <= set(names)
    assert {"core/report/cloud.js", "core/report/page.css"} <= set(names)
    assert "app/lessons/1-first-photon.md" in names
    own = [name for name in names if not name.startswith("app/lessons/")]
    assert not [name for name in own if "tests" in name or name.endswith((".png", ".md"))]


def test_the_installed_wheel_describes_the_sample_and_serves_the_app(wheel, tmp_path):
    commands = install(wheel, sys.executable, tmp_path / "env", dependencies=False)
    # The dependencies of the tests; their .pth files, which name the checkout, are not followed.
    (packages,) = commands.parent.glob("lib/python*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    _take_compiled_kernels(packages / "core")
    assert "Sample capture" in describe_sample(commands)
    assert "<title>firstphoton</title>" in start_page(commands)


def _take_compiled_kernels(installed):
    """Copy numba's cache of the checkout, which is valid for sources of the same size and time."""
    for source in installed.rglob("*.py"):
        original = ROOT / "core" / source.relative_to(installed)
        os.utime(source, (original.stat().st_atime, original.stat().st_mtime))
    for cached in (ROOT / "core").rglob("__pycache__/*.nb?"):
        copy = installed / cached.relative_to(ROOT / "core")
        copy.parent.mkdir(exist_ok=True)
        shutil.copy2(cached, copy)


def test_every_python_of_this_machine_accepts_the_wheel(wheel, tmp_path):
    """Only metadata and syntax: the dependencies are installed for one Python."""
    assert wheel.name == f"firstphoton-{core.__version__}-py3-none-any.whl"
    with ZipFile(wheel) as packed:
        packed.extractall(tmp_path)
    (metadata,) = tmp_path.glob("*.dist-info/METADATA")
    required = message_from_string(metadata.read_text("utf-8"))["Requires-Python"]
    found = pythons() | {"{}.{}".format(*sys.version_info): sys.executable}
    for version, python in found.items():
        assert version in SpecifierSet(required)
        compiling = [python, "-m", "compileall", "-q", tmp_path]
        subprocess.run(compiling, env=outside(), check=True)
