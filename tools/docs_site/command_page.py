"""The reference of the command line, made of its own parser."""

from __future__ import annotations

import argparse
import re

from sms_tools.cli import PROGRAM, _parser

# What Markdown would take for more than text.
SIGNS = re.compile(r"[\\`*_\[\]<>|]")


def command_page() -> str:
    """One section a verb: usage, arguments, options."""
    parser = _parser()
    (verbs,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    parts = [_verb(name, verb) for name, verb in verbs.choices.items()]
    return "\n".join([f"{parser.epilog}", "", *parts])


def _verb(name: str, parser: argparse.ArgumentParser) -> str:
    lines = [f"## {name}", "", parser.description or "", "", "| | |", "|---|---|"]
    lines += [f"| {_shown(action)} | {_help(parser, action)} |" for action in parser._actions]
    return "\n".join([f"{line}" for line in lines] + [""]).replace(f"{PROGRAM} {name}", f"`{PROGRAM} {name}`")


def _shown(action: argparse.Action) -> str:
    """An option with its value, or an argument, as it is typed."""
    value = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    if not action.option_strings:
        text = value if action.nargs != "?" else f"[{value}]"
    else:
        if action.choices is not None and action.metavar is None:
            value = "|".join(str(choice) for choice in action.choices)
        text = ", ".join(action.option_strings) + ("" if action.nargs == 0 else f" {value}")
    required = " (required)" if action.option_strings and action.required else ""
    return f"`{text}`{required}".replace("|", "\\|")


def _help(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    """The help text with argparse's own substitutions."""
    text = parser._get_formatter()._expand_help(action) if action.help else ""
    repeated = "; may be repeated" if isinstance(action, argparse._AppendAction) and "repeated" not in text else ""
    return SIGNS.sub(r"\\\g<0>", text + repeated)
