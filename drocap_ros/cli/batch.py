"""``drocap batch``: reconstruct many recordings; a second start goes on where the first one ended."""

from __future__ import annotations

import argparse
import contextlib
import copy
import fcntl
import glob
import itertools
import json
import re
import shlex
import shutil
import sys
import time
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.options import LineParser, Subparsers, add_command, add_quiet_option, clip_of
from drocap_ros.cli.reconstruct import add_options
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.cli.batch_recording import Record, Task


LOG_FILE, PAGE_FILE = "batch.jsonl", "summary.html"
#: Names of the temporary folders that killed processes leave.
_LEFT_OVER = re.compile(r"\.+[\w-]*-[0-9a-f]{16}\.\w+(\.\w+)?")


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "batch",
        run,
        help="many recordings, resumable, on one machine or a Dask cluster",
        description="Reconstruct each recording of INPUTS into a folder of its own in DIR. What is done is skipped, so"
        " that an interrupted batch goes on. DIR/batch.jsonl gets one line per recording, DIR/summary.html a table.",
    )
    parser.add_argument(
        "inputs",
        metavar="INPUTS",
        nargs="+",
        help="recordings, folders, patterns in quotes, or lists: .txt files with one recording per line, options of"
        " reconstruct after its path",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="output folder")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", metavar="N", type=int, default=1, help="recordings at a time (default: 1)")
    where.add_argument("--cluster", metavar="ADDRESS", help="Dask scheduler, for example tcp://10.0.0.5:8786")
    add_options(parser)
    add_quiet_option(parser)
    # SIGTERM ends the process and with it the recordings; an interrupt would wait for them.
    parser.set_defaults(interrupted_by=())


def run(args: argparse.Namespace) -> int:
    """Reconstruct what is not done yet; status 1 when a recording failed."""
    from drocap_ros.cli.atomic_output import check_output_folder
    from drocap_ros.cli.batch_recording import RECORD_FILE

    if args.jobs < 1:
        raise InputError(f"--jobs: expected at least 1, got {args.jobs}; correct the number")
    check_output_folder(args.out)
    tasks = _read_tasks(args)
    args.out.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()
    with _locked(args.out):
        _remove_left_overs(args.out)
        records, todo = _split(tasks, args.out)
        # A recording that was moved is found to be done by its bytes only.
        before = {path.parent.name for path in args.out.glob(f"*/{RECORD_FILE}")}
        _reconstruct(args, records, todo)
        _remove_left_overs(args.out)
    failures = [record for record in records if record["status"] != "done"]
    # The page has all failures.
    for record in failures[:10]:
        print(f"failed: {record['input']}: {record['error']}", file=sys.stderr)
    if not args.quiet:
        print(
            f"{len(tasks)} recording{'s' * (len(tasks) != 1)}: {len(records) - len(failures)} done,"
            f" {sum(record.get('folder') in before for record in records)} of them earlier,"
            f" {len(failures)} failed; {time.monotonic() - begin:.1f} s\n"
            f"written: {args.out}/{LOG_FILE}, {PAGE_FILE}"
        )
    return 1 if failures else 0


def _read_tasks(args: argparse.Namespace) -> list[Task]:
    """A task for each recording that the arguments name, each once."""
    from drocap_ros.cli.batch_recording import Task, content_digest, fingerprint, stat_digest, version

    options = argparse.ArgumentParser()
    add_options(options)
    defaults = argparse.Namespace(**{name: getattr(args, name) for name in vars(options.parse_args([]))})
    _check_files(defaults)
    shared = [value for value in vars(_resolved(defaults)).values() if isinstance(value, Path)]
    digests = {path: content_digest(path) for path in shared}
    current = version()
    tasks: dict[str, Task] = {}
    for arguments in map(_resolved, read_inputs(args.inputs, defaults)):
        key = fingerprint(arguments, current, stat_digest)
        tasks[key] = Task(arguments, args.out.absolute(), args.command_line, current, digests, key)
    return list(tasks.values())


def _check_files(defaults: argparse.Namespace) -> None:
    """Refuse options that no recording can have, and a missing file of one, before the work."""
    from drocap_ros.cli.reconstruct import attitude_of, with_known
    from drocap_ros.config import load_config
    from drocap_ros.recording.video_telemetry import NO_TELEMETRY

    for name, value in vars(defaults).items():
        if isinstance(value, Path) and name != "models" and value != NO_TELEMETRY and not value.exists():
            raise InputError(f"--{name} {value}: no such file; check the path")
    clip_of(defaults)
    attitude_of(defaults)
    with_known(load_config(defaults.config), defaults)


def _resolved(arguments: argparse.Namespace) -> argparse.Namespace:
    """Copy with absolute paths, and with the folder of models that ``reconstruct`` would use."""
    from drocap_ros.config import load_config
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.recording.video_telemetry import NO_TELEMETRY

    values = dict(vars(arguments))
    config = load_config(arguments.config)
    values["models"] = models_folder(arguments.models or config.pose_estimator.models_dir)
    relative = {k: v for k, v in values.items() if isinstance(v, Path) and v != NO_TELEMETRY}
    return argparse.Namespace(**values | {name: path.absolute() for name, path in relative.items()})


@contextlib.contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Hold the folder's lock; the end of the process, by SIGKILL too, releases it."""
    with (out / ".lock").open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"--out {out}: another batch is running there; wait, or choose another folder") from None
        yield


def _remove_left_overs(out: Path) -> None:
    for path in out.iterdir():
        if _LEFT_OVER.fullmatch(path.name):
            shutil.rmtree(path, ignore_errors=True)


