"""The guide to logs: its source tables, as they are written there, read a bag and a table."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
from mcap.writer import Writer

import sms_online as sms
from sms_online.description.parse import parse_system, shipped_text
from tests.guide import HOW_TO


def described(beginning: str, further: str = "") -> sms.System:
    """The planar example with the guide's block of TOML that begins so."""
    blocks = (HOW_TO / "logs.md").read_text(encoding="utf-8").split("```toml\n")
    table = next(block for block in blocks if block.startswith(beginning)).split("```")[0]
    return parse_system(f"{shipped_text('paper-planar')}\n{further}\n{table}", "rig.toml")


def test_the_guides_topics_and_wrench_are_read(tmp_path: Path) -> None:
    wrench = (HOW_TO / "logs.md").read_text(encoding="utf-8").split("```toml\n[[wrench]]")[1].split("```")[0]
    rig = described('[[source]]\nkind = "bag"', f"[[wrench]]{wrench}")
    sent = {
        "/joint_states": {"name": ["elbow", "shoulder"], "position": [9.0, 50.0], "effort": [300.0, 9.0]},
        "/base": {"pose": {"position": {"x": 20.0}}},
        "/torque_2": {"wrench": {"torque": {"z": 4000.0}}},
        "/contact": {"wrench": {"force": {"x": 7.0}}},
    }
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("rig", "jsonschema", b'{"type": "object"}')
        for topic, message in sent.items():
            channel = writer.register_channel(topic, "json", schema)
            for k in range(3):
                stamp = {"stamp": {"sec": 1_700_000_000 + k, "nsec": 0}}
                writer.add_message(channel, k, json.dumps({"header": stamp, **message}).encode(), k)
        writer.finish()
    read = sms.read_capture(tmp_path / "run.mcap", rig)
    assert dict(zip(read.channels, read.values[0].tolist(), strict=True)) == {
        "theta_m_1": 0.5, "tau_1": 3.0, "r_S_x": 0.02, "tau_2": -4.0, "wrench_1.f_x": 7.0,
    }  # fmt: skip
    assert read.t.tolist() == [0.0, 1.0, 2.0]


def test_the_guides_columns_are_read(tmp_path: Path) -> None:
    rig = described('[[source]]\nkind = "table"')
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["motors/t"] = np.array([0.0, 5.0])
        file["motors/torque"] = np.array([[1000.0, 1.0], [2000.0, 1.0]])
        file["motors/angle"] = np.array([180.0, 90.0])
    read = sms.read_capture(tmp_path / "run.h5", rig)
    assert read.channels == ("tau_1", "theta_m_1")
    np.testing.assert_allclose(read.values, [[1.0, np.pi + 0.02], [2.0, np.pi / 2 + 0.02]], rtol=1e-15)
    np.testing.assert_allclose(read.t, [0.0, 5e-3])
