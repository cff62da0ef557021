"""A serial port read live: all its bytes, and what happens when it is unplugged."""

from __future__ import annotations

import os
import pty
import socket
import time
import tty
from pathlib import Path

import pytest

from sms_adapters.devices import make_decoder, make_reader
from sms_adapters.raw import LostDevice, Reader, SerialChunk
from sms_online.description.sources import SerialField, SerialLines
from sms_online.errors import InputError


def reader(port: str) -> Reader:
    return make_reader(source(port), time.monotonic)


def source(port: str) -> SerialLines:
    fields = (SerialField(channel="q"),)
    return SerialLines(kind="serial", name="strain", port=port, format="lines", fields=fields)


def pair() -> tuple[int, str]:
    """The far end of a line and the name of the near one."""
    far, near = pty.openpty()
    tty.setraw(near)
    name = os.ttyname(near)
    os.close(near)
    return far, name


def received(device: Reader, count: int) -> list[SerialChunk]:
    """Chunks of that many bytes in all; fails where they do not come."""
    chunks: list[SerialChunk] = []
    end = time.monotonic() + 5.0
    while sum(len(chunk.data) for chunk in chunks) < count:
        assert time.monotonic() < end
        chunks += [raw for raw in device.read(0.1) if isinstance(raw, SerialChunk)]
    return chunks


def test_bytes_that_come_while_a_reader_waits_are_fetched_too() -> None:
    far, name = pair()

    def turn() -> None:
        os.write(far, b"2.5\n")
        time.sleep(0.05)

    device = make_reader(source(name), time.monotonic, turn)
    device.open()
    assert device.read(0.01) == []
    os.write(far, b"1.5\n")
    chunks = [raw for raw in device.read(1.0) if isinstance(raw, SerialChunk)]
    assert b"".join(chunk.data for chunk in chunks) == b"1.5\n2.5\n"
    device.close()
    os.close(far)


def test_bytes_come_as_they_were_sent_after_a_break() -> None:
    far, name = pair()
    device = reader(name)
    device.open()
    before = time.monotonic()
    os.write(far, b"1.5\n" * 500)
    chunks = received(device, 2000)
    assert chunks[0].data == b""
    assert b"".join(chunk.data for chunk in chunks) == b"1.5\n" * 500
    assert all(before <= chunk.arrival <= time.monotonic() for chunk in chunks)
    assert len(chunks) < 100  # not one a byte
    device.close()
    device.close()
    os.close(far)


def test_a_silent_port_gives_nothing() -> None:
    far, name = pair()
    device = reader(name)
    device.open()
    began = time.monotonic()
    assert device.read(0.05) == []
    assert time.monotonic() - began >= 0.04
    device.close()
    os.close(far)


def test_an_unplugged_port_is_lost_and_read_again_after_opening() -> None:
    far, name = pair()
    device, decoder = reader(name), make_decoder(source(name), None)
    device.open()
    os.write(far, b"0\n1\n-1")
    raw = received(device, 6)
    os.close(far)
    with pytest.raises(LostDevice, match=r"^strain: "):
        device.read(0.1)
    far, again = pair()
    device = reader(again)
    device.open()
    os.write(far, b".5\n2\n")
    raw += received(device, 5)
    assert [value for chunk in raw for (value,) in decoder.push(chunk).values.tolist()] == [1.0, 2.0]
    device.close()
    os.close(far)


def test_a_port_of_two_readers_is_refused() -> None:
    far, name = pair()
    first, second = reader(name), reader(name)
    first.open()
    with pytest.raises(LostDevice, match=r"strain: .*lock"):
        second.open()
    first.close()
    os.close(far)


def test_what_is_no_port_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "ttyUSB0"
    file.touch()
    for port, found in ((file, "no device"), (tmp_path, "no device"), ("nonesuch://", "nonesuch")):
        with pytest.raises(InputError, match=found) as refused:
            reader(str(port)).open()
        assert "\n" not in str(refused.value)


def test_a_socket_is_a_port_too() -> None:
    server = socket.create_server(("127.0.0.1", 0))
    device = reader(f"socket://127.0.0.1:{server.getsockname()[1]}")
    device.open()
    far, _ = server.accept()
    far.sendall(b"1.5\n")
    assert b"".join(chunk.data for chunk in received(device, 4)) == b"1.5\n"
    far.close()
    with pytest.raises(LostDevice):
        device.read(1.0)
    device.close()
    server.close()


@pytest.mark.parametrize("port", ["/dev/absent", "socket://nowhere"])
def test_a_port_that_cannot_be_opened_is_lost(port: str) -> None:
    with pytest.raises(LostDevice, match=r"^strain: ") as lost:
        reader(port).open()
    assert "\n" not in str(lost.value)
    with pytest.raises(LostDevice, match="not open"):
        reader(port).read(0.0)
