"""The photon budget in the app, without a browser: form, flux, link, undo and what it needs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from app.model.store import built_in_sources
from app.pages.shared.photon_budget import TITLE
from core import PhotonBudget, scenes
from core.photon_budget import flux_extents, steps
from tests.states import link_to
from tests.threads import HeldLayout, control


def opened(query: str = "") -> HeldLayout:
    layout = HeldLayout(built_in_sources(), link_to(query))
    (part,) = layout.page.select(lambda each: getattr(each, "title", None) == TITLE)
    part.collapsed = False
    return layout


def rows_of(layout: HeldLayout, title: str) -> list[dict[str, Any]]:
    (table,) = layout.page.select(lambda each: str(getattr(each, "title", "")).startswith(title))
    return table.rows


def test_a_budget_sets_signal_and_background_until_a_slider_moves():
    layout = opened()
    session = layout.session
    assert session.request.budget is None
    control(layout, "Use a photon budget").value = True
    answer = layout.next_answer()
    found = {step.symbol: step.value for step in steps(PhotonBudget(), scenes["car"]())}
    assert answer.request.budget == PhotonBudget()
    assert control(layout, "Signal").value == pytest.approx(found["S"], rel=1e-4)
    assert control(layout, "Background").value == pytest.approx(found["B"], rel=1e-4)
    signal = answer.capture.signal
    extent, _ = flux_extents(PhotonBudget(), scenes["car"]())
    assert (signal[signal > 0].min(), signal.max()) == pytest.approx(extent, rel=1e-4)
    (shown,) = (row for row in rows_of(layout, "Steps") if row["name"] == "Signal")
    assert shown["note"] == "S = η · M"
    assert shown["cells"][0][1:] == (pytest.approx(found["S"]), "per pulse")

    control(layout, "Pulse energy").value = 0.8
    assert layout.next_answer().capture.signal == pytest.approx(2 * signal, rel=1e-4)
    control(layout, "Pulses").value = 500
    request = layout.next_answer().request
    assert (request.budget, request.illumination.n_pulses) == (PhotonBudget(0.8), 500)
    query = session.query()

    control(layout, "Signal").value = 0.2
    request = layout.next_answer().request
    assert (request.budget, request.illumination.ppp) == (None, 0.2)
    assert request.illumination.flux.background == pytest.approx(found["B"], rel=1e-4)
    assert not control(layout, "Use a photon budget").value

    session.recall(query)  # as Back does
    request = layout.next_answer().request
    assert (request.budget, request.illumination.n_pulses) == (PhotonBudget(0.8), 500)
    assert control(layout, "Use a photon budget").value


def test_a_link_restores_a_budget_and_another_scene_keeps_it():
    layout = opened("budget.aperture_mm=20.0")
    assert layout.session.refused == []
    budget = layout.session.answer.request.budget
    assert budget == PhotonBudget(aperture_mm=20.0)
    control(layout, "Scene or capture").value = "building"
    answer = layout.next_answer()
    _, flux = budget.apply(scenes["building"]())
    assert answer.request.illumination.flux == flux
    assert control(layout, "Signal").value == flux.signal
    assert np.ptp(answer.capture.signal[answer.capture.signal > 0]) > 0


def test_the_form_finds_what_reaches_a_restoration_degree():
    layout = opened("budget.pulse_energy_uj=0.3")
    control(layout, "What reaches RD 0.99?").clicks += 1
    layout.tasks.run_until(lambda: rows_of(layout, "What reaches"))
    energy, _, filter_ = rows_of(layout, "What reaches")
    assert energy["name"] == "Pulse energy"
    assert energy["cells"][0][1] > 0.3
    assert filter_["cells"][0][1] < 5
    control(layout, "Reflectivity").value = 0.3
    layout.next_answer()
    assert rows_of(layout, "What reaches") == []
