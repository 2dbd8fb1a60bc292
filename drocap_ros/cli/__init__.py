"""The ``drocap`` command: one module per subcommand, each with ``add_parser`` and ``run``."""

from __future__ import annotations

import argparse
import errno
import importlib
import logging
import os
import shlex
import sys
import threading
from collections.abc import Sequence

from drocap_ros import __version__
from drocap_ros.cli.options import LineParser
from drocap_ros.cli.running import BOTH, interruptible
from drocap_ros.errors import DrocapError, InputError

#: Modules under ``drocap_ros.cli`` by what a user wants, in the order of ``drocap --help``.
COMMANDS = {
    "a video to a motion": ("app", "reconstruct", "export", "report", "view", "sample", "track", "batch"),
    "a flight": (
        *("graph.preflight", "graph.live", "graph.station", "graph.orbit", "graph.top"),
        *("graph.record", "graph.replay", "recover", "demo.command"),
    ),
    "files, networks, figures": ("info", "models", "calibrate", "evaluate"),
}


class _PrintCompletion(argparse.Action):
    """Prints what a shell reads to complete the commands, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, _: object, values: object, __: str | None = None) -> None:
        """As of argparse."""
        try:
            from argcomplete.shell_integration import shellcode
        except ImportError:
            raise InputError("--completion: expected argcomplete, found none; run pip install argcomplete") from None
        print(shellcode(["drocap"], shell=str(values)))
        parser.exit()


def build_parser() -> LineParser:
    """Parser of the whole command line."""
    parser = LineParser(
        prog="drocap",
        usage="drocap COMMAND ... (drocap COMMAND --help: its options)",
        description="Human motion capture with one drone: 3D motion of a person from the video of an orbiting camera.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"drocap {__version__}")
    parser.add_argument(
        "--completion",
        action=_PrintCompletion,
        choices=("bash", "zsh", "fish"),
        help='completion by the Tab key; into ~/.bashrc: eval "$(drocap --completion bash)"',
    )
    subparsers = parser.add_subparsers(
        prog="drocap", dest="command", metavar="COMMAND", required=True, help=argparse.SUPPRESS
    )
    lines = []
    for group, names in COMMANDS.items():
        before = len(subparsers.choices)
        for name in names:
            importlib.import_module(f"drocap_ros.cli.{name}").add_parser(subparsers)
        helps = [f"  {action.dest:<12}{action.help}" for action in subparsers._choices_actions[before:]]
        lines += [f"{group}:", *helps, ""]
    status = "Exit status: 0 done, 2 the input or the options cannot be used, 130 interrupted, 1 anything else."
    parser.epilog = "\n".join([*lines, status])
    return parser


def main(argv: Sequence[str] | None = None, parser: LineParser | None = None) -> int:
    """Run the command line, or another one by its parser; returns the exit status."""
    logging.basicConfig(level=logging.WARNING, format="drocap: %(message)s")
    words = sys.argv[1:] if argv is None else list(argv)
    # The commands' own threads share the processors; OpenCV's, which wait spinning, took a tenth more time of them.
    os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")
    _open_closed_streams()
    interrupted = threading.Event()
    try:
        parser = parser or build_parser()
        if "_ARGCOMPLETE" in os.environ:  # the shell asks, by what --completion printed
            import argcomplete

            argcomplete.autocomplete(parser)
        if not words:
            parser.print_help()
            return 0
        args = parser.parse_args(words)
        args.command_line = shlex.join(["drocap", *words])
        # The networks' own words are no warning about an input.
        words_of_networks = logging.ERROR if getattr(args, "quiet", False) else logging.NOTSET
        logging.getLogger("drocap_ros.perception.estimator.networks").setLevel(words_of_networks)
        with interruptible(getattr(args, "interrupted_by", BOTH)) as interrupted:
            status: int = args.run(args)
        sys.stdout.flush()
        return status
    except DrocapError as error:
        print(f"drocap: {_one_line(error)}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:
        # The reader closed the pipe (`drocap ... | head`): no failure.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        # A signal to the whole group ends worker processes, too, and a library may complain of that first.
        if interrupted.is_set():
            return _interrupted()
        if os.environ.get("DROCAP_DEBUG"):
            raise
        return _unexpected(error)


def _open_closed_streams() -> None:
    """Streams that the shell closed (>&-) lead nowhere; else the next file opened would take their number."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - it stays open as long as the program


def _unexpected(error: Exception) -> int:
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        print(f"drocap: expected space on the disk, found none: {_one_line(error)}; free some", file=sys.stderr)
    else:
        what = f"unexpected {type(error).__name__}: {_one_line(error)}"
        print(f"drocap: {what}; DROCAP_DEBUG=1 shows where", file=sys.stderr)
    return 1


def _interrupted() -> int:
    print("drocap: interrupted", file=sys.stderr)
    return 130


def _one_line(error: Exception) -> str:
    return " ".join(str(error).splitlines())  # a file's name may have a line break
