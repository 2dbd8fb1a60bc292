"""Random and mutated MAVLink bytes, and senseless commands: `python benchmarks/flight_fuzz.py [SECONDS]`.

The vehicle is in GUIDED or OFFBOARD with everything in order, and motion is enabled: whatever comes, nothing may
move, and the bridge must still fly when it is over.
"""

from __future__ import annotations

import random
import sys
import time

from drocap_ros.flight.orbit_controller import OperatorCommand
from drocap_ros.flight.safety import Action, State
from drocap_ros.simulation.orbit_loop import LoopSettings, OrbitLoop

_ODD = [float("nan"), float("inf"), -float("inf"), 0.0, -1e30, 1e30, 5.0, 1e-300]
_BLOCK_S = 30.0


def fuzz(seed: int) -> tuple[int, int, bool]:
    """One block of simulated flight: packets, commands, and whether it still flies at the end."""
    chance = random.Random(seed)
    loop = OrbitLoop(LoopSettings(autopilot="ardupilot", seed=seed, seconds=_BLOCK_S + 12))
    loop.run(2.0)
    heard: list[bytes] = []
    read = loop.down.read
    counts = [0, 0]

    def listen() -> bytes:
        data = read()
        if data:
            heard.append(data)
            del heard[:-60]
        return data

    loop.down.read = listen

    def disturb(loop: OrbitLoop) -> None:
        for _ in range(8):
            if chance.random() < 0.6 and heard:
                packet = bytearray(chance.choice(heard))
                for _ in range(chance.randrange(1, 5)):
                    packet[chance.randrange(len(packet))] ^= 1 << chance.randrange(8)
                packet = packet[: chance.randrange(1, len(packet) + 1)]
            else:
                packet = bytearray(chance.randbytes(chance.randrange(1, 400)))
            loop.down.write(bytes(packet))
            counts[0] += 1
        for _ in range(4):
            kind = chance.choice([*range(4, 256), -1, 2**31])
            loop.controller.command(OperatorCommand(kind, *(chance.choice(_ODD) for _ in range(3))))
            bad = chance.choice([0.0, -5.0, 1e30, float("inf")])
            loop.controller.command(OperatorCommand(chance.choice([1, 2, 3]), radius_m=bad))
            counts[1] += 2

    loop.run(_BLOCK_S, disturb)
    moved = any(row.action != Action.NOTHING for row in loop.rows)
    if moved or "SET_POSITION_TARGET_LOCAL_NED" in loop.copter.received:
        raise AssertionError(f"seed {seed}: motion was commanded")
    loop.start(4.0)
    loop.run(loop.t + 3.0)
    return counts[0], counts[1], loop.controller.safety.state == State.ORBITING


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 600.0
    begin, packets, commands, blocks, well = time.monotonic(), 0, 0, 0, 0
    while time.monotonic() - begin < seconds:
        more = fuzz(blocks)
        packets, commands, blocks, well = packets + more[0], commands + more[1], blocks + 1, well + more[2]
    print(
        f"{seconds:.0f} s: {packets} packets and {commands} commands in {blocks} flights of {_BLOCK_S:.0f} s: "
        f"no crash, no motion; {well} of {blocks} flew an orbit afterwards"
    )
    return 0 if well == blocks else 1


if __name__ == "__main__":
    raise SystemExit(main())
