"""CAN frames to samples: with cantools' values, each one a sample or counted, the same however they are grouped."""

from __future__ import annotations

from pathlib import Path

import cantools.database
import numpy as np
import pytest
from cantools.database.can import Database
from numpy.typing import NDArray

from sms_adapters.can_decoder import CanDecoder
from sms_adapters.devices import make_can_decoder, make_decoder
from sms_adapters.raw import ERROR_FRAME, EXTENDED, REMOTE_FRAME, CanFrames, DecodedSamples, SerialChunk
from sms_online.description.sources import CanSource, Signal
from sms_online.errors import InputError

DBC = """VERSION ""

BS_:

BU_: RIG

BO_ 291 ENCODER: 8 RIG
 SG_ ANGLE : 0|12@1+ (1,0) [0|0] "" RIG
 SG_ RATE : 23|16@0- (0.001,0) [0|0] "rad/s" RIG
 SG_ COUNT : 32|4@1+ (1,0) [0|0] "" RIG
 SG_ TURNS : 40|8@1- (2,0) [0|0] "" RIG

BO_ 2147483940 DRIVE: 4 RIG
 SG_ TORQUE : 0|32@1- (1,0) [0|0] "N m" RIG

SIG_VALTYPE_ 2147483940 TORQUE : 1;
"""
ENCODER, DRIVE = 0x123, 0x124 | EXTENDED
FULL_TURN = 4096


def decoder(tmp_path: Path, counters: tuple[str, ...] = (), **signals: object) -> CanDecoder:
    """signals: MESSAGE__SIGNAL = channel, or a table of the file."""
    (tmp_path / "rig.dbc").write_text(DBC)
    table = {name.replace("__", "."): Signal.model_validate(value) for name, value in signals.items()}
    source = CanSource(kind="can", name="bus", dbc="rig.dbc", signals=table, counters=counters)
    return make_can_decoder(source, tmp_path)


def frames(id_: int | NDArray[np.uint32], data: NDArray[np.uint8]) -> CanFrames:
    """Frames (N, bytes), one a millisecond, without stamps."""
    count, length = data.shape
    padded = np.zeros((count, 64), dtype=np.uint8)
    padded[:, :length] = data
    return CanFrames(
        np.linspace(0.0, (count - 1) * 1e-3, count),
        np.full(count, np.nan),
        np.broadcast_to(np.uint32(id_), count).copy(),
        np.full(count, length, dtype=np.uint8),
        padded,
        np.zeros(count, dtype=np.uint8),
    )


def counted(angles: list[int], counts: list[int]) -> CanFrames:
    """ENCODER frames with these angles and counts."""
    data = np.zeros((len(angles), 8), dtype=np.uint8)
    data[:, 0], data[:, 1] = np.array(angles) & 0xFF, np.array(angles) >> 8
    data[:, 4] = counts
    return frames(ENCODER, data)


def faults(source: CanDecoder) -> dict[str, int]:
    return {kind: count for kind, count in source.counters.items() if count}


def joined(parts: list[DecodedSamples]) -> tuple[NDArray[np.float64], ...]:
    return tuple(
        np.concatenate([getattr(part, name) for part in parts]) for name in ("t_arrival", "t_device", "values")
    )


def test_samples_are_cantools_values_in_their_channels(tmp_path: Path) -> None:
    """Random words of both messages, mixed, seed 5."""
    rng = np.random.default_rng(5)
    source = decoder(tmp_path, ENCODER__RATE="v", DRIVE__TORQUE="tau", ENCODER__ANGLE="q")
    data = rng.integers(0, 256, (400, 8), dtype=np.uint8)
    is_drive = rng.random(400) < 0.5
    data[is_drive, 4:] = 0
    data[is_drive, 3] &= 0x3F  # below NaN and infinity
    raw = frames(np.where(is_drive, DRIVE, ENCODER).astype(np.uint32), data)
    raw.length[is_drive] = 4
    samples = source.push(raw)
    database = cantools.database.load_string((tmp_path / "rig.dbc").read_text(), "dbc")
    assert isinstance(database, Database)
    for drive, row, values in zip(is_drive, data, samples.values, strict=True):
        expected = database.decode_message(*(("DRIVE", bytes(row[:4])) if drive else ("ENCODER", bytes(row))))
        assert isinstance(expected, dict)
        names = (None, "TORQUE", None) if drive else ("RATE", None, "ANGLE")
        assert np.isnan(values).tolist() == [name is None for name in names]
        assert values[~np.isnan(values)].tolist() == [expected[name] for name in names if name]
    assert source.channels == ("v", "tau", "q")
    assert not faults(source)


