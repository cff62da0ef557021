"""What the guides to benches and sources show is what the program takes: tables parse, the reader reads."""

from __future__ import annotations

import re
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.raw import LostDevice, SerialChunk
from sms_adapters.sources import READERS
from sms_adapters.system_file import system_text
from sms_online.description.parse import parse_system
from tests.axis import AXIS, axis_block

HOW_TO = Path(__file__).parents[1] / "docs" / "how-to"
RIG = '[joint_1]\nstiffness = 100.0\n[motor_1]\nrotor_inertia = 0.001\n[link_1]\nkind = "rigid"\n'


def shown(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (HOW_TO / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("table", [*shown("can-bench.md", "toml"), *shown("serial-bench.md", "toml")])
def test_the_tables_of_the_guides_are_accepted(table: str) -> None:
    assert parse_system(f'name = "rig"\n{RIG}{table}', "guide").sources


def test_the_guides_cameras_are_a_source_of_the_planar_example() -> None:
    table = shown("motion-capture.md", "toml")[-1]
    (source,) = parse_system(system_text("paper-planar") + table, "guide").sources
    assert source.name == "cameras"


def test_the_system_file_of_the_guide_is_accepted() -> None:
    (text,) = shown("describe-a-system.md", "toml")
    system = parse_system(text, "guide")
    assert [effect.name for effect in system.effects] == ["viscous_friction"]
    assert set(system.known) | set(system.priors) == {"joint_1.damping", "motor_1.rotor_inertia"}


@pytest.mark.long
def test_the_guides_log_gives_the_estimate_of_its_samples(tmp_path: Path) -> None:
    """Twelve seconds of a described axis, noise of seed 3."""
    scope: dict[str, Any] = {"__name__": "guide"}
    exec(compile(shown("add-a-source.md", "python")[0], "add-a-source.md", "exec"), scope)
    block, system = axis_block(coulomb=0.0), parse_system(AXIS, "axis")
    path = tmp_path / "run.npz"
    np.savez(path, t=block.t, values=block.values, channels=block.channels)
    expected = sms.estimate(system, sms.Capture(block.t, block.channels, block.values)).parameters
    found = sms.estimate(system, scope["NumpyLog"](path)).parameters
    assert [p.value for p in found.values()] == [p.value for p in expected.values()]
    np.savez(path, t=block.t, values=block.values)
    with pytest.raises(sms.InputError, match="channels"):
        scope["NumpyLog"](path)


def test_the_guides_format_is_read_and_cut_by_every_verb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, entry = shown("add-a-source.md", "python")[:2]
    scope: dict[str, Any] = {"__name__": "guide"}
    exec(compile(log, "add-a-source.md", "exec"), scope)
    for ending, reader in eval(f"{{{entry}}}", scope).items():
        monkeypatch.setitem(READERS, ending, reader)
    block, system = axis_block(coulomb=0.0), parse_system(AXIS, "axis")
    np.savez(tmp_path / "run.npz", t=block.t, values=block.values, channels=block.channels)
    capture = sms.read_capture(tmp_path / "run.npz", system, start=1.0, stop=4.0)
    assert (capture.t[0], capture.t[-1]) == (1.0, pytest.approx(3.995))
    with pytest.raises(sms.InputError, match="no samples from 20 s"):
        sms.read_capture(tmp_path / "run.npz", system, start=20.0)


def test_the_guides_own_source_reads_and_decodes() -> None:
    code = shown("add-a-source.md", "python")[-1]
    assert len(code.splitlines()) < 50
    scope: dict[str, Any] = {"__name__": "guide"}
    exec(compile(code, "add-a-source.md", "exec"), scope)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    reader, decoder = scope["DatagramReader"]("mocap", port, time.monotonic), scope["LineDecoder"](scope["POSE"])
    reader.open()
    assert reader.read(0.01) == []
    with pytest.raises(LostDevice, match="mocap: "):
        scope["DatagramReader"]("mocap", port, time.monotonic).open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in (0, 1, 3):
            sender.sendto(f"{k},{1000 + k},-500,0.25".encode(), ("127.0.0.1", port))
    chunks = [raw for _ in range(3) for raw in reader.read(1.0)]
    reader.close()
    assert all(isinstance(chunk, SerialChunk) for chunk in chunks)
    samples = [decoder.push(chunk) for chunk in chunks]
    assert decoder.channels == ("r_S_x", "r_S_y", "theta_0")
    assert [sample.values.tolist() for sample in samples] == [
        [[x * 1e-3, -500 * 1e-3, 0.25]] for x in (1000, 1001, 1003)
    ]
    assert [float(sample.t_device[0]) for sample in samples] == [0.0, 1 / 240, 3 / 240]
    assert decoder.counters["lost_counter"] == 1
