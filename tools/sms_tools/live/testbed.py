"""A described testbed, opened: clock, recorder, a feed for each source, merger and estimator as one session."""

from __future__ import annotations

import shutil
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from sms_adapters.checkpoint import read_checkpoint
from sms_adapters.clock_lanes import merger
from sms_adapters.clock_merge import Merger
from sms_adapters.devices import make_reader
from sms_adapters.recorder import Recorder
from sms_adapters.session_log import CHECKPOINT as RESUMED_FROM
from sms_adapters.session_log import MICROSECOND, SYSTEM, SessionHeader, read_header
from sms_adapters.system_file import system_text
from sms_online.checkpoint import SOURCE
from sms_online.description.given import given_system
from sms_online.description.parse import shipped_systems
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.session import Session
from sms_tools.live.feed import Feed, Interpreter, SessionClock
from sms_tools.live.loop import CHECKPOINT, LiveSession
from sms_tools.live.status import StatusWriter

PROGRAMS = ("sms-online", "numpy", "python-can", "pyserial", "cantools")
# After the last sample before a resumption, s: longer than any hole that the synchroniser bridges.
PAUSE = 2.0
# Threads give way to each other after so long, s; by default it is 5 ms, in which a bus sends a dozen frames.
SWITCH_INTERVAL = 1e-3


def versions() -> dict[str, str]:
    """Versions of the programs that a recording depends on, as far as they are installed."""
    found = {}
    for program in PROGRAMS:
        try:
            found[program] = version(program)
        except PackageNotFoundError:
            continue
    return found


def system_files(name: str, system: System) -> dict[str, bytes]:
    """The system file of a name or path, as `system.toml`, and the files beside it that it names."""
    files, path = {SYSTEM: system_text(name).encode()}, Path(name)
    if name in shipped_systems():
        return files
    for source in system.sources:
        for file in [getattr(source, "dbc", None), *getattr(source, "nodes", {}).values()]:
            if file is not None and (path.parent / file).is_file():
                files[Path(file).name] = (path.parent / file).read_bytes()
    return files


def open_testbed(
    name: str,
    system: System,
    folder: Path | None,
    directory: Path,
    resume: Path | None = None,
    status: StatusWriter | None = None,
    adopt: bool = False,
) -> tuple[LiveSession, Session, Merger]:
    """The session of a system, its devices not yet opened; it records into `directory`.

    name: of the system, as given. folder: where its file lies. resume: directory of an earlier session, from whose
    last checkpoint this one goes on. Threads of this process give way to each other sooner from now on. Raises
    InputError for a system without sources, files that do not fit, a directory that cannot be written, a checkpoint of
    another system.
    """
    channels = merger(system, folder).channels
    checkpoint = None if resume is None else read_checkpoint(resumable(resume))
    session = Session(system, channels, adopt=adopt, source=name, checkpoint=checkpoint)
    clock = SessionClock()
    start = 0.0 if resume is None else resumed_start(resume, session, clock.epoch)
    header = SessionHeader(
        clock.epoch,
        {source.name: source.recorded for source in system.devices},
        start,
        versions(),
        trackers=() if system.trackers == given_system(name)[0].trackers else system.trackers,
    )
    recorder = Recorder(directory, header, system_files(name, system))
    if resume is not None:
        shutil.copyfile(resume / CHECKPOINT, directory / RESUMED_FROM)
    interpreter = Interpreter()
    sys.setswitchinterval(SWITCH_INTERVAL)
    feeds = [Feed(make_reader(source, clock, interpreter.await_free), recorder) for source in system.devices]
    merged = merger(system, folder, start)
    if checkpoint is not None:
        checkpoint.put_beside(SOURCE, merged)
    live = LiveSession(clock, feeds, merged, session, start, directory, recorder, status, interpreter)
    return live, session, merged


def resumable(resume: Path) -> Path:
    """The checkpoint of an earlier session; InputError where there is none."""
    checkpoint = resume / CHECKPOINT
    if not checkpoint.is_file():
        raise InputError(str(resume), "", f"no {CHECKPOINT}", "the directory of a live session of five seconds or more")
    return checkpoint


def resumed_start(resume: Path, session: Session, epoch: int) -> float:
    """Time of a new session's clock zero in the time of the earlier one that it goes on from, s."""
    header, _ = read_header(resume)
    return max(header.start + (epoch - header.epoch) * MICROSECOND, session.estimator.end + PAUSE)
