"""Generated scripts: run in a fresh process, they reproduce the view bit for bit."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
import pytest

import core
from app.model.address import Link, defaults, query_of
from app.model.colors import image_of
from app.model.large import LIMIT
from app.model.script import COMMANDS, script_of
from app.model.state import Comparison, State
from app.model.store import ASSETS, Answer, Pixel, Request, built_in_sources, file_source, inspect
from app.pages.catalog import PAGES
from app.pages.compare.ranking import run_task, tasks_of
from app.pages.session import Session
from core.io.readers.labelled import dataset
from tests.browser import ROOT
from tests.states import another, random_state

PAGE_NAMES = [page.name for page in PAGES]

NOT_CODE = {"cloud_color", "unit", "kept"}
"""Parameters without an effect on arrays: colours, units on axes, and the estimate kept as A."""

RUN_EACH = """
import os, runpy, sys
import numpy as np

for folder in sys.argv[1:]:
    os.chdir(folder)
    found = runpy.run_path("script.py")
    answers = {"image": found["image"]} | found.get("images", {})
    kept = {"picture": found.get("picture", 0)}
    for name, image in answers.items():
        kept |= {f"{name} {each}": value for each, value in vars(image).items()}
        kept[f"{name} made_by"] = str(image.made_by)
    for name, signals in ({"signals": found.get("signals")} | found.get("pinned", {})).items():
        if isinstance(signals, np.ndarray):
            kept[f"{name} score"] = signals
        elif signals is not None:
            kept |= {f"{name} {n}": each for n, each in signals._asdict().items()}
    if "region" in found:
        kept["region"] = found["region"].summed.cube
    if "pictures" in found:
        kept |= {f"{name} picture": each for name, each in found["pictures"].items()}
    np.savez("kept.npz", **kept)
"""


def opened(query: str, **files: Path) -> Session:
    sources = built_in_sources() | {name: file_source(path) for name, path in files.items()}
    session = Session(sources, Link(dict(parse_qsl(query))))
    assert session.refused == []
    return session


def run(folder: Path, sessions: dict[str, Session], *files: Path) -> dict[str, dict]:
    """Arrays that each session's script computes, all in one fresh process."""
    for name, session in sessions.items():
        (folder / name).mkdir()
        (folder / name / "script.py").write_text(script_of(session.answer, session.state), "utf-8")
        for file in files:
            copy = shutil.copytree if file.is_dir() else shutil.copy
            copy(file, folder / name / file.name)
    check_style(folder)
    command = [sys.executable, "-c", RUN_EACH, *(str(folder / name) for name in sessions)]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {name: dict(np.load(folder / name / "kept.npz")) for name in sessions}


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
    whole = expected._asdict() if hasattr(expected, "_asdict") else vars(expected)
    for each, value in whole.items():
        if each == "made_by":
            assert str(found[f"{name} made_by"]) == str(value)
            continue
        assert np.array_equal(found[f"{name} {each}"], np.asarray(value), equal_nan=True), each


def same_pixel(found: dict, name: str, pixel: Pixel) -> None:
    """Compare the stages of a pixel, or its score, bit for bit."""
    if pixel.signals is None:
        assert np.array_equal(found[f"{name} score"], pixel.score)
    else:
        same(found, name, pixel.signals)


# -- results ---------------------------------------------------------------------------------------

STATES = {
    "first": "",
    "changed": "source=worn&light.sbr=0.3&light.n_pulses=500&light.seed=4&less.merge=2&less.pool=2"
    "&less.gate_from=0.1&less.pulses=0.7&absent=[%22jitter%22,%22pile_up%22]&tracking.l=0.01"
    "&tracking.n=500&tracking.m=1.5&tracking.alpha=0.3&tracking.t_n=10&tracking.weight=cubic"
    "&tracking.start=zero&image=Error&viewing.least_confidence=0.4"
    "&viewing.color_from_m=48&viewing.color_map=viridis&difference=true&pixel=[3,17]",
    "larger": "source=car_256&less.skip=3&image=Counts&absent=[%22signal_levels%22]",
    "inspected": "source=building&page=Inspect&map=SBR&pins=[[1,2],[30,41]]&pixel=[12,13]"
    "&region=[[20,20],[20,50],[50,35.5]]&crop.pixels=region&crop.from_m=1"
    "&absent=[%22pulse_shape%22,%22reflectivity%22]",
    "another method": "source=sample&page=Inspect&method=likelihood&subject=Profile"
    "&pins=[[3,4],[9,14]]&region=[[1,2],[1,9],[7,5]]&settings.likelihood.steps_per_bin=4",
    "file": "source=sample&reading.bin_width_s=1.5e-9&image=Counts",
}


