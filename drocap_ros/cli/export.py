"""``drocap export``: write a motion for Blender, OpenSim and other tools."""

from __future__ import annotations

import argparse
from pathlib import Path

from drocap_ros.cli.options import Subparsers, add_command, add_motion_argument, add_quiet_option, read_motion
from drocap_ros.errors import InputError
from drocap_ros.export import FORMATS


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    units = "; ".join(f"{form}: {facts}" for form, facts in FORMATS.items())
    parser = add_command(
        subparsers,
        "export",
        run,
        help="write a motion as BVH, USD, FBX, glTF, C3D, TRC or CSV, or its joint angles",
        description=f"Write a motion in the format of another tool. {units}. Conventions: docs/export.md.",
    )
    add_motion_argument(parser)
    parser.add_argument("--to", metavar="FORMAT", choices=tuple(FORMATS), required=True, help=", ".join(FORMATS))
    parser.add_argument("--out", metavar="FILE", type=Path, help="file to write (default: beside MOTION)")
    parser.add_argument(
        "--names",
        choices=("h36m", "lafan1", "mixamo", "mixamo-three"),
        help="joint names of bvh, glb, usd and fbx; mixamo-three: Mixamo's as three.js has them (default: h36m)",
    )
    parser.add_argument("--rest", choices=("t", "a"), help="rest pose of bvh, glb, usd and fbx: T or A (default: t)")
    parser.add_argument(
        "--smooth",
        metavar="HZ",
        type=float,
        nargs="?",
        const=6.0,
        help="low-pass filter, cut-off in Hz (6 without a number)",
    )
    parser.add_argument("--lock-feet", action="store_true", help="resting feet keep their place")
    add_quiet_option(parser, "no output, only errors")


def run(args: argparse.Namespace) -> int:
    """Export, of a folder of several persons each, and print the changes of the motion."""
    from drocap_ros.motion import people_files

    people = people_files(args.motion)
    if people and args.out:
        raise InputError(
            f"--out {args.out}: expected one motion, found persons {', '.join(map(str, people))}; name one"
        )
    for path in people.values() or [args.motion]:
        _export(args, path)
    return 0


def _export(args: argparse.Namespace, argument: Path) -> None:
    from drocap_ros.cli.atomic_output import output_file
    from drocap_ros.export import export

    path, motion = read_motion(argument)
    ending, *kind = args.to.split("-")
    out = args.out or path.with_suffix("".join(f".{word}" for word in (*kind, ending)))
    if out.suffix[1:] in {form.split("-")[0] for form in FORMATS} - {ending}:
        raise InputError(f"--out {out}: expected a name that ends in .{ending}, found {out.suffix}; change it or --to")
    with output_file(out, inputs=[path]) as file:
        notes = export(
            motion, file, args.to, names=args.names, rest=args.rest, smooth_hz=args.smooth, lock_feet=args.lock_feet
        )
        if (model := file.with_suffix(".osim")).exists():  # of --to mot
            model.replace(out.with_suffix(".osim"))
    if not args.quiet:
        print(f"written: {out} ({len(motion.joints)} joints, {FORMATS[args.to]})")
        for note in notes:
            print(f"  {note}")