def _split(tasks: list[Task], out: Path) -> tuple[list[Record], list[Task]]:
    """Records of the tasks that are done, from the log and the folders; the other tasks."""
    from drocap_ros.cli.batch_recording import RECORD_FILE

    logged: dict[str, Record] = {}
    if (out / LOG_FILE).exists():
        for line in (out / LOG_FILE).read_text(encoding="utf-8", errors="replace").splitlines():
            with contextlib.suppress(ValueError, KeyError, TypeError):  # a line that a kill cut off
                record = json.loads(line)
                logged[record["stat_key"]] = record
    done, todo = [], []
    for task in tasks:
        record = logged.get(task.stat_key, {})
        if record.get("status") == "done" and (out / str(record.get("folder")) / RECORD_FILE).is_file():
            done.append(record)
        else:
            todo.append(task)
    return done, todo


def _reconstruct(args: argparse.Namespace, records: list[Record], todo: list[Task]) -> None:
    """Run the tasks; their records are added to ``records``, to the log and, from time to time, to the page."""
    from drocap_ros.cli.atomic_output import output_file
    from drocap_ros.cli.batch_recording import run_on_cluster, run_on_this_machine, save_summary
    from drocap_ros.cli.running import progress_bars

    total = len(records) + len(todo)

    def save_page() -> float:
        with output_file(args.out / PAGE_FILE) as page:
            save_summary(page, records, total)
        return time.monotonic()

    with output_file(args.out / LOG_FILE) as log:
        log.write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")
    saved = save_page()
    run_tasks = run_on_cluster(todo, args.cluster) if args.cluster else run_on_this_machine(todo, args.jobs)
    try:
        with (
            progress_bars(args.quiet) as progress,
            (args.out / LOG_FILE).open("a", encoding="utf-8") as log,
            contextlib.closing(run_tasks) as results,
        ):
            for record in results if todo else ():
                log.write(json.dumps(record) + "\n")
                log.flush()
                records.append(record)
                progress("recordings", len(records) / total)
                # Period of the page while the batch runs, s (docs/batch.md).
                if time.monotonic() > saved + 60.0:
                    saved = save_page()
    finally:
        save_page()


#: Endings by which a folder's recordings are found; a recording that is named itself may end in anything.
_RECORDINGS = (
    ".npz", ".mcap", ".bag", ".db3",
    ".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".wmv", ".mjpeg",
)  # fmt: skip
_LIST = ".txt"
#: Folders in which systems keep small pictures and remains.
_OF_SYSTEMS = re.compile(r"@eaDir|__MACOSX|\$RECYCLE\.BIN|System Volume Information|lost\+found", re.IGNORECASE)


def read_inputs(words: Iterable[str], defaults: argparse.Namespace) -> list[argparse.Namespace]:
    """Arguments of ``drocap reconstruct``, one set per recording.

    words : lists (``.txt``), folders, glob patterns and recordings
    defaults : options of ``reconstruct``; a line of a list may change them
    """
    found: list[argparse.Namespace] = []
    for word in words:
        before = len(found)
        for path in [Path(word)] if Path(word).exists() else map(Path, sorted(glob.glob(word, recursive=True))):
            if path.suffix.lower() == _LIST and path.is_file():
                found += _read_list(path, defaults)
            else:
                found += [_arguments(each, defaults) for each in (_in_folder(path) if path.is_dir() else [path])]
        if len(found) == before:
            raise InputError(f"{word}: expected a list, folder, pattern or recording, found none; check the path")
    return found


def _arguments(recording: Path, defaults: argparse.Namespace) -> argparse.Namespace:
    arguments = copy.copy(defaults)
    arguments.input = recording
    return arguments


def _read_list(path: Path, defaults: argparse.Namespace) -> list[argparse.Namespace]:
    """One recording per line, with options of ``reconstruct`` after its path; ``#`` begins a comment line."""
    from drocap_ros.cli.reconstruct import add_options

    parser = LineParser("drocap reconstruct", add_help=False)
    parser.add_argument("input", type=Path)
    add_options(parser)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a text file with one recording per line; {error}") from None
    found = []
    for number, line in enumerate(map(str.strip, lines), 1):
        if not line or line.startswith("#"):
            continue
        if Path(line).exists():  # names with spaces need no quotes
            found.append(_arguments(Path(line), defaults))
            continue
        try:
            found.append(parser.parse_args(shlex.split(line), copy.copy(defaults)))
        except (ValueError, InputError) as error:
            raise InputError(f"{path}:{number}: expected a path and options of reconstruct; {error}") from None
    return found


def _in_folder(folder: Path) -> list[Path]:
    """Recordings at any depth; a session, or a folder of images alone, is one recording."""
    from drocap_ros.perception.sources.image_files import SUFFIXES as IMAGES
    from drocap_ros.recording.mcap.metadata import METADATA_FILE

    if (folder / METADATA_FILE).is_file():
        return [folder]
    entries = sorted(folder.glob("[!.]*"))
    folders = [p for p in entries if p.is_dir() and not p.is_symlink() and not _OF_SYSTEMS.fullmatch(p.name)]
    inside = list(itertools.chain.from_iterable(map(_in_folder, folders)))
    if (folder / "motion.npz").exists():  # the files are a result
        return inside
    files = _of_kinds(entries, _RECORDINGS)
    images_alone = not (files or folders) and _of_kinds(entries, IMAGES)
    return [folder] if images_alone else files + inside


def _of_kinds(entries: list[Path], suffixes: Collection[str]) -> list[Path]:
    return [path for path in entries if path.suffix.lower() in suffixes and path.is_file()]
