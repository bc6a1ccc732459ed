"""The README's commands work as they stand.

Every fenced block marked `sh` is run in order, but for those that hold `tools/salient demo` or `tools/salient test`,
which are run by whoever runs this. A block that starts `tools/salient sim` keeps running while the later ones are run,
as it would in a terminal of its own. The bus has a path of the test's own, so that two of them can run at once.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess

from salient.paths import ROOT

BLOCK_TIMEOUT_S = 120


def blocks() -> list[str]:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [block for block in found if "tools/salient demo" not in block and "tools/salient test" not in block]


def test_commands_of_the_readme(tmp_path):
    simulators = []
    bus = "/tmp/salient.sock"
    assert any("tools/salient sim" in block and bus in block for block in blocks())
    try:
        for block in blocks():
            shell = ["bash", "-euo", "pipefail", "-c", block.replace(bus, f"{tmp_path}/salient.sock")]
            if re.search(r"^tools/salient sim\b", block, re.MULTILINE):
                simulator = subprocess.Popen(shell, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                             text=True, start_new_session=True)
                simulators.append(simulator)
                assert json.loads(simulator.stdout.readline())["ready"], block
                continue
            result = subprocess.run(shell, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True,
                                    timeout=BLOCK_TIMEOUT_S)
            assert result.returncode == 0, f"{block}\n{result.stdout}\n{result.stderr}"
    finally:
        for simulator in simulators:
            os.killpg(simulator.pid, signal.SIGTERM)
            assert simulator.wait() in (0, -signal.SIGTERM)
