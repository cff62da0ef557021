"""The README's pictures: real screenshots of real sessions, made again by whoever wants to.

python tools/make_pictures.py [--quanser lqr_full_10deg.mat]

Needs the `test` extra and what tools/install_browser.sh installs: the viewer draws without a screen, on a software
renderer.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import monotonic, sleep

import numpy as np
from PIL import Image
from rerun.experimental import ViewerClient

from sms_tools.cli import main as sms_online

PICTURES = Path(__file__).parent.parent / "docs" / "pictures"
# px, of a screenshot: large enough for every title, small enough to be read where a page scales it to half; larger
# where there are more parameters.
WIDTH, HEIGHT = 1600, 900
LARGER = {"seven-joint": (1920, 1080)}
# The animated one: px, pictures a second of the session and of the animation, quality of its compression.
ANIMATED_WIDTH, FRAME_RATE, QUALITY = 960, 5.0, 60
ANIMATED_SECONDS = 12.0
# The viewer needs so long to start at most, to load a recording, and to draw another instant, s.
STARTING, LOADING, DRAWING = 60.0, 6.0, 0.8
COLORS = 256
# System, seconds of motion, grade of noise.
SESSIONS = {
    "planar": ("paper-planar", "20", "B"),
    "seven-joint": ("seven-joint", "20", "A"),
}
# Effects behind the picture of a diagnosis, one of each kind that has a picture of its own; size of its page, px.
EFFECTS = (
    "coulomb_friction@joint_2:torque=1",
    "cubic_stiffness@joint_1:stiffness=5000",
    "sensor_lag@link_1.*:corner=100",
)
PAGE_WIDTH, PAGE_HEIGHT = 1200, 1885


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate, replay with a recording, and photograph it."""
    parser = argparse.ArgumentParser(description="Make the pictures in docs/pictures.")
    parser.add_argument("--quanser", metavar="FILE.mat", type=Path, help="the published measurement, for its picture")
    parser.add_argument("--only", metavar="NAME", help="planar, seven-joint, quanser or diagnosis")
    options = parser.parse_args(arguments)
    PICTURES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        recordings = {}
        for name, (system, seconds, grade) in SESSIONS.items():
            if options.only in (None, name):
                capture = Path(folder) / f"{name}.csv"
                _run("simulate", "--system", system, "--capture", capture, "--duration", seconds, "--grade", grade)
                recordings[name] = _recording(capture, system)
        if options.quanser is not None and options.only in (None, "quanser"):
            capture = Path(folder) / "quanser.csv"
            _run("import", "quanser", options.quanser, "--capture", capture)
            recordings["quanser"] = _recording(capture, "quanser-2dsfl", "--prior", "--exaggerate", "3")
        if options.only in (None, "diagnosis"):
            recordings["diagnosis-rerun"] = _diagnosis(Path(folder) / "diagnosis.csv")
        for name, recording in recordings.items():
            _photograph(recording, name, animated=name == "planar")


def _run(*arguments: object) -> None:
    if code := sms_online([str(argument) for argument in arguments]):
        sys.exit(code)


def _recording(capture: Path, system: str, *options: str) -> Path:
    directory = capture.with_suffix("")
    _run("replay", capture, "--system", system, "--out", directory, "--rerun", "save", *options)
    return directory / "session.rrd"


def _diagnosis(capture: Path) -> Path:
    """The top of the page of a diagnosis, as a browser draws it; returns its recording."""
    system, seconds, grade = SESSIONS["planar"]
    effects = [part for effect in EFFECTS for part in ("--effect", effect)]
    _run("simulate", "--system", system, "--capture", capture, "--duration", seconds, "--grade", grade, *effects)
    directory = capture.with_suffix("")
    _run("diagnose", capture, "--system", system, "--out", directory, "--rerun", "save")
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
    return directory / "session.rrd"


def _photograph(recording: Path, name: str, animated: bool) -> None:
    # The viewer lies beside the interpreter, whether or not that directory is in PATH. `ViewerClient.spawn` would
    # start one of another size.
    port = _free_port()
    program = [Path(sys.executable).with_name("rerun"), "--headless", "--port", str(port)]
    width, height = LARGER.get(name, (WIDTH, HEIGHT))
    size = ["--window-size", f"{width}x{height}"]
    process = subprocess.Popen([*program, *size], stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        viewer = _connected(f"rerun+http://127.0.0.1:{port}/proxy")
        viewer.open([str(recording)])
        sleep(LOADING)
        # Few colours do for lines on black and make it a third as large; this method keeps the rare ones.
        few = _screenshot(viewer, width).quantize(COLORS, Image.Quantize.MAXCOVERAGE)
        few.save(PICTURES / f"{name}.png", optimize=True)
        if animated:
            frames = []
            for t in np.arange(0.4, ANIMATED_SECONDS, 1.0 / FRAME_RATE):
                viewer.set_time("time", duration=float(t), play_state="paused")
                sleep(DRAWING)
                frames.append(_screenshot(viewer, ANIMATED_WIDTH))
            frames[0].save(
                PICTURES / f"{name}.webp",
                save_all=True,
                append_images=frames[1:],
                duration=round(1000.0 / FRAME_RATE),
                loop=0,
                quality=QUALITY,
            )
    finally:
        # That program is a script, which starts the viewer itself.
        os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _connected(url: str) -> ViewerClient:
    end = monotonic() + STARTING
    while True:
        try:
            return ViewerClient.connect(url)
        except ConnectionError:
            if monotonic() > end:
                raise
            sleep(0.5)


def _screenshot(viewer: ViewerClient, width: int) -> Image.Image:
    picture = Image.open(io.BytesIO(viewer.take_screenshot())).convert("RGB")
    return picture.resize((width, round(width * picture.height / picture.width)), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main()
