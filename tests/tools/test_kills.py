"""Simulator, client, logger and runners killed at random moments; 200 times: build/venv/bin/python kills.py 200."""

from kills import KINDS, main


def test_kills_leave_no_process_and_readable_files(capsys):
    main(len(KINDS), seed=7)
    assert "nothing left running, every file readable, the next start works" in capsys.readouterr().out
