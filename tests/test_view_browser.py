"""`--rerun serve` in a real browser: the plots and the arm are on the canvas.

Needs Chromium, which tools/install_browser.sh installs, and a minute; run with `pytest -m browser`.
"""

from __future__ import annotations

import io
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from sms_adapters.capture import CaptureWriter
from sms_sim.sensors import Sensors
from sms_sim.simulate import Simulation, sampled_blocks
from sms_tools.view import style

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium; tools/install_browser.sh installs it"),
]
# Software rendering: a page may take so long to show everything, s.
PATIENCE = 90.0
WIDTH, HEIGHT = 1600, 900
# A pixel has a colour if no channel is further off: lines have soft edges.
SAME_COLOR = 25
SERVER = [
    "--no-sandbox",  # containers run as root
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]

Pixels = NDArray[np.int16]


@pytest.fixture
def address(tmp_path: Path, planar_session: Simulation) -> Iterator[str]:
    """Where a replay of the planar example is served until it is interrupted."""
    plant = planar_session.plant
    capture = tmp_path / "run.csv"
    with CaptureWriter(capture, Sensors(plant.system, plant.channels, "B", 1).channels) as writer:
        for block in sampled_blocks(planar_session, "B", seed=1):
            writer.write(block)
    arguments = ["replay", str(capture), "--system", "paper-planar", "--out", str(tmp_path), "--rerun", "serve"]
    session = subprocess.Popen([sys.executable, "-m", "sms_tools", *arguments], stderr=subprocess.PIPE, text=True)
    assert session.stderr is not None
    found = None
    for line in session.stderr:
        if found := re.search(r"http://\S+", line):
            break
    assert found is not None, "no address was printed"
    yield found[0]
    session.send_signal(signal.SIGINT)
    assert session.wait(20.0) == 0
    assert (tmp_path / "results.json").exists()


def count(pixels: Pixels, *colors: style.Color) -> int:
    """Pixels that have one of the colours."""
    return sum(int(np.sum(np.all(np.abs(pixels - np.array(color)) <= SAME_COLOR, axis=-1))) for color in colors)


def test_plots_and_arm_are_on_the_canvas(address: str) -> None:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SERVER)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="dark")
        page.goto(address)
        end = monotonic() + PATIENCE
        arm = lines = [0]
        while monotonic() < end and not (min(arm) > 0 and min(lines) > 50):
            page.wait_for_timeout(2000)
            picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
            pixels: Pixels = np.asarray(picture).astype(np.int16)
            left, right = pixels[: HEIGHT // 2, : WIDTH * 2 // 5], pixels[: HEIGHT * 2 // 3, WIDTH * 2 // 5 :]
            arm = [count(left, color) for color in (style.LINK, style.JOINT, style.TIP)]
            halves = [right[:, : right.shape[1] // 2], right[:, right.shape[1] // 2 :]]
            lines = [count(half, *style.LINES[:4]) for half in halves]
        browser.close()
    assert min(arm) > 0, f"pixels of links, joints and tip: {arm}"
    assert min(lines) > 50, f"pixels of lines in the left and right plots: {lines}"