def test_scripts_reproduce_the_screen(tmp_path):
    sessions = {name: opened(query) for name, query in STATES.items()}
    found = run(tmp_path, sessions, ASSETS / "sample_capture.npz")
    for name, session in sessions.items():
        answer, state = session.answer, session.state
        same(found[name], "image", answer.run.image)
        same_pixel(found[name], "signals", inspect(answer, *state.pixel))
        for file in ("range.png", "cloud.ply", "pixel.csv"):
            assert (tmp_path / name / file).stat().st_size > 0
        if state.page != "Inspect":
            picture, _ = image_of(answer, state.image, state.viewing)
            assert np.array_equal(found[name]["picture"], picture, equal_nan=True)
    answer, more = sessions["inspected"].answer, found["inspected"]
    for pixel in ((1, 2), (30, 41)):
        same_pixel(more, str(pixel), inspect(answer, *pixel))
    mask = core.inspection.pixels_in(sessions["inspected"].state.region, answer.capture.shape)
    assert np.array_equal(more["region"].ravel(), answer.capture.cube[mask].sum(axis=0))
    box = sessions["inspected"].state.box
    inside = answer.run.image.confident(0.9).cropped(box)
    header = (tmp_path / "inspected" / "cloud.ply").read_bytes().partition(b"end_header")[0]
    assert f"comment box: {box}\n".encode() in header
    assert f"element vertex {inside.valid.sum()}\n".encode() in header
    sbr = core.inspection.maps["SBR"](answer.capture)
    assert np.array_equal(more["picture"], sbr, equal_nan=True)


def test_scripts_of_random_states_run(tmp_path):
    """Bad settings give an image without ranges, and a script that runs."""
    sessions = {}
    for seed in range(4):
        state = random_state(np.random.default_rng(seed))
        state.param.update(source="car", page="Explore", pixel=(5, 6), region=(), pins=())
        state.param.update(window=None, image="Counts", comparison=State().comparison)
        session = Session(built_in_sources(), Link(dict(parse_qsl(query_of(state, {})))))
        sessions[str(seed)] = session
    for name, found in run(tmp_path, sessions).items():
        same(found, "image", sessions[name].answer.run.image)
        same_pixel(found, "signals", inspect(sessions[name].answer, 5, 6))


def test_a_script_reproduces_a_real_capture(tmp_path, real_capture):
    path = real_capture("21km_K11_night.mat")
    query = "source=it&less.pool=2&reading.n_pulses=20000&tracking.l=0.01&pixel=[60,70]"
    session = opened(query, it=path)
    found = run(tmp_path, {"it": session}, path)["it"]
    same(found, "image", session.answer.run.image)
    same_pixel(found, "signals", inspect(session.answer, 60, 70))
    assert str(path.parent) not in script_of(session.answer, session.state)


def test_a_script_reproduces_a_window_of_a_large_capture(tmp_path, monkeypatch):
    """Its confidence follows from the flux prior of the whole capture."""
    scene = core.scenes["building"]()
    whole = core.simulate(scene, scene.acquisition, core.Flux(sbr=0.5))
    path = tmp_path / "large.zarr"
    dataset(whole)[["counts"]].chunk(row=16, col=16).to_zarr(path, consolidated=False)
    monkeypatch.setenv(LIMIT, "1")
    query = "source=it&page=Inspect&map=Confidence&pixel=[3,4]"
    session = opened(f"{query}&window.rows=[8,40]&window.cols=[20,60]", it=path)
    found = run(tmp_path, {"it": session}, path)["it"]
    same(found, "image", session.answer.run.image)
    same_pixel(found, "signals", inspect(session.answer, 3, 4))
    assert session.answer.capture.shape == (32, 40)
    alone = core.estimate(replace(session.answer.capture, flux_prior=None), "tracking")
    assert not np.array_equal(alone.confidence, found["image confidence"])


def test_a_script_reproduces_the_comparison(tmp_path):
    query = (
        "page=Compare&comparison.methods=[%22peak%22,%22kde%22,%22tracking%22,%22oracle%22]"
        "&comparison.false_alarm=0.1&settings.kde.bandwidth_bins=0.7&tracking.l=0.01"
    )
    sessions = {
        "car": opened(query + "&comparison.kind=Error&comparison.viewing.least_confidence=0.5"),
        "file": opened(query + "&source=sample"),
    }
    found = run(tmp_path, sessions, ASSETS / "sample_capture.npz")
    for name, session in sessions.items():
        answer, chosen = session.answer, session.state.comparison
        for method, task in tasks_of(chosen, answer.request).items():
            if name == "file" and method == "oracle":
                assert "oracle range_m" not in found[name]
                continue
            compared = run_task(task, answer).answer
            same(found[name], method, compared.run.image)
            kind = "Error" if name == "car" else "Estimate"
            picture, _ = image_of(compared, kind, chosen.viewing)
            assert np.array_equal(found[name][f"{method} picture"], picture, equal_nan=True)


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
