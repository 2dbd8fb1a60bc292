"""What holds the vehicle after the bridge's process has ended."""

import itertools
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.guardian import PACKETS, PERIOD_S, Guardian, GuardianProcess, has_left
from drocap_ros.flight.mavlink.transport import open_transport

#: A bridge that hands over its hold, and ends as its last argument says; the first ones happen before.
_BRIDGE = """
import os, signal, sys, time
from pathlib import Path
from drocap_ros.flight.mavlink.guardian import GuardianProcess
from drocap_ros.flight.mavlink.transport import open_transport

transport = open_transport(sys.argv[1])
transport.write(b"orbit")
guardian = GuardianProcess(0.2)
child = int(Path(f"/proc/self/task/{os.getpid()}/children").read_text())
before, end = sys.argv[2:-1], sys.argv[-1]
if "stands" in before:
    os.kill(child, signal.SIGSTOP)
    print(child, flush=True)
for i in range(20):
    guardian.take([b"hold %d %d" % (i, n) for n in range(8)], (1, 1, 4), transport)
    time.sleep(0.02)
if "idle" in before:
    guardian.take([], (1, 1, 4), transport)
if "asked to end" in before:
    ignored = lambda: int(Path(f"/proc/{child}/status").read_text().split("SigIgn:")[1].split()[0], 16)
    while not ignored() >> signal.SIGTERM - 1 & 1:  # until it has started
        guardian.take([b"hold 19 %d" % n for n in range(8)], (1, 1, 4), transport)
        time.sleep(0.02)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        os.kill(child, number)
if end == "close":
    guardian.close()
else:
    os.kill(os.getpid(), getattr(signal, end))
"""
_STEP_S = 0.02


def sent(guardian, from_s, to_s):
    """(times, packets) that are due between, looked for as the process does."""
    steps = [from_s + _STEP_S * i for i in range(round((to_s - from_s) / _STEP_S))]
    found = [(t, packet) for t in steps if (packet := guardian.due(t)) is not None]
    return [t for t, _ in found], [packet for _, packet in found]


CONTROL = (1, 1, 4)  # ArduPilot's GUIDED
HOLD = [bytes([i]) for i in range(PACKETS)]


@pytest.mark.parametrize(("ended", "after_s"), [(True, 0.0), (False, 0.2)])
def test_packets_are_sent_once_the_bridge_has_ended_or_is_silent(ended, after_s):
    guardian = Guardian(0.2)
    for i in range(20):
        guardian.take(0.05 * i, HOLD)
        assert sent(guardian, 0.05 * i, 0.05 * i + 0.04) == ([], [])
    guardian.ended = ended
    times, packets = sent(guardian, 1.0, 6.0)
    assert packets == HOLD
    assert times[0] == pytest.approx(max(1.0, 0.95 + after_s), abs=2 * _STEP_S)
    assert max(b - a for a, b in itertools.pairwise(times)) < PERIOD_S + 1.5 * _STEP_S
    assert not guardian.armed


@pytest.mark.parametrize("ended", [True, False])
@pytest.mark.parametrize("packets", [HOLD, []], ids=["orbit", "idle"])
def test_nothing_is_sent_by_one_that_stood_still_itself_or_where_nothing_was_commanded(packets, ended):
    guardian = Guardian(0.2)
    guardian.due(0.98)
    guardian.take(1.0, packets)
    guardian.ended = ended
    assert sent(guardian, 1.0 if not packets else 3.0, 6.0) == ([], [])
    guardian.take(6.0, HOLD)
    assert sent(guardian, 6.0, 8.0)[1] == HOLD  # the next step of an orbit arms it again


@pytest.fixture
def vehicle():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        port.settimeout(20.0)
        yield port


def heard(vehicle, quiet_s):
    """(packet, sender) until nothing has come for so long."""
    found = [vehicle.recvfrom(100)]
    while select.select([vehicle], [], [], quiet_s)[0]:
        found.append(vehicle.recvfrom(100))
    return found


def bridge(vehicle, *end):
    url = f"udpout:127.0.0.1:{vehicle.getsockname()[1]}"
    return subprocess.Popen([sys.executable, "-c", _BRIDGE, url, *end], stdout=subprocess.PIPE)


@pytest.mark.parametrize(
    "end", [("SIGKILL",), ("asked to end", "SIGKILL"), ("close",)], ids=["killed", "service stopped", "orbit not ended"]
)
def test_a_bridge_that_ends_in_an_orbit_holds_by_its_own_port_and_gives_it_up(vehicle, end):
    with bridge(vehicle, *end):
        found = heard(vehicle, 3.0)
    packets, senders = zip(*found, strict=True)
    assert packets == (b"orbit", *(b"hold 19 %d" % n for n in range(PACKETS)))
    assert len(set(senders)) == 1  # the autopilot answers to the port that it knows
    open_transport(f"udpin:0.0.0.0:{senders[0][1]}").close()


def heartbeat(custom_mode, system=1, component=1):
    encoder = mavlink.MAVLink(None, system, component)
    kind, autopilot = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    return encoder.heartbeat_encode(kind, autopilot, 81, custom_mode, mavlink.MAV_STATE_ACTIVE).pack(encoder)


