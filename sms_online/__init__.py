"""Online parameter estimation for flexible space manipulators: `import sms_online as sms`.

A name is loaded when it is first used, so that importing costs nothing. Whatever is not named here is private.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sms_adapters.data_check import Check, check
    from sms_adapters.recorded import read_capture, write_capture
    from sms_adapters.runs import compare
    from sms_adapters.system_file import load_system
    from sms_online.capture import Capture
    from sms_online.description.parse import shipped_systems
    from sms_online.description.schema import System
    from sms_online.diagnosed import Diagnosis, diagnose
    from sms_online.errors import InputError
    from sms_online.history import History
    from sms_online.pipeline.events import Event
    from sms_online.repeatability import Comparison
    from sms_online.result import Coefficient, Finding, Parameter, Parameters, Result
    from sms_online.row_types import Residual
    from sms_online.session import Session, estimate
    from sms_online.stream import Block
    from sms_online.validation import Validation, validate
    from sms_online.verdict.trust import Trust
    from sms_sim.bound import Bounds, bound
    from sms_sim.capture import simulate
    from sms_sim.excitation import Excitation, excite
    from sms_sim.motion_limits import Limits
    from sms_tools.view.described import show

    __version__: str

# Where each name lives.
_HOMES = {
    "Block": "sms_online.stream",
    "Bounds": "sms_sim.bound",
    "Capture": "sms_online.capture",
    "Check": "sms_adapters.data_check",
    "Coefficient": "sms_online.result",
    "Comparison": "sms_online.repeatability",
    "Diagnosis": "sms_online.diagnosed",
    "Event": "sms_online.pipeline.events",
    "Excitation": "sms_sim.excitation",
    "Finding": "sms_online.result",
    "History": "sms_online.history",
    "InputError": "sms_online.errors",
    "Limits": "sms_sim.motion_limits",
    "Parameter": "sms_online.result",
    "Parameters": "sms_online.result",
    "Residual": "sms_online.row_types",
    "Result": "sms_online.result",
    "Session": "sms_online.session",
    "System": "sms_online.description.schema",
    "Trust": "sms_online.verdict.trust",
    "Validation": "sms_online.validation",
    "bound": "sms_sim.bound",
    "check": "sms_adapters.data_check",
    "compare": "sms_adapters.runs",
    "diagnose": "sms_online.diagnosed",
    "estimate": "sms_online.session",
    "excite": "sms_sim.excitation",
    "load_system": "sms_adapters.system_file",
    "read_capture": "sms_adapters.recorded",
    "shipped_systems": "sms_online.description.parse",
    "show": "sms_tools.view.described",
    "simulate": "sms_sim.capture",
    "validate": "sms_online.validation",
    "write_capture": "sms_adapters.recorded",
}

__all__ = [
    "Block",
    "Bounds",
    "Capture",
    "Check",
    "Coefficient",
    "Comparison",
    "Diagnosis",
    "Event",
    "Excitation",
    "Finding",
    "History",
    "InputError",
    "Limits",
    "Parameter",
    "Parameters",
    "Residual",
    "Result",
    "Session",
    "System",
    "Trust",
    "Validation",
    "__version__",
    "bound",
    "check",
    "compare",
    "diagnose",
    "estimate",
    "excite",
    "load_system",
    "read_capture",
    "shipped_systems",
    "show",
    "simulate",
    "validate",
    "write_capture",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("sms-online")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
