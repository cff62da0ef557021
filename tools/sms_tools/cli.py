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
UNDESCRIBED = "A is the least, C the most; B where no noise is described"


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
        epilog="Exit codes: 0 done; 1 nothing was received, or a capture is unfit; 2 bad input; 3 no parameter is "
        "determined (results are written); 130 interrupted.",
    )
    parser.add_argument("--version", action=Version, nargs=0, help="print the version")
    text = "print a completion script for the shell"
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
    parser.add_argument(
        "--json", action="store_true", help="print the result as JSON on stdout, and all else on stderr"
    )
    parser.set_defaults(module=module)
    return parser


def _add_system(parser: Parser, default: str | None = None) -> None:
    text = "a system file (.toml) or the name of a shipped system" + (f"; {default} by default" if default else "")
    parser.add_argument("--system", metavar="FILE|NAME", required=default is None, default=default, help=text)


def _add_out(parser: Parser, what: str = "for results.json and report.html; runs/<time> by default") -> None:
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"directory {what}")


def _add_view(parser: Parser, default: str = "off") -> None:
    places = "in a file in DIR, a page in the browser, a new viewer, or one that is running"
    text = f"show the session in rerun: {places}; {default} by default"
    names = "off|save|serve[=ADDRESS]|spawn|connect=URL"
    parser.add_argument("--rerun", metavar=names, type=rerun, default=default, help=text)
    text = "magnify the deflections that the view draws; 1 by default"
    parser.add_argument("--exaggerate", metavar="FACTOR", type=magnification, default=1.0, help=text)


def _add_adopt(parser: Parser) -> None:
    text = "add missing effects to the model as soon as they are named, and write them to adopted.toml"
    parser.add_argument("--adopt", action="store_true", help=text)


def _add_tracker(parser: Parser) -> None:
    text = (
        "replaces those of the system file: rls, rls:forgetting=KIND,memory=SECONDS or "
        "kalman:drift=KIND,PARAMETER=KIND/STD; may be repeated, and the first gives the estimate"
    )
    parser.add_argument("--tracker", metavar="TRACKER", action="append", help=text)


def _add_noise(parser: Parser) -> None:
    _add_grade(parser, "0 is none, C the most", "0", "A", "B", "C")
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="seed of the noise; 0 by default")


def _add_grade(parser: Parser, meaning: str, *grades: str) -> None:
    text = f"noise grade of all sensors, replaces the described noise: {meaning}"
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
    text = "continue from the last checkpoint of the session in DIR"
    parser.add_argument("--resume", metavar="DIR", type=Path, help=text)
    _add_duration(parser)
    _add_tracker(parser)
    _add_view(parser)


def _add_record(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "record", "record", "Record what devices send, without estimating.")
    text = (
        "a CAN bus, as python-can names it: [NAME=]INTERFACE:CHANNEL[:BITRATE][?OPTION=VALUE&…], such as "
        "socketcan:can0?fd=true"
    )
    parser.add_argument("--can", metavar="BUS", action="append", default=[], help=text)
    text = "a serial port: [NAME=]PATH[:BAUDRATE], such as /dev/ttyUSB0:115200"
    parser.add_argument("--serial", metavar="PORT", action="append", default=[], help=text)
    _add_out(parser, "for the recording; runs/<time> by default")
    _add_duration(parser)


def _add_duration(parser: Parser, text: str = "end the session after this time; Ctrl-C ends it too") -> None:
    parser.add_argument("--duration", metavar="SECONDS", type=seconds(positive=True), help=text)


