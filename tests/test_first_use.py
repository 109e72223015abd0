"""What the shipped scenes compile from an empty cache: a count of functions, since times depend on the machine."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from cgid._lib import compiled

_PROCESS = """
import collections, json, sys
import numba.core.event as event
from cgid.cli import main

counts = collections.Counter()

class Count(event.Listener):
    def on_start(self, started):
        function = started.data["dispatcher"].py_func
        counts["own" if function.__module__.startswith("cgid") else "numba's"] += 1

    def on_end(self, ended):
        pass

event.register("numba:compile", Count())
found = {}
for scene in sys.argv[2:]:
    before = dict(counts)
    code = main(["generate", scene, "-n", "1" if scene == "caving" else "300", "-o", f"{sys.argv[1]}/{scene}"])
    assert code == 0, (scene, code)
    found[scene] = {name: counts[name] - before.get(name, 0) for name in ("own", "numba's")}
print(json.dumps(found))
"""
#: Functions of cgid that each scene compiles beyond those of the scenes before it; a change is to be meant.
OWN = {"tail_beam": 73, "caving": 6, "plate": 1, "rock": 7, "anything": 3} | dict.fromkeys(
    ("corners", "lookalikes", "peers", "strangers", "reference", "yang2018"), 0
)
#: The most of numba's own functions that all of them compile, for its arrays and builtin functions: 33 with numba 0.68.
NUMBAS = 40


@pytest.mark.long
def test_a_scene_compiles_what_it_needs(tmp_path: Path):
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": str(Path(compiled.__file__).parents[2]),
    }
    command = [sys.executable, "-c", _PROCESS, str(tmp_path), *OWN]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    found = json.loads(ended.stdout.splitlines()[-1])
    assert {scene: counts["own"] for scene, counts in found.items()} == OWN
    assert sum(counts["numba's"] for counts in found.values()) <= NUMBAS
    # Nor does it warn of anything, such as of a feature of numba's.
    assert "warning" not in ended.stderr, ended.stderr
