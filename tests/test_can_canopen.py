"""CANopen process data, as an EDS maps it: a CiA 402 drive and a CiA 406 encoder on one bus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sms_adapters.devices import make_can_decoder
from sms_adapters.raw import EXTENDED, CanFrames
from sms_online.description.sources import CanopenSource
from sms_online.errors import InputError

pytest.importorskip("canopen", reason="the extra canopen is not installed")
# canopen 2.4 logs by a deprecated name.
pytestmark = pytest.mark.filterwarnings("ignore:The 'warn' method:DeprecationWarning")

HEAD = "[FileInfo]\nFileName=rig.eds\n[DeviceInfo]\nVendorName=Rig\n"
# Position actual value and torque actual value in the first TPDO, statusword and a real in the second, which is off.
DRIVE_OBJECTS = [
    ("1A00", "TPDO1 mapping", [2, 0x60640020, 0x60770010]),
    ("1A01", "TPDO2 mapping", [2, 0x60410010, 0x20000120]),
    ("1A02", "TPDO3 mapping", [2, 0x00050008, 0x20000120]),
]
VARIABLES = {
    "6064": ("Position actual value", 0x0004),
    "6077": ("Torque actual value", 0x0003),
    "6041": ("Statusword", 0x0006),
    "6004": ("Position value", 0x0007),
    "6030": ("Speed value", 0x0003),
}


def record(index: str, name: str, values: list[int | str]) -> str:
    """A record of unsigned numbers, subindex 0 first."""
    text = f"[{index}]\nParameterName={name}\nObjectType=0x9\nSubNumber={len(values)}\n"
    for sub, value in enumerate(values):
        kind = "0x0005" if sub == 0 else "0x0007"
        text += f"[{index}sub{sub}]\nParameterName=entry {sub}\nDataType={kind}\nAccessType=rw\nDefaultValue={value}\n"
    return text


def eds(path: Path, mappings: list[tuple[str, str, list[int]]], cobs: dict[str, str]) -> None:
    text = HEAD
    for index, (name, kind) in VARIABLES.items():
        text += f"[{index}]\nParameterName={name}\nObjectType=0x7\nDataType={kind:#06x}\nAccessType=ro\nPDOMapping=1\n"
    text += "[2000]\nParameterName=Rig\nObjectType=0x9\nSubNumber=2\n"
    text += "[2000sub0]\nParameterName=n\nDataType=0x0005\nAccessType=ro\nDefaultValue=1\n"
    text += "[2000sub1]\nParameterName=Strain\nDataType=0x0008\nAccessType=ro\nPDOMapping=1\n"
    for index, cob in cobs.items():
        text += record(index, "TPDO", [2, cob, 255])
    for index, name, entries in mappings:
        text += record(index, name, list(entries))
    path.write_text(text)


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    cobs = {"1800": "$NODEID+0x180", "1801": "$NODEID+0x80000280", "1802": "0x20012345"}
    eds(tmp_path / "drive.eds", DRIVE_OBJECTS, cobs)
    eds(tmp_path / "encoder.EDS", [("1A00", "TPDO1 mapping", [2, 0x60040020, 0x60300010])], {})
    return tmp_path


def source(**signals: object) -> CanopenSource:
    nodes = {"5": "drive.eds", "9": "encoder.EDS"}
    table = {name[1:].replace("_", ".", 1).replace("_", ":"): value for name, value in signals.items()}
    return CanopenSource.model_validate({"kind": "canopen", "name": "bus", "nodes": nodes, "signals": table})


def frames(*pairs: tuple[int, bytes]) -> CanFrames:
    count = len(pairs)
    data = np.frombuffer(b"".join(data.ljust(64, b"\0") for _, data in pairs), np.uint8).reshape(count, 64)
    length = np.array([len(data) for _, data in pairs], dtype=np.uint8)
    ids = np.array([id_ for id_, _ in pairs], dtype=np.uint32)
    return CanFrames(np.zeros(count), np.full(count, np.nan), ids, length, data, np.zeros(count, np.uint8))


def test_mapped_objects_become_channels(rig: Path) -> None:
    signals = {
        "n5_6064": {"channel": "theta_m_1", "scale": 1e-3},
        "n5_6077": {"channel": "tau_1", "scale": -0.01},
        "n9_6004": {"channel": "q_1", "scale": 0.5, "wrap": 65536},
        "n5_2000_1": "link_1.strain_angle",
    }
    decoder = make_can_decoder(source(**signals), rig)
    samples = decoder.push(
        frames(
            (0x185, (-70_000).to_bytes(4, "little", signed=True) + (-250).to_bytes(2, "little", signed=True)),
            (0x189, (65_530).to_bytes(4, "little") + b"\1\2"),
            (0x189, (4).to_bytes(4, "little") + b"\1\2"),
            (0x12345 | EXTENDED, b"\x07" + np.float32(0.25).tobytes()),
            (0x285, b"\1\2" + np.float32(0.25).tobytes()),
            (0x705, b"\5"),  # heartbeat
            (0x189, b"\1\2"),
        )
    )
    assert decoder.channels == ("theta_m_1", "tau_1", "q_1", "link_1.strain_angle")
    nan = np.nan
    expected = [[-70.0, 2.5, nan, nan], [nan, nan, 32765.0, nan], [nan, nan, 32770.0, nan], [nan, nan, nan, 0.25]]
    assert np.array_equal(samples.values, expected, equal_nan=True)
    assert {kind: count for kind, count in decoder.counters.items() if count} == {"unknown_id": 2, "wrong_length": 1}


@pytest.mark.parametrize(
    ("signal", "found"),
    [
        ("n5_6041", "signals, 5.6041: not in the process data; expected an object that drive.eds maps"),
        ("n9_6064", "6004:00, 6030:00"),
        ("n5_0005", "signals, 5.0005: an object that its EDS does not describe"),
    ],
)
def test_an_object_that_is_not_sent_is_refused(rig: Path, signal: str, found: str) -> None:
    with pytest.raises(InputError) as caught:
        make_can_decoder(source(**{signal: "q_1"}), rig)
    assert found in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [None, "", "gibberish", "[6064]\nParameterName=x\n", "[1A00]\n", "\x00\x01"])
def test_an_eds_that_is_none_is_refused(rig: Path, text: str | None) -> None:
    if text is None:
        (rig / "drive.eds").unlink()
    else:
        (rig / "drive.eds").write_text(text)
    with pytest.raises(InputError) as caught:
        make_can_decoder(source(n5_6064="q_1"), rig)
    assert "drive.eds" in str(caught.value)
    assert "\n" not in str(caught.value)
