"""The command line `sms-online`: one parser, one module a verb, one place for exit codes.

Nothing here imports NumPy, so that help and usage errors come at once.
"""

from __future__ import annotations

import argparse
import importlib
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from sms_online.errors import InputError
from sms_tools.exit_codes import BAD_INPUT, INTERRUPTED, OK
from sms_tools.option_values import magnification, positive, rerun, seconds, whole

PROGRAM = "sms-online"


class Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with the arguments; options are spelt out."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Exit with code 2 after one line."""
        self.exit(BAD_INPUT, f"{self.prog}: {message}\n")


class Version(argparse.Action):
    """Prints which version this is."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Exit with code 0."""
        from importlib.metadata import version  # costs as much as all the rest of a usage error

        print(f"{PROGRAM} {version(PROGRAM)}")
        parser.exit(OK)


class Completion(argparse.Action):
    """Prints the completion of verbs, options and files for a shell."""

    def __call__(self, parser: argparse.ArgumentParser, _: argparse.Namespace, shell: Any, *more: object) -> NoReturn:
        """Exit with code 0."""
        import shtab

        for each in (parser, *parser._subparsers._group_actions[0].choices.values()):  # type: ignore[union-attr]
            for action in each._actions:
                if action.type is Path or action.dest == "system":
                    files = shtab.DIRECTORY if action.metavar == "DIR" else shtab.FILE
                    action.complete = files
        print(shtab.complete(parser, shell))
        parser.exit(OK)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code: 0, 2 bad input, 3 nothing determined, 130 interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters shows ? for ρ
    try:
        args = _parser().parse_args(arguments)
        code: int = importlib.import_module(f"sms_tools.verbs.{args.module}").run(args)
        sys.stdout.flush()
    except InputError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return BAD_INPUT
    except SystemExit as exit_:  # argparse, after help or an error
        return int(exit_.code or OK)
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of the output has left (| head); results are in their files by then. What is still in the buffer
        # must not be written at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except OSError as error:  # a full disk, a file without permission
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return BAD_INPUT
    return code


def _parser() -> Parser:
    parser = Parser(
        prog=PROGRAM,
        description="Online parameter estimation for flexible space manipulators.",
        epilog="Exit codes: 0 done, 1 nothing was received to record or a capture is not fit, 2 bad input, 3 nothing "
        "is determined (results are written), 130 interrupted.",
    )
    parser.add_argument("--version", action=Version, nargs=0, help="which version this is")
    text = "how bash, zsh or tcsh complete what is typed, to be written where the shell looks for it"
    parser.add_argument("--print-completion", action=Completion, choices=("bash", "zsh", "tcsh"), help=text)
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    verb_parsers = (
        _add_demo, _add_live, _add_record, _add_simulate, _add_check, _add_replay, _add_diagnose, _add_validate,
        _add_import, _add_export, _add_markers, _add_bound, _add_excite, _add_compare, _add_archive, _add_show,
    )  # fmt: skip
    for add in verb_parsers:
        add(verbs)
    return parser


Verbs = Any  # argparse's action of add_subparsers is private


def _add_verb(verbs: Verbs, name: str, module: str, description: str) -> Parser:
    """A verb with the option that all have."""
    parser: Parser = verbs.add_parser(name, help=description, description=description)
    parser.add_argument("--json", action="store_true", help="the result as JSON on stdout, all else on stderr")
    parser.set_defaults(module=module)
    return parser


def _add_system(parser: Parser, default: str | None = None) -> None:
    text = "a system file (.toml) or the name of a shipped system" + (f", {default} by default" if default else "")
    parser.add_argument("--system", metavar="FILE|NAME", required=default is None, default=default, help=text)


def _add_out(parser: Parser, what: str = "results.json goes, runs/<time> by default") -> None:
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"where {what}")


def _add_view(parser: Parser, default: str = "off") -> None:
    places = "a file in DIR, a page in the browser, a viewer started or running already"
    text = f"view in rerun: {places}; {default} by default"
    names = "off|save|serve[=ADDRESS]|spawn|connect=URL"
    parser.add_argument("--rerun", metavar=names, type=rerun, default=default, help=text)
    text = "factor on the deflections that the view draws, 1 by default"
    parser.add_argument("--exaggerate", metavar="FACTOR", type=magnification, default=1.0, help=text)


