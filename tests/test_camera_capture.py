"""A motion capture joins the recording of the drives on their clock, which the motion of both gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import sms_online as sms
from sms_adapters.camera_capture import import_points
from sms_adapters.sources import open_source
from sms_online.description.schema import System
from sms_online.errors import InputError
from tests.camera_rig import marked_bench, seen_by_cameras

# The drives' clock at the cameras' t = 0, s, and by how much it is faster.
OFFSET, RATE = 3.217, 40e-6
BASE = ("r_S_x", "r_S_y", "theta_0")


def named(system: System) -> System:
    """A rig whose markers and base have names in a motion capture."""
    links = []
    for i, link in enumerate(system.links, start=1):
        markers = [m.model_copy(update={"name": f"m{i}{j}"}) for j, m in enumerate(link.markers, start=1)]
        links.append(link.model_copy(update={"markers": tuple(markers)}))
    base = system.spacecraft
    return system.model_copy(
        update={
            "links": tuple(links),
            "spacecraft": None if base is None else base.model_copy(update={"name": "chaser"}),
        }
    )


def motive(t: Sequence[float], markers: dict[str, np.ndarray], base: np.ndarray | None) -> str:
    """A take as Motive exports it: points (B, 2) by name and the pose (B, 3) of a rigid body, z up."""
    kinds, names, quantities, axes, columns = ["Type"], ["Name"], [""], ["Time (Seconds)"], []
    if base is not None:
        x, y, angle = base.T
        nothing = np.zeros_like(x)
        parts = ("Rotation", "XYZW", [nothing, nothing, np.sin(angle / 2), np.cos(angle / 2)])
        for quantity, letters, values in (parts, ("Position", "XYZ", [x, y, nothing])):
            for letter, column in zip(letters, values, strict=True):
                kinds.append("Rigid Body"), names.append("chaser"), quantities.append(quantity), axes.append(letter)
                columns.append(column)
    for name, points in markers.items():
        for letter, column in zip("XYZ", (*points.T, np.zeros(len(points))), strict=True):
            kinds.append("Marker"), names.append(f"rig:{name}"), quantities.append("Position"), axes.append(letter)
            columns.append(column)
    head = ["Format Version,1.23,Length Units,Meters", ""]
    head += [",".join(["", *row]) for row in (kinds, names, quantities)] + [",".join(["Frame", *axes])]
    body = [
        ",".join([str(k), f"{instant:.7f}", *("" if np.isnan(v) else f"{v:.7f}" for v in row)])
        for k, (instant, row) in enumerate(zip(t, np.stack(columns, axis=1), strict=True))
    ]
    return "\n".join([*head, *body]) + "\n"


def recorded(system: System, data: sms.Capture, folder: Path, angle: np.ndarray | None = None) -> tuple[Path, Path]:
    """The take of the cameras and the recording of the drives, each on its clock; angle: what encoders read instead."""
    at = {name: data.values[:, k] for k, name in enumerate(data.channels)}
    seen = np.isfinite(at["link_1.marker_1.x"])
    markers = {
        marker.name: np.stack([at[f"link_{i}.marker_{j}.{axis}"][seen] for axis in "xy"], axis=1)
        for i, link in enumerate(system.links, start=1)
        for j, marker in enumerate(link.markers, start=1)
    }
    base = None if system.spacecraft is None else np.stack([at[name][seen] for name in BASE], axis=1)
    take = folder / "take.csv"
    take.write_text(motive((data.t[seen] - OFFSET) / (1.0 + RATE), markers, base), encoding="utf-8")
    drives = [name for name in data.channels if name not in BASE and ".marker_" not in name]
    values = np.stack([at[name] if angle is None or name.startswith("tau_") else angle for name in drives], axis=1)
    return take, sms.write_capture(sms.Capture(data.t, tuple(drives), values), folder / "drives.csv")


@pytest.fixture(scope="module")
def bench() -> tuple[System, sms.Capture]:
    system = named(marked_bench())
    return system, sms.simulate(system)


def test_a_take_joins_the_drives_on_their_clock(bench: tuple[System, sms.Capture], tmp_path: Path) -> None:
    system, data = bench
    take, drives = recorded(system, data, tmp_path)
    count, _, (said,) = import_points(take, system, tmp_path / "run.csv", open_source(drives, system))
    blocks = list(open_source(tmp_path / "run.csv", system))
    t, values = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("t", "values"))
    assert (count, said.partition(" is ")[0]) == (t.size, f"t = 0 of {take}")
    column = blocks[0].channels.index("link_1.marker_2.x")
    own = data.channels.index("link_1.marker_2.x")
    seen = np.isfinite(data.values[:, own])
    there = np.isfinite(values[:, column])
    assert_allclose(values[there, column], data.values[seen, own], atol=1e-6)
    # A camera that is late by 0.3 ms moves a point at 3 m/s by a millimetre.
    assert_allclose(t[there], data.t[seen], atol=3e-4)
    assert set(data.channels) == set(blocks[0].channels)


@pytest.mark.long
def test_the_base_is_a_rigid_body_and_drift_is_found(tmp_path: Path) -> None:
    system = named(seen_by_cameras("paper-planar"))
    data = sms.simulate(system)
    take, drives = recorded(system, data, tmp_path)
    _, _, (said,) = import_points(take, system, tmp_path / "run.csv", open_source(drives, system))
    offset, std = (float(part) for part in said.partition(" is ")[2].split(" s of ")[0].split(" ± "))
    ppm, ppm_std = (float(part) for part in said.partition("clock is ")[2].split(" ppm ")[0].split(" ± "))
    assert said.endswith("ppm slower")
    assert abs(offset - OFFSET) < 3.0 * std < 1e-4
    assert abs(ppm - 1e6 * RATE) < 3.0 * ppm_std < 10.0
    (first, *_) = open_source(tmp_path / "run.csv", system)
    assert set(BASE) <= set(first.channels)


def test_another_motion_is_refused(bench: tuple[System, sms.Capture], tmp_path: Path) -> None:
    system, data = bench
    take, drives = recorded(system, data, tmp_path, angle=0.3 * np.sin(data.t**2) + 0.3 * np.sin(11.0 * data.t))
    with pytest.raises(InputError, match=r"--beside: markers whose motion the encoders explain to \d+ % at best"):
        import_points(take, system, tmp_path / "run.csv", open_source(drives, system))


def test_a_motion_that_repeats_gives_no_clock(bench: tuple[System, sms.Capture], tmp_path: Path) -> None:
    system, data = bench
    t = np.arange(0.0, 12.0, 0.004)
    angle = 0.5 * np.sin(2.0 * np.pi * t)
    values = np.full((t.size, len(data.channels)), np.nan)
    for name, column in (("q_1", angle), ("theta_m_1", angle), ("tau_1", np.cos(2.0 * np.pi * t))):
        values[:, data.channels.index(name)] = column
    for j, marker in enumerate(system.links[0].markers, start=1):
        x, y, _ = marker.position
        values[:, data.channels.index(f"link_1.marker_{j}.x")] = x * np.cos(angle) - y * np.sin(angle)
        values[:, data.channels.index(f"link_1.marker_{j}.y")] = x * np.sin(angle) + y * np.cos(angle)
    take, drives = recorded(system, sms.Capture(t, data.channels, values), tmp_path)
    with pytest.raises(InputError, match="a motion that repeats: t = 0 is"):
        import_points(take, system, tmp_path / "run.csv", open_source(drives, system))


def test_clocks_of_a_moment_are_not_compared(bench: tuple[System, sms.Capture], tmp_path: Path) -> None:
    system, data = bench
    moment = sms.Capture(data.t[:100], data.channels, data.values[:100])
    take, drives = recorded(system, moment, tmp_path)
    with pytest.raises(InputError, match="too short a recording to compare clocks"):
        import_points(take, system, tmp_path / "run.csv", open_source(drives, system))


def test_a_base_that_is_not_in_the_file_is_named(bench: tuple[System, sms.Capture], tmp_path: Path) -> None:
    system, data = bench
    take, _ = recorded(system, data, tmp_path)
    free = named(seen_by_cameras("paper-planar"))
    own = free.links[0].model_copy(update={"markers": system.links[0].markers})
    free = free.model_copy(update={"links": (own, *free.links[1:])})
    with pytest.raises(InputError, match="no rigid body; expected 'chaser'"):
        import_points(take, free, tmp_path / "run.csv")


def test_a_channel_in_both_recordings_is_refused(bench: tuple[System, sms.Capture], tmp_path: Path) -> None:
    system, data = bench
    take, _ = recorded(system, data, tmp_path)
    both = sms.write_capture(replace(data, truth=None), tmp_path / "both.csv")
    with pytest.raises(InputError, match=r"link_1\.marker_1\.x, .* in both"):
        import_points(take, system, tmp_path / "run.csv", open_source(both, system))
