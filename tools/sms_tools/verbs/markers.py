"""markers: the clamped-loaded bending modes of each flexible link and the markers that they need, (5) and (6)."""

from __future__ import annotations

import argparse
import math
from typing import Any

from rich.table import Table

from sms_online.description.bodies import FlexibleLink
from sms_online.description.schema import System
from sms_online.model.eigenmodes import LinkMarkers, markers
from sms_tools.exit_codes import OK
from sms_tools.report import say, table
from sms_tools.session import described_system


def run(args: argparse.Namespace) -> int:
    """Print the modes and the number of markers of every link that bends."""
    system, _ = described_system(args)
    links = [_link(system, found) for found in markers(system, args.modes)]
    none = [f"{system.name}: no flexible link that bends"]
    document = {"schema": "sms-online/markers/1", "system": system.name, "links": links}
    say(args, *([_modes(links), "", _markers(links)] if links else none), document=document)
    return OK


def _link(system: System, found: LinkMarkers) -> dict[str, Any]:
    described = system.links[found.link - 1]
    assert isinstance(described, FlexibleLink)
    modes = [
        {
            "plane": plane,
            "beta": mode.beta,
            "spatial_frequency": mode.spatial_frequency,
            "frequency_hz": mode.natural_frequency / (2.0 * math.pi),
        }
        for plane, series in found.modes.items()
        for mode in series
    ]
    return {
        "link": f"link_{found.link}",
        "modes": modes,
        "f_max": found.f_max,
        "f_s": found.f_s,
        "markers_required": found.markers,
        "markers_described": described.elements,
    }


def _modes(links: list[dict[str, Any]]) -> Table:
    rows = [
        [link["link"], mode["plane"], *(f"{mode[key]:.4g}" for key in ("beta", "spatial_frequency", "frequency_hz"))]
        for link in links
        for mode in link["modes"]
    ]
    return table(("link", "plane", "β, 1/m", "β/2π, 1/m", "frequency, Hz"), rows, left=("link", "plane"))


def _markers(links: list[dict[str, Any]]) -> Table:
    rows = [
        [f"{each['link']}", f"{each['f_max']:.4g}", f"{each['f_s']:.4g}"]
        + [str(each[key]) for key in ("markers_required", "markers_described")]
        for each in links
    ]
    return table(("link", "f_max, 1/m", "f_s, 1/m", "markers required", "in the system file"), rows, left=("link",))
