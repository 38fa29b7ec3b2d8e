"""The first start: what is compiled ahead is what tracking then calls."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from rasnik import load_system, simulate
from rasnik.tracking import warm_up

TRACKED = """
import numpy as np
from rasnik import Tracker, load_system, simulate
from rasnik.tracking import warm_up
warm_up.compile_kernels(np.dtype("uint8"))
before = [len(kernel.signatures) for kernel in warm_up._KERNELS]
small = load_system("solidras", {"sensor.width_px": 360, "sensor.height_px": 270})
frames = simulate(small, [(4000.0 + 0.01 * k, 5000.0, 0.002) for k in range(4)], seed=1).frames
assert Tracker(small).run(frames).ok.all()
print(before, [len(kernel.signatures) for kernel in warm_up._KERNELS])
"""


def test_nothing_more_is_compiled_for_frames() -> None:
    command = [sys.executable, "-c", TRACKED]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[1, 1, 1] [1, 1, 1]"


def test_prepared_by_two_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    small = load_system("solidras", {"sensor.width_px": 360, "sensor.height_px": 270})
    frame = simulate(small, [(4000.0, 5000.0, 0.002)], seed=1).frames[0]
    warm_up.compile_kernels(np.dtype("uint8"))
    assert warm_up.is_compiled() and not warm_up.prepare(frame, small)
    monkeypatch.setattr(warm_up, "is_compiled", lambda: False)
    assert warm_up.prepare(frame, small)
