"""Published measurements (.mat) turned into captures. The data stay with their owners; only the conversion is here."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from sms_adapters.files import reading
from sms_adapters.mcap_capture import capture_writer
from sms_online.errors import InputError
from sms_online.stream import Array, Block

# Recorded times carry the rounding of their subtraction; the rigs' clocks tick in milliseconds.
_TIME_DECIMALS = 9


def import_emps(source: Path, capture: Path) -> int:
    """Turn DATA_EMPS.mat into a capture and return its number of samples.

    The Electro-Mechanical Positioning System of Janot, Gautier and Brunot, 1 kHz, 24.84 s: force_1 = gtau vir, N, and
    q_1 = qm, m, at the recorded times (within 0.032 µs of the 1 ms grid). qm is measured, on a grid of 5e-8 m. vir is
    the voltage that the controller sent to the amplifier, at full float resolution: the force is a command times the
    published drive gain, 35.15 N/V, not a measurement. The reference qg is left out.
    Raises InputError where a variable is missing or of another size.
    """
    data = load_matlab(source)
    gain = _numbers(source, data, "gtau", ())
    t = _numbers(source, data, "t", (None,))
    values = np.column_stack(
        [gain * _numbers(source, data, "vir", t.shape), _numbers(source, data, "qm", t.shape)],
    )
    return _write(source, capture, t, ("force_1", "q_1"), values)


def import_quanser(source: Path, capture: Path) -> int:
    """Turn lqr_full_10deg.mat into a capture of the part with measured current and return its number of samples.

    The 2-DOF Serial Flexible Link of CTU Prague (aa4cc), 500 Hz, the last 20 s, time from 0. With stage i:
    tau_i = Ktg_i I_i / Kg_i, N m at the motor shaft, from the measured current data_Im_i (grid 0.61 mA) and the maker's
    torque constant at the output and gear ratio; theta_m_i = the hub encoder data_th_i1 (grid 15.3 and 30.7 µrad) and
    link_i.strain_angle = the tip deflection as an angle from the root's strain, data_th_i2, rad. All are the third
    columns, angles in degrees. In radians they equal stage1_X1_meas and stage2_X2_sim to 1e-16 at the same instants: in
    spite of its name the latter holds the measured stage 2, and stage2_X2_meas its reference. The strain, alone among
    the signals, shows no grid.
    Raises InputError where a variable is missing, of another size, or not on the instants of the first current.
    """
    data = load_matlab(source)
    t = _numbers(source, data, "data_Im1", (None, 3))[:, 0]
    channels: list[str] = []
    columns: list[Array] = []
    for stage in (1, 2):
        current, hub, deflection = (
            _measured(source, data, name, t) for name in (f"data_Im{stage}", f"data_th{stage}1", f"data_th{stage}2")
        )
        torque_constant = _numbers(source, data, f"Ktg{stage}", ())
        gear = _numbers(source, data, f"Kg{stage}", ())
        channels += [f"tau_{stage}", f"theta_m_{stage}", f"link_{stage}.strain_angle"]
        columns += [torque_constant * current / gear, np.deg2rad(hub), np.deg2rad(deflection)]
    return _write(source, capture, np.round(t - t[0], _TIME_DECIMALS), tuple(channels), np.column_stack(columns))


def load_matlab(source: Path, names: Sequence[str] | None = None) -> Mapping[str, Any]:
    """Variables of a .mat file up to version 7, structs as dictionaries. names: which. InputError: it is none."""
    try:
        with reading(source, "a readable .mat file"), source.open("rb") as file:
            # Its stubs know names only.
            return loadmat(file, simplify_cells=True, variable_names=names)  # type: ignore[arg-type]
    except (MatReadError, ValueError, TypeError, NotImplementedError, zlib.error) as error:
        raise InputError(str(source), "", f"no MATLAB data ({error})", "a .mat file of version 7 or older") from None


def _numbers(source: Path, data: Mapping[str, Any], name: str, shape: tuple[int | None, ...]) -> Array:
    """A variable as float64; InputError where it is missing, not of the shape (None: any length) or not finite."""
    if name not in data:
        raise InputError(str(source), "", f"no variable {name!r}", "the file as its owners published it")
    value = np.asarray(data[name])
    expected = " x ".join("n" if n is None else str(n) for n in shape) or "a number"
    if (
        value.dtype.kind not in "iuf"
        or value.ndim != len(shape)
        or any(n is not None and n != m for n, m in zip(shape, value.shape, strict=True))
    ):
        raise InputError(str(source), f"variable {name!r}", f"{value.dtype} of shape {value.shape}", expected)
    if not np.isfinite(value).all():
        raise InputError(str(source), f"variable {name!r}", "NaN or infinity", "finite numbers")
    return value.astype(np.float64)


def _measured(source: Path, data: Mapping[str, Any], name: str, t: Array) -> Array:
    """The measured column of [t, commanded or reference, measured], checked to be sampled at the instants t."""
    table = _numbers(source, data, name, (t.size, 3))
    if not np.array_equal(table[:, 0], t):
        raise InputError(str(source), f"variable {name!r}", "other times than data_Im1", "one clock for all tables")
    return table[:, 2]


def _write(source: Path, capture: Path, t: Array, channels: tuple[str, ...], values: Array) -> int:
    if not (t.size and (np.diff(t) > 0).all()):
        raise InputError(str(source), "", "times that do not increase", "one sample after the other")
    with capture_writer(capture, channels) as writer:
        writer.write(Block(t, channels, values))
    return t.size
