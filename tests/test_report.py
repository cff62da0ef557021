"""What a person reads at a terminal: the table in the width there is, and the verdict in its colour."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from sms_tools.report import parameter_table, report_console, show, table, verdict_text

LONGEST_NAME = "spacecraft.inertia_about_joint_1"


def parameter(name: str, identifiable: bool = True, true: float | None = None) -> dict[str, Any]:
    estimate, std = 865.0211, 0.012
    bounds = {"lower95": 864.9976, "upper95": 865.0446}
    return {"name": name, "unit": "kg m²", "estimate": estimate, "std": std, "identifiable": identifiable} | {
        **bounds,
        "true": true,
    }


def printed(document: dict[str, Any], width: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    console.print(parameter_table(document, width))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("true", [None, 865.008])
def test_the_interval_stays_in_a_narrow_terminal(true: float | None) -> None:
    lines = printed({"parameters": [parameter(LONGEST_NAME, true=true)]}, 80)
    assert "95 % interval" in lines[0]
    assert any("864.998 … 865.045" in line for line in lines)
    assert ("error %" in lines[0]) == (true is not None)


@pytest.mark.parametrize("text", ["/dev/null:abc: gone", "run[1].csv: [bold] is no style", "[red]x[/red]"])
def test_messages_are_shown_as_they_are(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    show(report_console(json=False), text, table(("what",), [(text,)]))
    assert capsys.readouterr().out.count(text) == 2


def test_a_wide_terminal_shows_the_deviation_and_the_truth_too() -> None:
    heading, line = printed({"parameters": [parameter(LONGEST_NAME, true=865.008)]}, 120)
    assert all(word in heading for word in ("± std", "95 % interval", "true", "error %"))
    assert all(number in line for number in ("865.021", "0.012", "864.998 … 865.045", "865.008", "+0.0015"))


@pytest.mark.parametrize("width", [80, 120])
def test_what_is_not_determined_has_no_interval(width: int) -> None:
    _, line = printed({"parameters": [parameter("link_1.inertia", identifiable=False)]}, width)
    assert "not determined" in line
    assert "…" not in line


@pytest.mark.parametrize(
    ("level", "grave", "color"),
    [("trust", False, "green"), ("doubt", False, "yellow"), ("doubt", True, "red"), ("not yet", False, "bright_black")],
)
def test_a_verdict_has_the_colour_of_its_level(level: str, grave: bool, color: str) -> None:
    reasons = ["first", "another"]
    verdict = {"level": level, "grave": grave, "sentence": "What is said", "reasons": reasons, "next_step": "do it"}
    text = verdict_text(verdict)
    assert text.plain == "What is said\n  another\n  next: do it"
    assert any(color in str(span.style) for span in text.spans if span.start == 0)
