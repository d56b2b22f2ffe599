"""``python -m tests.attack`` in short: its verdicts are right."""

from __future__ import annotations

import os
import signal

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


def test_a_server_that_ends_has_not_held(monkeypatch, capsys):
    def harmless(server):
        return Outcome(1, "nothing", server.is_alive)

    def deadly(server):
        os.kill(server.process.pid, signal.SIGKILL)
        server.process.wait()
        return Outcome(1, "killed", True)

    attacks = [Attack("harmless", harmless), Attack("deadly", deadly)]
    monkeypatch.setattr(attack, "ATTACKS", attacks)
    assert attack.main([]) == 1
    harmless_row, deadly_row = capsys.readouterr().out.splitlines()[2:4]
    assert "ENDED" in deadly_row and "did NOT hold" in deadly_row
    assert harmless_row.endswith("| held |")


@pytest.mark.parametrize(
    ("script", "status"),
    [("print('x')", 0), ("raise SystemExit(2)", 2), ("while True: pass", None)],
)
def test_a_command_is_bounded_and_measured(script, status):
    ended = command("-c", script, limit_s=2.0)
    assert ended.status == status
    assert ended.peak_bytes > 0
