"""Process data of CANopen nodes as their EDS maps them, in the terms of the array decoder of CAN signals.

Source: CiA 301 (TPDO communication parameters 1800h, mapping 1A00h and following, predefined connection set).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cantools.database.can import Signal
from cantools.database.conversion import BaseConversion

from sms_adapters.can_signals import WantedMessage
from sms_adapters.extras import installed
from sms_adapters.files import reading
from sms_adapters.raw import EXTENDED, one_line
from sms_online.description.sources import CanopenSource
from sms_online.errors import InputError

if TYPE_CHECKING:
    from canopen import ObjectDictionary

_COMMUNICATION, _MAPPING = 0x1800, 0x1A00
_MOST_PDOS = 512
# COB-ID entry: bit 31 set where the PDO is not in use, bit 29 where its identifier has 29 bits.
_DISABLED, _LONG, _IDENTIFIER = 1 << 31, 1 << 29, (1 << 29) - 1
# Identifiers of the first four TPDOs where the EDS gives none: predefined connection set.
_PREDEFINED = (0x180, 0x280, 0x380, 0x480)


@dataclass(frozen=True)
class _Pdo:
    """A TPDO of a node: entries are (index, subindex, first bit, bits)."""

    id: int
    length: int
    entries: tuple[tuple[int, int, int, int], ...]


def pdo_messages(source: CanopenSource, directory: Path | None) -> list[WantedMessage]:
    """The PDOs that source.signals come from, columns in its order; the EDS from the system's directory.

    Raises InputError for a missing package `canopen`, an EDS that is missing or unreadable, and an object that it does
    not know, does not map into a PDO in use, or that is no number.
    """
    place = f"source {source.name}"
    dictionaries = {node: _read_eds(place, name, int(node), directory) for node, name in source.nodes.items()}
    pdos = {node: list(_pdos(od, int(node))) for node, od in dictionaries.items()}
    wanted: dict[tuple[str, _Pdo], list[tuple[int, Signal]]] = {}
    for column, name in enumerate(source.signals):
        node, _, object_ = name.partition(".")
        index, _, subindex = object_.partition(":")
        key = (int(index, 16), int(subindex or "0", 16))
        found = [(pdo, bit, bits) for pdo in pdos[node] for *entry, bit, bits in pdo.entries if tuple(entry) == key]
        if not found:
            mapped = ", ".join(f"{i:04X}:{s:02X}" for pdo in pdos[node] for i, s, _, _ in pdo.entries)
            expected = f"an object that {source.nodes[node]} maps into a PDO in use: {mapped or 'it maps none'}"
            raise InputError(place, f"signals, {name}", "not in the process data", expected)
        pdo, bit, bits = found[0]
        signal = _signal(place, name, dictionaries[node], key, bit, bits)
        wanted.setdefault((node, pdo), []).append((column, signal))
    return [
        WantedMessage(
            f"node {node} PDO {pdo.id & _IDENTIFIER:X}h",
            pdo.id,
            pdo.length,
            tuple(signal for _, signal in pairs),
            tuple(column for column, _ in pairs),
        )
        for (node, pdo), pairs in wanted.items()
    ]


def _read_eds(place: str, name: str, node: int, directory: Path | None) -> ObjectDictionary:
    canopen = installed("canopen", place, "kind", "canopen")
    path = (directory or Path()) / name
    try:
        with reading(path, "the EDS beside the system file"):
            dictionary: ObjectDictionary = canopen.import_od(str(path), node)
            return dictionary
    except InputError:
        raise
    # Its parser lets through whatever a malformed entry raises.
    except Exception as error:
        raise InputError(str(path), "", one_line(error), "a readable EDS") from None


def _pdos(od: ObjectDictionary, node: int) -> Iterator[_Pdo]:
    """The TPDOs in use, in the order of their numbers."""
    for k in range(_MOST_PDOS):
        if _MAPPING + k not in od:
            continue
        cob = _entry(od, _COMMUNICATION + k, 1)
        if cob is None:
            cob = _PREDEFINED[k] + node if k < len(_PREDEFINED) else _DISABLED
        if cob & _DISABLED:
            continue
        entries, bit = [], 0
        for sub in range(1, (_entry(od, _MAPPING + k, 0) or 0) + 1):
            word = _entry(od, _MAPPING + k, sub) or 0
            entries.append((word >> 16, word >> 8 & 0xFF, bit, word & 0xFF))
            bit += word & 0xFF
        yield _Pdo(cob & _IDENTIFIER | (EXTENDED if cob & _LONG else 0), (bit + 7) // 8, tuple(entries))


def _entry(od: ObjectDictionary, index: int, subindex: int) -> int | None:
    """An unsigned entry as configured (DCF), or by default; None where the EDS says nothing."""
    if index not in od:
        return None
    try:
        variable = od[index][subindex]  # type: ignore[index]  # PDO parameters are records
    except (KeyError, TypeError):
        return None
    value = variable.default if variable.value is None else variable.value
    return value if isinstance(value, int) else None


def _signal(place: str, name: str, od: ObjectDictionary, key: tuple[int, int], bit: int, bits: int) -> Signal:
    from canopen.objectdictionary import datatypes

    variable = od.get_variable(*key)
    if variable is None:
        raise InputError(place, f"signals, {name}", "an object that its EDS does not describe", "one that it does")
    if variable.data_type not in datatypes.NUMBER_TYPES:
        raise InputError(place, f"signals, {name}", "an object that is no number", "an integer or a real")
    is_float = variable.data_type in datatypes.FLOAT_TYPES
    signed = variable.data_type in datatypes.SIGNED_TYPES
    return Signal(name, bit, bits, is_signed=signed, conversion=BaseConversion.factory(is_float=is_float))
