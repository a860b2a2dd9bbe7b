"""The command line: parses, calls, prints, sets the exit status."""

from __future__ import annotations

import argparse
import ctypes
import logging
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sasmap.errors import InputError
from sasmap.run.wording import duration
from sasmap.settings.survey import load_survey, survey_schema
from sasmap.version import VERSION

# Number of latest finished cells from whose rate the remaining time is estimated (a choice: seconds
# to minutes).
# Least time, s, over which they must spread: cells kept from an earlier run end all at once.
LATEST, LEAST_PACED = 32, 1.0
# Parameters of glibc's heaps, and their values (choices). Threads share two heaps (M_ARENA_MAX): a
# heap per thread keeps the memory of the thread's largest cell, 150 of 870 MB in a run of 25 Mpx
# with two threads, and saves no time. Arrays up to 32 MB, the largest possible value, are allocated
# in the heaps (M_MMAP_THRESHOLD), which keep 256 MB of free memory (M_TRIM_THRESHOLD): allocating
# each from the system took 2 of 34 s of the sediment stage of 100 Mpx, and as much memory.
HEAPS = ((-8, 2), (-3, 32 << 20), (-1, 256 << 20))
AGAIN = 1.0  # seconds until an interrupt that was dropped is raised again (a choice)
COMPLETE, INCOMPLETE, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand and return the exit status.

    Parameters
    ----------
    arguments : sequence of str, optional
        Default: those of the process.

    Returns
    -------
    int
        0 complete, 1 some cells could not be computed, 2 bad usage or input, 130 interrupted.
    """
    options = _parser().parse_args(arguments)
    try:
        return int(options.call(options))
    except InputError as error:
        for fault in error.faults:
            print(f"sasmap: {_readable(fault)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt as stop:
        signal.setitimer(signal.ITIMER_REAL, 0)
        print(f"sasmap: {stop or 'interrupted'}; run again to go on from here", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader has closed the pipe; Python would flush stdout once more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return COMPLETE
    except OSError as error:
        print(f"sasmap: {error}", file=sys.stderr)
        return INCOMPLETE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sasmap", description="Sand ripples and sediments from sonar tiles, with error bars."
    )
    parser.add_argument("--version", action="version", version=f"sasmap {VERSION}")
    verbs = parser.add_subparsers(title="verbs", required=True, metavar="VERB")
    _add_survey_verbs(verbs)
    _add_other_verbs(verbs)
    return parser


def _add_survey_verbs(verbs: Any) -> None:
    """Add the subcommands that take a survey file: run and plan."""
    run = verbs.add_parser(
        "run",
        help="run a survey",
        description="Run a survey. Example: sasmap run sample_data/survey.yaml",
    )
    run.add_argument("survey", type=Path, help="survey file")
    run.add_argument("--output", type=_folder, metavar="DIR", help="folder of the products")
    where = run.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_positive, metavar="N", help="threads; default: cores")
    where.add_argument("--scheduler", metavar="ADDRESS", help="dask.distributed scheduler to use")
    run.add_argument("--restart", action="store_true", help="discard finished cells first")
    run.add_argument("--quiet", action="store_true", help="print only warnings and errors")
    run.set_defaults(call=_run)

    plan = verbs.add_parser(
        "plan",
        help="show what would run; writes nothing",
        description="Show what would run, and what is left out. Example: sasmap plan survey.yaml",
    )
    plan.add_argument("survey", type=Path, help="survey file")
    plan.add_argument("--output", type=_folder, metavar="DIR", help="folder of the products")
    plan.add_argument("--workers", type=_positive, metavar="N", help="threads; default: cores")
    plan.set_defaults(call=_plan)


def _add_other_verbs(verbs: Any) -> None:
    """Add the subcommands that make surveys or help to write them."""
    simulate = verbs.add_parser(
        "simulate",
        help="simulate a survey with known truth",
        description="Simulate a survey. Example: sasmap simulate scene.yaml --output scene",
    )
    simulate.add_argument("scene", type=Path, help="scene file")
    simulate.add_argument("--output", type=_folder, required=True, metavar="DIR", help="folder")
    simulate.set_defaults(call=_simulate)

    tiles = verbs.add_parser(
        "tiles",
        help="turn a raw recording into tiles, navigation and a survey file",
        description="Turn a raw recording (XTF; extra raw) into ground-range tiles, navigation and "
        "a survey file. Example: sasmap tiles LINE.xtf --output line",
    )
    tiles.add_argument("recording", type=Path, help="XTF file")
    tiles.add_argument("--output", type=_folder, required=True, metavar="DIR", help="folder")
    tiles.add_argument("--crs", help="CRS of its positions, where they are in metres")
    tiles.add_argument("--pixel", type=_metres, metavar="M", help="pixel size, m")
    tiles.set_defaults(call=_tiles)

    schema = verbs.add_parser(
        "schema",
        help="print the JSON Schema of survey.yaml",
        description="Print the JSON Schema of survey.yaml, for editors. Example: sasmap schema",
    )
    schema.set_defaults(call=_schema)

    completion = verbs.add_parser(
        "completion",
        help="print a script that completes commands in a shell",
        description="Print a script that completes commands. Example: sasmap completion bash >> "
        "~/.bashrc",
    )
    completion.add_argument("shell", choices=("bash", "zsh", "fish"), help="the shell")
    completion.set_defaults(call=_completion)


def _positive(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return value


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1e-3 <= value <= 100:
        raise argparse.ArgumentTypeError(f"expected metres from 0.001 to 100, got {text!r}")
    return value


def _folder(text: str) -> Path:
    if not text.strip():
        raise argparse.ArgumentTypeError("expected a folder, got an empty text")
    return Path(text)


def _run(options: argparse.Namespace) -> int:
    from sasmap.run.answers import summary_lines
    from sasmap.run.pipeline import run_survey  # the compiled code loads only where it is needed

    _log(options.quiet)
    survey = load_survey(options.survey)
    progress = None if options.quiet else _Progress()
    outcome = run_survey(
        survey,
        output=options.output,
        workers=options.workers,
        scheduler=options.scheduler,
        restart=options.restart,
        progress=progress,
    )
    if not options.quiet:
        for line in summary_lines(outcome):
            print(line)
        _repeat(outcome.warnings)
    return INCOMPLETE if outcome.failures else COMPLETE


def _repeat(warnings: Sequence[str]) -> None:
    """Repeat the warnings at the end, where they remain visible."""
    if not warnings:
        return
    count = len(warnings)
    print(
        f"sasmap: {count} warning{'s' if count > 1 else ''}: results may be wrong until "
        f"{'these are' if count > 1 else 'this is'} checked:",
        file=sys.stderr,
    )
    for line in warnings:
        print(f"sasmap: WARNING: {_readable(line)}", file=sys.stderr)


def _readable(line: str) -> str:
    """Escape characters that a terminal cannot show."""
    return line.encode("utf-8", "backslashreplace").decode()


def _plan(options: argparse.Namespace) -> int:
    from sasmap.run.cost import check_fits, describe_cost
    from sasmap.run.plan import describe, make_plan
    from sasmap.run.suggestion import describe_window

    _log(quiet=False)
    survey = load_survey(options.survey)
    if options.output is not None:
        survey = survey.model_copy(update={"output": str(options.output.absolute())})
    plan = make_plan(survey)
    for line in describe(plan):
        print(line)
    check_fits(plan, options.workers)
    for line in (*describe_window(plan), *describe_cost(plan, options.workers)):
        print(line)
    _repeat(plan.opened.warnings)
    return COMPLETE


def _simulate(options: argparse.Namespace) -> int:
    from sasmap.simulate import load_scene, simulate

    written = simulate(load_scene(options.scene), options.output)
    print(f"{len(written)} files in {options.output}")
    return COMPLETE


def _tiles(options: argparse.Namespace) -> int:
    from sasmap.survey.raw import make_tiles

    written, warnings = make_tiles(options.recording, options.output, options.crs, options.pixel)
    print(f"{len(written)} files in {options.output}; next: sasmap run {written[-1]}")
    _repeat(warnings)
    return COMPLETE


def _schema(options: argparse.Namespace) -> int:
    print(survey_schema())
    return COMPLETE


def _log(quiet: bool) -> None:
    """Print log messages; the log file in the output folder always holds all of them."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    handler.setLevel(logging.WARNING if quiet else logging.INFO)
    logger = logging.getLogger("sasmap")
    logger.handlers = [handler]
    logger.setLevel(logging.INFO)


