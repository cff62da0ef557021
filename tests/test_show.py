"""`show`: a described arm in rerun with its frames, joints, markers and channels, before there are any data."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_online.effects.build import build_model
from sms_tools.cli import main
from sms_tools.view.described import channel_table
from sms_tools.view.scene import Scene
from tests.model_systems import tree
from tests.recordings import columns


def test_a_tree_is_drawn_with_frames_and_channels(tmp_path: Path) -> None:
    """Frames are where the model's kinematics have them; every place says which channels are measured there."""
    system = tree()
    sms.show(system, rerun="save", directory=tmp_path)
    recording = tmp_path / "session.rrd"
    (arrows,) = columns(recording, "/arm/frames/x")
    model = build_model(system)
    x = np.zeros((1, model.layout.n_x))
    x[0, model.layout.position_names.index("eta")] = 1.0
    frames = model.chain.configure(x).frames
    origins = dict(zip(arrows["Arrows3D:labels"], arrows["Arrows3D:origins"], strict=True))
    assert list(origins) == ["{0}", *(f"{{{i}}}" for i in range(1, 9)), "tip"]
    for i in range(1, 9):
        np.testing.assert_allclose(origins[f"{{{i}}}"], frames[2 * i].origin[0], atol=1e-6)
    (labels,) = (row["Points3D:labels"] for row in columns(recording, "/arm/channels"))
    assert "tau_1, theta_m_1, q_1" in labels
    assert "q_4" in labels
    assert "link_5.marker_2.{u_y,u_z,theta_x,theta_y,theta_z,x,y,z}" in [label.replace("u_x,", "") for label in labels]
    drawn = [columns(recording, f"/arm/link_{i}") for i in range(1, 9)]
    assert all(drawn)


def test_every_channel_has_one_place() -> None:
    for name in sms.shipped_systems():
        system = sms.load_system(name)
        placed = [channel for row in channel_table(system) for channel in row.channels]
        assert len(placed) == len(set(placed)) > 0


def test_links_of_a_tree_begin_where_others_end() -> None:
    model = build_model(tree())
    x = np.zeros((1, model.layout.n_x))
    x[0, model.layout.position_names.index("eta")] = 1.0
    drawing = Scene(model).draw(x)
    # The bracket, link 7, begins 0.11 m from the end of link 1.
    gap = drawing.links[6][0, 0] - drawing.links[0][0, -1]
    assert np.linalg.norm(gap) == pytest.approx(np.hypot(0.05, 0.1), rel=1e-9)
    assert len(drawing.links) == 8


def test_off_prints_the_channels_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "--system", "emps", "--rerun", "off", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["places"] == [{"place": "joint_1", "channels": ["force_1", "q_1"]}]


def test_an_absent_viewer_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
        assert main(["show", "--system", "emps", "--rerun", f"connect=127.0.0.1:{port}"]) == 2
    assert f"no viewer at rerun+http://127.0.0.1:{port}/proxy" in capsys.readouterr().err


@pytest.mark.slow
def test_a_served_view_stays_until_it_is_interrupted() -> None:
    command = [sys.executable, "-m", "sms_tools", "show", "--system", "emps", "--rerun", "serve"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        lines = [process.stderr.readline() for _ in range(2)]
        assert lines[0].startswith("view: in the browser: http://127.0.0.1:")
        assert "stays until Ctrl-C" in lines[1]
        assert process.poll() is None
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(20.0) == 0
    port = int(lines[0].split("127.0.0.1:")[1].split("/")[0])
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0
