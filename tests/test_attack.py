"""``python -m tests.attack`` in short: its verdicts are right."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tests import attack
from tests.attacks.attack import MIB, Attack, Outcome, command


def test_the_exit_status_is_0_if_all_attacks_held(monkeypatch, capsys):
    def survived(_folder):
        return Outcome(3, "refused with 403", True, 5 * MIB)

    def failed(_folder):
        raise ConnectionError("the server hung up")

    attacks = [
        Attack("one that holds", survived, False),
        Attack("one that does not", failed, False),
    ]
    monkeypatch.setattr(attack, "ATTACKS", attacks)
    assert attack.main(["--only", "HOLDS"]) == 0
    assert "| one that holds | 3 | refused with 403 |  | 5 MiB | 0 s | held |" in (
        capsys.readouterr().out
    )
    assert attack.main([]) == 1
    assert "| 1 | ConnectionError: the server hung up |" in capsys.readouterr().out
    assert attack.main(["--only", "no such attack"]) == 1


@pytest.mark.parametrize(
    ("is_alive", "is_lost", "longest_s", "text"),
    [
        (True, False, 0.2, "| 200 | 0.2 s |"),
        (False, False, 0.2, "200; the server ENDED (last words)"),
        (True, True, 0.2, "200; another session was LOST"),
        (True, False, 9.0, "| 200 | 9.0 s |"),
    ],
)
def test_an_attack_holds_if_the_server_goes_on_serving(
    monkeypatch, tmp_path, is_alive, is_lost, longest_s, text
):
    monkeypatch.setattr(attack.time, "sleep", lambda _s: None)
    memory = SimpleNamespace(is_killed=False, peak_bytes=7 * MIB)
    server = SimpleNamespace(is_alive=is_alive, memory=memory, logged=lambda: "last words\n")
    other = SimpleNamespace(is_lost=is_lost, longest_s=longest_s)
    target = SimpleNamespace(healthy=lambda: (server, other))
    one = Attack("one", lambda _: Outcome(1, "200", held=True))
    row, has_held = attack.row_of(one, target, tmp_path)
    assert text in row and "| 7 MiB |" in row
    assert has_held == row.endswith("| held |") == (text == "| 200 | 0.2 s |")


@pytest.mark.parametrize(
    ("script", "status"),
    [("print('x')", 0), ("raise SystemExit(2)", 2), ("while True: pass", None)],
)
def test_a_command_is_bounded_and_measured(script, status):
    ended = command("-c", script, limit_s=2.0)
    assert ended.status == status
    assert ended.peak_bytes > 0