def _completion(options: argparse.Namespace) -> int:
    from sasmap.completion import script

    print(script(_parser(), options.shell), end="")
    return COMPLETE


class _Progress:
    """A progress bar on a terminal, ten lines elsewhere: cells done, rate, time left.

    The rate is that of the latest cells: the first ones wait for compilation, and those finished by
    an earlier run take no time.
    """

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._stage, self._tenth = "", 0
        self._times: deque[float] = deque(maxlen=LATEST)

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage != self._stage:
            self._stage, self._tenth = stage, 0
            self._times.clear()
        self._times.append(time.monotonic())
        text = f"{stage}: {done} of {total} cells done{self._pace(done, total)}"
        if self._terminal:
            filled = 30 * done // total
            bar = "#" * filled + "." * (30 - filled)
            end = "\n" if done == total else ""
            print(f"\r[{bar}] {text}\033[K", end=end, file=sys.stderr, flush=True)
        elif 10 * done // total > self._tenth:
            self._tenth = 10 * done // total
            print(text, file=sys.stderr, flush=True)

    def _pace(self, done: int, total: int) -> str:
        seconds = self._times[-1] - self._times[0]
        if seconds < LEAST_PACED or done == total:
            return ""
        rate = (len(self._times) - 1) / seconds
        return f", {float(f'{rate:.3g}'):,g} a second, {duration((total - done) / rate)} left"


def _terminated(*_: object) -> None:
    """Interrupt the run, and again each second until the interrupt takes effect.

    Python drops an exception raised in one of its own callbacks, such as that of an import lock.
    """
    if not isinstance(sys.exc_info()[1], KeyboardInterrupt):  # otherwise the run is already ending
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
        raise KeyboardInterrupt("terminated")


def _share_heaps() -> bool:
    """Limit the heaps of threads, where the C library can; return whether it was done."""
    limit = getattr(ctypes.CDLL(None), "mallopt", None)
    return limit is not None and all(limit(*one) == 1 for one in HEAPS)


def console() -> None:
    """Run as a command; an interrupt does not wait for unfinished cells, which are discarded."""
    _share_heaps()
    # a batch system's signal ends the run in the same way as an interrupt
    signal.signal(signal.SIGTERM, _terminated)
    signal.signal(signal.SIGALRM, _terminated)
    status = main()
    if status == INTERRUPTED:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


if __name__ == "__main__":
    console()