def _add_adopt(parser: Parser) -> None:
    text = "add effects that the model lacks to it as soon as they are named, and write adopted.toml with them"
    parser.add_argument("--adopt", action="store_true", help=text)


def _add_tracker(parser: Parser) -> None:
    text = (
        "in place of the system file's: rls, rls:forgetting=KIND,memory=SECONDS or "
        "kalman:drift=KIND,PARAMETER=KIND/STD; may be repeated, the first gives the estimate"
    )
    parser.add_argument("--tracker", metavar="TRACKER", action="append", help=text)


def _add_noise(parser: Parser) -> None:
    _add_grade(parser, "0 none, A, B, C ever more", "0", "A", "B", "C")
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the noise, 0 by default")


def _add_grade(parser: Parser, meaning: str, *grades: str) -> None:
    text = f"noise of all sensors in place of the described one: {meaning}"
    parser.add_argument("--grade", choices=grades, help=text)


def _add_capture(parser: Parser, required: bool = True) -> None:
    text = "the capture to write: .csv, or .mcap for Foxglove and PlotJuggler"
    parser.add_argument("--capture", metavar="FILE", type=Path, required=required, help=text)


def _add_demo(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "demo", "demo", "Simulate the paper's example and watch its parameters converge.")
    _add_system(parser, default="paper-planar")
    _add_noise(parser)
    # Less noise than that of the devices' clocks would leave residuals that the sensors do not explain.
    parser.set_defaults(grade="B")
    _add_out(parser)
    _add_tracker(parser)
    _add_view(parser)


def _add_live(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "live", "live", "Estimate while the testbed moves, and record what its devices send.")
    _add_system(parser)
    _add_out(parser)
    _add_adopt(parser)
    text = "go on from the last checkpoint of an earlier session"
    parser.add_argument("--resume", metavar="DIR", type=Path, help=text)
    _add_duration(parser)
    _add_tracker(parser)
    _add_view(parser)


def _add_record(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "record", "record", "Record what devices send, without estimating anything.")
    text = (
        "a CAN bus by python-can's names: [NAME=]INTERFACE:CHANNEL[:BITRATE][?OPTION=VALUE&…], such as "
        "socketcan:can0?fd=true"
    )
    parser.add_argument("--can", metavar="BUS", action="append", default=[], help=text)
    text = "a serial port: [NAME=]PATH[:BAUDRATE], such as /dev/ttyUSB0:115200"
    parser.add_argument("--serial", metavar="PORT", action="append", default=[], help=text)
    _add_out(parser, "the recording goes, runs/<time> by default")
    _add_duration(parser)


def _add_duration(parser: Parser, text: str = "end after so long; Ctrl-C ends it too") -> None:
    parser.add_argument("--duration", metavar="SECONDS", type=seconds(positive=True), help=text)


def _add_simulate(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "simulate", "simulate", "Simulate a system; write a capture, and its truth beside it.")
    _add_system(parser)
    _add_capture(parser)
    _add_duration(parser, "length of the session, the described trajectory's by default")
    text = "an effect that the system file does not declare, NAME@WHERE:coefficient=value,…; may be repeated"
    parser.add_argument("--effect", metavar="EFFECT", action="append", default=[], help=text)
    text = (
        "a parameter that changes on the way: PARAMETER:share=-0.1,over=60, PARAMETER:by=5,over=60 or "
        "PARAMETER:half_life=20, and begin=SECONDS; may be repeated"
    )
    parser.add_argument("--drift", metavar="DRIFT", action="append", default=[], help=text)
    text = (
        "a fault of the cameras: missing@link_1.*:share=0.1, hidden@link_2.*:begin=8,over=2 or "
        "swapped@link_1.marker_1+link_1.marker_2:begin=5,over=1; may be repeated"
    )
    parser.add_argument("--fault", metavar="FAULT", action="append", default=[], help=text)
    _add_noise(parser)


