"""Random and mutated MAVLink bytes, and senseless commands: `python benchmarks/flight_fuzz.py [SECONDS] [FIRST_SEED]`.

The vehicle is where an operator would start the orbit, everything is in order, and motion is enabled: whatever comes,
nothing may move, and the bridge must still fly when it is over.  Both dialects by turns, every fourth pair signed.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from figures import write_figures

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Action, OperatorCommand, State
from lab.flights.orbit_loop import EPOCH_NS, LoopSettings, OrbitLoop, with_config

_ODD = [float("nan"), float("inf"), -float("inf"), 0.0, -0.0, -1e30, 1e30, 5.0, 1e-300, 3.4e38]
_BAD_RADIUS = [0.0, -5.0, 1e30, float("inf"), -float("inf"), 3.49, 100.1]
_BLOCK_S = 30.0
_KEY = bytes(range(32))


class Block(NamedTuple):
    """What one flight took, and whether it flew an orbit afterwards."""

    mutated: int
    random: int
    commands: int
    answers: int
    bad: int
    flew: bool


def fuzz(seed: int, key_file: Path, block_s: float = _BLOCK_S) -> Block:  # noqa: C901 - one disturbance after the other, of one chance
    """One block of simulated flight.

    Raises
    ------
    AssertionError
        When something moved.
    """
    chance = random.Random(seed)
    settings = LoopSettings(autopilot="px4" if seed % 2 else "ardupilot", seed=seed, seconds=block_s + 12)
    signed = seed % 8 > 5
    loop = OrbitLoop(with_config(settings, signing_key_file=str(key_file)) if signed else settings)
    if signed:
        loop.copter.use_key(_KEY, EPOCH_NS)
    loop.run(2.0)
    heard: list[bytes] = []
    read = loop.down.read
    counts = {"mutated": 0, "random": 0, "commands": 0}

    def listen() -> bytes:
        data = read()
        if 0 < len(data) <= 600:  # longer ones hold what was thrown in before, and would grow without end
            heard.append(data)
            del heard[:-60]
        return data

    loop.down.read = listen  # type: ignore[method-assign]

    def disturb(loop: OrbitLoop) -> None:
        for _ in range(8):
            if chance.random() < 0.6 and heard:
                packet = bytearray(chance.choice(heard))
                for _ in range(chance.randrange(1, 5)):
                    packet[chance.randrange(len(packet))] ^= 1 << chance.randrange(8)
                packet = packet[: chance.randrange(1, len(packet) + 1)]
                counts["mutated"] += 1
            else:
                packet = bytearray(chance.randbytes(chance.randrange(1, 400)))
                if chance.random() < 0.5:
                    packet[0] = chance.choice((0xFD, 0xFE))
                counts["random"] += 1
            loop.down.write(bytes(packet))
        for _ in range(4):
            kind = chance.choice([*range(4, 256), -1, 2**31])
            stamp_ns = chance.choice([0, 1, -1, 2**62, loop.clock_ns() - 3 * 10**9])
            loop.controller.command(OperatorCommand(kind, *(chance.choice(_ODD) for _ in range(3)), stamp_ns))
            bad = chance.choice(_BAD_RADIUS)
            loop.controller.command(OperatorCommand(chance.choice([1, 2, 3]), bad, *chance.choices(_ODD, k=2)))
            counts["commands"] += 2

    loop.run(block_s, disturb)
    moved = any(row.action != Action.NOTHING for row in loop.rows)
    if moved or "SET_POSITION_TARGET_LOCAL_NED" in loop.copter.received:
        raise AssertionError(f"seed {seed}: motion was commanded")
    if any(answer.accepted and answer.condition.code != ConditionCode.NOT_ORBITING for _, answer in loop.answers):
        raise AssertionError(f"seed {seed}: a command was obeyed: {loop.answers[-3:]}")
    answers, bad_count = len(loop.answers), loop.link.status().bad_count
    loop.start(4.0)
    loop.run(loop.t + 3.0)
    return Block(**counts, answers=answers, bad=bad_count, flew=loop.controller.safety.state == State.ORBITING)


def main() -> int:
    """Fuzz for the given seconds of real time and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", nargs="?", type=float, default=600.0)
    parser.add_argument("first_seed", nargs="?", type=int, default=0)
    args = parser.parse_args()
    begin, blocks = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        key_file = Path(folder) / "key"
        key_file.write_text(_KEY.hex())
        while time.monotonic() - begin < args.seconds:
            blocks.append(fuzz(args.first_seed + len(blocks), key_file))
    total = Block(*(sum(values) for values in zip(*blocks, strict=True)))
    last = args.first_seed + len(blocks) - 1
    summary = (
        f"{time.monotonic() - begin:.0f} s, seeds {args.first_seed} to {last}: "
        f"{total.mutated} mutated and {total.random} "
        f"random packets, {total.commands} commands ({total.answers} answered, each refused), {total.bad} pieces "
        f"of bad data counted, in {len(blocks)} flights of {_BLOCK_S:.0f} s: no crash, no motion; {total.flew} of "
        f"{len(blocks)} flew an orbit afterwards"
    )
    print(summary)
    write_figures("flight_fuzz", "Fuzzing of link and commands", f"Both dialects, every fourth pair signed. {summary}.")
    return 0 if total.flew == len(blocks) else 1


if __name__ == "__main__":
    raise SystemExit(main())
