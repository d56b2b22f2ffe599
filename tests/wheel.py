"""The wheel outside the checkout: ``make wheel`` installs it on every supported Python found here.

Each Python gets a fresh environment with all dependencies. There the wheel must describe the
sample capture and serve the start page. This downloads about 1 GB for three Pythons; the suite
checks the same on its own Python with the dependencies that are installed already (`test_wheel`).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from urllib.request import urlopen

from app.server.ports import free_port
from tests.browser import ROOT, when_up

SUPPORTED = ("3.11", "3.12", "3.13")

SAMPLE = "from importlib import resources; print(resources.files('assets') / 'sample_capture.npz')"


def pythons() -> dict[str, str]:
    """Return an interpreter of each supported version that this machine has."""
    found = {}
    for version in SUPPORTED:
        installed = Path.home().glob(f".pyenv/versions/{version}.*/bin/python{version}")
        for candidate in (shutil.which(f"python{version}"), *installed):
            # pyenv puts a stub on the path for versions that are not enabled.
            if candidate and _runs(candidate):
                found[version] = str(candidate)
                break
    return found


def _runs(python: str | Path) -> bool:
    return subprocess.run([python, "-V"], check=False, capture_output=True).returncode == 0


def build(folder: Path) -> Path:
    """Build the wheel and return its path."""
    _pip("wheel", "--no-deps", "--wheel-dir", str(folder), str(ROOT))
    (wheel,) = folder.glob("firstphoton-*.whl")
    return wheel


def install(wheel: Path, python: str, folder: Path, *, dependencies: bool) -> Path:
    """Install the wheel into a new environment and return its folder of commands."""
    subprocess.run([python, "-m", "venv", "--without-pip", folder], check=True)
    commands = folder / "bin"
    options = (
        ("--constraint", str(ROOT / "constraints.txt"))
        if dependencies
        else ("--no-deps", "--no-compile")
    )
    requirement = f"{wheel}[app]" if dependencies else str(wheel)
    _pip("--python", str(commands / "python"), "install", *options, requirement)
    return commands


def run(command: Path, *arguments: str) -> str:
    """Run an installed command outside the checkout and return what it prints."""
    return subprocess.run(
        [command, *arguments],
        cwd=command.parent,
        env=outside(),
        check=True,
        text=True,
        stdout=subprocess.PIPE,
    ).stdout.strip()


def describe_sample(commands: Path) -> str:
    """Return the installed command line's description of the installed sample capture."""
    sample = run(commands / "python", "-c", SAMPLE)
    assert Path(sample).is_relative_to(commands.parent), f"{sample} is outside the environment"
    return run(commands / "firstphoton-core", "info", sample)


def start_page(commands: Path) -> str:
    """Return the page that the installed app serves."""
    port = free_port()
    with (
        TemporaryFile("w+") as log,
        subprocess.Popen(
            [commands / "firstphoton", "--port", str(port)],
            cwd=commands,
            env=outside(),
            stdout=log,
            stderr=subprocess.STDOUT,
        ) as server,
    ):
        try:
            address = when_up(f"http://127.0.0.1:{port}/", server, log, limit_s=600.0)
            with urlopen(address, timeout=120) as page:
                text: str = page.read().decode()
                return text
        finally:
            server.terminate()


def outside() -> dict[str, str]:
    """Return an environment in which Python does not find the checkout."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def _pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*command, *arguments], check=True)


def main() -> int:
    """Check every supported Python of this machine; returns the exit code."""
    found = pythons()
    with TemporaryDirectory() as folder:
        wheel = build(Path(folder))
        for version in SUPPORTED:
            if version not in found:
                print(f"Python {version}: not on this machine", flush=True)
                continue
            commands = install(wheel, found[version], Path(folder) / version, dependencies=True)
            assert "Sample capture" in describe_sample(commands)
            assert "<title>firstphoton</title>" in start_page(commands)
            print(f"Python {version}: describes the sample and serves the app", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