def _add_replay(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "replay", "replay", "Estimate the parameters of a system from a recorded session.")
    _add_recorded(parser, "a capture (.csv), CAN log, bag, table or recording")
    _add_system(parser)
    _add_out(parser)
    _add_part(parser)
    _add_prior(parser)
    text = "the Cramér-Rao bound of every parameter too, as the yardstick of its estimate"
    parser.add_argument("--bound", action="store_true", help=text)
    text = "as fast as it goes, or in step with the recorded time"
    parser.add_argument("--speed", choices=("max", "1"), default="max", help=text)
    _add_adopt(parser)
    _add_tracker(parser)
    _add_view(parser)


def _add_recorded(parser: Parser, text: str = "a capture, log or recording, as for replay") -> None:
    parser.add_argument("capture", metavar="CAPTURE", type=Path, help=text)


def _add_part(parser: Parser) -> None:
    parser.add_argument("-ss", dest="start", metavar="SECONDS", type=seconds(), help="leave out what is before")
    parser.add_argument("-to", dest="stop", metavar="SECONDS", type=seconds(positive=True), help="and what is after")


def _add_prior(parser: Parser) -> None:
    text = (
        "start from the system file's nominal values, each ± 10 %% (those of 0 stay unknown); "
        "priors that the file itself states hold with and without it"
    )
    parser.add_argument("--prior", action="store_true", help=text)


def _add_diagnose(verbs: Verbs) -> None:
    text = "Find what a recorded session holds that its system file does not describe, and describe it."
    parser = _add_verb(verbs, "diagnose", "diagnose", text)
    text = "a capture, log or recording, as for replay; several of the same rig are searched at once"
    parser.add_argument("captures", metavar="CAPTURE", type=Path, nargs="+", help=text)
    _add_system(parser)
    _add_out(parser)
    _add_part(parser)
    _add_prior(parser)
    text = (
        "check what is found on this capture, which decides nothing; the one that is searched means what comes after "
        "-to. Without it blocks of time are held out in turn, of several captures each"
    )
    parser.add_argument("--holdout", metavar="CAPTURE", type=Path, help=text)
    text = "where no law of the catalogue is selected, try curves over a joint's rate, angle, deflection and load"
    parser.add_argument("--learn", action="store_true", help=text)
    _add_view(parser)


def _add_validate(verbs: Verbs) -> None:
    text = "Predict another run with everything fixed, and measure what is left of its torques."
    parser = _add_verb(verbs, "validate", "validate", text)
    _add_recorded(parser)
    text = "results.json of a session or the folder of its run; or a system file, whose nominal values are taken"
    parser.add_argument("--system", metavar="FILE|NAME", required=True, help=text)
    _add_out(parser, "validation.json goes, runs/<time> by default")
    _add_part(parser)


def _add_check(verbs: Verbs) -> None:
    text = "What is the matter with a capture, and what its motion determines: before it is estimated from."
    parser = _add_verb(verbs, "check", "check", text)
    _add_recorded(parser)
    _add_system(parser)
    _add_out(parser, "check.json goes; none is written by default")


def _add_import(verbs: Verbs) -> None:
    text = "Turn a log, or a published measurement, into a capture, or a URDF into a system file."
    parser = _add_verb(verbs, "import", "import_data", text)
    text = "log: a bag, table, CAN log or recording; points: a motion capture (.c3d, Motive's or Nexus' .csv); "
    text += "quanser, emps: a published measurement (.mat); urdf"
    parser.add_argument("kind", metavar="KIND", choices=("log", "points", "quanser", "emps", "urdf"), help=text)
    parser.add_argument("source", metavar="SOURCE", type=Path, help="the file as it is")
    text = "of a log: the system file, whose [[source]] tables say what its numbers are, or whose markers have names"
    parser.add_argument("--system", metavar="FILE|NAME", help=text)
    _add_capture(parser, required=False)
    text = "of a URDF: the system file to write, SOURCE with the ending .toml by default"
    parser.add_argument("--out", metavar="FILE.toml", type=Path, help=text)