def test_the_vehicles_own_heartbeat_alone_shows_that_the_pilot_has_taken_over():
    others = heartbeat(5, system=2) + heartbeat(0, component=154) + b"\xfd" + bytes(8) + heartbeat(4)
    assert not has_left(others, CONTROL)
    for mode in (5, 0, 4 + 256):
        assert has_left(others + heartbeat(mode) + others, CONTROL)
        assert not has_left(others + heartbeat(mode)[:-11], CONTROL)  # its rest has not come


def test_nothing_is_sent_into_the_pilots_mode(vehicle):
    with bridge(vehicle, "SIGKILL"):
        found = [vehicle.recvfrom(100) for _ in range(3)]
        vehicle.sendto(heartbeat(4), found[0][1])
        found.append(vehicle.recvfrom(100))
        vehicle.sendto(heartbeat(5), found[0][1])
        time.sleep(2 * _STEP_S)
        while select.select([vehicle], [], [], 2 * PERIOD_S)[0]:
            found.append(vehicle.recvfrom(100))
    assert [packet for packet, _ in found][:4] == [b"orbit", *(b"hold 19 %d" % n for n in range(3))]
    assert len(found) < PACKETS  # one may have been on its way


def test_a_bridge_that_starts_at_once_waits_for_the_port(vehicle):
    with bridge(vehicle, "SIGKILL"):
        packets = [vehicle.recvfrom(100) for _ in range(2)]  # the guardian has begun
    open_transport(f"udpin:0.0.0.0:{packets[0][1][1]}").close()


def test_a_stopped_bridge_holds(vehicle):
    with bridge(vehicle, "SIGSTOP") as process:
        packets = [packet for packet, _ in heard(vehicle, 3.0)]
        os.kill(process.pid, signal.SIGKILL)
    assert packets == [b"orbit", *(b"hold 19 %d" % n for n in range(PACKETS))]
    assert not select.select([vehicle], [], [], 1.0)[0]


def test_what_waited_for_a_guardian_that_stood_is_not_sent(vehicle):
    """Neither where the bridge has died meanwhile, nor later."""
    with bridge(vehicle, "stands", "SIGKILL") as process:
        guardian = int(process.stdout.readline())
        process.wait()
        time.sleep(0.6)
        os.kill(guardian, signal.SIGCONT)
        assert [packet for packet, _ in heard(vehicle, 3.0)] == [b"orbit"]


@pytest.mark.parametrize("end", ["SIGKILL", "close"])
def test_a_bridge_that_commands_nothing_ends_without_a_word(vehicle, end):
    with bridge(vehicle, "idle", end):
        assert [packet for packet, _ in heard(vehicle, 2.0)] == [b"orbit"]


def child():
    """The process of this process' guardian, which was started last; other tests may have left children."""
    return int(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()[-1])


@pytest.fixture
def pipe():
    read, write = os.pipe()
    yield read, SimpleNamespace(port=lambda: (write, None))
    os.close(read)
    os.close(write)


def holds(guardian, read, transport):
    """Whether it sends what it was given last."""
    for _ in range(20):  # until it has started: what waited for it is not sent
        guardian.take([b"hold"], CONTROL, transport)
        if select.select([read], [], [], 1.0)[0]:
            return os.read(read, 100) == b"hold"
    return False


def test_a_port_without_datagrams_is_shared_too(pipe):
    guardian = GuardianProcess(0.2)
    assert holds(guardian, *pipe)
    guardian.close()


def test_a_guardian_that_was_killed_is_started_again(pipe, caplog):
    guardian = GuardianProcess(0.2)
    guardian.revive()
    assert not caplog.records
    os.kill(killed := child(), signal.SIGKILL)
    os.waitid(os.P_PID, killed, os.WEXITED | os.WNOWAIT)
    guardian.take([b"hold"], CONTROL, pipe[1])
    guardian.revive()
    assert "ended with status -9: started again" in caplog.text
    assert holds(guardian, *pipe)
    guardian.close()


def test_a_guardian_that_stands_does_not_keep_the_port(pipe):
    guardian = GuardianProcess(0.2)
    guardian.take([b"hold"], CONTROL, pipe[1])
    os.kill(stands := child(), signal.SIGSTOP)
    guardian.close()
    assert not Path(f"/proc/{stands}").exists()


def test_a_port_that_is_gone_does_not_stop_the_bridge(pipe):
    """A device that was pulled out: its driver's port has no descriptor, and raises."""

    def port():
        raise OSError("port is not open")

    guardian, gone = GuardianProcess(0.2), SimpleNamespace(port=port)
    guardian.take([b"hold"], CONTROL, pipe[1])
    guardian.take([b"hold"], CONTROL, gone)
    guardian.take([], CONTROL, gone)
    guardian.close()


def test_a_guardian_without_an_order_waits_without_looking():
    guardian = GuardianProcess(0.2)

    def switches():
        """How often it has gone to sleep."""
        status = Path(f"/proc/{child()}/status").read_text()
        return int(re.search(r"^voluntary_ctxt_switches:\s*(\d+)", status, re.MULTILINE)[1])

    before = -1
    while before != (before := switches()):  # until it has started
        time.sleep(0.5)
    guardian.close()
