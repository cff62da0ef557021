"""The reference of the command line, made of its own parser."""

from __future__ import annotations

import argparse
from html import escape

from sms_tools.cli import PROGRAM, _parser


def command_page() -> str:
    """Exit codes and options of the program, then one section a verb: its arguments and options."""
    parser = _parser()
    (verbs,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    parts = [f"## {name}\n\n{verb.description}\n\n{_table(verb)}\n" for name, verb in verbs.choices.items()]
    return "\n".join([f"{parser.epilog}\n", f"`{PROGRAM} VERB …`\n", _table(parser), "", *parts])


def _table(parser: argparse.ArgumentParser) -> str:
    """As HTML: in a table of Markdown no sign of the usage would be safe."""
    rows = [
        f"<tr><td><code>{escape(_shown(action))}</code></td><td>{escape(_help(parser, action))}</td></tr>"
        for action in parser._actions
        if not isinstance(action, argparse._SubParsersAction)
    ]
    head = "<thead><tr><th>as typed</th><th>meaning</th></tr></thead>"
    return f"<table>{head}<tbody>{''.join(rows)}</tbody></table>"


def _shown(action: argparse.Action) -> str:
    """An option with its value, or an argument, as it is typed."""
    value = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    if not action.option_strings:
        return f"[{value}]" if action.nargs == "?" else value
    if action.choices is not None and action.metavar is None:
        value = "|".join(str(choice) for choice in action.choices)
    return ", ".join(action.option_strings) + ("" if action.nargs == 0 else f" {value}")


def _help(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    """The help text with argparse's own substitutions, and what the parser knows beside it."""
    text = parser._get_formatter()._expand_help(action) if action.help else ""
    if isinstance(action, argparse._AppendAction) and "repeated" not in text:
        text += "; may be repeated"
    return f"{text}; required" if action.option_strings and action.required else text