def _add_simulate(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "simulate", "simulate", "Simulate a system; write a capture with its true parameters.")
    _add_system(parser)
    _add_capture(parser)
    _add_duration(parser, "length of the session; that of the described trajectory by default")
    text = "add an effect that the system file does not declare: NAME@WHERE:coefficient=value,…; may be repeated"
    parser.add_argument("--effect", metavar="EFFECT", action="append", default=[], help=text)
    text = (
        "change a parameter over time: PARAMETER:share=-0.1,over=60, PARAMETER:by=5,over=60 or "
        "PARAMETER:half_life=20, each also with begin=SECONDS; may be repeated"
    )
    parser.add_argument("--drift", metavar="DRIFT", action="append", default=[], help=text)
    text = (
        "add a fault of the cameras: missing@link_1.*:share=0.1, hidden@link_2.*:begin=8,over=2 or "
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
    text = "also compute the Cramér-Rao bound of every parameter"
    parser.add_argument("--bound", action="store_true", help=text)
    text = "max: as fast as possible; 1: at the recorded speed"
    parser.add_argument("--speed", choices=("max", "1"), default="max", help=text)
    _add_adopt(parser)
    _add_tracker(parser)
    _add_view(parser)


def _add_recorded(parser: Parser, text: str = "a capture, log or recording, as for replay") -> None:
    parser.add_argument("capture", metavar="CAPTURE", type=Path, help=text)


def _add_part(parser: Parser) -> None:
    parser.add_argument(
        "-ss", dest="start", metavar="SECONDS", type=seconds(), help="leave out the samples before this time"
    )
    parser.add_argument(
        "-to", dest="stop", metavar="SECONDS", type=seconds(positive=True), help="leave out the samples after this time"
    )


def _add_prior(parser: Parser) -> None:
    text = (
        "use as priors the nominal values of the system file, each ± 10 %% (a nominal value of 0 is none), or the "
        "estimates of a run with their covariance; priors that the file states itself always hold"
    )
    parser.add_argument("--prior", metavar="RESULTS", nargs="?", const=True, default=False, help=text)


def _add_diagnose(verbs: Verbs) -> None:
    text = "Find effects in a recorded session that its system file does not describe, and write them to a system file."
    parser = _add_verb(verbs, "diagnose", "diagnose", text)
    text = "a capture, log or recording, as for replay; several captures of one rig are searched together"
    parser.add_argument("captures", metavar="CAPTURE", type=Path, nargs="+", help=text)
    _add_system(parser)
    _add_out(parser, "for diagnosis.json, diagnosis.html and system.toml; runs/<time> by default")
    _add_part(parser)
    _add_prior(parser)
    text = (
        "check the findings on this capture, which is not searched; if it is the searched capture itself, on what "
        "comes after -to. Without it, blocks of time are held out in turn, or whole captures of several"
    )
    parser.add_argument("--holdout", metavar="CAPTURE", type=Path, help=text)
    text = "if no law of the catalogue is selected, try learned curves over a joint's rate, angle, deflection and load"
    parser.add_argument("--learn", action="store_true", help=text)
    _add_view(parser)


def _add_validate(verbs: Verbs) -> None:
    text = "Predict the torques of another run with fixed parameters, and measure what is left."
    parser = _add_verb(verbs, "validate", "validate", text)
    _add_recorded(parser)
    text = "results.json of a session, the folder of its run, or a system file, whose nominal values are used"
    parser.add_argument("--system", metavar="FILE|NAME", required=True, help=text)
    _add_out(parser, "for validation.json and validation.html; runs/<time> by default")
    _add_part(parser)


def _add_check(verbs: Verbs) -> None:
    text = "Check a capture before estimating: faults of its channels, and which parameters its motion determines."
    parser = _add_verb(verbs, "check", "check", text)
    _add_recorded(parser)
    _add_system(parser)
    _add_out(parser, "for check.json; nothing is written by default")


def _add_import(verbs: Verbs) -> None:
    text = "Convert a log or a published measurement to a capture, or a URDF to a system file."
    parser = _add_verb(verbs, "import", "import_data", text)
    text = "log: a bag, table, CAN log or recording; points: a motion capture (.c3d, Motive's or Nexus' .csv); "
    text += "quanser, emps: a published measurement (.mat); urdf"
    parser.add_argument("kind", metavar="KIND", choices=("log", "points", "quanser", "emps", "urdf"), help=text)
    parser.add_argument("source", metavar="SOURCE", type=Path, help="the file to import")
    text = "for log and points: the system file, whose [[source]] tables or marker names describe the contents"
    parser.add_argument("--system", metavar="FILE|NAME", help=text)
    _add_capture(parser, required=False)
    text = "for points: what drives and encoders recorded meanwhile; the capture then holds both, on this one's clock"
    parser.add_argument("--beside", metavar="RECORDED", type=Path, help=text)
    text = "for urdf: the system file to write; SOURCE with the ending .toml by default"
    parser.add_argument("--out", metavar="FILE.toml", type=Path, help=text)


def _add_export(verbs: Verbs) -> None:
    text = "Write estimates into the URDF that a system file was imported from."
    parser = _add_verb(verbs, "export", "export_urdf", text)
    parser.add_argument("kind", metavar="KIND", choices=("urdf",), help="urdf")
    parser.add_argument("source", metavar="SOURCE", type=Path, help="the URDF that was imported")
    text = "results of a session whose system file was imported from SOURCE"
    parser.add_argument("--results", metavar="results.json", type=Path, required=True, help=text)
    parser.add_argument("--out", metavar="FILE.urdf", type=Path, required=True, help="the URDF to write")


def _add_markers(verbs: Verbs) -> None:
    parser = _add_verb(verbs, "markers", "markers", "List the modes of each flexible link and the markers it needs.")
    _add_system(parser)
    text = "number of modes that the markers have to resolve; 2 by default"
    parser.add_argument("--modes", metavar="N", type=whole(1), default=2, help=text)


def _add_show(verbs: Verbs) -> None:
    text = "Draw a described arm in rerun, with its frames, joints, markers and channels; needs no data."
    parser = _add_verb(verbs, "show", "show", text)
    _add_system(parser)
    _add_out(parser, "for session.rrd, with --rerun save; runs/show by default")
    _add_view(parser, default="spawn")


def _add_bound(verbs: Verbs) -> None:
    text = "Compute the Cramér-Rao bound of each parameter for a motion and its sensors."
    parser = _add_verb(verbs, "bound", "bound", text)
    text = "a capture; without one the described trajectory is simulated"
    parser.add_argument("capture", metavar="CAPTURE", type=Path, nargs="?", help=text)
    _add_system(parser)
    _add_grade(parser, UNDESCRIBED, "A", "B", "C")
    text = "also compute the bounds without each of the described sensors"
    parser.add_argument("--each-sensor", action="store_true", help=text)


def _add_excite(verbs: Verbs) -> None:
    text = "Design a trajectory within limits that lowers the Cramér-Rao bounds of the parameters."
    parser = _add_verb(verbs, "excite", "excite", text)
    _add_system(parser)
    own = "that of the described motion by default"
    units = {
        "--angle": ("RAD", f"largest angle of a joint (m for a prismatic one); {own}"),
        "--rate": ("RAD/S", f"largest rate of a joint; {own}"),
        "--torque": ("NM", f"largest torque of a joint after its gear; {own}"),
        "--base-rotation": ("RAD", f"largest rotation of the base; {own}"),
        "--deflection": ("M", f"largest deflection of a marker; {own}"),
        "--duration": ("SECONDS", f"length of the motion; {own}"),
    }
    for name, (unit, text) in units.items():
        read = seconds(positive=True) if name == "--duration" else positive
        parser.add_argument(name, metavar=unit, type=read, help=text)
    text = "two effects, NAME@WHERE:coefficient=value, that a diagnosis could not separate: design for them alone"
    parser.add_argument("--separate", metavar="EFFECT", nargs=2, help=text)
    _add_grade(parser, UNDESCRIBED, "A", "B", "C")
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="seed of the random start; 0 by default")
    text = "largest number of optimiser steps; 6 by default"
    parser.add_argument("--iterations", metavar="N", type=whole(1), default=6, help=text)
    _add_out(parser, "for system.toml, reference.csv and excitation.json; runs/<time> by default")


def _add_compare(verbs: Verbs) -> None:
    text = "Compare the parameters of several sessions of one rig, and find what has changed."
    parser = _add_verb(verbs, "compare", "compare", text)
    text = "results.json of a session, or the folder of its run"
    parser.add_argument("runs", metavar="RUN", type=Path, nargs="+", help=text)
    _add_out(parser, "for the comparison; runs/<time> by default")


def _add_archive(verbs: Verbs) -> None:
    text = "Estimate and diagnose every capture under a folder into one table; continues an interrupted run."
    parser = _add_verb(verbs, "archive", "archive", text)
    parser.add_argument("folder", metavar="DIR", type=Path, help="the folder with captures, logs and recordings")
    _add_system(parser)
    _add_out(parser, "for rows, table and results; runs/archive-<name of DIR> by default")
    where = parser.add_mutually_exclusive_group()
    text = "number of processes on this machine; one for each core by default"
    where.add_argument("--workers", metavar="N", type=whole(1), help=text)
    text = "address of a Dask scheduler whose workers see the same files under the same names"
    where.add_argument("--scheduler", metavar="ADDRESS", help=text)
