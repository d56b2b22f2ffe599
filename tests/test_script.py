"""Generated scripts: run in a fresh process, they reproduce the view bit for bit."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest

import core
from app.model.address import defaults, query_of
from app.model.colors import image_of
from app.model.large import LIMIT
from app.model.script import COMMANDS, script_of
from app.model.state import Comparison, State
from app.model.store import ASSETS, Answer, Pixel, Request, built_in_sources, file_source, inspect
from app.pages.catalog import PAGES
from app.pages.compare.ranking import run_task, tasks_of
from app.pages.inspect.results import inspect_pixel, predict
from app.pages.session import Session
from core import RangeImage
from core.io.readers.labelled import dataset
from core.tests.captures import CAPTURES
from tests.browser import ROOT
from tests.states import another, link_to, random_state

PAGE_NAMES = [page.name for page in PAGES]

NOT_CODE = {
    *("cloud_color", "unit", "kept", "unread", "study", "reported", "held", "echo_free"),
    *("learning", "present"),
}
"""Parameters without an effect on arrays: colours, units on axes, the estimate kept as A, a file
that could not be read, the sections of Trade-off and Paper, whose scripts name a command, what a
slider leaves alone, whether estimates are simulated without an echo, lessons, and slides."""

RUN_EACH = """
import os, runpy, sys
import numpy as np

for folder in sys.argv[1:]:
    os.chdir(folder)
    found = runpy.run_path("script.py")
    answers = {"image": found["image"]} | found.get("images", {})
    kept = {"picture": found.get("picture", 0)}
    for name, image in answers.items():
        kept |= {f"{name} {each}": plane.values for each, plane in image.planes.items()}
        kept[f"{name} made_by"] = str(image.made_by)
    for name, signals in ({"signals": found.get("signals")} | found.get("pinned", {})).items():
        if isinstance(signals, np.ndarray):
            kept[f"{name} score"] = signals
        elif signals is not None:
            kept |= {f"{name} {n}": each for n, each in signals._asdict().items()}
    if "region" in found:
        kept["region"] = found["region"].summed.cube
    if "expected" in found:
        kept["expected"] = found["expected"].expected
    if "pictures" in found:
        kept |= {f"{name} picture": each for name, each in found["pictures"].items()}
    np.savez("kept.npz", **kept)
