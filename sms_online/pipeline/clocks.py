"""Which position sensors share a clock: those of one device, or of one kind where no devices are described."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from sms_online.pipeline.latency import SourceGroup, clock_groups
from sms_online.pipeline.sensing import Sensing

MARKER = re.compile(r"(?P<marker>link_(?P<link>\d+)\.marker_\d+)\.(?P<kind>u|theta)_(?P<axis>[xyz])")
# Clocks of what measures links behind flexible joints.
GAUGES, LINK_ENCODERS = "gauges", "link encoders"


def reference_clock(sensing: Sensing) -> SourceGroup | None:
    """The device that the others are late against, which delivers torques; None where no devices are described."""
    return next((device for device in clock_groups(sensing) if device.joints), None)


def clock_of(name: str, names: Sequence[str], base: Sequence[str]) -> str:
    """The clock of a position sensor where no devices are described; names: of all, base: of those that see it."""
    if name in base:
        return "base"
    if ".marker_" in name:
        return "markers"
    if name.endswith("strain_angle"):
        return GAUGES
    return LINK_ENCODERS if name.startswith("q_") and f"theta_m_{name[2:]}" in names else "encoders"


def other_clocks(sensing: Sensing) -> dict[tuple[str, str], list[int]]:
    """Position sensors (indices) of each of the others, by its name and which of several of that name.

    Of one device encoders, base and markers have one clock each. So have encoders behind flexible joints, beside those
    of the motors: they come from other electronics.
    """
    groups: dict[tuple[str, str], list[int]] = {}
    if devices := clock_groups(sensing):
        reference = reference_clock(sensing)
        others = [device for device in devices if device != reference]
        shared = Counter(device.name for device in others)
        for number, device in enumerate(others, start=1):
            # Senders on one bus have a clock each.
            part = str(number) if shared[device.name] > 1 else ""
            groups[device.name, part] = list(device.sensors)
    else:
        names = [sensing.channels[column] for column in sensing.position_columns]
        base = sensing.model.layout.n_base_positions
        for k, name in enumerate(names):
            groups.setdefault((clock_of(name, names, names[:base]), ""), []).append(k)
    return {name: sensors for name, sensors in groups.items() if sensors}
