"""Modules import one way: whoever reads one finds what it needs below it."""

from __future__ import annotations

import re
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PLACES = {"sms_online": ROOT, "sms_adapters": ROOT / "adapters", "sms_sim": ROOT / "sim", "sms_tools": ROOT / "tools"}
# Beginning of a line to the end of what is imported, which parentheses hold over several lines.
IMPORT = re.compile(r"^ *from (sms_[\w.]+) import (\([^)]*\)|.*)", re.MULTILINE)
# Resolves names of all packages when they are first used, and is imported for its version.
DOOR = "sms_online"
# Conveniences that go the other way: `System.nominal` asks the model which parameters there are, and the dynamics that
# `Model.dynamics` makes name their model as a type.
KNOWN = {
    "sms_online.description.schema": "sms_online.effects.build",
    "sms_online.model.dynamics": "sms_online.model.model",
}


def modules() -> dict[str, Path]:
    """Files of all modules by name."""
    return {
        ".".join(path.relative_to(place).with_suffix("").parts).removesuffix(".__init__"): path
        for package, place in PLACES.items()
        for path in sorted((place / package).rglob("*.py"))
    }


def imported(path: Path, known: dict[str, Path]) -> set[str]:
    """Modules that a file imports anywhere in it, in functions and for types too."""
    found = set()
    for module, names in IMPORT.findall(path.read_text(encoding="utf-8")):
        inner = {f"{module}.{name}" for name in re.findall(r"\w+", names)} & known.keys()
        found |= inner or {module}
    return found


def test_no_module_imports_one_that_imports_it() -> None:
    known = modules()
    assert len(known) > 300
    graph = {name: imported(path, known) & known.keys() - {DOOR} for name, path in known.items() if name != DOOR}
    for name, other in KNOWN.items():
        graph[name].remove(other)
    TopologicalSorter(graph).prepare()  # raises CycleError with the modules of a cycle


def test_the_estimator_imports_no_other_package_when_it_is_imported() -> None:
    others = tuple(PLACES.keys() - {DOOR})
    for name, path in modules().items():
        if name.startswith(f"{DOOR}.") and name != f"{DOOR}.__main__":
            modules_above = re.findall(r"^from (\S+) import", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert not [module for module in modules_above if module.startswith(others)], name