def test_what_is_no_sample_is_counted(tmp_path: Path) -> None:
    source = decoder(tmp_path, DRIVE__TORQUE={"channel": "tau", "minimum": -50.0, "maximum": 50.0})
    torque = np.array([1.0, np.nan, np.inf, 60.0, -60.0, 50.0, 2.0, 3.0, 4.0, 5.0], dtype="<f4")
    raw = frames(DRIVE, torque.view(np.uint8).reshape(-1, 4))
    raw.flags[6], raw.flags[7] = ERROR_FRAME, REMOTE_FRAME
    raw.id[8] = 0x124  # the short identifier of the same number
    raw.length[9] = 3
    assert source.push(raw).values[:, 0].tolist() == [1.0, 50.0]
    assert source.unknown_ids == [0x124]
    assert faults(source) == {
        "error_frame": 1,
        "remote": 1,
        "unknown_id": 1,
        "wrong_length": 1,
        "non_finite": 2,
        "out_of_range": 2,
    }


def test_counts_become_si_and_turns_are_counted(tmp_path: Path) -> None:
    """Twelve-bit counts of an encoder that turns backwards through zero, with a jump of a third of a turn."""
    angle = np.concatenate([np.arange(100, -9000, -700), np.arange(-9000, 6000, 1300)])
    scale = -2 * np.pi / FULL_TURN
    source = decoder(tmp_path, ENCODER__ANGLE={"channel": "q", "scale": scale, "offset": 0.5, "wrap": FULL_TURN})
    samples = source.push(counted((angle % FULL_TURN).tolist(), [0] * angle.size))
    assert np.abs(samples.values[:, 0] - (angle * scale + 0.5)).max() < 1e-12


def test_a_wrong_word_does_not_count_as_a_turn(tmp_path: Path) -> None:
    source = decoder(tmp_path, ENCODER__ANGLE={"channel": "q", "wrap": FULL_TURN, "maximum": 4000.0})
    samples = source.push(counted([3000, 4095, 3010, 3500, 4050, 3999, 100], [0] * 7))
    assert samples.values[:, 0].tolist() == [3000, 3010, 3500, 3999, 100 + FULL_TURN]
    assert faults(source) == {"out_of_range": 2}


def test_a_counter_shows_lost_repeated_and_late_frames(tmp_path: Path) -> None:
    source = decoder(tmp_path, ("ENCODER.COUNT",), ENCODER__ANGLE="q")
    counts = [14, 15, 0, 0, 3, 2, 4]  # from 15 on to 0; 0 twice; 1 and 2 missing; 2 after 3
    samples = source.push(counted(list(range(7)), counts))
    assert samples.values[:, 0].tolist() == [0, 1, 2, 4, 6]
    assert faults(source) == {"repeated_counter": 1, "late_counter": 1, "lost_counter": 2}


def test_a_sender_that_starts_again_loses_one_frame(tmp_path: Path) -> None:
    source = decoder(tmp_path, ("ENCODER.COUNT",), ENCODER__ANGLE="q")
    samples = source.push(counted(list(range(6)), [3, 4, 0, 1, 2, 3]))
    assert samples.values[:, 0].tolist() == [0, 1, 3, 4, 5]
    assert faults(source) == {"late_counter": 1, "restarted_counter": 1}


def test_a_frame_with_the_same_stamp_is_a_repetition(tmp_path: Path) -> None:
    source = decoder(tmp_path, ENCODER__ANGLE="q")
    raw = counted([1, 1, 2, 3], [0] * 4)
    raw.stamp[:] = [7.0, 7.0, 7.001, np.nan]
    samples = source.push(raw)
    assert np.array_equal(samples.t_device, [7.0, 7.001, np.nan], equal_nan=True)
    assert samples.t_arrival.tolist() == raw.arrival[[0, 2, 3]].tolist()
    assert faults(source) == {"repeated_time": 1}


def test_the_same_samples_however_the_frames_are_grouped(tmp_path: Path) -> None:
    """Frames with faults of every kind, whole, singly, and by sevens; seed 6."""
    rng = np.random.default_rng(6)
    signals = {"ENCODER__ANGLE": {"channel": "q", "wrap": FULL_TURN, "maximum": 3500.0}, "DRIVE__TORQUE": "tau"}
    data = rng.integers(0, 256, (300, 8), dtype=np.uint8)
    data[:, 4] = np.cumsum(rng.choice([1, 1, 1, 0, 2, 15], 300)) % 16
    raw = frames(rng.choice([ENCODER, DRIVE, 0x77], 300).astype(np.uint32), data)
    raw.length[:] = np.where(raw.id == DRIVE, 4, rng.choice([8, 7], 300, p=[0.9, 0.1]))
    raw.stamp[:] = np.cumsum(rng.choice([0.0, 1e-3], 300))
    raw.flags[:] = rng.choice([0, ERROR_FRAME, REMOTE_FRAME], 300, p=[0.9, 0.05, 0.05])
    counters = ("ENCODER.COUNT",)
    whole = decoder(tmp_path, counters, **signals)
    expected = joined([whole.push(raw)])
    singly = decoder(tmp_path, counters, **signals)
    parts = [singly.push(raw[k : k + 1]) for k in range(150)]
    parts += [singly.push(raw[k : k + 7]) for k in range(150, 300, 7)]
    for got, want in zip(joined(parts), expected, strict=True):
        assert np.array_equal(got, want, equal_nan=True)
    assert singly.counters == whole.counters
    assert singly.unknown_ids == whole.unknown_ids
    assert all(whole.counters[kind] for kind in ("lost_counter", "repeated_counter", "repeated_time", "out_of_range"))


