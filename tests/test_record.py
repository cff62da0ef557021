"""record: what a person may say of a bus, and what is said where nothing comes."""

from __future__ import annotations

import json
import socket
import threading
from pathlib import Path
from time import monotonic

import can
import pytest

from sms_adapters.session_log import SESSION
from sms_tools.cli import main
from sms_tools.live.simulated import GROUP
from sms_tools.verbs.record import _can
from tests.axis import AXIS


def test_a_bus_has_the_options_of_its_interface() -> None:
    source = _can("arm=socketcan:can0:500000?fd=true&receive_own_messages=false&data_bitrate=2000000&app=lab")
    assert (source.name, source.interface, source.channel, source.bitrate) == ("arm", "socketcan", "can0", 500000)
    assert source.options == {"fd": True, "receive_own_messages": False, "data_bitrate": 2000000, "app": "lab"}


@pytest.mark.realtime
def test_options_reach_the_interface(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    stopped = threading.Event()

    def send() -> None:
        with can.Bus(GROUP, "udp_multicast", ignore_config=True, port=port) as bus:
            while not stopped.wait(0.01):
                bus.send(can.Message(arbitration_id=1, is_extended_id=False))

    sender = threading.Thread(target=send)
    sender.start()
    try:
        bus = f"udp_multicast:{GROUP}?port={port}"
        assert main(["record", "--can", bus, "--duration", "3", "--out", str(tmp_path / "run")]) == 0
    finally:
        stopped.set()
        sender.join()


def test_options_that_are_none_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--can", "virtual:x?fd", "--out", str(tmp_path / "run")]) == 2
    assert "'fd'; expected options as OPTION=VALUE" in capsys.readouterr().err


def test_where_nothing_comes_the_end_says_what_was_listened_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = tmp_path / "port"
    devices = ["--can", "arm=virtual:nobody:500000?receive_own_messages=true", "--serial", f"{port}:9600"]
    assert main(["record", *devices, "--duration", "0.5", "--out", str(tmp_path / "run"), "--json"]) == 1
    out, said = capsys.readouterr()
    listened = f"arm (virtual nobody, 500000 bit/s, receive_own_messages True), port ({port} at 9600 bit/s)"
    assert f"nothing was received from {listened}" in said
    assert json.loads(out)["sources"] == {"arm": 0, "port": 0}


@pytest.mark.parametrize("verb", ["record", "live"])
def test_an_interface_that_is_none_ends_the_verb_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    system = tmp_path / "axis.toml"
    signals = "".join(f' SG_ {name} : {bit}|16@1- (1,0) [0|0] "" ARM\n' for name, bit in (("B", 0), ("C", 16)))
    (tmp_path / "a.dbc").write_text(f'VERSION ""\nBU_: ARM\nBO_ 1 A: 8 ARM\n{signals}')
    source = '[[source]]\nkind = "can"\nname = "arm"\ndbc = "a.dbc"\ninterface = "nonesuch"\nchannel = "x"\n'
    system.write_text(AXIS + source + 'signals = { "A.B" = "q_1", "A.C" = "force_1" }\n')
    device = ["--can", "arm=nonesuch:x"] if verb == "record" else ["--system", str(system)]
    began = monotonic()
    assert main([verb, *device, "--duration", "60", "--out", str(tmp_path / "run")]) == 2
    assert monotonic() - began < 30.0
    err = capsys.readouterr().err
    assert "sms-online: arm, nonesuch x: " in err
    assert "expected a bus that python-can can open here" in err
    # The corrected command may name the same directory.
    assert not (tmp_path / "run" / SESSION).exists()
