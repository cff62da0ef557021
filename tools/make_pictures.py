"""The documentation's pictures: real screenshots of real sessions, made again by whoever wants to.

python tools/make_pictures.py

Needs the `test` extra and what tools/install_browser.sh installs: the viewer draws without a screen, on a software
renderer.
"""

from __future__ import annotations

import io
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from time import monotonic, sleep

from PIL import Image
from rerun.experimental import ViewerClient

from sms_tools.cli import main as sms_online
from sms_tools.view.choice import LOOPBACK
from sms_tools.view.sink import free_port

PICTURES = Path(__file__).parent.parent / "docs" / "pictures"
# px, of a screenshot: large enough for every title, small enough to be read where a page scales it to half.
WIDTH, HEIGHT = 1600, 900
# The viewer needs so long to start at most, and to load a recording, s.
STARTING, LOADING = 60.0, 6.0
COLORS = 256
SYSTEM = "paper-planar"
# Effects behind the picture of a diagnosis, one of each kind that has a picture of its own; size of its page, px.
EFFECTS = (
    "coulomb_friction@joint_2:torque=1",
    "cubic_stiffness@joint_1:stiffness=5000",
    "sensor_lag@link_1.*:corner=100",
)
PAGE_WIDTH, PAGE_HEIGHT = 1200, 1885


def main() -> None:
    """Simulate, replay and diagnose, and photograph both."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        capture, directory = Path(folder) / "planar.csv", Path(folder) / "planar"
        _simulate(capture)
        _run("replay", capture, "--system", SYSTEM, "--out", directory, "--rerun", "save")
        _photograph(directory / "session.rrd", PICTURES / "planar.png")
        _diagnosis(Path(folder) / "diagnosis.csv")


def _run(*arguments: object) -> None:
    if code := sms_online([str(argument) for argument in arguments]):
        sys.exit(code)


def _simulate(capture: Path, *options: str) -> None:
    _run("simulate", "--system", SYSTEM, "--capture", capture, "--duration", "20", "--grade", "B", *options)


def _diagnosis(capture: Path) -> None:
    """The top of the page of a diagnosis, as a browser draws it."""
    _simulate(capture, *(part for effect in EFFECTS for part in ("--effect", effect)))
    directory = capture.with_suffix("")
    _run("diagnose", capture, "--system", SYSTEM, "--out", directory)
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        sys.exit("no Chromium; tools/install_browser.sh installs it")
    options = [
        "--headless",
        "--no-sandbox",  # containers run as root
        "--hide-scrollbars",
        f"--window-size={PAGE_WIDTH},{PAGE_HEIGHT}",
        f"--screenshot={PICTURES / 'diagnosis.png'}",
    ]
    subprocess.run([browser, *options, (directory / "diagnosis.html").as_uri()], check=True, stderr=subprocess.DEVNULL)


def _photograph(recording: Path, picture: Path) -> None:
    # The viewer lies beside the interpreter, whether or not that directory is in PATH. `ViewerClient.spawn` would
    # start one of another size.
    port = free_port(0, LOOPBACK)
    program = [Path(sys.executable).with_name("rerun"), "--headless", "--port", str(port)]
    size = ["--window-size", f"{WIDTH}x{HEIGHT}"]
    process = subprocess.Popen([*program, *size], stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        viewer = _connected(f"rerun+http://127.0.0.1:{port}/proxy")
        viewer.open([str(recording)])
        sleep(LOADING)
        seen = Image.open(io.BytesIO(viewer.take_screenshot())).convert("RGB")
        seen = seen.resize((WIDTH, round(WIDTH * seen.height / seen.width)), Image.Resampling.LANCZOS)
        # Few colours do for lines on black and make it a third as large; this method keeps the rare ones.
        seen.quantize(COLORS, Image.Quantize.MAXCOVERAGE).save(picture, optimize=True)
    finally:
        # That program is a script, which starts the viewer itself.
        os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def _connected(url: str) -> ViewerClient:
    end = monotonic() + STARTING
    while True:
        try:
            return ViewerClient.connect(url)
        except ConnectionError:
            if monotonic() > end:
                raise
            sleep(0.5)


if __name__ == "__main__":
    main()