def test_a_counter_must_be_a_plain_number_of_a_wanted_message(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"counters, DRIVE\.TORQUE: no channel comes from its message"):
        decoder(tmp_path, ("DRIVE.TORQUE",), ENCODER__ANGLE="q")
    with pytest.raises(InputError, match="unsigned whole number"):
        decoder(tmp_path, ("ENCODER.TURNS",), ENCODER__ANGLE="q")
    with pytest.raises(InputError, match=r"such as 'ENCODER\.COUNT'"):
        decoder(tmp_path, ("ENCODER.CUONT",), ENCODER__ANGLE="q")


def test_bytes_are_no_frames(tmp_path: Path) -> None:
    source = CanSource(kind="can", name="bus", dbc="ak80.dbc", signals={"AK80_REPLY.POSITION": Signal(channel="q")})
    with pytest.raises(TypeError, match="SerialChunk"):
        make_decoder(source, tmp_path).push(SerialChunk(0.0, b"x"))


MULTIPLEXED = """VERSION ""

BS_:

BU_: RIG

BO_ 291 DRIVE: 8 RIG
 SG_ PAGE M : 0|4@1+ (1,0) [0|0] "" RIG
 SG_ COUNT : 4|4@1+ (1,0) [0|0] "" RIG
 SG_ ANGLE : 8|16@1- (0.001,0) [0|0] "rad" RIG
 SG_ TORQUE m0 : 24|16@1- (0.01,0) [0|0] "N m" RIG
 SG_ SPEED m1 : 24|16@1- (0.1,0) [0|0] "rad/s" RIG
 SG_ DEEP m2M : 24|8@1+ (1,0) [0|0] "" RIG
 SG_ TEMPERATURE m7 : 32|8@1+ (1,0) [0|0] "" RIG

SG_MUL_VAL_ 291 TORQUE PAGE 0-0;
SG_MUL_VAL_ 291 SPEED PAGE 1-1;
SG_MUL_VAL_ 291 DEEP PAGE 2-3;
SG_MUL_VAL_ 291 TEMPERATURE DEEP 7-7;
"""


def test_multiplexed_signals_are_read_from_their_frames(tmp_path: Path) -> None:
    (tmp_path / "rig.dbc").write_text(MULTIPLEXED)
    names = {"ANGLE": "q_1", "TORQUE": "tau_1", "SPEED": "omega_0_z", "TEMPERATURE": "r_S_x"}
    table = {f"DRIVE.{name}": Signal(channel=channel) for name, channel in names.items()}
    source = CanSource(kind="can", name="bus", dbc="rig.dbc", signals=table, counters=("DRIVE.COUNT",))
    decode = make_can_decoder(source, tmp_path)
    # Random pages, 7 and DEEP among them. Seed 6.
    data = np.random.default_rng(6).integers(0, 256, (4000, 8), dtype=np.uint8)
    data[:, 0] = (np.arange(4000) % 16 << 4) | np.random.default_rng(7).integers(0, 5, 4000)
    data[::3, 3] = 7
    sampled = decode.push(frames(ENCODER, data))
    assert decode.counters["lost_counter"] == 0  # the counter counts all pages
    database = cantools.database.load_string(MULTIPLEXED, "dbc")
    assert isinstance(database, Database)
    wanted = np.full((4000, 4), np.nan)
    for row, word in zip(wanted, data, strict=True):
        try:
            decoded = database.get_message_by_name("DRIVE").decode(word.tobytes(), decode_choices=False)
        except cantools.database.DecodeError:  # a page that the DBC does not describe
            decoded = {"ANGLE": int.from_bytes(word[1:3].tobytes(), "little", signed=True) * 0.001}
        assert isinstance(decoded, dict)
        row[:] = [decoded.get(name, np.nan) for name in names]
    np.testing.assert_array_equal(sampled.values, wanted)
    assert all(np.isfinite(column).sum() > 200 for column in wanted.T)


def test_a_multiplexed_counter_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rig.dbc").write_text(
        MULTIPLEXED.replace(" COUNT ", " COUNT m0 ") + "SG_MUL_VAL_ 291 COUNT PAGE 0-0;\n"
    )
    table = {"DRIVE.ANGLE": Signal(channel="q_1")}
    source = CanSource(kind="can", name="bus", dbc="rig.dbc", signals=table, counters=("DRIVE.COUNT",))
    with pytest.raises(InputError, match=r"counters, DRIVE.COUNT: a multiplexed signal; expected one that every frame"):
        make_can_decoder(source, tmp_path)
