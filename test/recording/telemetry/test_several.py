"""Logs of several vehicles, mounts or tracks: the one with most states is taken and named, another one by its name."""

import struct

import numpy as np
import pytest
from dataflash import write_dataflash_text
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from telemetry_logs import angles_of, wrapped, write_ulog

from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import quaternion_from_euler
from drocap_ros.recording.telemetry.log import Lack
from drocap_ros.recording.telemetry.read import read_telemetry

T = np.arange(0, 8, 0.1)


def angles(seed):
    return np.stack([0.1 * np.sin(T + seed), 0.05 * np.cos(T + seed), 0.1 * seed + 0.2 * T], axis=1)


def several_in(log):
    return [lack.detail for lack in log.lacks if lack.kind is Lack.SEVERAL]


def write_tlog(path, vehicles, gimbals=()):
    """Vehicles as (system, step, first place); gimbals as (system, component, pitch, step)."""
    links, out = {}, []

    def add(us, source, message):
        link = links.setdefault(source, mavlink.MAVLink(None, *source))
        out.append(struct.pack(">Q", us) + message.pack(link))

    for i, s in enumerate(T):
        us, ms = round((1_700_000_000 + s) * 1e6), round(1000 * (5 + s))
        add(us, (255, 190), mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        for system, step, first in vehicles:
            if i % step == 0 and i >= first:
                roll, pitch, yaw = angles(system)[i]
                add(us, (system, 1), mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
                place = mavlink.MAVLink_local_position_ned_message(ms, 10.0 * system, s, -2.0, 0, 1, 0)
                add(us, (system, 1), place)
                add(us, (system, 1), mavlink.MAVLink_attitude_message(ms, roll, pitch, yaw, 0, 0, 0))
        for system, component, tilt, step in gimbals:
            if i % step == 0:
                x, y, z, w = quaternion_from_euler(0.0, tilt, 0.0)
                status = mavlink.MAVLink_gimbal_device_attitude_status_message(1, 0, ms, 32, [w, x, y, z], 0, 0, 0, 0)
                add(us, (system, component), status)
    path.write_bytes(b"".join(out))
    return path


@pytest.mark.parametrize("vehicles", [
    [(1, 4, 0), (2, 1, 3)], [(2, 1, 0), (1, 4, 0)], [(7, 1, 10), (3, 3, 0), (9, 5, 0)],
    [(5, 1, 0), (4, 2, 0), (3, 2, 0), (2, 2, 0), (1, 2, 0)],
])  # fmt: skip
def test_the_vehicle_with_most_states_is_taken_and_another_by_its_name(tmp_path, vehicles):
    path = write_tlog(tmp_path / "x.tlog", vehicles)
    most = min(vehicles, key=lambda v: v[1])[0]
    log = read_telemetry(path)
    assert np.nanmedian(log.track.position[:, 1]) == pytest.approx(10 * most, abs=0.1)
    (words,) = several_in(log)
    assert f"{most} is used" in words
    assert all(f"{system} (" in words for system, _, _ in vehicles)
    for system, _, _ in vehicles:
        for name in (f"x.tlog#{system}", f"x.tlog#vehicle={system}"):
            other = read_telemetry(tmp_path / name)
            assert np.nanmedian(other.track.position[:, 1]) == pytest.approx(10 * system, abs=0.1)
    with pytest.raises(InputError, match="expected one of"):
        read_telemetry(tmp_path / "x.tlog#77")
    with pytest.raises(InputError, match="#vehicle=NAME or #mount=NAME"):
        read_telemetry(tmp_path / "x.tlog#gimbal=1")


@pytest.mark.parametrize("gimbals", [[(1, 154, -0.3, 2), (1, 171, -0.7, 1)], [(1, 171, -0.7, 1), (1, 154, -0.3, 1)],
                                     [(2, 154, -0.9, 1), (1, 172, -0.7, 2), (1, 154, -0.3, 3)]])  # fmt: skip
def test_one_of_several_gimbals_is_used(tmp_path, gimbals):
    path = write_tlog(tmp_path / "x.tlog", [(1, 1, 0)], gimbals)
    own = sorted((step, component, tilt) for system, component, tilt, step in gimbals if system == 1)
    log = read_telemetry(path)
    assert angles_of(log.track.gimbal)[20, 1] == pytest.approx(own[0][2], abs=1e-3)
    assert f"{own[0][1]} is used" in several_in(log)[0]
    for _, component, tilt in own:
        other = read_telemetry(tmp_path / f"x.tlog#mount={component}")
        assert angles_of(other.track.gimbal)[20, 1] == pytest.approx(tilt, abs=1e-3)


@pytest.mark.parametrize(("steps", "settings", "used"), [
    ((1, 1), [], 1), ((3, 1), [], 2), ((1, 2, 4), [], 1), ((1, 4), [("CAM1_MNT_INST", 2)], 2),
    ((1, 4), [("CAM1_MNT_INST", 0)], 1), ((1, 2), [("CAM1_MNT_INST", 9)], 1),
])  # fmt: skip
def test_text_logs_of_ardupilot_with_several_mounts(tmp_path, invented_flight, steps, settings, used):
    t, body, geodetic, mount = invented_flight
    mounts = [(mount + np.array([0, 0.2 * i, 0]), step) for i, step in enumerate(steps)]
    path = write_dataflash_text(tmp_path / "x.log", t, body, geodetic, mounts, settings)
    log = read_telemetry(path)
    assert wrapped(angles_of(log.track.orientation) - body).max() < 1e-5
    assert np.isfinite(log.track.position).all(axis=1).mean() > 0.9
    found = angles_of(log.track.gimbal)
    known = np.isfinite(found).all(axis=1)
    assert np.median(wrapped(found[known] - mounts[used - 1][0][known])) < 1e-3
    assert f"{used} is used" in several_in(log)[0]
    other = angles_of(read_telemetry(tmp_path / "x.log#2").track.gimbal)
    known = np.isfinite(other).all(axis=1)
    assert np.median(wrapped(other[known] - mounts[1][0][known])) < 1e-3


def ulog_of(path, gimbals, shifted=0):
    us = np.round(1e6 * (1 + T)).astype(int)

    def rows(values, step=1):
        return [(int(u), *(float(q) for q in row)) for u, row in zip(us[::step], values[::step], strict=True)]

    body = np.array([quaternion_from_euler(*a) for a in angles(1)])[:, [3, 0, 1, 2]]
    topics = [("vehicle_attitude", 0, "uint64_t timestamp;float[4] q;", "<Q4f", rows(body))]
    for number, (tilt, step) in enumerate(gimbals):
        q = np.tile(np.array(quaternion_from_euler(0.0, tilt, 0.0))[[3, 0, 1, 2]], (len(T), 1))
        data = [(*row, 32) for row in rows(q, step)]
        form = "uint64_t timestamp;float[4] q;uint16_t device_flags;"
        topics.append(("gimbal_device_attitude_status", number, form, "<Q4fH", data))
    return write_ulog(path, topics)


@pytest.mark.parametrize(
    ("gimbals", "used"), [([(-0.2, 1)], 0), ([(-0.2, 3), (-0.8, 1)], 1), ([(-0.2, 1), (-0.8, 1)], 0)]
)
def test_ulog_with_several_gimbals(tmp_path, gimbals, used):
    log = read_telemetry(ulog_of(tmp_path / "x.ulg", gimbals))
    assert angles_of(log.track.gimbal)[20, 1] == pytest.approx(gimbals[used][0], abs=1e-5)
    assert len(several_in(log)) == (len(gimbals) > 1)
    last = len(gimbals) - 1
    other = read_telemetry(tmp_path / f"x.ulg#{last}")
    assert angles_of(other.track.gimbal)[20, 1] == pytest.approx(gimbals[last][0], abs=1e-5)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_damage_of_a_ulog_is_told(tmp_path, share):
    path = ulog_of(tmp_path / "x.ulg", [(-0.2, 1)])
    assert not any(lack.kind is Lack.DAMAGED for lack in read_telemetry(path).lacks)
    data = bytearray(path.read_bytes())
    for k in range(40):
        data[int(share * len(data)) + 17 * k % 500] ^= 90
    path.write_bytes(data)
    log = read_telemetry(path)
    assert any(lack.kind is Lack.DAMAGED for lack in log.lacks)
    assert len(log.track.stamp_ns) > 0.5 * len(T)


def test_a_choice_of_a_log_without_several_is_refused(tmp_path):
    (tmp_path / "x.srt").write_text("1\n00:00:00,000 --> 00:00:00,033\n[rel_alt: 5.0] [gb_yaw: 1.0 gb_pitch: -9.0]\n")
    with pytest.raises(InputError, match="expected no choice after this log's name"):
        read_telemetry(tmp_path / "x.srt#2")
    read_telemetry(tmp_path / "x.srt")


@pytest.mark.parametrize("step", [1, 3])
@pytest.mark.parametrize("first", [True, False])
def test_places_are_those_of_one_receiver(tmp_path, invented_flight, step, first):
    t, body, geodetic, mount = invented_flight
    path = write_dataflash_text(tmp_path / "x.log", t, body, geodetic, [(mount, 1)])
    plain = read_telemetry(path).track.position
    lines = []
    for i, line in enumerate(path.read_text().splitlines()):
        words = line.split(", ")
        if words[0] == "FMT" and words[3] == "GPS":
            line = line.replace("QBIHLLf", "QBBIHLLf").replace("TimeUS,Status", "TimeUS,I,Status")
        if words[0] == "GPS":
            own = ", ".join([*words[:2], str(int(not first)), *words[2:]])
            far = [*words[:2], str(int(first)), *words[2:5], f"{float(words[5]) + 3e-5:.7f}", *words[6:]]
            both = [own] + [", ".join(far)] * (i % (2 * step) == 0)
            line = "\n".join(both if first else both[::-1])
        lines.append(line)
    path.write_text("\n".join(lines) + "\n")
    assert np.nanmax(np.abs(read_telemetry(path).track.position - plain)) < 0.02
