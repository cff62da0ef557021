"""What the guides to benches and sources show is what the program takes: tables parse, the reader reads."""

from __future__ import annotations

import re
import socket
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.devices import DECODERS, make_decoder, make_reader
from sms_adapters.raw import LostDevice, Raw
from sms_adapters.sources import READERS
from sms_adapters.system_file import system_text
from sms_online.description import sources as described
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


def test_the_guides_own_device_is_read_and_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Datagrams of one and of two lines, and of what is no line; a port that is taken is a lost device."""
    record, code, entry = shown("add-a-source.md", "python")[2:]
    assert len(record.splitlines()) + len(code.splitlines()) < 60
    scope = dict(vars(described))
    exec(compile(record, "add-a-source.md", "exec", dont_inherit=True), scope)
    monkeypatch.setattr(described, "JsonSource", scope["JsonSource"], raising=False)
    own: dict[str, Any] = {"__name__": "guide", "JsonSource": scope["JsonSource"]}
    exec(compile(code, "add-a-source.md", "exec", dont_inherit=True), own)
    for kind, decoder_of in eval(f"{{{entry}}}", own).items():
        monkeypatch.setitem(DECODERS, kind, decoder_of)
    (table,) = tomllib.loads(shown("add-a-source.md", "toml")[0])["source"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    source = scope["JsonSource"](**table | {"port": port})
    assert (source.recorded, source.address) == ("udp", f"UDP 0.0.0.0:{port}")
    reader, decoder = make_reader(source, time.monotonic), make_decoder(source, None)
    reader.open()
    with pytest.raises(LostDevice, match="axis: "):
        make_reader(source, time.monotonic).open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for sent in (
            b'{"t": 0.5, "angle": 2, "torque": -1}',
            b'{"t": 0.6, "angle": 3, "torque": 0}\n{"t": 0.7, "angle": 4, "torque": NaN}\n',
            b'{"t": 0.8, "angle": 3}\n[1]\n\xff',
        ):
            sender.sendto(sent, ("127.0.0.1", port))
        items: list[Raw] = []
        while len(items) < 3 and (came := reader.read(5.0)):
            items += came
    reader.close()
    samples = decoder.push(*items)
    assert decoder.channels == ("q_1", "tau_1")
    np.testing.assert_array_equal(samples.values, [[2, -1], [3, 0], [4, np.nan]])
    assert samples.t_device.tolist() == [0.5, 0.6, 0.7]
    assert decoder.counters == {"bad_number": 3, "non_finite": 1, "out_of_range": 0}
