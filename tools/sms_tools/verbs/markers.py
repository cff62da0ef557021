"""markers: the clamped-loaded bending modes of each flexible link and the markers that they need, (5) and (6)."""

from __future__ import annotations

import argparse
import math
from typing import Any

from rich.table import Table

from sms_online.description.schema import FlexibleLink, System
from sms_online.model.eigenmodes import LinkMarkers, markers
from sms_online.result import json_text
from sms_tools.exit_codes import OK
from sms_tools.report import report_console, show
from sms_tools.session import described_system


def run(args: argparse.Namespace) -> int:
    """Print the modes and the number of markers of every link that bends."""
    system, _ = described_system(args)
    links = [_link(system, found) for found in markers(system, args.modes)]
    console = report_console(args.json)
    if links:
        show(console, _modes_table(links), "", _markers_table(links))
    else:
        show(console, f"{system.name}: no flexible link that bends")
    if args.json:
        print(json_text({"schema": "sms-online/markers/1", "system": system.name, "links": links}))
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


def _modes_table(links: list[dict[str, Any]]) -> Table:
    table = _table("link", "plane", "β, 1/m", "β/2π, 1/m", "frequency, Hz")
    for link in links:
        for mode in link["modes"]:
            numbers = (f"{mode[key]:.4g}" for key in ("beta", "spatial_frequency", "frequency_hz"))
            table.add_row(link["link"], mode["plane"], *numbers)
    return table


def _markers_table(links: list[dict[str, Any]]) -> Table:
    table = _table("link", "f_max, 1/m", "f_s, 1/m", "markers required", "in the system file")
    for link in links:
        counts = (str(link["markers_required"]), str(link["markers_described"]))
        table.add_row(link["link"], f"{link['f_max']:.4g}", f"{link['f_s']:.4g}", *counts)
    return table


def _table(*headings: str) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="left" if heading in ("link", "plane") else "right")
    return table