def _add_export(verbs: Verbs) -> None:
    text = "Put estimates into the URDF that a system file was imported from."
    parser = _add_verb(verbs, "export", "export_urdf", text)
    parser.add_argument("kind", metavar="KIND", choices=("urdf",), help="urdf")
    parser.add_argument("source", metavar="SOURCE", type=Path, help="the URDF as it was imported")
    text = "of a session whose system file was imported from it"
    parser.add_argument("--results", metavar="results.json", type=Path, required=True, help=text)
    parser.add_argument("--out", metavar="FILE.urdf", type=Path, required=True, help="the URDF to write")


def _add_markers(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "markers", "markers", "Eigenmodes of each flexible link and the markers that they need.")
    _add_system(parser)
    text = "how many modes the markers have to resolve, 2 by default"
    parser.add_argument("--modes", metavar="N", type=whole(1), default=2, help=text)


def _add_show(verbs: Verbs) -> None:
    text = "Draw a described arm in rerun, with its frames, joints, markers and channels, before there are any data."
    parser = _add_verb(verbs, "show", "show", text)
    _add_system(parser)
    _add_out(parser)
    _add_view(parser, default="spawn")


def _add_bound(verbs: Verbs) -> None:
    text = "The least standard deviation that a motion and its sensors allow (Cramér-Rao)."
    parser = _add_verb(verbs, "bound", "bound", text)
    text = "a capture; without one the described trajectory is simulated"
    parser.add_argument("capture", metavar="CAPTURE", type=Path, nargs="?", help=text)
    _add_system(parser)
    _add_grade(parser, "A, B, C ever more; B where none is described", "A", "B", "C")
    text = "what the bounds would be without each of the described sensors"
    parser.add_argument("--each-sensor", action="store_true", help=text)


def _add_excite(verbs: Verbs) -> None:
    text = "Design the trajectory that parameters are best estimated from, within limits, by the Cramér-Rao bound."
    parser = _add_verb(verbs, "excite", "excite", text)
    _add_system(parser)
    own = "the described motion's own by default"
    units = {
        "--angle": ("RAD", f"largest angle of a joint (m on a prismatic one), {own}"),
        "--rate": ("RAD/S", f"largest rate of a joint, {own}"),
        "--torque": ("NM", f"largest torque of a joint after its gear, {own}"),
        "--base-rotation": ("RAD", f"how far the base may turn, {own}"),
        "--deflection": ("M", f"largest deflection of a marker, {own}"),
        "--duration": ("SECONDS", f"length of the motion, {own}"),
    }
    for name, (unit, text) in units.items():
        read = seconds(positive=True) if name == "--duration" else positive
        parser.add_argument(name, metavar=unit, type=read, help=text)
    text = (
        "two effects, NAME@WHERE:coefficient=value, that a diagnosis could not separate: the motion is designed for "
        "their coefficients; all parameters count without it"
    )
    parser.add_argument("--separate", metavar="EFFECT", nargs=2, help=text)
    _add_grade(parser, "A, B, C ever more; B where none is described", "A", "B", "C")
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the random draw, 0 by default")
    text = "steps of the optimiser at most, 15 by default"
    parser.add_argument("--iterations", metavar="N", type=whole(1), default=15, help=text)
    _add_out(parser, "system.toml, reference.csv and excitation.json go, runs/<time> by default")


def _add_compare(verbs: Verbs) -> None:
    text = "Each parameter over sessions of one rig, and what has changed."
    parser = _add_verb(verbs, "compare", "compare", text)
    text = "results.json of a session, or the folder of its run"
    parser.add_argument("runs", metavar="RUN", type=Path, nargs="+", help=text)
    _add_out(parser, "the page goes, runs/<time> by default")


def _add_archive(verbs: Verbs) -> None:
    text = "Identify and diagnose every capture under a folder, in one table; go on where an earlier run ended."
    parser = _add_verb(verbs, "archive", "archive", text)
    parser.add_argument("folder", metavar="DIR", type=Path, help="the folder with captures, logs and recordings")
    _add_system(parser)
    _add_out(parser, "rows, table and results go, runs/archive-<name of DIR> by default")
    where = parser.add_mutually_exclusive_group()
    text = "processes of this machine, one for each core by default"
    where.add_argument("--workers", metavar="N", type=whole(1), help=text)
    text = "address of a Dask scheduler, whose workers see the same files under the same names"
    where.add_argument("--scheduler", metavar="ADDRESS", help=text)