"""


def opened(query: str, **files: Path) -> Session:
    sources = built_in_sources() | {name: file_source(path) for name, path in files.items()}
    session = Session(sources, link_to(query))
    assert session.refused == []
    return session


@dataclass(frozen=True)
class Scripted:
    """Sessions by name, what their scripts computed, and where."""

    sessions: dict[str, Session]
    arrays: dict[str, dict[str, np.ndarray]]
    folder: Path

    def one(self, name: str) -> tuple[Session, dict[str, np.ndarray]]:
        return self.sessions[name], self.arrays[name]


def run(folder: Path, sessions: dict[str, Session], *files: Path) -> Scripted:
    """Run the scripts of all sessions in one fresh process."""
    for name, session in sessions.items():
        (folder / name).mkdir()
        (folder / name / "script.py").write_text(script_of(session.answer, session.state), "utf-8")
        for file in files:
            (folder / name / file.name).symlink_to(file)
    check_style(folder)
    command = [sys.executable, "-c", RUN_EACH, *(str(folder / name) for name in sessions)]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    arrays = {name: dict(np.load(folder / name / "kept.npz")) for name in sessions}
    return Scripted(sessions, arrays, folder)


def check_style(folder: Path) -> None:
    """Check linter and formatter, with the project's rules and with defaults."""
    for arguments in (
        ("check", "--config", str(ROOT / "pyproject.toml")),
        ("check", "--isolated"),
        ("format", "--check", "--isolated"),
    ):
        command = [sys.executable, "-m", "ruff", *arguments, "--no-cache", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


def same(found: dict, name: str, expected) -> None:
    """Compare all arrays of a range image, or of signals, bit for bit."""
    if isinstance(expected, RangeImage):
        assert str(found[f"{name} made_by"]) == str(expected.made_by)
        whole = {each: plane.values for each, plane in expected.planes.items()}
    else:
        whole = expected._asdict()
    for each, numbers in whole.items():
        assert np.array_equal(found[f"{name} {each}"], numbers, equal_nan=True), each


def same_pixel(found: dict, name: str, pixel: Pixel) -> None:
    """Compare the stages of a pixel, or its score, bit for bit."""
    if pixel.signals is None:
        assert np.array_equal(found[f"{name} score"], pixel.score)
    else:
        same(found, name, pixel.signals)


# -- results ---------------------------------------------------------------------------------------

STATES = {
    "first": "",
    "budget": "budget.filter_nm=0.5&budget.reflectivity=0.3&light.n_pulses=300",
    "changed": "source=worn&light.sbr=0.3&light.n_pulses=500&light.seed=4&less.merge=2&less.pool=2"
    "&less.gate_from=0.1&less.pulses=0.7&absent=[%22jitter%22,%22pile_up%22]&tracking.l=0.01"
    "&tracking.n=500&tracking.m=1.5&tracking.alpha=0.3&tracking.t_n=10&tracking.weight=cubic"
    "&tracking.start=zero&image=Error&viewing.least_confidence=0.4"
    "&viewing.color_from_m=48&viewing.color_map=viridis&difference=true&pixel=[3,17]",
    "larger": "source=car_256&less.skip=3&image=Counts&absent=[%22signal_levels%22]",
    "inspected": "source=car&page=Inspect&map=SBR&plot=Fit&pins=[[1,2],[30,41]]&pixel=[12,13]"
    "&region=[[20,20],[20,50],[50,35.5]]&crop.pixels=region&crop.from_m=1"
    "&absent=[%22pulse_shape%22,%22reflectivity%22]",
    "another method": "source=sample&page=Inspect&method=likelihood&subject=Profile"
    "&pins=[[3,4],[9,14]]&region=[[1,2],[1,9],[7,5]]&settings.likelihood.steps_per_bin=4",
    "file": "source=sample&reading.bin_width_s=1.5e-9&image=Counts",
}


COMPARED = (
    "page=Compare&comparison.methods=[%22peak%22,%22kde%22,%22tracking%22,%22oracle%22]"
    "&comparison.false_alarm=0.1&settings.kde.bandwidth_bins=0.7&tracking.l=0.01"
)
FAR = CAPTURES / "21km_K11_night.mat"
N_RANDOM = 2


def random_session(seed: int) -> Session:
    state = random_state(np.random.default_rng(seed))
    state.param.update(source="car", page="Explore", pixel=(5, 6), region=(), pins=())
    state.param.update(window=None, image="Counts", comparison=State().comparison)
    return Session(built_in_sources(), link_to(query_of(state, {})))


def window_of_a_large_capture(path: Path) -> Session:
    scene = core.scenes["building"]()
    whole = core.simulate(scene, scene.acquisition, core.Flux(sbr=0.5))
    dataset(whole)[["counts"]].chunk(row=16, col=16).to_zarr(path, consolidated=False)
    query = "source=it&page=Inspect&map=Confidence&pixel=[3,4]"
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(LIMIT, "1")
        return opened(f"{query}&window.rows=[8,40]&window.cols=[20,60]", it=path)


@pytest.fixture(scope="module")
def scripted(tmp_path_factory) -> Scripted:
    """Sessions and what their scripts compute: starting a process takes seconds."""
    files = [ASSETS / "sample_capture.npz", tmp_path_factory.mktemp("made") / "large.zarr"]
    sessions = {
        **{name: opened(query) for name, query in STATES.items()},
        **{f"random {seed}": random_session(seed) for seed in range(N_RANDOM)},
        "compared": opened(
            COMPARED + "&comparison.kind=Error&comparison.viewing.least_confidence=0.5"
        ),
        "compared file": opened(COMPARED + "&source=sample"),
        "window": window_of_a_large_capture(files[-1]),
    }
    if FAR.exists():
        query = "source=it&less.pool=2&reading.n_pulses=20000&tracking.l=0.01&pixel=[60,70]"
        sessions["far"] = opened(query, it=FAR)
        files.append(FAR)
    return run(tmp_path_factory.mktemp("scripts"), sessions, *files)


def test_scripts_reproduce_the_screen(scripted):
    for name in STATES:
        session, found = scripted.one(name)
        answer, state = session.answer, session.state
        same(found, "image", answer.run.image)
        same_pixel(found, "signals", inspect(answer, *state.pixel))
        for file in ("range.png", "cloud.ply", "pixel.csv"):
            assert (scripted.folder / name / file).stat().st_size > 0
        if state.page != "Inspect":
            picture, _ = image_of(answer, state.image, state.viewing)
            assert np.array_equal(found["picture"], picture, equal_nan=True)


def test_a_script_reproduces_pins_region_box_and_map(scripted):
    session, found = scripted.one("inspected")
    answer, box = session.answer, session.state.box
    for pixel in ((1, 2), (30, 41)):
        same_pixel(found, str(pixel), inspect(answer, *pixel))
    mask = core.inspection.pixels_in(session.state.region, answer.capture.shape)
    assert np.array_equal(found["region"].ravel(), answer.capture.cube[mask].sum(axis=0))
    predicted = predict(inspect_pixel(answer, *session.state.pixel)).counts
    assert np.array_equal(found["expected"], predicted.expected)
    inside = answer.run.image.confident(0.9).cropped(box)
    cloud = scripted.folder / "inspected" / "cloud.ply"
    header = cloud.read_bytes().partition(b"end_header")[0]
    assert f"comment box: {box}\n".encode() in header
    assert f"element vertex {inside.valid.sum()}\n".encode() in header
    sbr = core.inspection.maps["SBR"](answer.capture)
    assert np.array_equal(found["picture"], sbr, equal_nan=True)


def test_scripts_of_random_states_run(scripted):
    """Bad settings give an image without ranges, and a script that runs."""
    for seed in range(N_RANDOM):
        session, found = scripted.one(f"random {seed}")
        same(found, "image", session.answer.run.image)
        same_pixel(found, "signals", inspect(session.answer, 5, 6))


def test_a_script_reproduces_a_real_capture(scripted, real_capture):
    assert real_capture(FAR.name) == FAR
    session, found = scripted.one("far")
    same(found, "image", session.answer.run.image)
    same_pixel(found, "signals", inspect(session.answer, 60, 70))
    assert str(FAR.parent) not in script_of(session.answer, session.state)


def test_a_script_reproduces_a_window_of_a_large_capture(scripted):
    """Its confidence follows from the flux prior of the whole capture."""
    session, found = scripted.one("window")
    same(found, "image", session.answer.run.image)
    same_pixel(found, "signals", inspect(session.answer, 3, 4))
    assert session.answer.capture.shape == (32, 40)
    alone = core.estimate(replace(session.answer.capture, flux_prior=None), "tracking")
    assert not np.array_equal(alone.confidence, found["image confidence"])


@pytest.mark.parametrize(("name", "kind"), [("compared", "Error"), ("compared file", "Estimate")])
def test_a_script_reproduces_the_comparison(scripted, name, kind):
    session, found = scripted.one(name)
    answer, chosen = session.answer, session.state.comparison
    for method, task in tasks_of(chosen, answer.request).items():
        if kind == "Estimate" and method == "oracle":
            assert "oracle range_m" not in found  # the file does not state its flux
            continue
        compared = run_task(task, answer).answer
        same(found, method, compared.run.image)
        picture, _ = image_of(compared, kind, chosen.viewing)
        assert np.array_equal(found[f"{method} picture"], picture, equal_nan=True)


# -- text ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def car() -> Answer:
    return opened("").answer


@pytest.mark.parametrize(("page", "command"), COMMANDS.items())
def test_the_title_names_the_command_of_a_page(page, command, car):
    script, usual = (script_of(car, State(page=each)) for each in (page, "Explore"))
    first, *rest = script.splitlines()
    assert first == f'"""Explore view of firstphoton ({page}: {command})."""'
    assert rest == usual.splitlines()[1:]


@pytest.mark.parametrize("name", sorted(defaults().keys() - NOT_CODE))
def test_every_parameter_is_in_the_script_of_some_page(name, car):
    """Fails for a new parameter or field that scripts ignore."""
    first = {"source": "sample" if name in ("reading", "window") else "worn"}
    if name == "settings":
        first["comparison"] = Comparison(methods=tuple(core.ESTIMATORS))
    if name == "crop":
        first["region"] = ((1, 2), (1, 9), (7, 5))
    for value in ["building"] if name == "source" else another(name):
        seen = [{"page": page, **first} for page in PAGE_NAMES]
        assert any(
            script_with(car, State(**one)) != script_with(car, State(**one | {name: value}))
            for one in seen
        )


def script_with(answer: Answer, state: State, **of_source: str) -> str:
    """Return the script of a state, without computing it."""
    chosen = {each.name: getattr(state, each.name) for each in fields(Request)}
    source = replace(built_in_sources()[state.source], **of_source)
    request = Request(**chosen | {"source": source})
    return script_of(replace(answer, request=request), state)


def test_a_name_from_outside_is_never_code(car):
    name = 'a"b\'c\n\\"""; import os #{x}\u2028%s.npz'
    text = script_with(car, State(source="sample"), name=name)
    (path,) = (
        node.value.value
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "path"
    )
    assert path == name
    assert text.replace("\n", "").isprintable()
